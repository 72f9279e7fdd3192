"""Noise whose level goes up and down at random: a hidden chain of levels, the sum of sources that are on or off.

Of `m` sources, each of which comes on with probability `enter` a sample and goes off with `leave`, `k` are on: a chain
of `m + 1` states whose variances are `base factor^(k / m)`. One source makes bursts; many make a log variance that is
nearly normal, with correlations `(1 - enter - leave)^lag`.

References:
    Rouwenhorst, Asset pricing implications of equilibrium business cycle models, in Cooley (ed.), Frontiers of
    Business Cycle Research, 1995: the chain. Rabiner, Proc. IEEE 77 (1989), 257: its likelihood.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from scipy import optimize, special, stats
from torch import Tensor

_Number = TypeVar("_Number", float, Tensor)


class RandomLevel(NamedTuple):
    """A law of the level.

    Attributes:
        sources: Number of sources.
        base: Variance where none is on.
        factor: Ratio of the variance where all are on to that.
        enter, leave: Probabilities that a source comes on, and goes off, with a sample.
        sensors: Number of sensors that have the same level, whose squares are added up.
    """

    sources: int
    base: float
    factor: float
    enter: float
    leave: float
    sensors: int = 1

    @property
    def mean(self) -> float:
        """Mean of the variance."""
        return self.base * mean_over_base(self.sources, self.factor, self.share)

    @property
    def share(self) -> float:
        """Share of the time that a source is on."""
        return self.enter / (self.enter + self.leave)

    @property
    def samples(self) -> float:
        """Time constant of the course, samples."""
        return -1 / math.log(max(1 - self.enter - self.leave, 1e-9))

    def log_likelihood(self, squares: Tensor) -> Tensor:
        """Of each of some blocks of squares `(block, time)` by themselves, nats without the constant, `(block,)`."""
        start, transition = chain(self.sources, self.enter, self.leave)
        log_variance = math.log(self.base) + math.log(self.factor) * torch.linspace(
            0, 1, self.sources + 1, dtype=torch.float64
        )
        at_once = max(2**22 // (squares.shape[-1] * len(start) ** 2), 1)
        parts = []  # products of all steps of a block take much memory
        for part in squares.split(at_once):
            log_density = -(self.sensors * log_variance + part[..., None] * (-log_variance).exp()) / 2
            parts.append(_over_all_paths(log_density, start, transition))
        return torch.cat(parts)

    def gains(self, squares: Tensor) -> Tensor:
        """The same over a steady level of the same mean, `(block,)`."""
        steady = -(self.sensors * math.log(self.mean) + squares / self.mean).sum(-1) / 2
        return self.log_likelihood(squares) - steady

    @classmethod
    def fitted(cls, squares: Tensor, sensors: int = 1) -> RandomLevel:
        """The likeliest law of squares `(block, time)`; more sources where these are likelier."""
        mean = float(squares.mean()) / sensors
        times, shares, factors = (3.0, 12.0, 50.0, 200.0), (0.03, 0.2, 0.5), (3.0, 10.0)
        starts = [
            cls(1, mean / (1 + share * (factor - 1)), factor, share / time, (1 - share) / time, sensors)
            for time in times
            for share in shares
            for factor in factors
        ]
        few = squares[:: max(len(squares) // 8, 1)]
        first = max(starts, key=lambda law: float(law.log_likelihood(few).sum()))
        best = first.improved(squares)
        score = float(best.log_likelihood(squares).sum())
        for sources in (2, 4, 8):
            spread = math.log(best.factor) * math.sqrt(sources / best.sources)  # keeps that of the log variance
            middle = math.log(best.base) + math.log(best.factor) * best.share
            base, factor = math.exp(middle - spread * best.share), math.exp(spread)
            more = cls(sources, base, factor, best.enter, best.leave, sensors).improved(squares)
            its_score = float(more.log_likelihood(squares).sum())
            if its_score <= score:
                break
            best, score = more, its_score
        return best

    def improved(self, squares: Tensor) -> RandomLevel:
        """The likeliest law of as many sources, from this one on."""
        start = np.array([math.log(self.base), math.log(self.factor), *special.logit([self.enter, self.leave])])

        def law(theta: np.ndarray) -> RandomLevel:
            base, factor = np.exp(np.clip(theta[:2], -50.0, 50.0))
            enter, leave = special.expit(np.clip(theta[2:], -14.0, 3.0))
            return RandomLevel(self.sources, float(base), float(factor), float(enter), float(leave), self.sensors)

        run = optimize.minimize(
            lambda theta: -float(law(theta).log_likelihood(squares).sum()),
            start,
            method="Nelder-Mead",
            options={
                "xatol": 0.02,
                "fatol": 0.2,
                "maxfev": 160,
                "initial_simplex": start + 0.4 * np.vstack([np.zeros(4), np.eye(4)]),
            },
        )
        return law(run.x)


def mean_over_base(sources: _Number, factor: _Number, share: _Number) -> _Number:
    """Mean of the variance over that where no source is on, of numbers or of tensors of them."""
    return (1 + share * (factor ** (1 / sources) - 1)) ** sources


def chain(sources: int, enter: float, leave: float) -> tuple[Tensor, Tensor]:
    """Probabilities of `0` to `sources` sources that are on, `(state,)`, and of steps from state (row) to state."""
    states = np.arange(sources + 1)
    stay, come = (
        stats.binom.pmf(states[None, :], count[:, None], p)
        for count, p in ((states, 1 - leave), (sources - states, enter))
    )
    transition = np.array([np.convolve(a, b)[: sources + 1] for a, b in zip(stay, come, strict=True)])
    start = stats.binom.pmf(states, sources, enter / (enter + leave))
    return torch.from_numpy(start), torch.from_numpy(transition)


def _over_all_paths(log_density: Tensor, start: Tensor, transition: Tensor) -> Tensor:
    """Log likelihood over all paths of blocks `(block, time, state)`, by a tree of products, `(block,)`.

    Products of neighbouring steps take a number of operations that grows with the logarithm of the time.
    """
    peak = log_density.amax(-1, keepdim=True)
    steps = transition[None, None] * (log_density - peak).exp()[..., None, :]
    first = start * (log_density[:, 0] - peak[:, 0]).exp()
    steps[:, 0] = first[:, None, :] / len(start)  # each row a share of what the first sample has
    total = peak.sum((-1, -2))
    while steps.shape[1] > 1:
        odd = steps[:, -1:] if steps.shape[1] % 2 else steps[:, :0]
        even = steps[:, : steps.shape[1] // 2 * 2]
        steps = torch.cat([even[:, ::2] @ even[:, 1::2], odd], 1)
        size = steps.amax((-1, -2), keepdim=True).clamp(min=1e-300)
        steps, total = steps / size, total + size.log().sum((-1, -2, -3))
    return total + steps[:, 0].sum((-1, -2)).clamp(min=1e-300).log()
