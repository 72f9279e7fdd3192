"""Responses of the sensors to channels: what moves a device reaches each sensor in a way of its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.channels import accelerations, rates, regress
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.likelihoods.finite_response import (
    FiniteResponse,
    ResponseSums,
    path_gains,
    responded,
    response_at,
)
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.known_path import KnownPath
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import sidak

_REACHES = (2, 8)  # samples either way
_SIMPLER = 0.02  # share of the score that more numbers have to add, to responses of fewer and to plain gains


@dataclass(frozen=True, eq=False)
class ChannelTransfer(KnownPath):
    """`x_i(t) = sum_k sum_l taps_ikl a_k(t - l)`, `l` from `-L` to `L`, over the rows `a` of auxiliary channels.

    A scale factor, a misalignment, a delay and a sensitivity to acceleration are cases of it, which are preferred where
    they explain as much: they have one gain at all frequencies, or one response for all sensors. It has no rival among
    spectra: what noise predicts of samples held out is nothing, and much where a channel was left out.

    Attributes:
        channels: Names of the channels, in the order of their rows.
        taps: `(sensor, row, lag)`, signal per unit of a row.
    """

    name: ClassVar[str] = "channel_transfer"
    separated_by: ClassVar[str] = "a recording with another motion"
    channels: tuple[str, ...]
    taps: Annotated[Tensor, Dims(("sensor", "row", "lag"))]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        best = _best(comparison)
        if best is None or best.p_value > level:
            return None
        info, rate = comparison.info, comparison.info.rate
        fit = _sums(comparison).solved(best.rows, best.reach)
        has = best.scores > 2 * math.log(comparison.n_sensors + 1)  # nats held out
        sensors = tuple(has.nonzero()[:, 0].tolist())
        taps = fit.taps * has[:, None, None]
        effect = cls(best.channels, taps)
        if not sensors or _of_one_band(comparison, effect):
            return None
        rows, names = _rows(info, best.channels, comparison.n_samples), _row_names(info, best.channels)
        f = _busiest(comparison, taps, rows)
        size = response_at(taps, f).abs() * rows.std(-1)  # (sensor, row): who contributes most
        parameters = {}
        for i in sensors:
            k = int(size[i].argmax())
            parameters[f"gain[{i}]"], parameters[f"delay[{i}]"] = _gain_and_delay(fit, i, k, f, info, names[k])
        i = max(sensors, key=lambda i: float(size[i].max()))
        gain, delay = parameters[f"gain[{i}]"], parameters[f"delay[{i}]"]
        late = f"{abs(delay.value):.3g} ms {'late' if delay.value > 0 else 'early'}"
        return effect.found(
            f"the output of {info.named(sensors, 'every sensor')} follows {' and '.join(best.channels)} with responses "
            f"of {2 * best.reach + 1} samples, each sensor with its own: near {f * rate:.3g} Hz most of all sensor "
            f"{info.sensors[i]} follows {names[int(size[i].argmax())]} by {gain.value:.3g} {gain.unit}, {late}",
            best.p_value,
            sensors,
            parameters,
            levels=(level_of(max(f, 1 / comparison.n_samples)),),
            channel=" and ".join(best.channels),
            gain=best.total / 2 if best.simple else best.total,
        )

    @property
    def follows(self) -> tuple[str, ...]:
        return self.channels

    @property
    def amplitudes(self) -> Tensor:
        return self.taps.flatten(1)

    def with_amplitudes(self, amplitudes: Tensor) -> ChannelTransfer:
        return replace(self, taps=amplitudes.view_as(self.taps))

    def fit_without(self, comparison: Comparison, fold: int) -> ChannelTransfer:
        places = _places(comparison, self.channels)
        found = _sums(comparison).solved(places, self.taps.shape[-1] // 2, fold)
        return replace(self, taps=torch.where(self.taps != 0, found.taps, 0.0))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        """In the noise that it leaves: where a channel was left out, the simulation's is no measure of what remains."""
        return path_gains(comparison, self._path(comparison.info, comparison.n_samples), fold)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        path = self._path(comparison.info, comparison.n_samples)[sensor]
        label = f"what follows {' and '.join(self.channels)}, as fitted"
        pictures.gain_on_channel(ax, comparison, sensor, path, label)

    def _path(self, info: RecordingInfo, n_samples: int) -> Tensor:
        return responded(self.taps, _rows(info, self.channels, n_samples))


class _Candidate(NamedTuple):
    """Channels and a reach.

    Attributes:
        channels: Names.
        rows: Places of their rows among those of all channels.
        reach: Samples either way.
        scores: Log likelihood ratios held out, `(sensor,)`, nats.
        p_value: For having asked all candidates.
        simple: Whether plain gains, or one response that all sensors share, do as well: these have names of their own,
            which are preferred.
    """

    channels: tuple[str, ...]
    rows: list[int]
    reach: int
    scores: Tensor
    p_value: float
    simple: bool = False

    @property
    def total(self) -> float:
        """Score of the sensors that gain."""
        return float(self.scores.clamp(min=0).sum())


@derived
def _best(comparison: Comparison) -> _Candidate | None:
    """The fewest numbers that explain all but a little of what any explain; None where nothing follows a channel."""
    names = _moving(comparison)
    if not any(_worth_a_response(comparison, name) for name in names):
        return None
    sums, tried = _sums(comparison), []
    sets = [(name,) for name in names] + ([tuple(names)] if len(names) > 1 else [])
    for channels in sets:
        rows = _places(comparison, channels)
        for reach in _REACHES:
            scores = sums.held_out(rows, reach)
            # The mean of e-values of folds and sensors is one.
            log_e = float(scores.flatten().logsumexp(0)) - math.log(scores.numel())
            p_value = sidak(math.exp(min(-log_e, 0.0)), len(sets) * len(_REACHES))
            tried.append(_Candidate(channels, rows, reach, scores.sum(0), p_value))

    least = (1 - _SIMPLER) * max(one.total for one in tried)
    best = min((one for one in tried if one.total >= least), key=lambda one: len(one.rows) * (2 * one.reach + 1))
    simpler = [sums.held_out(best.rows, 0), sums.held_out(best.rows, best.reach, shared=True)]
    simple = any(float(scores.sum(0).clamp(min=0).sum()) >= (1 - _SIMPLER) * best.total for scores in simpler)
    return best._replace(simple=simple)


@derived
def _sums(comparison: Comparison) -> ResponseSums:
    """Sums for all channels that may move the sensors."""
    rows = _rows(comparison.info, tuple(_moving(comparison)), comparison.n_samples)
    return ResponseSums.of(comparison, rows, max(_REACHES))


def _worth_a_response(comparison: Comparison, name: str) -> bool:
    """Whether plain gains, and gains a quarter of a cycle late, show enough to leave something to its numbers."""
    least = 60.0  # of the statistic over chance
    fit = regress(comparison, _rows(comparison.info, (name,), comparison.n_samples))
    return fit is not None and fit.excess + fit.quadrature - fit.gains.numel() > least


def _moving(comparison: Comparison) -> list[str]:
    """Channels of motion."""
    return [*dict.fromkeys([*accelerations(comparison), *rates(comparison)])]


def _places(comparison: Comparison, channels: Sequence[str]) -> list[int]:
    """Places of the rows of some channels among those of all."""
    of_row = [name for name in _moving(comparison) for _ in range(_count(comparison.info, name))]
    return [k for channel in channels for k, name in enumerate(of_row) if name == channel]


def _count(info: RecordingInfo, channel: str) -> int:
    """Rows of a channel."""
    values = info.channels[channel]
    return values.numel() // values.shape[-1]


def _row_names(info: RecordingInfo, channels: Sequence[str]) -> list[str]:
    names = []
    for channel in channels:
        count = _count(info, channel)
        names += [channel] if count == 1 else [f"row {k + 1} of {channel}" for k in range(count)]
    return names


def _rows(info: RecordingInfo, channels: Sequence[str], n_samples: int) -> Tensor:
    """Rows of channels less their means, `(row, time)`."""
    rows = []
    for channel in channels:
        values = info.channel_rows(channel)
        if values.shape[-1] < n_samples:
            raise ValueError(
                f"`channels`: expected {n_samples} samples of {channel!r}, which the sensors follow, got "
                f"{values.shape[-1]}; give the channel for the whole simulation"
            )
        rows.append(values[:, :n_samples])
    every = torch.cat(rows)
    return every - every.mean(-1, keepdim=True)


def _of_one_band(comparison: Comparison, effect: ChannelTransfer) -> bool:
    """Whether nearly all evidence lies in one band: there a line that both feel has a gain and a phase too."""
    path = effect._path(comparison.info, comparison.n_samples)
    power = torch.fft.rfft(path)[:, 1:].abs().square()
    f = torch.arange(1, power.shape[-1] + 1, dtype=torch.float64) / comparison.n_samples
    weight = (power / comparison.observed.base.spectrum(f)).sum(0)
    edges = torch.tensor(comparison.bands.edges[1:-1], dtype=torch.float64) / comparison.bands.n_samples
    share = torch.zeros(len(edges) + 1, dtype=torch.float64).index_add(0, torch.bucketize(f, edges), weight)
    return float(share.max() / share.sum()) > 0.9


def _busiest(comparison: Comparison, taps: Tensor, rows: Tensor) -> float:
    """Frequency of most evidence, cycles per sample."""
    path = responded(taps, rows)
    weight = torch.fft.rfft(path - path.mean(-1, keepdim=True)).abs().square().sum(0)
    return max(float(weight.argmax()), 1.0) / comparison.n_samples


def _gain_and_delay(
    fit: FiniteResponse, sensor: int, row: int, f: float, info: RecordingInfo, name: str
) -> tuple[Parameter, Parameter]:
    """Gain of one sensor on one row at `f` cycles per sample, and the delay in phase there, with limits."""
    n_lags = fit.taps.shape[-1]
    lags = torch.arange(n_lags, dtype=torch.float64) - n_lags // 2
    turn = torch.polar(torch.ones_like(lags), -2 * math.pi * f * lags)
    own = fit.inverse[row * n_lags : (row + 1) * n_lags, row * n_lags : (row + 1) * n_lags] * fit.variance[sensor]
    gain = complex((fit.taps[sensor, row].to(turn.dtype) * turn).sum())
    along = turn * (gain / max(abs(gain), 1e-300)).conjugate()
    sd, sd_across = (math.sqrt(max(float(v @ own @ v), 0.0)) for v in (along.real, along.imag))
    size, sign = abs(gain), 1.0 if gain.real >= 0 else -1.0
    phase = math.atan2((gain * sign).imag, (gain * sign).real)  # of a gain that is reversed, from there
    ms = 1e3 / (2 * math.pi * f * info.rate)
    late, reach = -phase * ms, Z * sd_across / max(size, 1e-300) * ms
    unit = f"{info.measure} per unit of {name}"
    return (
        Parameter.around(sign * size, Z * sd, unit),
        Parameter.around(late, reach, "ms"),
    )
