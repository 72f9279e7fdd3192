"""What resonances and wandering tones have in common: a bump of the spectrum, and its gains in the sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.moving.chirps import swept
from gyrofuse.mismatch.detectors.spectra.band_tests import excess_p_value, level_of
from gyrofuse.mismatch.detectors.spectra.peak_fit import Oscillation, oscillation_of
from gyrofuse.mismatch.detectors.spectra.peaks import Stretch
from gyrofuse.mismatch.detectors.spectra.steadiness import Steadiness, steadiness
from gyrofuse.mismatch.likelihoods.spectra.common_sources import CommonBump
from gyrofuse.mismatch.likelihoods.spectra.components import Peak, oscillation
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.spectra.findings import spanned
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import chosen_shape, leading_shape, refit, run_length
from gyrofuse.mismatch.mechanisms.spectra.spectral import Addition, Spectral
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import ComplexOfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples
from gyrofuse.mismatch.signals.psd import light_taper
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z

_PARTS = 16  # of a record, over which a frequency is seen to wander
_BROAD = 0.1  # half width over centre, from which a peak has no flanks of its own


@dataclass(frozen=True, eq=False)
class Mode:
    """A bump and how the sensors see it.

    Attributes:
        centre, width: Centre and half width, cycles per sample.
        gain: Complex, `(sensor,)`: rms and phase.
        shared: Whether one source moves all sensors, or each has its own.
    """

    centre: float
    width: float
    gain: ComplexOfSensors
    shared: bool

    def profile(self, f: Tensor, resolution: float = 0.0) -> Tensor:
        """Density of variance one at `f` cycles per sample, as spectra of a resolution show it.

        A line under a light taper is 0.45 of a bin wide, half width.
        """
        narrowest = 1e-9  # of a line, which has no density
        width = torch.tensor(max(math.hypot(self.width, 0.45 * resolution), narrowest), dtype=torch.float64)
        return oscillation(f, torch.tensor(self.centre, dtype=torch.float64), width)

    def matrix(self) -> Tensor:
        """Covariance of the sensors, complex, `(sensor, sensor)`."""
        if self.shared:
            return self.gain[:, None] * self.gain.conj()
        return torch.diag(self.gain.abs().square()).to(self.gain.dtype)


class OscillationOnTop(Addition):
    """What resonances and wandering tones do alike."""

    mode: Mode

    def with_company(self, comparison: Comparison) -> tuple[Mechanism, tuple[Mechanism, ...]]:
        """With levels and filters of the joint fit: of wrong ones a recording may be farther away, with its line in."""
        shape = leading_shape(comparison)
        terms = () if shape is None else (shape.term, *shape.company)
        company = tuple(term for term in terms if not isinstance(term, Peak | CommonBump))
        return Spectral.with_company(replace(self, company=company), comparison)


class Seen(NamedTuple):
    """A bump that may be named, with all that a finding says whatever its name."""

    comparison: Comparison
    peak: Oscillation
    verdict: Steadiness
    sensors: tuple[int, ...]
    rivals: tuple[str, ...]

    @property
    def where(self) -> str:
        return self.comparison.info.named(self.sensors, "all sensors")

    def of(self, effect: Mechanism, sentence: str, amplitude: str, factor: float) -> Finding:
        """The finding, amplitudes `factor` times the rms."""
        peak, rate, unit = self.peak, self.comparison.info.rate, self.comparison.info.measure
        centre_sd, width_sd = peak.log_sd
        if effect.name == "drifting_tone" or self.verdict.open:
            centre_sd = math.hypot(centre_sd, wandering_sd(self.comparison, peak) / peak.centre)
        parameters = {
            "frequency": spanned(lambda x: rate * math.exp(x), math.log(peak.centre), centre_sd, "Hz"),
            "width": spanned(lambda x: 2 * rate * math.exp(x), math.log(peak.width), width_sd, "Hz"),
        }
        if amplitude == "rms":
            spread = math.hypot(centre_sd, width_sd)
            quality = math.log(peak.centre / peak.width / 2)
            parameters["quality_factor"] = spanned(math.exp, quality, spread, "")
        for i in self.sensors:
            value, sd = float(peak.variance[i]), float(peak.variance_sd[i])
            parameters[f"{amplitude}[{i}]"] = spanned(lambda x: factor * math.sqrt(max(x, 0.0)), value, sd, unit)
            if peak.gain is not None:
                reference = peak.gain[peak.gain.abs().argmax()]
                turn = math.degrees(float((peak.gain[i] * reference.conj()).angle()))
                reach = math.degrees(Z * sd / (2 * value))
                parameters[f"phase[{i}]"] = Parameter.around(turn, reach, "deg")
        other = ("resonance",) if effect.name == "drifting_tone" else ("drifting_tone",)
        alternatives = tuple(sorted({*self.rivals, *(other if self.verdict.open else ())} - {effect.name}))
        return effect.found(
            sentence,
            peak.stretch.p_value,
            self.sensors,
            parameters,
            levels=(level_of(peak.centre),),
            alternatives=alternatives,
            frequency_hz=peak.centre * rate,
            gain=peak.nats,
        )

    @property
    def slow(self) -> bool:
        return self.verdict.slow


def nominated(comparison: Comparison, level: float, *, tone: bool) -> tuple[Mode, Seen] | None:
    """The strongest bump, if it is a tone, or if it is none."""
    peak = _with_bands(comparison, oscillation_of(comparison))
    rivals: tuple[str, ...] = ()
    if peak is None or peak.stretch.p_value > level:
        shape = chosen_shape(comparison, "resonance", level)
        if shape is None or not isinstance(shape.term, Peak | CommonBump):
            return None
        rivals = shape.alternatives
        centre, width = shape.term.shared.exp().tolist()
        peak = Oscillation.of(Stretch(centre, width, shape.p_value, ()), shape.term, shape.sd, shape.gain)
        # Which sensors it takes is a matter of likelihood: variances are as uncertain as the width is.
        has = shape.term.free.any(0)
    else:
        has = included_sensors(*_seen(peak)).which
    sensors = tuple(has.nonzero()[:, 0].tolist())
    verdict = steadiness(comparison, peak)
    steady = verdict.tone and peak.width <= _BROAD * peak.centre  # what is all over the spectrum is no tone
    if steady != tone or _momentary(comparison, peak) or swept(comparison, peak.nats, level):
        return None
    gain = peak.variance.clamp(min=0).sqrt().to(torch.complex128) if peak.gain is None else peak.gain
    mode = Mode(peak.centre, peak.width, gain, peak.gain is not None)
    return mode, Seen(comparison, peak, verdict, sensors, rivals)


def _with_bands(comparison: Comparison, peak: Oscillation | None) -> Oscillation | None:
    """A bump with the p value of more power in the bands where it stands, if that is the smaller one.

    Of a bump of its own that is plain enough where it is looked for among all: bands are fewer than places and widths.
    """
    plain = 0.01  # p value
    if peak is None or peak.stretch.p_value > plain:
        return peak
    low, high = peak.centre - peak.width, peak.centre + peak.width
    p_value = min(peak.stretch.p_value, excess_p_value(comparison, low, high))
    return replace(peak, stretch=peak.stretch._replace(p_value=p_value))


def _seen(peak: Oscillation) -> tuple[Tensor, int]:
    """Squares `(sensor,)` of a bump in standard deviations, and their degrees of freedom: of gains two, complex."""
    squares = (peak.variance / peak.variance_sd).clamp(min=0).square()
    return (squares, 1) if peak.gain is None else (4 * squares, 2)  # sd of |g|^2 is 2 |g| times that of |g|


def _in_band(comparison: Comparison, peak: Oscillation) -> tuple[Tensor, float]:
    """Sensors summed in phase in six half widths on either side of the centre, and the power of noise alone there.

    Complex samples `(time,)`, one for each bin of the band; none at the ends of the spectrum.
    """
    n = comparison.n_samples
    centre, reach = round(peak.centre * n), max(round(6 * peak.width * n), 2 * _PARTS)
    reach = min(reach, centre - 1, n // 2 - centre)
    if reach < 1:
        return torch.zeros(0, dtype=torch.complex128), 0.0
    strength = peak.variance.clamp(min=0).sqrt().to(torch.complex128) if peak.gain is None else peak.gain
    noise = comparison.base.spectrum(torch.tensor([peak.centre], dtype=torch.float64))[:, 0]
    weights = strength.conj() / noise
    bins = weights @ torch.fft.rfft(comparison.recording)[:, centre - reach : centre + reach]
    level = float(weights.abs().square() @ noise) * n / len(bins)
    return torch.fft.ifft(torch.fft.ifftshift(bins)), level


def _momentary(comparison: Comparison, peak: Oscillation) -> bool:
    """Whether one of 32 parts of the record has half of it: what rings after a blow is neither a mode nor a tone."""
    parts = 32
    z, level = _in_band(comparison, peak)
    length = len(z) // parts
    if length < 1:
        return False
    excess = z[: length * parts].unflatten(0, (parts, length)).abs().square().mean(-1) - level
    return float(excess.max()) > float(excess.sum().clamp(min=0)) / 2


def wandering_sd(comparison: Comparison, peak: Oscillation) -> float:
    """Standard deviation of a record's mean frequency that wanders, from means over its parts, cycles per sample.

    Of the sum of sensors in phase: the mean turn from sample to sample in a band whose middle is the centre, where
    white noise has none. Neighbouring parts that are alike make the mean of all as uncertain as fewer of them would.
    """
    z, _ = _in_band(comparison, peak)
    if len(z) < 3 * _PARTS:  # a turn from sample to sample needs a few
        return 0.0
    parts = z[: len(z) // _PARTS * _PARTS].unflatten(0, (_PARTS, -1))
    turns = (parts[:, 1:] * parts[:, :-1].conj()).sum(-1).angle() / (2 * math.pi)
    left = turns - turns.mean()
    alike = float((left[1:] * left[:-1]).sum() / left.square().sum())
    # Subtracting the mean biases a correlation of neighbours down; from 0.8 on sixteen parts do not show it any more.
    alike = min(max(alike + (1 + 4 * alike) / _PARTS, 0.0), 0.8)
    spread = float(left.square().sum()) / (_PARTS - 1) / _PARTS * (1 + alike) / (1 - alike)
    return math.sqrt(spread) * len(z) / comparison.n_samples


def refitted_mode(comparison: Comparison, fold: int, mode: Mode) -> Mode:
    """Numbers anew, without the blocks that a fold holds out.

    Sensors that do not have the mode are not to get what chance would give them.
    """
    found = _refitted(comparison, fold, mode)
    return replace(found, gain=found.gain * (mode.gain != 0))


def _refitted(comparison: Comparison, fold: int, mode: Mode) -> Mode:
    """The same centre and width, gains from the power in blocks that a fold does not hold out.

    Of a narrow one they are fitted within 7.5 half widths, in six bins at least. A broad mode has no flanks of its own:
    it is fitted to the whole spectrum.
    """
    if not mode.shared and mode.width > _BROAD * mode.centre:
        start = Peak.start(mode.centre, mode.width, mode.gain.abs().square())
        term = refit(comparison, fold, replace(start, free=start.local > 0))
        centre, width = term.shared.exp().tolist()
        return Mode(centre, width, term.local[0].sqrt().to(torch.complex128), False)
    keep = estimation_samples(comparison.n_samples, fold)
    block = run_length(keep)
    blocks = comparison.lineless[:, keep].unflatten(-1, (-1, block))
    transform = torch.fft.rfft(blocks * light_taper(block)).movedim(-1, 0)  # (bin, sensor, block)
    f = torch.arange(len(transform), dtype=torch.float64) / block
    usable = (f > 2.5 / block) & (f < 0.5 - 2 / block) & ((f - mode.centre).abs() <= 7.5 * (mode.width + 1 / block))
    if int(usable.sum()) < 6:
        return mode
    f, transform = f[usable], transform[usable]
    level = comparison.base.spectrum(f).mT.sqrt()
    both = level[:, :, None] * level[:, None, :]
    white = transform @ transform.mH / transform.shape[-1]
    covariance = excess_along(mode.profile(f, 1 / block), white, both)
    if mode.shared:
        values, vectors = torch.linalg.eigh((covariance + covariance.mH) / 2)
        return replace(mode, gain=vectors[:, -1] * values[-1].clamp(min=0).sqrt())
    return replace(mode, gain=covariance.diagonal().real.clamp(min=0).sqrt().to(torch.complex128))


def excess_along(profile: Tensor, white: Tensor, both: Tensor) -> Tensor:
    """Least squares `C` of spectra `(bin, sensor, sensor)` as `L + C profile / both`, whatever the level `L`."""
    template = profile[:, None, None] / both
    weight = template - template.mean(0)
    return (weight * white).sum(0) / (weight * template).sum(0)
