"""Test of clocks: sensors that sample at another rate than the others, or lose samples, by a tone that all feel.

A sensor that takes its sample `t` at `(1 + skew) t + lost(t)` turns the phase of a tone of `f` cycles per sample by
`2 pi f` times what it is ahead: a slope, or steps. With `z_b` the whitened signal demodulated in `B` blocks, in units
of the noise, a path `phi_b` of the phase has the log likelihood `|sum z_b exp(-i phi_b)|^2 / B` with the best amplitude
and phase.

Statistic: mean likelihood ratio over paths and sets of sensors; the hypothesis of one clock has as many numbers, so
that its expectation is one. Null law: that of an e-value (`p_value_from_e_value`). The reference is an auxiliary
channel with the same tone, where there is one, or else the other sensors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import CERTAIN, NATS_AS_GOOD
from gyrofuse.mismatch.detectors.lines.demodulation import (
    BLOCKS,
    best_slope,
    demodulated,
    energy_by_slope,
    slope_variance,
    turn_by,
)
from gyrofuse.mismatch.detectors.lines.lost_samples import Loss, losses_of, paths_of, put_back
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.known_lines import without_lines
from gyrofuse.mismatch.signals.lines import sets_of, simulated_lines, whitened
from gyrofuse.mismatch.stats.multiplicity import e_value_of, p_value_from_e_value

SIMULATION = "the simulation"  # as the reference of a clock
_IN_PHASE = 0.9  # share of a tone's power that has one phase: a tenth may be something else


@dataclass(frozen=True)
class Slip:
    """How the clock of some sensors runs away from the reference.

    Attributes:
        frequency: Frequency of the tone in the reference, cycles per sample.
        sensors: Positions of the sensors that slip.
        skew: Samples that they are ahead per sample, and the standard deviation `skew_sd`.
        losses: Losses of samples in the order of time.
        lost: Limits of the samples lost in all.
        gain: Log likelihood over that of no slip, nats.
        log_ratio: Logarithm of the mean likelihood ratio over sets of sensors, tones, and slopes or steps.
        reference: Name of the reference channel, or `SIMULATION`; None where the other sensors are the reference.
    """

    frequency: float
    sensors: tuple[int, ...]
    skew: float
    skew_sd: float
    losses: tuple[Loss, ...]
    lost: tuple[int, int]
    gain: float
    log_ratio: float
    reference: str | None

    @property
    def p_value(self) -> float:
        """p value of no slip."""
        return p_value_from_e_value(self.log_ratio)

    def among(self, alike: float) -> Slip:
        """What is known of it where so many sensors count as one."""
        return replace(
            self, gain=self.gain / alike, log_ratio=self.log_ratio / alike, skew_sd=self.skew_sd * math.sqrt(alike)
        )


class _Fit(NamedTuple):
    """The most likely slip of one kind, times in blocks.

    Attributes:
        which: Index of the set of sensors.
        slope, variance: Cycles over the record that they are ahead, and the variance of that.
        losses: Losses of samples.
        lost: Limits of the samples lost in all.
        gain: Log likelihood over that of no slip, nats.
        log_ratio: Logarithm of the mean likelihood ratio over all sets and paths of the kind.
        rest: Cycles over the record by which the tone of the others differs from the frequency assumed.
        angle: Angle by which one lost sample turns the tone.
    """

    which: int
    slope: float
    variance: float
    losses: list[Loss]
    lost: tuple[int, int]
    gain: float
    log_ratio: float
    rest: float
    angle: float = 0.0


def clock_test(comparison: Comparison) -> TestResult:
    """Phases of a shared tone that drift apart."""
    slip = strongest_slip(comparison)
    if slip is None:
        return TestResult("clock", 1.0, "recording and simulation share no tone that would show their clocks")
    f = slip.frequency * comparison.info.rate
    return TestResult(
        "clock",
        slip.p_value,
        f"the tone at {f:.6g} Hz slips in {comparison.info.named(slip.sensors)}",
        sensors=slip.sensors,
        frequency_hz=f,
        time_s=slip.losses[0].at / comparison.info.rate if slip.losses else None,
        channel=None if slip.reference == SIMULATION else slip.reference,
    )


@derived
def strongest_slip(comparison: Comparison) -> Slip | None:
    """The most likely slip of any tone that the recording shares with the simulation, or that is new and steady."""
    block = comparison.n_samples // BLOCKS
    lines, found = simulated_lines(comparison.reference), comparison.line
    slowest = 1 / block  # a cycle in a block, or more
    shared = [f for f in lines if f >= slowest and not _rings(comparison, f) and _in_both(comparison, f)]
    tones = [f for f in shared if not _elsewhere(comparison, f)][:3]
    if found.p_value < CERTAIN and found.frequency * block >= 1 and _steady(comparison, found.frequency):
        tones.append(found.frequency)
    simulated = [
        slip.among(_alike(comparison, f))
        for f in shared[:3]
        if not comparison.wandering((f,)) and (slip := _from_simulated(comparison, f)) is not None
    ]
    if not tones and not simulated:
        return None
    apart = 4 / comparison.n_samples  # a tone that fades is wider than a bin, and its skirts are no other lines
    slips = [slip for f in tones for slip in _of_tone(comparison, f, tuple(o for o in lines if abs(o - f) > apart))]
    best = max([*slips, *simulated], key=lambda slip: slip.log_ratio, default=None)
    return None if best is None else replace(best, log_ratio=best.log_ratio - math.log(2 * len({*tones, *shared[:3]})))


def _from_simulated(comparison: Comparison, f: float) -> Slip | None:
    """All sensors together against a tone of the simulation, which they have in one phase but for a slope or steps."""
    observed = demodulated(comparison.white, f)
    simulated = demodulated(_white_simulation(comparison), f)
    power, energy = _power_and_energy(observed)
    (slope, size), (other, their_size) = best_slope(observed), best_slope(simulated)
    length = comparison.n_samples // BLOCKS * BLOCKS
    same = comparison.reference.signal.shape[-1] / comparison.n_samples  # of another length: slopes are over the record
    if min(size, their_size) < 2 * NATS_AS_GOOD:
        return None
    whole, straight = float(power.clamp(min=0).sum()), float(energy.sum())
    if straight < whole - 2 * NATS_AS_GOOD:  # steps may be better
        turned = observed * turn_by(-other / same)
        steps = _lost_by_all(turned, f + other / same / length, length // BLOCKS, straight + NATS_AS_GOOD)
        if steps is not None:
            return steps
    if straight < _IN_PHASE * whole:
        return None
    variance = slope_variance(size) + slope_variance(their_size) / same**2
    z = (slope - other / same) / math.sqrt(variance)
    scale = 1 / (f * length)
    return Slip(
        f,
        tuple(range(comparison.n_sensors)),
        (slope - other / same) * scale,
        math.sqrt(variance) * scale,
        (),
        (0, 0),
        z**2 / 2,
        e_value_of(math.erfc(abs(z) / math.sqrt(2))),
        SIMULATION,
    )


@derived
def _white_simulation(comparison: Comparison) -> Tensor:
    """The simulation's first record in units of the recording's noise, `(sensor, time)`."""
    return whitened(comparison.reference.signal[0], comparison.base)


def _in_both(comparison: Comparison, f: float) -> bool:
    """Whether a tone of the simulation is in the recording: what noise is left there in common has a phase as well."""
    least = 0.02  # of its power
    white = _white_simulation(comparison)
    theirs = _power_and_energy(demodulated(white, f))[0].clamp(min=0).sum()
    own = _power_and_energy(demodulated(comparison.white, f))[0].clamp(min=0).sum()
    return float(own / comparison.n_samples) > least * float(theirs / white.shape[-1])


def _alike(comparison: Comparison, f: float) -> float:
    """How many sensors count as one by the noise that they share in bands beside `f`: all have one path of phase."""
    beside = 2  # bands on either side
    coherence, at = comparison.reference.coherence, int((comparison.bands.frequency - f).abs().argmin())
    around = torch.cat([coherence[max(at - beside, 0) : at], coherence[at + 1 : at + 1 + beside]])
    return float(torch.linalg.eigvalsh(around.mean(0).abs())[-1]) if len(around) else 1.0


def _lost_by_all(z: Tensor, f: float, block: int, least: float) -> Slip | None:
    """Samples that all sensors lost at once, each by itself in one phase again once these are put back.

    Args:
        z: Tone of the sensors against that of the simulation, demodulated, `(sensor, block)`.
        f: Its frequency, cycles per sample.
        block: Samples of a block.
        least: Energy in one phase that has to be surpassed, nats.
    """
    angle = 2 * math.pi * f
    fit = _lost(z, torch.ones(1, len(z), dtype=torch.float64), torch.zeros(1, dtype=torch.float64), angle, fixed=True)
    back = put_back(z, {loss.at: loss.count for loss in fit.losses}, angle)
    in_phase, whole = float(back.sum(-1).abs().square().sum()) / BLOCKS, float(z.abs().square().sum()) - z.numel()
    if not fit.losses or in_phase < max(_IN_PHASE * whole, least):
        return None
    losses = tuple(_in_samples(loss, block) for loss in fit.losses)
    return Slip(f, tuple(range(len(z))), 0.0, 0.0, losses, fit.lost, fit.gain, fit.log_ratio, SIMULATION)


def _elsewhere(comparison: Comparison, f: float) -> bool:
    """Whether what is near a line of the simulation has its phase in no sensor: it is a line of another frequency."""
    power, energy = _power_and_energy(demodulated(comparison.white, f))
    return float(power.max()) > 2 * NATS_AS_GOOD and not bool((energy > power / 2)[power > power.max() / 100].any())


def _steady(comparison: Comparison, f: float) -> bool:
    """Whether a line is a tone of one phase in every sensor that has it, but for a slope: that of noise wanders."""
    power, energy = _power_and_energy(demodulated(comparison.white, f))
    has = power > NATS_AS_GOOD + power.max() / 100
    return bool((energy > _IN_PHASE * power)[has].all()) and int(has.sum()) > 1


def _power_and_energy(z: Tensor) -> tuple[Tensor, Tensor]:
    """Power of rows `(row, block)` above noise, and what a phase with the best slope has of it, `(row,)`."""
    return z.abs().square().sum(-1) - BLOCKS, energy_by_slope(z).amax(-1)


def _rings(comparison: Comparison, f: float) -> bool:
    """Whether a line of the simulation lies on a mode that was found: noise, whose phase is no clock."""
    return any(abs(f - centre) < 4 * (width + 1 / comparison.n_samples) for centre, width in comparison.modes)


def _course(z: Tensor) -> Tensor:
    """Amplitude of a tone in the blocks of rows `(row, block)`, of mean square one: weights; ones where it is steady.

    Where it has died away a phase is that of noise, and with a steady weight as good as any other.
    """
    part, sure = 32, 6.0  # blocks; standard deviations
    power = z.abs().square().unflatten(-1, (-1, part)).mean((0, -1)) - 1  # (part,)
    sd = ((1 + 2 * power.mean().clamp(min=0)) / (part * len(z))).sqrt()
    if float((power - power.mean()).abs().amax()) < sure * float(sd):
        return torch.ones(z.shape[-1], dtype=power.dtype)
    weight = torch.where(power > 2 * sd, power, 0.0).clamp(min=0).sqrt().repeat_interleave(part)
    return weight / weight.square().mean().sqrt().clamp(min=1e-300)


def _back_from_wander(z: Tensor) -> Tensor:
    """What turns blocks of rows `(row, block)` back by the phase that all rows wander through; ones where none does.

    All sensors are nearer to one phase then, each by itself: where one of them slips, what it shares with the others is
    half of its slip, and the others are farther off.
    """
    near = 9  # blocks of a phase
    turn = torch.ones_like(z[0])
    power, straight = _power_and_energy(z)
    loud = power > power.max() / 20
    if int(loud.sum()) < 2:
        return turn
    for _ in range(2):  # the phases of the sensors and that of the blocks in turns
        own = (z * turn).sum(-1, keepdim=True)
        common = (z * own.conj() / own.abs().clamp(min=1e-300))[loud].sum(0)
        both = torch.stack([common.real, common.imag])
        smooth = torch.nn.functional.avg_pool1d(both, near, 1, near // 2, count_include_pad=False)
        turn = torch.polar(torch.ones_like(smooth[0]), -torch.atan2(smooth[1], smooth[0]))
    gained = (z * turn).sum(-1).abs().square() / BLOCKS - straight
    by_chance = BLOCKS / near / 2 / int(loud.sum())  # nats that as many phases gain
    return turn if bool((gained > 2 * by_chance + NATS_AS_GOOD)[loud].all()) else torch.ones_like(turn)


def _in_step(z: Tensor) -> bool:
    """Whether the phase of a tone `(row, block)` wanders, alike in every sensor that has much of it."""
    power, straight = _power_and_energy(z)
    loud, least = power > power.max() / 20, 0.97  # share of what has one phase against the loudest
    size = z.abs() * z[power.argmax()].abs()
    alike = (z * z[power.argmax()].conj()).sum(-1).abs() > least * size.sum(-1)
    return bool((straight < _IN_PHASE * power)[loud].any()) and bool(alike[loud].all())


def _of_tone(comparison: Comparison, f: float, others: tuple[float, ...]) -> list[Slip]:
    """A skew and a loss of samples, as a tone of about `f` cycles per sample shows them, beside other ones."""
    z = demodulated(
        whitened(without_lines(comparison.recording, others), comparison.base) if others else comparison.white, f
    )
    in_step = _in_step(z)
    z = z * _course(z)
    z = z * _back_from_wander(z)
    length = comparison.n_samples // BLOCKS * BLOCKS
    found = _reference(comparison, f, float(energy_by_slope(z).amax()))
    if found is None and (len(z) < 2 or in_step):
        return []
    name, slope, of_reference = found or (None, 0.0, 0.0)
    z = z * turn_by(-slope)
    sets, log_chance = sets_of(len(z))
    if name is None:  # by convention the smaller part slips
        small = sets.sum(-1) <= len(z) / 2
        sets, log_chance = sets[small], log_chance[small]
    fixed = name is not None
    slips = []
    for fit in (
        _skewed(z, sets, log_chance, fixed=fixed),
        _lost(z, sets, log_chance, 2 * math.pi * (f + slope / length), fixed=fixed),
    ):
        inside = sets[fit.which].bool()
        if fixed and len(sets) <= len(z) + 1:  # of so many sensors not every set was tried
            inside, more = _with_the_like(z, inside, fit)
            fit = fit._replace(gain=fit.gain + more)
        tone = f + (slope + fit.rest) / length
        scale = 1 / (tone * length)
        slips.append(
            Slip(
                tone,
                tuple(inside.nonzero()[:, 0].tolist()),
                fit.slope * scale,
                0.0 if fit.losses else math.sqrt(fit.variance + of_reference) * scale,
                tuple(_in_samples(loss, length // BLOCKS) for loss in fit.losses),
                fit.lost,
                fit.gain,
                fit.log_ratio,
                name,
            )
        )
    return slips


def _with_the_like(z: Tensor, inside: Tensor, fit: _Fit) -> tuple[Tensor, float]:
    """A set of sensors `(sensor,)` with all others whose tone the same slip explains, and the nats that these gain."""
    lost = {loss.at: loss.count for loss in fit.losses}
    back = put_back(z, lost, fit.angle) if lost else z * turn_by(-fit.slope)
    gains = (back.sum(-1).abs().square() - z.sum(-1).abs().square()) / BLOCKS
    more = ~inside & (gains > math.log(len(z)) + NATS_AS_GOOD)
    return inside | more, float(gains[more].sum())


def _in_samples(loss: Loss, block: int) -> Loss:
    first, last = loss.at_limits
    return Loss(loss.at * block, loss.count, ((first - 1) * block, (last + 1) * block))


def _reference(comparison: Comparison, f: float, strongest: float) -> tuple[str, float, float] | None:
    """Channel with the same tone, the cycles over the record by which it differs, and their variance."""
    best: tuple[str, float, float] | None = None
    for name, values in comparison.info.channels.items():
        rows = values.to(torch.float64).reshape(-1, values.shape[-1])
        rows = rows - rows.mean(-1, keepdim=True)
        if not bool(rows.isfinite().all()) or not bool(rows.any(-1).all()):
            continue
        slope, energy = best_slope(demodulated(rows, f))
        if energy > 10 * strongest:  # its phase is known well beside that of any sensor
            best, strongest = (name, slope, slope_variance(energy)), energy / 10
    return best


def _skewed(z: Tensor, sets: Tensor, log_chance: Tensor, *, fixed: bool) -> _Fit:
    """The most likely set of sensors with a skew, against a reference that is fixed or the other sensors."""
    energy = energy_by_slope(z)  # (sensor, slope)
    own = sets @ energy
    middle = energy.shape[-1] // 2
    # Without a channel both parts have their best slopes, and no slip has the best slope of all.
    over = -own[:, middle] if fixed else ((1 - sets) @ energy).amax(-1) - energy.sum(0).amax()
    gains = own.amax(-1) + over
    means = torch.logsumexp(own, -1) - math.log(own.shape[-1]) + over
    which = int((gains + log_chance).argmax())
    inside = sets[which].bool()
    slope, size = best_slope(z[inside])
    rest, rest_size = (0.0, math.inf) if fixed else best_slope(z[~inside])
    variance = slope_variance(size) + slope_variance(rest_size)
    ratio = float(torch.logsumexp(means + log_chance, 0))
    return _Fit(which, slope - rest, variance, [], (0, 0), float(gains[which]), ratio, rest)


def _lost(z: Tensor, sets: Tensor, log_chance: Tensor, angle: float, *, fixed: bool) -> _Fit:
    """The most likely set of sensors that lost samples, each of which turns the tone by `angle`."""
    rests, handicap = [0.0] * len(sets), torch.zeros(len(sets), dtype=torch.float64)
    if not fixed:
        rests = [best_slope(z[~row.bool()])[0] for row in sets]
    straight = z * turn_by(-torch.tensor(rests, dtype=torch.float64))[:, None]  # (set, sensor, block)
    if not fixed:
        # No slip may have another slope than is best for the others alone.
        straight_energy = straight.sum(-1).abs().square().sum(-1) / BLOCKS
        handicap = (energy_by_slope(z).sum(0).amax() - straight_energy).clamp(min=0.0)
    paths = paths_of(straight, sets, angle)
    ratios = paths.log_ratio - handicap + log_chance
    which = int(ratios.argmax())
    losses, gain = losses_of(straight[which, sets[which].bool()], paths.lost[which], angle)
    low, high = paths.limits(which)
    count = sum(loss.count for loss in losses)
    lost = min(low, count), max(high, count)
    gain -= float(handicap[which])
    return _Fit(which, 0.0, 0.0, losses, lost, gain, float(torch.logsumexp(ratios, 0)), rests[which], angle)
