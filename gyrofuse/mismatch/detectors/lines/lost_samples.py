"""Samples that sensors lost, as steps in the phase of a tone: a mean likelihood ratio over all paths; single losses.

Beforehand a loss is as likely in any block, and each further sample in it half as likely. With amplitudes `a` of the
tone in the rows, the number of samples lost before a block is the state of a hidden Markov chain: its forward and
backward passes give the likelihood of all paths together, and their mean turn gives better amplitudes (Baum). Over the
likelihood of no loss with its own best amplitudes that is a mean likelihood ratio. By how much a maximum over
amplitudes exceeds a mean is less than the factor of twenty by which the p value is above Ville's bound:
`exp(x) P(log ratio > x)` was at most 0.025 among 1600 drawn tones, of one sensor and of six, 0.05 to 2 sd in a block.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.stats.hmm import forward_backward, most_likely_path

_STEPS, _STATES = 128, 20  # of the chain: times, and samples lost, from 0
_EXPECTED = 2.0  # losses in a record, beforehand
_AT_ONCE = 8  # samples: the phase of one tone does not say how many whole cycles were lost either
_AS_GOOD = 2.0  # nats within which another block is as good: the 95 % limits of a likelihood ratio
_NEAR = 2  # blocks between losses that are one


@dataclass(frozen=True)
class Loss:
    """Samples lost at once: the first sample after them, with limits, and how many."""

    at: int
    count: int
    at_limits: tuple[int, int]


class Paths(NamedTuple):
    """Samples lost by sets of sensors.

    Attributes:
        log_ratio: Logarithm of the mean likelihood ratio, `(set,)`.
        lost: Posterior mean of the samples lost before each step of the chain, `(set, step)`.
        total: Posterior probabilities of the samples lost in all, `(set, state)`.
    """

    log_ratio: Tensor
    lost: Tensor
    total: Tensor

    def limits(self, which: int) -> tuple[int, int]:
        """95 % limits of the samples that a set lost in all."""
        below = self.total[which].cumsum(0)
        return int((below < 0.025).sum()), int((below < 0.975).sum())


def paths_of(z: Tensor, sets: Tensor, angle: float, rounds: int = 4, kept: int = 3) -> Paths:
    """All paths together, of every set of sensors.

    Args:
        z: Demodulated tone in units of the noise, straight but for losses, `(set, sensor, block)`.
        sets: Ones where a sensor is in a set, `(set, sensor)`.
        angle: Angle by which one lost sample turns the tone.
        rounds: Rounds of better amplitudes.
        kept: Starts that are followed after the first round.
    """
    z = z.unflatten(-1, (_STEPS, -1)).sum(-1) / math.sqrt(z.shape[-1] // _STEPS) * sets[..., None]
    none_lost = z.sum(-1).abs().square().sum(-1) / _STEPS
    turn, transition = _turns(_STATES, angle), _transition(_STEPS)
    starts = turn[_starts()]  # (start, step)
    early = [z[..., : _STEPS // part].mean(-1) for part in (16, 8, 4)]  # before a first loss, which may come late
    amplitude = torch.cat([(z @ starts.mT / _STEPS).movedim(-1, 1), torch.stack(early, 1)], 1)  # (set, start, sensor)
    for number in range(rounds):
        projected = (amplitude.conj() @ z)[..., None] * turn
        squares = amplitude.abs().square().sum(-1)[..., None, None]
        total, states = forward_backward((2 * projected.real - squares).flatten(0, 1), transition[0], transition)
        log_ratio = total.view(len(z), -1) - none_lost[:, None]
        states = states.unflatten(0, log_ratio.shape)
        best = log_ratio.topk(kept if number < rounds - 1 else 1).indices
        states = states[torch.arange(len(z))[:, None], best]
        amplitude = (states.to(turn.dtype) @ turn) @ z.mT / _STEPS
    lost = states[:, 0] @ torch.arange(_STATES, dtype=torch.float64)
    return Paths(log_ratio.amax(-1), lost, states[:, 0, -1])


def losses_of(z: Tensor, lost: Tensor, angle: float, rounds: int = 4) -> tuple[list[Loss], float]:
    """Single losses in rows `(row, block)` that all share, in blocks, and their log likelihood ratio, nats.

    The most likely path and its amplitudes in turns, from two starts: the best single loss, and the mean path.

    Args:
        z: Demodulated tone in units of the noise, straight but for losses.
        lost: Mean of the samples lost before each step of the chain, `(step,)`.
        angle: Angle by which one lost sample turns the tone.
        rounds: Rounds of better amplitudes.
    """
    n_blocks = z.shape[-1]
    transition, turn = _transition(n_blocks), _turns(_STATES, angle)
    gains = (_loss_gains(z, angle) - math.log(2) * torch.arange(1, _STATES))[:, :_AT_ONCE]
    at, count = divmod(int(gains.argmax()), _AT_ONCE)
    single = {at + 1: count + 1}
    found, most = single, _log_posterior(z, single, angle)
    for start in (single, _losses(lost.round().long().repeat_interleave(n_blocks // len(lost)))):
        losses = start
        for _ in range(rounds):
            amplitude = put_back(z, losses, angle).mean(-1)
            values = 2 * ((amplitude.conj() @ z)[:, None] * turn).real - amplitude.abs().square().sum()
            for at in losses:  # the block of a loss has a phase in between, as if of another count
                values[at - 1 : at + 1] = 0.0
            losses = _losses(most_likely_path(values, transition[0], transition))
        if losses and (value := _log_posterior(z, losses, angle)) > most:
            found, most = losses, value
    listed = []
    for at, count in sorted(found.items()):
        others = {block: lost for block, lost in found.items() if block != at}
        gains = _loss_gains(put_back(z, others, angle), angle)[:, count - 1]
        blocks = (gains >= gains.max() - _AS_GOOD).nonzero()[:, 0] + 1
        listed.append(Loss(int(gains.argmax()) + 1, count, (int(blocks[0]), int(blocks[-1]))))
    return listed, _gain_of(z, {loss.at: loss.count for loss in listed}, angle)


def put_back(z: Tensor, losses: dict[int, int], angle: float) -> Tensor:
    """Rows `(row, block)` without the steps of the phase that losses made, the counts of which go by their block."""
    lost = torch.zeros(z.shape[-1], dtype=torch.float64)
    for at, count in losses.items():
        lost[at:] += count
    return z * torch.polar(torch.ones_like(lost), -angle * lost)


def _losses(path: Tensor) -> dict[int, int]:
    """Counts of losses by their block, of samples lost before each block; losses next to each other are one."""
    losses: dict[int, int] = {}
    last = -math.inf
    for at in (path.diff().nonzero()[:, 0] + 1).tolist():
        count = int(path[at] - path[at - 1])
        if at - last <= _NEAR:
            count += losses.pop(int(last))
        losses[at] = count
        last = at
    return losses


def _loss_gains(z: Tensor, angle: float) -> Tensor:
    """Log likelihood ratio of one loss in rows `(row, block)`, at each block and of each count, `(block, count)`."""
    before = z.cumsum(-1)
    whole, before = before[:, -1:, None], before[:, :-1, None]
    turned = before + (whole - before) * _turns(_STATES, angle)[1:]
    return (turned.abs().square() - whole.abs().square()).sum(0) / z.shape[-1]


def _gain_of(z: Tensor, losses: dict[int, int], angle: float) -> float:
    """Log likelihood ratio of losses in all rows, nats."""
    after, before = (rows.sum(-1).abs().square().sum() / z.shape[-1] for rows in (put_back(z, losses, angle), z))
    return float(after - before)


def _log_posterior(z: Tensor, losses: dict[int, int], angle: float) -> float:
    """Log likelihood ratio of losses and prior probability of their blocks and counts, nats."""
    cost = len(losses) * math.log(z.shape[-1] / _EXPECTED) + math.log(2) * sum(losses.values())
    return _gain_of(z, losses, angle) - cost


def _turns(states: int, angle: float) -> Tensor:
    """What turns the phase back by so many lost samples from 0 on, `(state,)`."""
    lost = torch.arange(states, dtype=torch.float64)
    return torch.polar(torch.ones_like(lost), -angle * lost)


def _starts() -> Tensor:
    """Paths to begin with, `(start, step)`: losses spread evenly over the record, or a single one of one or two."""
    s = (torch.arange(_STEPS, dtype=torch.float64) + 0.5) / _STEPS
    even = [(total * s).floor() for total in (0, 2, 3, 4, 5, 6, 8)]
    single = [count * (s > share).double() for share, count in itertools.product((0.2, 0.4, 0.6, 0.8), (1, 2))]
    return torch.stack([*even, *single]).long()


def _transition(steps: int) -> Tensor:
    """Probabilities of steps from state to state, `(state, state)`; from none, those of the first state."""
    states = torch.arange(_STATES, dtype=torch.float64)
    more = states - states[:, None]
    rate = _EXPECTED / steps
    lost = (more > 0) & (more <= _AT_ONCE)
    chain = torch.where(lost, rate * 0.5 ** more.clamp(min=0), 0.0) + (1 - rate) * (more == 0)
    return chain / chain.sum(-1, keepdim=True)
