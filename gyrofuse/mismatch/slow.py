"""What is slow: means over 256 blocks, their exact covariance, and likelihoods that let it be somewhat wrong.

Successive differences `d` of a sensor's block means do not see its constant bias, and have a covariance even where
there is a random walk:

    d ~ N(b x, sum_k e^theta_k Q_k)

with a template `x` of size `b`. `Q` are what the simulation has below and above the length of a block, and flicker and
a random walk beside it. The `theta` have a normal prior around the simulation: without one the noise swallows the
effect, without freedom it is taken for one. Hypotheses are compared with the `theta` best for each.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.base import Base, _time_constants, atom_covariances
from gyrofuse.mismatch.case import N_BLOCKS, Case, block_means

_ROUNDS = 12
_CLOSE = 0.02  # of a log factor
_LONGEST_STEP = 1.5
_PRIOR_SD = 0.35  # of the simulation's own parts, when it is long
# Of flicker and a random walk beside the simulation: log share of its power at two cycles in the record, where spectra
# say nothing any more, and how free it is.
_BESIDE = {"flicker": (-3.5, 2.0), "walk": (-4.5, 2.0)}
_LOWEST = 2.0
_OWN = 2  # parts that the simulation has: fast and slow
_AHEAD = (0.0, 0.0, 3.0, 4.0)  # where to start: a part that is far too small has no slope to climb
_SLOWEST_BANDS = 3
_LEAST_DOF = 0.25


@dataclass(frozen=True, eq=False)
class SlowNoise:
    """Noise of the differences of block means, independent sensors.

    Attributes:
        parts: `Q`, `(sensor, part, difference, difference)`.
        centre, spread: Prior of the log factors, `(part,)`; of the parts beside the simulation there is one for all
            sensors, since those of an array are made alike.
        ahead: From the centre to where a fit starts.
    """

    parts: Tensor
    centre: Tensor
    spread: Tensor
    ahead: Tensor

    def covariance(self, log_factors: Tensor) -> Tensor:
        """`(sensor, difference, difference)` with factors `(sensor, part)`."""
        return torch.einsum("sp,spij->sij", log_factors.exp(), self.parts)


class Fit(NamedTuple):
    """Best log factors of a template, `x = 0` without one.

    Attributes:
        log_factors: `(sensor, part)`.
        value: Logarithm of likelihood times prior, `(sensor,)`, without constants.
        inverse: Of the covariance, `(sensor, difference, difference)`.
        size: `b`, `(sensor,)`.
    """

    log_factors: Tensor
    value: Tensor
    inverse: Tensor
    size: Tensor


def slow_noise(case: Case) -> SlowNoise:
    """What the simulation says of block means, in parts that may be wrong, each by its own factor."""
    base = case.base
    constants = torch.tensor(_time_constants(base.n_samples), dtype=torch.float64)
    atoms = atom_covariances(base.n_samples, case.block, N_BLOCKS).diff(dim=-1).diff(dim=-2)
    fast = torch.cat([torch.ones(2), constants < case.block, torch.zeros(1)]).to(torch.float64)
    own = [torch.einsum("sa,aij->sij", base.coefficients * share, atoms) for share in (fast, 1 - fast)]
    # AR1s of equal variance and log-spaced corners are flicker.
    flicker = torch.cat(
        [torch.zeros(2, dtype=torch.float64), -torch.expm1(-2 / constants), torch.zeros(1, dtype=torch.float64)]
    )
    walk = torch.eye(len(flicker), dtype=torch.float64)[-1]
    lowest = torch.tensor([_LOWEST / base.n_samples], dtype=torch.float64)
    beside = []
    for coefficients in (flicker, walk):
        share = base.spectrum(lowest) / replace(base, coefficients=coefficients[None]).spectrum(lowest)  # (sensor, 1)
        beside.append(share[..., None] * torch.einsum("a,aij->ij", coefficients, atoms))
    dof = float(case.simulated.dof[:_SLOWEST_BANDS].sum())
    known = math.hypot(_PRIOR_SD, 1 / math.sqrt(max(dof, _LEAST_DOF)))
    centre = torch.tensor([0.0, 0.0, *(c for c, _ in _BESIDE.values())], dtype=torch.float64)
    spread = torch.tensor([_PRIOR_SD, known, *(s for _, s in _BESIDE.values())], dtype=torch.float64)
    return SlowNoise(torch.stack([*own, *beside], 1), centre, spread, torch.tensor(_AHEAD, dtype=torch.float64))


def best_fit(noise: SlowNoise, y: Tensor, x: Tensor | None = None, start: Tensor | None = None) -> Fit:
    """Maximise the likelihood over log factors and size, by average information (Gilmour et al., 1995).

    Args:
        noise: Of `y`.
        y: Differences `(sensor, difference)`.
        x: Template `(sensor, difference)`.
        start: Log factors to start from, `(sensor, part)`.
    """
    theta = (noise.centre + noise.ahead).expand(len(y), -1) if start is None else start
    precision = noise.spread**-2
    precision = torch.cat([precision[:_OWN], precision[_OWN:] / len(y)])  # what is shared counts once
    best: Fit | None = None
    for _ in range(_ROUNDS):
        root = torch.linalg.cholesky(noise.covariance(theta))
        inverse = torch.cholesky_inverse(root)
        size, left = torch.zeros_like(y[:, 0]), y
        if x is not None:
            weighted = (inverse @ x[..., None])[..., 0]
            size = (weighted * y).sum(-1) / (weighted * x).sum(-1)
            left = y - size[:, None] * x
        white = (inverse @ left[..., None])[..., 0]
        log_determinant = 2 * root.diagonal(dim1=-1, dim2=-2).log().sum(-1)
        off = theta - noise.centre
        prior = (off.square() * precision).sum(-1)
        value = -((left * white).sum(-1) + log_determinant + prior) / 2
        now = Fit(theta, value, inverse, size)
        best = now if best is None else max(best, now, key=lambda fit: float(fit.value.sum()))
        factors = theta.exp()
        pulls = factors[..., None] * (noise.parts @ white[:, None, :, None])[..., 0]  # (sensor, part, difference)
        trace = factors * (noise.parts * inverse[:, None]).sum((-1, -2))
        slope = ((pulls * white[:, None]).sum(-1) - trace) / 2 - off * precision
        information = pulls @ inverse @ pulls.mT / 2 + torch.diag(precision)
        step = _shared_step(information, slope).clamp(-_LONGEST_STEP, _LONGEST_STEP)
        theta = theta + step
        if float(step.abs().max()) < _CLOSE:
            break
    assert best is not None
    return best


def scores(y: Tensor, inverse: Tensor, templates: Tensor) -> tuple[Tensor, Tensor]:
    """Sizes `(sensor, template)` of each template alone, and the information on them, by generalised least squares."""
    weighted = templates @ inverse  # (sensor, template, difference)
    information = (weighted * templates).sum(-1)
    return (weighted @ y[..., None])[..., 0] / information, information


def differences(signal: Tensor) -> Tensor:
    """Successive differences of the means of 256 blocks, `(..., time)` -> `(..., difference)`."""
    return block_means(signal).diff()


@functools.lru_cache(maxsize=4)
def cell_differences(base: Base, cell: int, n_cells: int) -> Tensor:
    """Covariance of differences of means over cells of any length, `(sensor, difference, difference)`."""
    return base.block_covariance(cell, n_cells).diff(dim=-1).diff(dim=-2)


def _shared_step(information: Tensor, slope: Tensor) -> Tensor:
    """Newton's step `(sensor, part)` with one factor for all sensors in the parts beside the simulation."""
    own, beside = slice(None, _OWN), slice(_OWN, None)
    through = torch.linalg.solve(information[:, own, own], information[:, own, beside])  # (sensor, own, beside)
    left = information[:, beside, beside] - information[:, beside, own] @ through
    pull = slope[:, beside] - (through.mT @ slope[:, own, None])[..., 0]
    common = torch.linalg.solve(left.sum(0), pull.sum(0))
    rest = torch.linalg.solve(information[:, own, own], slope[:, own]) - through @ common
    return torch.cat([rest, common.expand(len(slope), -1)], 1)
