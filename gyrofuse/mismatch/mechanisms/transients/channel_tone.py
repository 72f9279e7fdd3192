"""Tones whose frequencies follow an auxiliary channel: a motor's command, its speed, a supply voltage."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse._base.results import readable
from gyrofuse.mismatch.detectors.moving.channel_tracks import channel_track
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_tone import DriftingTone
from gyrofuse.mismatch.mechanisms.transients.channel_line import ChannelLine
from gyrofuse.mismatch.mechanisms.transients.transient import Transient, kept_of
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class ChannelTone(Transient):
    """Lines along the rows of a channel, and along one of them at several multiples: motors, and what turns with them.

    In another recording, of another course of the channel, their amplitudes are steady and their phases others.

    Attributes:
        lines: In the order in which they were found.
    """

    name: ClassVar[str] = DriftingTone.name
    separated_by: ClassVar[str] = DriftingTone.separated_by
    lines: tuple[ChannelLine, ...]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found = _strongest(comparison, level)
        if found is None:
            return None
        (p_value, first), rounds = found, 3
        lines, told = [first], 0
        for _ in range(rounds):  # lines near each other are told apart once each is fitted beside the others
            lines = _with_others(comparison, lines, level)
            if len(lines) == told:
                break
            lines = _beside_each_other(comparison, lines)
            told = len(lines)
        lines = [line for k, line in enumerate(lines) if _gains(comparison, line, [*lines[:k], *lines[k + 1 :]])]
        return cls(tuple(lines))._found(comparison, p_value) if lines else None

    def _found(self, comparison: Comparison, p_value: float) -> Finding | None:
        info, n = comparison.info, comparison.n_samples
        there, parameters = set[int](), dict[str, Parameter]()
        for k, line in enumerate(self.lines):
            suffix = f"_{k + 1}" if k else ""
            frequency, slope = line.limits(comparison)
            parameters |= {f"frequency{suffix}": frequency, f"slope{suffix}": slope}
            sd, size = line.size_sd(comparison), line.size(comparison)
            own = line.sensors
            there |= set(own)
            for i in own if not k else [int(size.argmax())]:
                a, reach = float(size[i]), Z * float(sd[i])
                parameters[f"amplitude{suffix}[{i}]"] = Parameter.around(a, reach, info.measure, least=0.0)
        ends = torch.stack([torch.stack([f.min(), f.max()]) for f in (one.frequencies(info, n) for one in self.lines)])
        sensors, first = tuple(sorted(there)), self.lines[0]
        sizes = torch.stack([line.size(comparison) for line in self.lines])
        loudest = int(sizes.amax(0).argmax())
        several = len(info.channel_rows(first.channel)) > 1
        laws = "; ".join(f"{f'row {line.row + 1}: ' * several}{line.law}" for line in self.lines)
        tones = "a tone whose frequency follows" if len(ends) == 1 else f"{len(ends)} tones whose frequencies follow"
        return self.found(
            f"{tones} {readable(first.channel)}, {laws}; from {float(ends.min()):.4g} Hz to "
            f"{float(ends.max()):.4g} Hz, in {info.named(sensors, 'all sensors')}, of amplitude up to "
            f"{float(sizes.max()):.3g} {info.measure} (sensor {info.sensors[loudest]}), that the simulation does not "
            "have",
            p_value,
            sensors,
            parameters,
            levels=tuple(sorted({level_of(max(float(f) / info.rate, 1 / n)) for f in ends.flatten()})),
            channel=first.channel,
            frequency_hz=first.middle_hz,
            gain=self.gained(comparison, sum(line.numbers for line in self.lines)),
        )

    def path_along(self, info: RecordingInfo, n_samples: int) -> Tensor:
        return torch.stack([line.path(info, n_samples) for line in self.lines]).sum(0)

    @property
    def follows(self) -> tuple[str, ...]:
        return tuple(sorted({line.channel for line in self.lines}))

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        """Along the channel as it is there, in other phases for each record."""
        records, n = signal.reshape(-1, *signal.shape[-2:]), signal.shape[-1]
        turns = 2 * math.pi * torch.rand(len(records), len(self.lines), generator=generator, dtype=torch.float64)
        drawn = [
            record + sum(line.drawn(info, n, turn) for line, turn in zip(self.lines, own, strict=True))
            for record, own in zip(records, turns.tolist(), strict=True)
        ]
        return torch.stack(drawn).view_as(signal)

    def fit_without(self, comparison: Comparison, fold: int) -> ChannelTone:
        """Amplitudes anew, of each line beside the others."""
        keep, lines = kept_of(comparison.n_samples, fold), list(self.lines)
        for k, line in enumerate(lines):
            beside = _beside(comparison, [*lines[:k], *lines[k + 1 :]])
            lines[k] = line.fitted(beside, len(line.cosine), keep).of_sensors(line.cosine.any(0) | line.sine.any(0))
        return replace(self, lines=tuple(lines))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        courses = [line.frequencies(comparison.info, comparison.n_samples) for line in self.lines]
        low, high = min(float(f.min()) for f in courses), max(float(f.max()) for f in courses)
        gap = torch.full((1,), math.nan, dtype=torch.float64)  # between one line and the next
        seconds = torch.cat([comparison.info.seconds(comparison.n_samples), gap])
        lines = torch.cat([torch.cat([f, gap]) for f in courses])
        track = (seconds.repeat(len(courses))[:-1], lines[:-1]) if fitted else None
        window = 256 / comparison.info.rate
        pictures.spectrogram(ax, comparison, sensor, (low - (high - low) / 4, high + (high - low) / 4), window, track)


def _strongest(comparison: Comparison, level: float, channel: str | None = None) -> tuple[float, ChannelLine] | None:
    """The strongest line, in the sensors that have it, and its p value; along one channel if it is given."""
    track = channel_track(comparison)
    if track is None or track.p_value > level or (channel is not None and track.channel != channel):
        return None
    line = ChannelLine.followed(comparison, track)
    line = _where_it_is(comparison, line)
    return (track.p_value, line) if _gains(comparison, line, []) else None


def _with_others(comparison: Comparison, lines: list[ChannelLine], level: float) -> list[ChannelLine]:
    """Lines, and those along the same channel that are found once these are taken off."""
    lines, most = list(lines), 12
    while len(lines) < most:
        more = _strongest(_beside(comparison, lines), level, lines[0].channel)
        if more is None:
            break
        lines.append(more[1])
    return lines


def _beside_each_other(comparison: Comparison, lines: list[ChannelLine]) -> list[ChannelLine]:
    """Lines each fitted anew beside the others, until none needs other knots."""
    most = 6
    lines = [line for k, line in enumerate(lines) if not any(line.is_near(one, comparison) for one in lines[:k])]
    for _ in range(most if len(lines) > 1 else 0):
        knots = [len(line.cosine) for line in lines]
        for k, line in enumerate(lines):
            left = _beside(comparison, [*lines[:k], *lines[k + 1 :]])
            lines[k] = _where_it_is(left, line.refitted(left))
        if [len(line.cosine) for line in lines] == knots:
            break
    return lines


def _where_it_is(comparison: Comparison, line: ChannelLine) -> ChannelLine:
    """In the sensors that have it."""
    square = (line.size(comparison) / line.size_sd(comparison)).square()
    return line.of_sensors(included_sensors(square, 2).which)


def _gains(comparison: Comparison, line: ChannelLine, others: list[ChannelLine]) -> bool:
    """Whether a line explains more beside others than its numbers cost."""
    return line.gain(_beside(comparison, others)) > line.cost()


def _beside(comparison: Comparison, lines: list[ChannelLine]) -> Comparison:
    """The comparison without lines."""
    if not lines:
        return comparison
    paths = [line.path(comparison.info, comparison.n_samples) for line in lines]
    return comparison.subtract(torch.stack(paths).sum(0))
