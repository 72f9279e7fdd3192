"""What resonances and wandering tones have in common: a bump of the spectrum, and its gains in the sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.axes import ComplexOfSensors
from gyrofuse.mismatch.bump_fit import Oscillation, likeliest_oscillation, oscillation_of
from gyrofuse.mismatch.bumps import Stretch, light_taper
from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.folds import estimation_samples
from gyrofuse.mismatch.mechanism import Finding, Mechanism, Parameter, Z
from gyrofuse.mismatch.partakers import partakers
from gyrofuse.mismatch.shape_terms import Bump, CommonBump, oscillation
from gyrofuse.mismatch.shape_words import spanned
from gyrofuse.mismatch.shapes import chosen_shape, refit, run_length
from gyrofuse.mismatch.steadiness import Steadiness, steadiness
from gyrofuse.mismatch.sweeps import swept
from gyrofuse.mismatch.witnesses import level_of

_BAND = 6.0  # half widths on either side
_PARTS, _MOST_ALIKE = 16, 0.8  # of a record, to see a frequency wander, and the correlation of neighbours
_FEWEST = 3  # samples of the band in a part
_MOMENTS, _MOST_AT_ONCE = 32, 0.5  # parts of a record, and share of the excess in one
_BROAD = 0.1  # half width over centre
_SMEARED = 0.45  # bins: half width of a line under a light taper
_REACH, _FEWEST_BINS = 7.5, 6  # half widths around a mode, and bins, that tell its strength


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
        """Density of variance one at `f` cycles per sample, as spectra of a resolution show it."""
        width = torch.tensor(math.hypot(self.width, _SMEARED * resolution), dtype=torch.float64)
        return oscillation(f, torch.tensor(self.centre, dtype=torch.float64), width)

    def matrix(self) -> Tensor:
        """Covariance of the sensors, complex, `(sensor, sensor)`."""
        if self.shared:
            return self.gain[:, None] * self.gain.conj()
        return torch.diag(self.gain.abs().square()).to(self.gain.dtype)


class Seen(NamedTuple):
    """A bump that may be named, with all that a finding says whatever its name."""

    case: Case
    bump: Oscillation
    verdict: Steadiness
    sensors: tuple[int, ...]
    rivals: tuple[str, ...]

    @property
    def where(self) -> str:
        return self.case.scene.named(self.sensors, "all sensors")

    def of(self, effect: Mechanism, sentence: str, amplitude: str, factor: float) -> Finding:
        """The finding, amplitudes `factor` times the rms."""
        bump, rate, unit = self.bump, self.case.scene.rate, self.case.scene.measure
        centre_sd, width_sd = bump.log_sd
        if effect.name == "drifting_tone" or self.verdict.open:
            centre_sd = math.hypot(centre_sd, wandering_sd(self.case, bump) / bump.centre)
        parameters = {
            "frequency": spanned(lambda x: rate * math.exp(x), math.log(bump.centre), centre_sd, "Hz"),
            "width": spanned(lambda x: 2 * rate * math.exp(x), math.log(bump.width), width_sd, "Hz"),
        }
        if amplitude == "rms":
            spread = math.hypot(centre_sd, width_sd)
            quality = math.log(bump.centre / bump.width / 2)
            parameters["quality_factor"] = spanned(math.exp, quality, spread, "")
        for i in self.sensors:
            value, sd = float(bump.variance[i]), float(bump.variance_sd[i])
            parameters[f"{amplitude}[{i}]"] = spanned(lambda x: factor * math.sqrt(max(x, 0.0)), value, sd, unit)
            if bump.gain is not None:
                reference = bump.gain[bump.gain.abs().argmax()]
                turn = math.degrees(float((bump.gain[i] * reference.conj()).angle()))
                reach = math.degrees(Z * sd / (2 * value))
                parameters[f"phase[{i}]"] = Parameter(turn, turn - reach, turn + reach, "deg")
        other = ("resonance",) if effect.name == "drifting_tone" else ("drifting_tone",)
        alternatives = tuple(sorted({*self.rivals, *(other if self.verdict.open else ())} - {effect.name}))
        return Finding(
            effect.name,
            effect,
            sentence,
            bump.stretch.p_value,
            self.sensors,
            parameters,
            levels=(level_of(bump.centre),),
            alternatives=alternatives,
            frequency_hz=bump.centre * rate,
            gain=bump.nats,
        )

    @property
    def slow(self) -> bool:
        return self.verdict.slow


def nominated(case: Case, level: float, *, tone: bool) -> tuple[Mode, Seen] | None:
    """The strongest bump, if it is a tone, or if it is none."""
    bump = oscillation_of(case)
    rivals: tuple[str, ...] = ()
    if bump is None or bump.stretch.p_value > level:
        bump = likeliest_oscillation(case)
    if bump is None or bump.stretch.p_value > level:
        shape = chosen_shape(case, "resonance", level)
        if shape is None or not isinstance(shape.term, Bump | CommonBump):
            return None
        rivals = shape.alternatives
        centre, width = shape.term.shared.exp().tolist()
        bump = Oscillation.of(Stretch(centre, width, shape.p_value, ()), shape.term, shape.sd, shape.gain)
        # Which sensors it takes is a matter of likelihood: variances are as uncertain as the width is.
        has = shape.term.free.any(0)
    else:
        has = partakers(*_seen(bump)).which
    sensors = tuple(has.nonzero()[:, 0].tolist())
    verdict = steadiness(case, bump)
    steady = verdict.tone and bump.width <= _BROAD * bump.centre  # what is all over the spectrum is no tone
    if steady != tone or _momentary(case, bump) or swept(case, bump.nats, level):
        return None
    gain = bump.variance.clamp(min=0).sqrt().to(torch.complex128) if bump.gain is None else bump.gain
    mode = Mode(bump.centre, bump.width, gain, bump.gain is not None)
    return mode, Seen(case, bump, verdict, sensors, rivals)


def _seen(bump: Oscillation) -> tuple[Tensor, int]:
    """Squares `(sensor,)` of a bump in standard deviations, and their degrees of freedom: of gains two, complex."""
    squares = (bump.variance / bump.variance_sd).clamp(min=0).square()
    return (squares, 1) if bump.gain is None else (4 * squares, 2)  # sd of |g|^2 is 2 |g| times that of |g|


def _in_band(case: Case, bump: Oscillation) -> tuple[Tensor, float]:
    """Sensors summed in phase, in a band whose middle is the centre, and the power that noise alone has there.

    Complex samples `(time,)`, one for each bin of the band; none at the ends of the spectrum.
    """
    n = case.n_samples
    centre, reach = round(bump.centre * n), max(round(_BAND * bump.width * n), 2 * _PARTS)
    reach = min(reach, centre - 1, n // 2 - centre)
    if reach < 1:
        return torch.zeros(0, dtype=torch.complex128), 0.0
    strength = bump.variance.clamp(min=0).sqrt().to(torch.complex128) if bump.gain is None else bump.gain
    noise = case.base.spectrum(torch.tensor([bump.centre], dtype=torch.float64))[:, 0]
    weights = strength.conj() / noise
    bins = weights @ torch.fft.rfft(case.recording)[:, centre - reach : centre + reach]
    level = float(weights.abs().square() @ noise) * n / len(bins)
    return torch.fft.ifft(torch.fft.ifftshift(bins)), level


def _momentary(case: Case, bump: Oscillation) -> bool:
    """Whether one moment has most of it: what rings after a blow is neither noise through a resonance nor a tone."""
    z, level = _in_band(case, bump)
    length = len(z) // _MOMENTS
    if length < 1:
        return False
    excess = z[: length * _MOMENTS].unflatten(0, (_MOMENTS, length)).abs().square().mean(-1) - level
    return float(excess.max()) > _MOST_AT_ONCE * float(excess.sum().clamp(min=0))


def wandering_sd(case: Case, bump: Oscillation) -> float:
    """Standard deviation of a record's mean frequency that wanders, from means over its parts, cycles per sample.

    Of the sum of sensors in phase: the mean turn from sample to sample in a band whose middle is the centre, where
    white noise has none. Neighbouring parts that are alike make the mean of all as uncertain as fewer of them would.
    """
    z, _ = _in_band(case, bump)
    if len(z) < _FEWEST * _PARTS:
        return 0.0
    parts = z[: len(z) // _PARTS * _PARTS].unflatten(0, (_PARTS, -1))
    turns = (parts[:, 1:] * parts[:, :-1].conj()).sum(-1).angle() / (2 * math.pi)
    left = turns - turns.mean()
    alike = float((left[1:] * left[:-1]).sum() / left.square().sum())
    alike = min(max(alike + (1 + 4 * alike) / _PARTS, 0.0), _MOST_ALIKE)  # a mean of its own biases it down
    spread = float(left.square().sum()) / (_PARTS - 1) / _PARTS * (1 + alike) / (1 - alike)
    return math.sqrt(spread) * len(z) / case.n_samples


def refitted_mode(case: Case, fold: int, mode: Mode) -> Mode:
    """Numbers anew, without the blocks that a fold holds out.

    Sensors that do not have the mode are not to get what chance would give them.
    """
    found = _refitted(case, fold, mode)
    return replace(found, gain=found.gain * (mode.gain != 0))


def _refitted(case: Case, fold: int, mode: Mode) -> Mode:
    """The same centre and width, gains from the power in blocks that a fold does not hold out.

    A broad mode has no flanks of its own: it is fitted to the whole spectrum.
    """
    if not mode.shared and mode.width > _BROAD * mode.centre:
        start = Bump.start(mode.centre, mode.width, mode.gain.abs().square())
        term = refit(case, fold, replace(start, free=start.local > 0))
        centre, width = term.shared.exp().tolist()
        return Mode(centre, width, term.local[0].sqrt().to(torch.complex128), False)
    keep = estimation_samples(case.n_samples, fold)
    block = run_length(keep)
    blocks = case.lineless[:, keep].unflatten(-1, (-1, block))
    transform = torch.fft.rfft(blocks * light_taper(block)).movedim(-1, 0)  # (bin, sensor, block)
    f = torch.arange(len(transform), dtype=torch.float64) / block
    usable = (f > 2.5 / block) & (f < 0.5 - 2 / block) & ((f - mode.centre).abs() <= _REACH * (mode.width + 1 / block))
    if int(usable.sum()) < _FEWEST_BINS:
        return mode
    f, transform = f[usable], transform[usable]
    level = case.base.spectrum(f).mT.sqrt()
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
