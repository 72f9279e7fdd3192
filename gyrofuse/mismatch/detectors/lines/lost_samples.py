"""Samples that sensors lost, as steps in the phase of a tone, and the mean likelihood ratio over where and how many.

Beforehand a loss is as likely in any block, and each further sample in it half as likely. With amplitudes `a` of the
tone in the rows, what was lost before a block is the state of a hidden Markov chain: forward and backward passes give
the likelihood of all paths together, and their mean turn gives better amplitudes (Baum). Over the likelihood of no loss
with its own best amplitudes that is a mean likelihood ratio. What more a maximum over amplitudes gains is less than the
factor of twenty that is not claimed: `exp(x) P(log ratio > x)` was at most 0.025 among 1600 drawn tones, of one
sensor and of six, 0.05 to 2 sd in a block.
"""

from __future__ import annotations

import cmath
import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

_STEPS, _STATES = 128, 20  # of the chain: times, and samples lost, from 0
_EXPECTED = 2.0  # losses
_TOTALS = (2, 3, 4, 5, 6, 8)  # lost evenly over the record, as paths to begin with
_PLACES, _AT_ONCE = (0.2, 0.4, 0.6, 0.8), (1, 2)  # of a single loss, likewise
_PARTS = (16, 8, 4)  # of the record, at the start of which nothing may be lost yet
_ROUNDS, _KEPT = 4, 3
_MOST_LOST, _FEW_LOST = 8, 4  # samples at once
_COARSER = 4  # blocks in which two losses are looked for at once
_MOST_LOSSES = 16
_CERTAIN = 3.0  # nats that a further loss must gain beyond chance
_AS_GOOD = 2.0  # nats within which another number is as good
_NEAR = 2  # blocks between losses that may be one
_HOPELESS = 500.0  # nats below the likeliest state at one time, of a loud tone
_BEYOND = 0.025  # probability of totals beyond a limit


@dataclass(frozen=True)
class Loss:
    """Samples lost at once: the first sample after them, with limits, and how many."""

    at: int
    count: int
    at_limits: tuple[int, int]


class Paths(NamedTuple):
    """What was lost by sets of sensors.

    Attributes:
        log_ratio: Log of the mean likelihood ratio, `(set,)`.
        lost: Mean of what was lost before each step of the chain, `(set, step)`.
        total: Probabilities of what was lost in all, `(set, state)`.
    """

    log_ratio: Tensor
    lost: Tensor
    total: Tensor

    def limits(self, which: int) -> tuple[int, int]:
        """Of the total of a set."""
        below = self.total[which].cumsum(0)
        return int((below < _BEYOND).sum()), int((below < 1 - _BEYOND).sum())


def paths_of(z: Tensor, sets: Tensor, angle: float) -> Paths:
    """All paths together, of every set of sensors.

    Args:
        z: Demodulated, in units of the noise, straight but for losses, `(set, sensor, block)`.
        sets: Ones where a sensor is in it, `(set, sensor)`.
        angle: By which one lost sample turns the tone.
    """
    z = z.unflatten(-1, (_STEPS, -1)).sum(-1) / math.sqrt(z.shape[-1] // _STEPS) * sets[..., None]
    alike = z.sum(-1).abs().square().sum(-1) / _STEPS
    turn = torch.polar(torch.ones(_STATES, dtype=torch.float64), -angle * torch.arange(_STATES, dtype=torch.float64))
    chain = _chain()
    starts = turn[_starts()]  # (start, step)
    early = [z[..., : _STEPS // part].mean(-1) for part in _PARTS]
    amplitude = torch.cat([(z @ starts.mT / _STEPS).movedim(-1, 1), torch.stack(early, 1)], 1)  # (set, start, sensor)
    for number in range(_ROUNDS):
        projected = (amplitude.conj() @ z)[..., None] * turn
        squares = amplitude.abs().square().sum(-1)[..., None, None]
        log_likelihood, states = _passed((2 * projected.real - squares).flatten(0, 1), chain)
        log_ratio = log_likelihood.view(len(z), -1) - alike[:, None]
        states = states.unflatten(0, log_ratio.shape)
        kept = log_ratio.topk(_KEPT if number < _ROUNDS - 1 else 1).indices
        states = states[torch.arange(len(z))[:, None], kept]
        amplitude = (states.to(turn.dtype) @ turn) @ z.mT / _STEPS
    lost = states[:, 0] @ torch.arange(_STATES, dtype=torch.float64)
    return Paths(log_ratio.amax(-1), lost, states[:, 0, -1])


def _starts() -> Tensor:
    """Paths to begin with, `(start, step)`."""
    s = (torch.arange(_STEPS, dtype=torch.float64) + 0.5) / _STEPS
    even = [(total * s).floor() for total in (0, *_TOTALS)]
    single = [count * (s > place) for place, count in itertools.product(_PLACES, _AT_ONCE)]
    return torch.stack([*even, *(path.to(s.dtype) for path in single)]).long()


def _chain() -> Tensor:
    """Probabilities of steps from state to state, `(state, state)`."""
    states = torch.arange(_STATES, dtype=torch.float64)
    more = states - states[:, None]
    rate = _EXPECTED / _STEPS
    chain = torch.where(more > 0, rate * 0.5 ** more.clamp(min=0), 0.0) + (1 - rate) * (more == 0)
    return chain / chain.sum(-1, keepdim=True)


def _passed(log_likelihood: Tensor, chain: Tensor) -> tuple[Tensor, Tensor]:
    """Log likelihood of all paths `(item,)`, and probabilities `(item, step, state)`, from `(item, step, state)`."""
    peak = log_likelihood.amax(-1, keepdim=True)
    likelihood = (log_likelihood - peak).clamp(min=-_HOPELESS).exp()  # some state is always possible
    total, before = peak.sum((-1, -2)), chain[0].expand(len(peak), -1)
    forward = []
    for step in range(_STEPS):
        here = before * likelihood[:, step]
        size = here.sum(-1, keepdim=True)
        total = total + size[:, 0].log()
        forward.append(here / size)
        before = forward[-1] @ chain
    after, states = torch.ones_like(before), [forward[-1]]
    for step in range(_STEPS - 1, 0, -1):
        after = (after * likelihood[:, step]) @ chain.mT
        after = after / after.sum(-1, keepdim=True)
        here = forward[step - 1] * after
        here = torch.where(here.sum(-1, keepdim=True) > 0, here, forward[step - 1])  # of a path that none can be
        states.append(here / here.sum(-1, keepdim=True))
    return total, torch.stack(states[::-1], 1)


def losses_of(z: Tensor, lost: Tensor, angle: float) -> tuple[list[Loss], float]:
    """Single losses in rows `(row, block)` that all share, places in blocks, and their gain over none, nats.

    Args:
        z: Straight but for losses.
        lost: What was lost before each step of a chain, `(step,)`: where to begin.
        angle: By which one lost sample turns the tone.
    """
    found = _best_losses(z, lost, angle)
    losses = []
    for at in sorted(found):
        near_best = _further(z, {place: count for place, count in found.items() if place != at}, angle)
        places = (near_best >= near_best.amax() - _AS_GOOD).any(-1).nonzero()[:, 0] + 1
        losses.append(Loss(at, found[at], (int(places[0]), int(places[-1]))))
    return losses, _gain_of(z, found, angle)


def _best_losses(z: Tensor, lost: Tensor, angle: float) -> dict[int, int]:
    """Losses in rows `(row, block)` that all share: block after each, and how many samples.

    From the best one or two at once, or where a path steps, one more as long as it gains enough, each time all of them
    moved to where they are best.
    """
    starts: list[dict[int, int]] = [{}, _best_pair(z, angle), _steps_of(lost, z.shape[-1])]
    best: dict[int, int] = {}
    for start in starts:
        found = _moved(z, start, angle)  # what moving gains is not one more's
        while len(found) < _MOST_LOSSES:
            longer = _moved(z, _with_best(z, found, angle), angle)
            if found and _worth(z, longer, angle) - _worth(z, found, angle) < _CERTAIN:
                break
            found = longer
        found = _merged(z, found, angle)
        if not best or _worth(z, found, angle) > _worth(z, best, angle):
            best = found
    return best


def _merged(z: Tensor, losses: dict[int, int], angle: float) -> dict[int, int]:
    """Losses next to each other as one, or none, where all but the blocks between them is told as well.

    In a block in which samples are lost a loud tone has a phase in between, which another loss before it would have.
    """
    for first, second in itertools.pairwise(sorted(losses)):
        if second - first > _NEAR or first not in losses:
            continue
        clear = z.clone()
        clear[:, first - 1 : second + 1] = 0.0
        others = {at: count for at, count in losses.items() if at not in (first, second)}
        instead = [others, *({**others, second: count} for count in range(1, _MOST_LOST + 1))]
        simpler = max(instead, key=lambda losses: _worth(clear, losses, angle))
        if _worth(clear, simpler, angle) > _worth(clear, losses, angle):
            moved = _moved_one(z, simpler, second, angle) if second in simpler else simpler
            return _merged(z, moved, angle)
    return losses


def _moved_one(z: Tensor, losses: dict[int, int], which: int, angle: float) -> dict[int, int]:
    """Losses, one of them where it is best with its count."""
    others = {at: count for at, count in losses.items() if at != which}
    gain = _further(z, others, angle)[:, losses[which] - 1]
    gain[[at - 1 for at in others]] = -math.inf
    return {**others, int(gain.argmax()) + 1: losses[which]}


def _steps_of(lost: Tensor, n_blocks: int) -> dict[int, int]:
    """Where a path steps, and by how much."""
    steps = lost.round().diff().long()
    wide = n_blocks // len(lost)
    return {wide * (at + 1): min(int(steps[at]), _MOST_LOST) for at in steps.nonzero()[:, 0].tolist()[:_MOST_LOSSES]}


def _best_pair(z: Tensor, angle: float) -> dict[int, int]:
    """The best two losses, places and counts coarsely."""
    sums = z.unflatten(-1, (-1, _COARSER)).sum(-1).cumsum(-1)
    first, second = torch.triu_indices(sums.shape[-1] - 1, sums.shape[-1] - 1, 1)
    parts = sums[:, first], sums[:, second] - sums[:, first], sums[:, -1:] - sums[:, second]
    best, found = -math.inf, {}
    for one, other in itertools.product(range(1, _FEW_LOST + 1), repeat=2):
        turned = parts[0] + cmath.exp(-1j * angle * one) * parts[1] + cmath.exp(-1j * angle * (one + other)) * parts[2]
        gain = turned.abs().square().sum(0) / z.shape[-1] - math.log(2) * (one + other)
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
    return _step_gains(put_back(z, losses, angle), angle).sum(0) - _counts_cost()


def _gain_of(z: Tensor, losses: dict[int, int], angle: float) -> float:
    """Gain of losses in all rows, nats."""
    energies = [rows.sum(-1).abs().square().sum() / z.shape[-1] for rows in (put_back(z, losses, angle), z)]
    return float(energies[0] - energies[1])


def _worth(z: Tensor, losses: dict[int, int], angle: float) -> float:
    """Their gain less the logarithm of how many places and counts they are chosen from, as likely as beforehand."""
    cost = len(losses) * math.log(z.shape[-1] - 1) + math.log(2) * sum(losses.values())
    return _gain_of(z, losses, angle) - cost


def _counts_cost() -> Tensor:
    return math.log(2) * torch.arange(1, _MOST_LOST + 1, dtype=torch.float64)


def _step_gains(z: Tensor, angle: float) -> Tensor:
    """Gain of one loss in each row `(row, block)`, nats, `(row, place, count)`."""
    before = z.cumsum(-1)
    whole, before = before[:, -1:], before[:, :-1]
    turn = torch.polar(torch.ones(_MOST_LOST, dtype=torch.float64), -angle * torch.arange(1.0, _MOST_LOST + 1).double())
    turned = before[..., None] + (whole - before)[..., None] * turn
    return (turned.abs().square() - whole[..., None].abs().square()) / z.shape[-1]


def put_back(z: Tensor, losses: dict[int, int], angle: float) -> Tensor:
    """Rows without the steps of the phase that losses made."""
    lost = torch.zeros(z.shape[-1], dtype=torch.float64)
    for at, count in losses.items():
        lost[at:] += count
    return z * torch.polar(torch.ones_like(lost), -angle * lost)
