"""Noise on top that only the simulation has: what would be found in it, were it the recording, is taken off it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.decisions import NEW_TERM_NATS
from gyrofuse.mismatch.detectors.exchanged import exchanged
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.spectra.peak_fit import Oscillation, bump_at
from gyrofuse.mismatch.detectors.spectra.peaks import Stretch, strongest_peak
from gyrofuse.mismatch.detectors.spectra.pooled_coherence import shared_ordinates
from gyrofuse.mismatch.likelihoods.spectra.data import reference_noise
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode, OscillationOnTop, refitted_mode
from gyrofuse.mismatch.mechanisms.spectra.bumps.resonance import Resonance
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_tone import DriftingTone
from gyrofuse.mismatch.mechanisms.spectra.common_source import CommonMode
from gyrofuse.mismatch.mechanisms.spectra.findings import spanned
from gyrofuse.mismatch.mechanisms.spectra.spectral import Addition, Spectral
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.filters import mixed
from gyrofuse.mismatch.signals.folds import spectral_gains
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum, fit_base
from gyrofuse.mismatch.signals.psd import narrow_bands
from gyrofuse.mismatch.signals.records import Records

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class SimulatedNoise(Spectral):
    """`S -> M S M^H`, `M = N^1/2 (N^-1/2 (N + G) N^-1/2)^-1/2 N^-1/2`: of `N + G` the noise `N` is left.

    Attributes:
        added: Noise on top, with the spectra `G`.
        own: The recording's noise, `N`, where that was found.
    """

    kind: ClassVar[type[Addition]]
    added: Addition
    own: NoiseSpectrum

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        # Where a model's numbers were estimated, what it has too much of may be their error.
        if comparison.reference.uncertainty is not None:
            return None
        other = exchanged(comparison)
        if not cls.may_be_there(comparison, other, level):
            return None
        found = cls.kind.detect_and_fit(other, level)
        if found is None or not isinstance(found.effect, cls.kind) or not found.identified:
            return None
        effect = cls(replace(found.effect, company=()), reference_noise(other))
        if not effect.stands_out(comparison):
            return None
        sentence = found.sentence.replace("that the simulation does not have", "that only the simulation has")
        return replace(found, effect=effect, sentence=sentence)

    @classmethod
    def may_be_there(cls, comparison: Comparison, other: Comparison, level: float) -> bool:
        """Whether it is worth looking for: at a glance, for most have nothing of it.

        Args:
            comparison: Recording and simulation.
            other: The same with sides exchanged.
            level: Largest p value.
        """
        raise NotImplementedError

    def stands_out(self, comparison: Comparison) -> bool:
        """Whether the simulation shows it by itself, and not only beside what the recording lacks."""
        raise NotImplementedError

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        """Of the recording's noise over the same with what is taken off: the simulation's smooth spectrum lacks it."""
        return spectral_gains(comparison, comparison.recording, self._after, fold, self._before)

    def _after(self, matrices: Tensor, f: Tensor) -> Tensor:
        return torch.diag_embed(self.own.spectrum(f.clamp(min=1 / self.own.n_samples)).mT).to(torch.complex128)

    def _before(self, matrices: Tensor, f: Tensor) -> Tensor:
        return self.added.spectra(self._after(matrices, f), f)

    def mixing(self, f: Tensor) -> Tensor:
        """Complex gains `(frequency, sensor, sensor)` at `f` cycles per sample."""
        level = self.own.spectrum(f.clamp(min=1 / self.own.n_samples)).mT.sqrt()  # (frequency, sensor)
        both = self.added.spectra(torch.diag_embed(level.square()).to(torch.complex128), f)
        values, vectors = torch.linalg.eigh(both / (level[:, :, None] * level[:, None, :]))
        root = (vectors * values.clamp(min=1e-12).rsqrt()[:, None, :]) @ vectors.mH
        return level[:, :, None] * root / level[:, None, :]

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return mixed(signal, self.mixing)

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        mixing = self.mixing(f)
        return mixing @ matrices.to(mixing.dtype) @ mixing.mH

    def factor(self, base: NoiseSpectrum, f: Tensor) -> Tensor:
        before = torch.diag_embed(base.spectrum(f).mT).to(torch.complex128)
        return (self.spectra(before, f) / before.diagonal(dim1=-2, dim2=-1)[:, None]).diagonal(dim1=-2, dim2=-1).real.mT

    def plot(self, comparison: Comparison, ax: Axes, *, sensor: int, fitted: bool) -> None:
        self.added.plot(comparison, ax, sensor=sensor, fitted=fitted)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        """Its numbers are those of the simulation, of which nothing is held out."""
        return self


@dataclass(frozen=True, eq=False)
class SimulatedBump(SimulatedNoise):
    """A bump that only the simulation has."""

    added: OscillationOnTop

    @classmethod
    def may_be_there(cls, comparison: Comparison, other: Comparison, level: float) -> bool:
        return _may_bulge(comparison, other, level)

    def stands_out(self, comparison: Comparison) -> bool:
        """As a bump of the simulation alone."""
        return _bulges(comparison, self.added.mode)


@dataclass(frozen=True, eq=False)
class SimulatedResonance(SimulatedBump):
    """A mode that only the simulation has."""

    name: ClassVar[str] = "resonance"
    rivals: ClassVar[tuple[str, ...]] = ("parameter_shift", "low_pass")
    separated_by: ClassVar[str] = Resonance.separated_by
    kind: ClassVar[type[Addition]] = Resonance
    added: Resonance


@dataclass(frozen=True, eq=False)
class MovedResonance(SimulatedResonance):
    """A mode that the simulation has with other numbers: at another frequency, wider, or of another size.

    Each side's is measured by itself, over the noise that it stands on. What one has more than the other has another
    shape than either.

    Attributes:
        recorded: The mode as the recording has it.
    """

    recorded: Resonance

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        if comparison.reference.uncertainty is not None:  # what it has too much of may be the error of its numbers
            return None
        hump, nearby, plain = _hump_of(comparison.reference), 1.5, 3 * NEW_TERM_NATS
        if hump is None:
            return None
        old, new = (bump_at(comparison, side, hump) for side in (comparison.reference, comparison.observed))
        if old is None or new is None or min(old.nats, new.nats) < plain:
            return None
        if not 1 / nearby < new.centre / old.centre < nearby:
            return None
        fewest = 20  # bins of a half width, from which on it is noise and no line that wanders another way each time
        if min(old.width, new.width) * comparison.n_samples < fewest or not _alike_in_all(old, new):
            return None
        off, sd = _differences(old, new)
        spread = 1.5  # of squares: what each side's simple spectrum is off beneath a broad mode is no part of the sds
        z = off / (sd * math.sqrt(spread))
        p_value = float(stats.chi2.sf(float(z.square().sum()), len(z)))
        if p_value > level:
            return None
        rate, unit = comparison.info.rate, comparison.info.measure
        sensors = tuple(range(comparison.n_sensors))
        parameters = {}
        for prefix, bump in (("simulated_", old), ("", new)):
            (at, wide), (at_sd, wide_sd) = (math.log(bump.centre), math.log(bump.width)), bump.log_sd
            parameters[f"{prefix}frequency"] = spanned(lambda x: rate * math.exp(x), at, at_sd, "Hz")
            parameters[f"{prefix}width"] = spanned(lambda x: 2 * rate * math.exp(x), wide, wide_sd, "Hz")
            for i in sensors:
                size, size_sd = float(bump.variance[i]), float(bump.variance_sd[i])
                parameters[f"{prefix}rms[{i}]"] = spanned(lambda x: math.sqrt(max(x, 0.0)), size, size_sd, unit)
        before, after = (
            f"{bump.centre * rate:.4g} Hz (quality factor {bump.centre / bump.width / 2:.3g}, "
            f"up to {float(bump.variance.max().sqrt()):.3g} {unit} rms)"
            for bump in (old, new)
        )
        recorded, simulated = (Resonance(_mode(bump)) for bump in (new, old))
        if (own := _base_below(comparison.reference, simulated.mode)) is None:
            return None
        # Flanks of a mode are not quite those of an AR2.
        return cls(simulated, own, recorded, approximate=True).found(
            f"the simulation's resonance at {before} is at {after} in the recording, in all sensors",
            p_value,
            sensors,
            parameters,
            levels=(level_of(new.centre),),
            frequency_hz=new.centre * rate,
            gain=float(z.square().sum()) / 2,
        )

    @property
    def _as_filter(self) -> bool:
        """Whether a filter makes the one mode of the other, whose flanks keep their form; sources are exchanged."""
        return not (self.added.mode.shared or self.recorded.mode.shared)

    def mixing(self, f: Tensor) -> Tensor:
        if not self._as_filter:
            return super().mixing(f)
        noise = torch.diag_embed(self.own.spectrum(f.clamp(min=1 / self.own.n_samples)).mT).to(torch.complex128)
        new, old = (effect.spectra(noise, f).diagonal(dim1=-2, dim2=-1).real for effect in (self.recorded, self.added))
        return torch.diag_embed((new / old).sqrt()).to(torch.complex128)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        made = super().apply(signal, info, generator)
        return made if self._as_filter else self.recorded.apply(made, info, generator)

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        made = super().spectra(matrices, f)
        return made if self._as_filter else self.recorded.spectra(made, f)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return Spectral.held_out_scores(self, comparison, fold)

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        built = super().apply_to_reference(comparison, generator)
        mode = self.recorded.mode
        return replace(built, modes=(*built.modes, (mode.centre, mode.width)))

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        return replace(self, recorded=replace(self.recorded, mode=refitted_mode(comparison, fold, self.recorded.mode)))

    def plot(self, comparison: Comparison, ax: Axes, *, sensor: int, fitted: bool) -> None:
        self.recorded.plot(comparison, ax, sensor=sensor, fitted=fitted)


@dataclass(frozen=True, eq=False)
class SimulatedWanderingTone(SimulatedBump):
    """A wandering tone that only the simulation has."""

    name: ClassVar[str] = "drifting_tone"
    rivals: ClassVar[tuple[str, ...]] = ("parameter_shift",)
    separated_by: ClassVar[str] = DriftingTone.separated_by
    kind: ClassVar[type[Addition]] = DriftingTone
    added: DriftingTone

    def plot(self, comparison: Comparison, ax: Axes, *, sensor: int, fitted: bool) -> None:
        Resonance(self.added.mode).plot(comparison, ax, sensor=sensor, fitted=fitted)


@dataclass(frozen=True, eq=False)
class SimulatedCommonMode(SimulatedNoise):
    """Noise of one source in the simulation's sensors, and not in the recording's.

    Other numbers leave what sensors share as it is, in units of their powers.
    """

    name: ClassVar[str] = "common_mode"
    separated_by: ClassVar[str] = CommonMode.separated_by
    kind: ClassVar[type[Addition]] = CommonMode
    added: CommonMode

    @classmethod
    def may_be_there(cls, comparison: Comparison, other: Comparison, level: float) -> bool:
        fewest = 20.0  # ordinates
        simulated, recorded = shared_ordinates(comparison)
        return bool(((simulated > fewest) & (simulated > 2 * recorded)).any())

    def stands_out(self, comparison: Comparison) -> bool:
        """As what the simulation's sensors share alone."""
        simulated, recorded = shared_ordinates(comparison)
        has = self.added.gain != 0
        return 2 * float(recorded[has].sum()) < float(simulated[has].sum())


def _may_bulge(comparison: Comparison, other: Comparison, level: float) -> bool:
    """Whether a bump of the simulation over the recording is one of the simulation in any sensor."""
    bump = strongest_peak(other)
    if bump.p_value > level:
        return False
    mode = Mode(bump.frequency, bump.width / 4, torch.ones(comparison.n_sensors, dtype=torch.complex128), False)
    simulated, recorded = (_over_flanks(side.steady, mode) for side in (comparison.reference, comparison.observed))
    return bool(((simulated > 0) & (simulated > recorded)).any())


def _bulges(comparison: Comparison, mode: Mode) -> bool:
    """Whether the simulation's power at a mode stands above its flanks, and the recording's hardly.

    In the sensors that have it, by the logarithms. Where the recording's does as well, something acts on both; where it
    is below, that has a hole there.
    """
    size, plain = mode.gain.abs() / comparison.base.spectrum(torch.tensor([mode.centre]))[:, 0].sqrt(), 0.3
    has = size > plain * size.max()
    simulated, recorded = (_over_flanks(side.steady, mode)[has] for side in (comparison.reference, comparison.observed))
    return 2 * abs(float(recorded.mean())) < float(simulated.mean())


def _over_flanks(signal: Tensor, mode: Mode) -> Tensor:
    """Logarithms of the power within a half width of a mode over that from three to six away, `(sensor,)`."""
    _, power, inside, beside = _near(signal, mode)
    return power[:, inside].mean(-1).log() - power[:, beside].mean(-1).log()


def _hump_of(side: Records) -> Stretch | None:
    """The plainest hump of the density that simple spectra lack; None where it has none.

    By the logarithms within over those beside it, on both sides, in the mean of the sensors.
    """
    narrow, least, span = narrow_bands(side.bands.n_samples), 0.25, 3
    above = side.ripple.mean(0)
    best: tuple[float, Stretch | None] = (0.0, None)
    for width in (1, 2, 4, 8, 16, 32):  # bands
        if (span + 1) * width > len(above) / 2:
            break
        inside = above.unfold(0, width, 1).mean(-1)  # from each band on
        middle, away = inside[span * width : -span * width], span * width
        beside = torch.maximum(inside[: -2 * away], inside[2 * away :])
        height = (middle - beside) * math.sqrt(width)
        at = int(height.argmax())
        if float(height[at]) > best[0] and float(middle[at] - beside[at]) > least:
            lower, upper = narrow.edges[at + away], narrow.edges[at + away + width]
            n = narrow.n_samples
            best = float(height[at]), Stretch((lower + upper) / 2 / n, 2 * (upper - lower) / n, 0.0, ())
    return best[1]


def _base_below(side: Records, mode: Mode) -> NoiseSpectrum | None:
    """The simple spectrum of the noise that a mode stands on; None where hardly a band shows that."""
    mostly, fewest = 0.5, 8  # of a power; bands
    alone = side.bands.mean_of(mode.profile(side.bands.nodes)) * mode.gain.abs().square()[:, None]
    beside = (alone < mostly * side.power).all(0)
    if int((beside & (side.dof > 0)).sum()) < fewest:
        return None
    return fit_base(torch.where(beside, side.power - alone, 0.0), side.bands, side.bands.n_samples, side.dof * beside)


def _alike_in_all(old: Oscillation, new: Oscillation) -> bool:
    """Whether the mode is larger or smaller by about one factor in all sensors: else what differs is theirs."""
    if min(float(old.variance.min()), float(new.variance.min())) <= 0:
        return False
    rare, ratio = 1e-3, (new.variance / old.variance).log()
    sd = ((new.variance_sd / new.variance).square() + (old.variance_sd / old.variance).square()).sqrt()
    weight = 1 / sd.square()
    off = (ratio - (ratio * weight).sum() / weight.sum()) / sd
    return float(stats.chi2.sf(float(off.square().sum()), max(len(off) - 1, 1))) > rare


def _mode(bump: Oscillation) -> Mode:
    gain = bump.variance.clamp(min=0).sqrt().to(torch.complex128) if bump.gain is None else bump.gain
    return Mode(bump.centre, bump.width, gain, bump.gain is not None)


def _differences(old: Oscillation, new: Oscillation) -> tuple[Tensor, Tensor]:
    """Of the logarithms of centre and width, and of the sensors' variances, with their standard deviations."""
    numbers, sds = [], []
    for bump in (old, new):
        numbers.append(torch.cat([torch.tensor([bump.centre, bump.width], dtype=torch.float64).log(), bump.variance]))
        sds.append(torch.cat([torch.tensor(bump.log_sd, dtype=torch.float64), bump.variance_sd]))
    return numbers[1] - numbers[0], (sds[0].square() + sds[1].square()).sqrt()


def _near(signal: Tensor, mode: Mode) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Frequencies `(bin,)`, mean densities of records `(sensor, bin)`, bins within a half width, and on the flanks."""
    n, fewest = signal.shape[-1], 4.0  # bins
    width = max(mode.width, fewest / n)
    taper = torch.hann_window(n, dtype=signal.dtype)
    transform = torch.fft.rfft((signal - signal.mean(-1, keepdim=True)) * taper)
    f = torch.arange(transform.shape[-1], dtype=torch.float64) / n
    away = (f - mode.centre).abs() / width
    power = transform.abs().square().mean(0) / taper.square().sum()
    return f, power, away < 1, (away > 3) & (away < 6)
