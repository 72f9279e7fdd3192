"""A tone whose frequency wanders: a rotor that is not held to its speed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.spectra.frequency_courses import probably_normal, rampless_transform
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode, OscillationOnTop, nominated, refitted_mode
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.psd import drawn_towards
from gyrofuse.noise.processes.ar1_recursion import ar1_recursion

_SHORT = 0.05  # cycles of the width in which a phase that diffuses forgets its frequency
_LONG = 8.0
_REACH = 10.0  # half widths of the band that is cleaned
_FLANK, _FEWEST = 0.6, 64  # of the reach to either side, and bins, that tell the noise beside
_STEP = 16  # bins
_FAINT = 0.03  # of the largest gain
_SPREAD, _SEEN = math.pi / math.sqrt(6), 2.0  # sd of the logarithm of an exponential variable, and how many are seen
_EULER = 0.5772156649015329  # by which the mean logarithm of an exponential variable is below that of its mean


@dataclass(frozen=True, eq=False)
class DriftingTone(OscillationOnTop):
    """`x_i(t) = a_i cos(phi(t) + theta_i)` with `phi' = 2 pi (f_0 + u(t))` and a wandering `u`, an AR1.

    Its line is wider than the record's resolution, yet it has one frequency at a time and a steady amplitude: windows
    that are short against its wander show a peak, and where it wanders too fast for that its squared envelope still
    varies less than that of Gaussian noise.

    Attributes:
        mode: Centre, half width, and gains: complex, those of a Lorentzian.
        slow: Whether short windows show its frequency.
        share: Its power over that of the Lorentzian, whose far tails it need not have.
    """

    name: ClassVar[str] = "drifting_tone"
    rivals: ClassVar[tuple[str, ...]] = ("vibration_tone",)
    named_together: ClassVar[tuple[str, ...]] = ("resonance",)
    separated_by: ClassVar[str] = "a longer recording, over which the frequency moves by more than its own width"
    additive: ClassVar[bool] = True
    shown: ClassVar[float] = 6.0  # half widths on either side in a picture
    mode: Mode
    slow: bool
    share: float = 1.0

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        seen = nominated(comparison, level, tone=True)
        if seen is None:
            return None
        mode, finding = seen
        rate, share = comparison.info.rate, _share(comparison, mode, probably_normal(comparison, finding.peak))
        factor = math.sqrt(2 * share)
        return finding.of(
            cls(mode, finding.slow, share),
            f"a tone near {mode.centre * rate:.4g} Hz whose frequency wanders by about {mode.width * rate:.2g} Hz, in "
            f"{finding.where}, of amplitude up to {factor * float(mode.gain.abs().max()):.3g} "
            f"{comparison.info.measure}, that the simulation does not have",
            amplitude="amplitude",
            factor=factor,
        )

    def line_width(self, parameters: Mapping[str, Parameter], comparison: Comparison) -> float | None:
        return self.mode.width * comparison.info.rate

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        rate = comparison.info.rate
        centre, width = self.mode.centre * rate, max(self.mode.width * rate, rate / comparison.n_samples)
        band, window = (centre - self.shown * width, centre + self.shown * width), 2 / width
        track = _loudest(comparison, sensor, band, window) if fitted else None
        pictures.spectrogram(ax, comparison, sensor, band, window, track)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Its line, and others in step with it."""
        return (self.mode,)

    @property
    def turns(self) -> tuple[float, ...]:
        """By how many times its phase each of them turns."""
        return (1.0,)

    def density(self, f: Tensor) -> Tensor:
        resolution = 2 * float(f[1] - f[0])
        parts = [mode.matrix() * mode.profile(f, resolution)[:, None, None] for mode in self.modes]
        return torch.stack(parts).sum(0)

    def course(self, n_samples: int, generator: torch.Generator) -> Tensor:
        """Its frequency less that of its centre, `(time,)`, cycles per sample."""
        width = self.mode.width
        memory = (_LONG if self.slow else _SHORT) / (2 * math.pi * width)  # samples
        phi = math.exp(-1 / memory)
        # A phase that diffuses as fast as a Lorentzian of that half width has it.
        spread = width if self.slow else math.sqrt(width / math.pi * (1 - phi) / (1 + phi))
        return spread * _wandered(n_samples, phi, generator)

    def path(self, n_samples: int, generator: torch.Generator) -> Tensor:
        course = self.course(n_samples, generator)
        turn = 2 * math.pi * torch.rand((), generator=generator, dtype=torch.float64)
        phase = 2 * math.pi * (self.mode.centre + course).cumsum(0) + turn
        parts = [
            mode.gain.abs()[:, None] * (mode.gain.angle()[:, None] + times * phase).cos()
            for mode, times in zip(self.modes, self.turns, strict=True)
        ]
        return math.sqrt(2 * self.share) * torch.stack(parts).sum(0)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """Its band is filled with the noise around it: another path of its own would differ from the recorded one."""
        whole = _Band.of(comparison, self.mode).reach(self.mode, comparison)
        for mode, times in zip(self.modes, self.turns, strict=True):
            if bool(mode.gain.any()):
                comparison = self._filled(comparison, mode, round(times * whole) if times != 1 else 0, generator)
        return comparison

    @staticmethod
    def _filled(comparison: Comparison, mode: Mode, least: int, generator: torch.Generator) -> Comparison:
        """With noise in the band of a line, of so many bins on either side at least."""
        signal, n = comparison.recording, comparison.n_samples
        ramp = torch.linspace(0, 1, n, dtype=torch.float64) * (signal[:, -1:] - signal[:, :1])
        band, transform = _Band.of(comparison, mode, least), rampless_transform(comparison).clone()
        inside = slice(band.first, band.last + 1)
        parts = torch.randn(2, *band.noise.shape, generator=generator, dtype=torch.float64)
        filled = torch.complex(parts[0], parts[1]) / math.sqrt(2) * band.noise.sqrt()
        transform[band.concerned, inside] = filled[band.concerned]
        cleaned = torch.fft.irfft(transform, n=n) + ramp
        return comparison.with_recording(torch.where(band.concerned[:, None], cleaned, signal))

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        return replace(self, mode=refitted_mode(comparison, fold, self.mode))


class _Band(NamedTuple):
    """Where a line shows in a record.

    Attributes:
        power: Of the record, `(sensor, bin)` from the first to the last.
        concerned: Sensors that have it, `(sensor,)`; the others stay as they are.
        first, last: Bins.
        noise: Power of the noise around it, `(sensor, bin)` from the first to the last.
    """

    power: Tensor
    concerned: Tensor
    first: int
    last: int
    noise: Tensor

    @classmethod
    def of(cls, comparison: Comparison, mode: Mode, least: int = 0) -> _Band:
        """That of a mode, of so many bins on either side at least."""
        n = comparison.n_samples
        bins = torch.arange(n // 2 + 1)
        density = comparison.base.spectrum(bins.clamp(min=1) / n)
        size = mode.gain.abs()
        concerned = size > _FAINT * size.amax()
        power = rampless_transform(comparison).abs().square() / density
        first, last = _ends(power[concerned], mode, n, least)
        middle = round(mode.centre * n)
        below, above = (max(round(_FLANK * reach), _FEWEST) for reach in (middle - first, last - middle))
        # An octave below at most: what is slower leaks into the slowest ordinates, and is many times the noise there.
        beside = ((bins >= max(first - below, first // 2)) & (bins < first)) | ((bins > last) & (bins <= last + above))
        beside &= bins > 0
        # By the mean logarithm of exponential ordinates: a few that hold more would lift a mean, and all of the band.
        level = (power[:, beside].clamp(min=1e-300).log().mean(-1, keepdim=True) + _EULER).exp()
        density = density[:, first : last + 1]
        return cls(power[:, first : last + 1] * density, concerned, first, last, level * density)

    def reach(self, mode: Mode, comparison: Comparison) -> int:
        """Bins on the longer side of the middle."""
        middle = round(mode.centre * comparison.n_samples)
        return max(middle - self.first, self.last - middle)


def _ends(power: Tensor, mode: Mode, n_samples: int, least: int) -> tuple[int, int]:
    """First and last bin of a line, of powers `(sensor, bin)` in units of the simulation's noise.

    A strong line is seen far beyond the widths of its middle, and none knows how its flanks fall: either end goes on
    while there is more next to it than farther off, beyond chance and by a tenth: noise has slopes too.
    """
    least_more = 0.1  # log power
    logs = power.clamp(min=1e-300).log().mean(0)
    middle, ends = round(mode.centre * n_samples), []
    for side in (logs[1:middle].flip(0), logs[middle + 1 : n_samples // 2]):  # from the centre outwards
        end = min(max(round(_REACH * mode.width * n_samples), least), len(side))
        while True:
            step, far = (max(round(_FLANK * end), fewest) for fewest in (_STEP, _FEWEST))
            near, beyond = side[end : end + step], side[end + step : end + step + far]
            chance = _SPREAD * math.sqrt(1 / step + 1 / far)
            if len(beyond) < far or float(near.mean() - beyond.mean()) < max(_SEEN * chance, least_more):
                break
            end += step
        ends.append(end)
    return max(middle - ends[0], 1), min(middle + ends[1], n_samples // 2 - 1)


def _share(comparison: Comparison, mode: Mode, normal: float) -> float:
    """Power of the line over that of the Lorentzian that was fitted to it, by what its band has above the noise.

    Drawn towards what is expected of its form, by as much as chance explains of the difference (Stein): a course of
    frequencies that keeps near its middle has no far tails, and a fifth less power than a Lorentzian of like width and
    height.

    Args:
        comparison: Recording and simulation.
        mode: Lorentzian.
        normal: Probability that the line has the shape of a normal law instead.
    """
    if not bool(mode.gain.any()):
        return 1 - normal / 5
    band = _Band.of(comparison, mode)
    here, n = band.concerned, comparison.n_samples
    noise = band.noise[here]
    weight = 1 / noise.mean(-1, keepdim=True)
    above = (band.power[here] - noise) * weight
    whole = float((mode.gain[here].abs().square()[:, None] * weight).sum()) * n**2 / 2
    excess = float(above.sum())
    chance = float(((noise * weight).square()).sum()) + 2 * max(excess, 0.0)
    centre, width = mode.centre * n, mode.width * n
    inside = (math.atan((centre - band.first) / width) + math.atan((band.last - centre) / width)) / math.pi
    whole *= 1 - (1 - inside) * (1 - normal)  # a Lorentzian has tails beyond the band
    measured = torch.tensor(excess / whole, dtype=torch.float64)
    return max(float(drawn_towards(measured, torch.tensor(chance / whole**2), 1 - normal / 5)), 0.1)


def _wandered(n_samples: int, phi: float, generator: torch.Generator) -> Tensor:
    """Stationary AR1 path `(time,)` of variance one."""
    steps = torch.randn(n_samples, generator=generator, dtype=torch.float64)
    steps[1:] *= math.sqrt(1 - phi**2)
    return ar1_recursion(steps[None], torch.tensor([phi], dtype=steps.dtype))[0]


def _loudest(
    comparison: Comparison, sensor: int, band_hz: tuple[float, float], window_s: float
) -> tuple[Tensor, Tensor]:
    """Where the power in a band is highest at each time, medians of five; NaN where it is faint."""
    seconds, f, power = pictures.power_over_time(comparison, sensor, window_s)
    power = torch.where((f >= band_hz[0]) & (f <= band_hz[1]), power, 0.0)
    best, at = power.max(-1)
    track = (
        torch.nn.functional.pad(f[at][None, None], (2, 2), mode="replicate")[0, 0].unfold(-1, 5, 1).median(-1).values
    )
    loud = 6.0  # times the median of the band, which exponential powers exceed in one of sixty-four
    return seconds, torch.where(best > loud * power[power > 0].median(), track, math.nan)
