"""Sensors whose clock is not that of the others, seen by a tone that recording and simulation share.

A sensor that takes its sample `t` at `(1 + skew) t + lost(t)` turns the phase of a tone of `f` cycles per sample by
`2 pi f` times what it is ahead: a slope, or steps. With `z_b` the whitened signal demodulated in `B` blocks, in units
of the noise, a path `phi_b` of the phase has the log likelihood `|sum z_b exp(-i phi_b)|^2 / B` with the best amplitude
and phase. No slip at all has as many numbers, so that chance gains `g` nats at no more than `exp(-g)` of the places.

The reference is an auxiliary channel with the same tone, where there is one, or else the other sensors.
"""

from __future__ import annotations

import cmath
import functools
import itertools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import Evidence
from gyrofuse.mismatch.lines import sets_of, simulated_lines
from gyrofuse.mismatch.remembered import remembered

BLOCKS = 512
_FEWEST_CYCLES = 2.0  # of a tone in a block
_TONES = 3
_CLEARER = 10.0  # times the evidence of any sensor that a channel needs to be the reference
_CYCLES, _FINER = 4, 32  # slip over the record that is looked for, and steps of a cycle
_MOST_LOST, _FEW_LOST = 8, 4  # samples at once
_COARSER = 4  # blocks in which two losses are looked for at once
_MOST_LOSSES = 16
_CERTAIN = 3.0  # nats that a further loss must gain beyond chance
_AS_GOOD = 2.0  # nats within which another number is as good


@dataclass(frozen=True)
class Loss:
    """Samples lost at once: the first sample after them, and how many, each with limits."""

    at: int
    count: int
    at_limits: tuple[int, int]
    count_limits: tuple[int, int]


@dataclass(frozen=True)
class Slip:
    """How the clock of some sensors runs away from the reference.

    Attributes:
        frequency: Of the tone in the reference, cycles per sample.
        sensors: Those that slip.
        skew: What they are ahead per sample, and its standard deviation `skew_sd`.
        losses: In the order of time.
        gain: Log likelihood over that of no slip, nats.
        log_p: Logarithm of the p value, for all sets of sensors, slopes and steps.
        reference: Name of the channel that tells; None where the other sensors do.
    """

    frequency: float
    sensors: tuple[int, ...]
    skew: float
    skew_sd: float
    losses: tuple[Loss, ...]
    gain: float
    log_p: float
    reference: str | None

    @property
    def p_value(self) -> float:
        return math.exp(min(self.log_p, 0.0))


class _Fit(NamedTuple):
    """A slip of one kind, its places in blocks.

    Attributes:
        which: Index of the set of sensors.
        slope, variance: Cycles over the record that they are ahead, and their variance.
        losses: Of samples.
        gain: Over no slip, nats.
        log_p: Logarithm of the p value for all places of the kind.
        rest: Cycles over the record by which the others differ from where they were looked for.
    """

    which: int
    slope: float
    variance: float
    losses: list[Loss]
    gain: float
    log_p: float
    rest: float


def clock_witness(case: Case) -> Evidence:
    """Phases of a shared tone that run away from each other."""
    slip = strongest_slip(case)
    if slip is None:
        return Evidence("clock", 1.0, "recording and simulation share no tone that would tell clocks apart")
    f = slip.frequency * case.scene.rate
    return Evidence(
        "clock",
        slip.p_value,
        f"the tone at {f:.6g} Hz slips in {case.scene.named(slip.sensors)}",
        sensors=slip.sensors,
        frequency_hz=f,
        time_s=slip.losses[0].at / case.scene.rate if slip.losses else None,
        channel=slip.reference,
    )


@remembered
def strongest_slip(case: Case) -> Slip | None:
    """The most likely slip of any tone that the recording shares with the simulation."""
    block = case.n_samples // BLOCKS
    tones = [f for f in simulated_lines(case.simulated) if f * block >= _FEWEST_CYCLES][:_TONES]
    if not tones:
        return None
    slips = [slip for f in tones for slip in _of_tone(case, f)]
    best = min(slips, key=lambda slip: slip.log_p, default=None)
    return None if best is None else replace(best, log_p=best.log_p + math.log(2 * len(tones)))


def demodulated(signal: Tensor, f: float) -> Tensor:
    """Signals `(row, time)` turned back by a tone, in blocks `(row, block)`, noise of variance one."""
    block = signal.shape[-1] // BLOCKS
    t = torch.arange(block * BLOCKS, dtype=torch.float64)
    angle = 2 * math.pi * f * t
    z = torch.complex(signal[:, : len(t)] * angle.cos(), -signal[:, : len(t)] * angle.sin())
    z = z.unflatten(-1, (BLOCKS, block)).mean(-1)
    # Least squares of both quadratures: in a block they are not orthogonal.
    image = torch.polar(torch.ones_like(t), -2 * angle).unflatten(-1, (BLOCKS, block)).mean(-1)
    z = (z - z.conj() * image) / (1 - image.abs().square())
    return z / (z.diff().abs().square().mean(-1, keepdim=True) / 2).sqrt().clamp(min=1e-300)


def best_slope(z: Tensor) -> tuple[float, float]:
    """Cycles over the record that fit demodulated rows `(row, block)` best, and their energy there, nats."""
    energy = _energy(z).sum(0)
    at = int(energy[1:-1].argmax()) + 1
    left, here, right = energy[at - 1 : at + 2].tolist()
    bend = left - 2 * here + right
    offset = (left - right) / (2 * bend) if bend < 0 else 0.0
    return float(_slopes()[at]) + max(min(offset, 1.0), -1.0) / _FINER, here


def _of_tone(case: Case, f: float) -> list[Slip]:
    """A skew and a loss of samples, as a tone of about `f` cycles per sample shows them."""
    z = demodulated(case.white, f)
    length = case.n_samples // BLOCKS * BLOCKS
    seen = _reference(case, f, float(_energy(z).amax()))
    if seen is None and len(z) < 2:
        return []
    name, slope, slope_variance = seen or (None, 0.0, 0.0)
    z = z * _turn(-slope)
    sets, log_chance = sets_of(len(z))
    if name is None:  # the smaller part is said to slip
        small = sets.sum(-1) <= len(z) / 2
        sets, log_chance = sets[small], log_chance[small]
    fixed = name is not None
    slips = []
    for fit in (
        _skewed(z, sets, log_chance, fixed=fixed),
        _lost(z, sets, log_chance, 2 * math.pi * (f + slope / length), fixed=fixed),
    ):
        tone = f + (slope + fit.rest) / length
        scale = 1 / (tone * length)
        slips.append(
            Slip(
                tone,
                tuple(sets[fit.which].nonzero()[:, 0].tolist()),
                fit.slope * scale,
                0.0 if fit.losses else math.sqrt(fit.variance + slope_variance) * scale,
                tuple(_in_samples(loss, length // BLOCKS) for loss in fit.losses),
                fit.gain,
                fit.log_p,
                name,
            )
        )
    return slips


def _in_samples(loss: Loss, block: int) -> Loss:
    first, last = loss.at_limits
    return Loss(loss.at * block, loss.count, ((first - 1) * block, (last + 1) * block), loss.count_limits)


def _reference(case: Case, f: float, strongest: float) -> tuple[str, float, float] | None:
    """Channel with the same tone, the cycles over the record by which it differs, and their variance."""
    best: tuple[str, float, float] | None = None
    for name, values in case.scene.channels.items():
        rows = values.to(torch.float64).reshape(-1, values.shape[-1])
        rows = rows - rows.mean(-1, keepdim=True)
        if not bool(rows.isfinite().all()) or not bool(rows.any(-1).all()):
            continue
        slope, energy = best_slope(demodulated(rows, f))
        if energy > _CLEARER * strongest:
            best, strongest = (name, slope, _variance(energy)), energy / _CLEARER
    return best


def _skewed(z: Tensor, sets: Tensor, log_chance: Tensor, *, fixed: bool) -> _Fit:
    """The most likely set of sensors with a skew, against a reference that is fixed or the other sensors."""
    energy = _energy(z)  # (sensor, slope)
    own, others = sets @ energy, (1 - sets) @ energy
    middle = energy.shape[-1] // 2
    gains = own.amax(-1) - own[:, middle] if fixed else own.amax(-1) + others.amax(-1) - energy.sum(0).amax()
    log_p = math.log(4 * _CYCLES) - gains - log_chance
    which = int(log_p.argmin())
    inside = sets[which].bool()
    slope, size = best_slope(z[inside])
    rest, rest_size = (0.0, math.inf) if fixed else best_slope(z[~inside])
    variance = _variance(size) + _variance(rest_size)
    return _Fit(which, slope - rest, variance, [], float(gains[which]), float(log_p[which]), rest)


def _lost(z: Tensor, sets: Tensor, log_chance: Tensor, angle: float, *, fixed: bool) -> _Fit:
    """The most likely set of sensors that lost samples, each of which turns the tone by `angle`."""
    rests, handicap = [0.0] * len(sets), torch.zeros(len(sets), dtype=torch.float64)
    if fixed:
        gains = (sets @ _step_gains(z, angle).flatten(1) - _counts_cost().repeat(BLOCKS - 1)).amax(-1)
    else:
        rests = [best_slope(z[~row.bool()])[0] for row in sets]
        turned = [z * _turn(-rest) for rest in rests]
        # No slip may have another slope than suits the others alone.
        alike = torch.stack([rows.sum(-1).abs().square().sum() / BLOCKS for rows in turned])
        handicap = (_energy(z).sum(0).amax() - alike).clamp(min=0.0)
        steps = (_step_gains(rows[row.bool()], angle).sum(0) for row, rows in zip(sets, turned, strict=True))
        gains = torch.stack([(step - _counts_cost()).amax() for step in steps]) - handicap
    which = int((gains + log_chance).argmax())
    straight = z[sets[which].bool()] * _turn(-rests[which])
    found = _best_losses(straight, angle)
    losses = []
    for at in sorted(found):
        near_best = _further(straight, {place: count for place, count in found.items() if place != at}, angle)
        near = near_best >= near_best.amax() - _AS_GOOD
        places, counts = near.any(-1).nonzero()[:, 0] + 1, near.any(0).nonzero()[:, 0] + 1
        limits = (int(places[0]), int(places[-1])), (int(counts[0]), int(counts[-1]))
        losses.append(Loss(at, found[at], *limits))
    gain, cost = _gain_of(straight, found, angle) - float(handicap[which]), _cost(found)
    return _Fit(which, 0.0, 0.0, losses, gain, cost - gain - float(log_chance[which]), rests[which])


def _best_losses(z: Tensor, angle: float) -> dict[int, int]:
    """Losses in rows `(row, block)` that all share: block after each, and how many samples.

    From the best one or two at once, one more as long as it gains enough, each time all of them moved to where they are
    best.
    """
    starts: list[dict[int, int]] = [{}, _best_pair(z, angle)]
    best: dict[int, int] = {}
    for found in starts:
        while len(found) < _MOST_LOSSES:
            longer = _moved(z, _with_best(z, found, angle), angle)
            gained = _gain_of(z, longer, angle) - _gain_of(z, found, angle) - _cost(longer) + _cost(found)
            if found and gained < _CERTAIN:
                break
            found = longer
        if not best or _gain_of(z, found, angle) - _cost(found) > _gain_of(z, best, angle) - _cost(best):
            best = found
    return best


def _best_pair(z: Tensor, angle: float) -> dict[int, int]:
    """The best two losses, places and counts coarsely."""
    sums = z.unflatten(-1, (-1, _COARSER)).sum(-1).cumsum(-1)
    first, second = torch.triu_indices(sums.shape[-1] - 1, sums.shape[-1] - 1, 1)
    parts = sums[:, first], sums[:, second] - sums[:, first], sums[:, -1:] - sums[:, second]
    best, found = -math.inf, {}
    for one, other in itertools.product(range(1, _FEW_LOST + 1), repeat=2):
        turned = parts[0] + cmath.exp(-1j * angle * one) * parts[1] + cmath.exp(-1j * angle * (one + other)) * parts[2]
        gain = turned.abs().square().sum(0) / BLOCKS - math.log(2) * (one + other)
        at = int(gain.argmax())
        if float(gain[at]) > best:
            best = float(gain[at])
            found = {_COARSER * (int(first[at]) + 1): one, _COARSER * (int(second[at]) + 1): other}
    return found


def _with_best(z: Tensor, losses: dict[int, int], angle: float) -> dict[int, int]:
    """Losses and the one more that gains most."""
    gain = _further(z, losses, angle)
    gain[[at - 1 for at in losses]] = -math.inf
    at, count = divmod(int(gain.argmax()), _MOST_LOST)
    return {**losses, at + 1: count + 1}


def _moved(z: Tensor, losses: dict[int, int], angle: float) -> dict[int, int]:
    """Losses, each in turn where it is best beside the others."""
    for _ in range(2):
        for at in list(losses):
            losses = _with_best(z, {place: count for place, count in losses.items() if place != at}, angle)
    return losses


def _further(z: Tensor, losses: dict[int, int], angle: float) -> Tensor:
    """Gain of one loss beside others in all rows, less what its count costs, nats, `(place, count)`."""
    return _step_gains(_put_back(z, losses, angle), angle).sum(0) - _counts_cost()


def _gain_of(z: Tensor, losses: dict[int, int], angle: float) -> float:
    """Gain of losses in all rows, nats."""
    energies = [rows.sum(-1).abs().square().sum() / BLOCKS for rows in (_put_back(z, losses, angle), z)]
    return float(energies[0] - energies[1])


def _cost(losses: dict[int, int]) -> float:
    """Logarithm of how many places and counts losses are chosen from: each further sample is half as likely."""
    return len(losses) * math.log(BLOCKS - 1) + math.log(2) * sum(losses.values())


def _counts_cost() -> Tensor:
    return math.log(2) * torch.arange(1, _MOST_LOST + 1, dtype=torch.float64)


def _step_gains(z: Tensor, angle: float) -> Tensor:
    """Gain of one loss in each row `(row, block)`, nats, `(row, place, count)`."""
    before = z.cumsum(-1)
    whole, before = before[:, -1:], before[:, :-1]
    turn = torch.polar(torch.ones(_MOST_LOST, dtype=torch.float64), -angle * torch.arange(1.0, _MOST_LOST + 1).double())
    turned = before[..., None] + (whole - before)[..., None] * turn
    return (turned.abs().square() - whole[..., None].abs().square()) / BLOCKS


def _put_back(z: Tensor, losses: dict[int, int], angle: float) -> Tensor:
    """Rows without the steps of the phase that losses made."""
    lost = torch.zeros(BLOCKS, dtype=torch.float64)
    for at, count in losses.items():
        lost[at:] += count
    return z * torch.polar(torch.ones_like(lost), -angle * lost)


def _slopes() -> Tensor:
    """Cycles over the record that are tried, `(slope,)`, 0 in the middle."""
    return torch.arange(-_CYCLES * _FINER, _CYCLES * _FINER + 1, dtype=torch.float64) / _FINER


def _turn(cycles: float | Tensor) -> Tensor:
    """`exp(2 pi i cycles s)` at the blocks' places `s` from 0 to 1."""
    s = (torch.arange(BLOCKS, dtype=torch.float64) + 0.5) / BLOCKS
    phase = 2 * math.pi * torch.as_tensor(cycles, dtype=torch.float64)[..., None] * s
    return torch.polar(torch.ones_like(phase), phase)


def _energy(z: Tensor) -> Tensor:
    """Energy of a tone with each slope of the phase, nats, `(row, slope)`."""
    return (z @ _all_turns()).abs().square() / BLOCKS


@functools.cache
def _all_turns() -> Tensor:
    """What turns a phase of each slope back, `(block, slope)`."""
    return _turn(-_slopes()).mT


def _variance(energy: float) -> float:
    """Of the slope of a phase, cycles over the record, for a tone of so many nats: Cramer and Rao."""
    return 6 / (4 * math.pi**2 * max(energy, 1.0))
