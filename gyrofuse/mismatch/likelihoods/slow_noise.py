"""What is slow: means over 256 blocks, their spectra, and likelihoods that let the noise be somewhat wrong.

Cosine ordinates `y_k` of a sensor's block means do not see its constant bias. They are independent for white noise and
random walks, and nearly so for what lies between:

    y_k ~ N(b x_k, sum_p e^theta_p S_pk)

with a template `x` of size `b`. `S` are the exact variances of what the simulation has below and above the length of a
block, and of flicker and a random walk beside it. The `theta` have a normal prior around the simulation: without one
the noise swallows the effect, without freedom it is taken for one. Hypotheses are compared with the `theta` best for
each.

Spectra in bands say nothing of the first few ordinates, on which slow effects live: what the simulation has there is
told by its own ordinates, and by what the sensors of an array have in common. A model that was fitted to a record is
off as far as its numbers are, all places together; a random walk that it found none of may be there.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from gyrofuse._base.nnls import nonnegative_least_squares
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, block_means
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum, _time_constants, atom_covariances

_ROUNDS = 12
_CLOSE = 0.02  # of a log factor
_LONGEST_STEP = 1.5
_PRIOR_SD = 0.35  # of the simulation's own parts, when it is long
# Of flicker and a random walk beside the simulation: log share of its power at two cycles in the record, where spectra
# say nothing any more, and how free it is.
_BESIDE = {"flicker": (-3.5, 2.0), "walk": (-4.5, 2.0)}
_LOWEST = 2.0
_OTHER_ATOMS = 3  # of a base, beside AR1s
_OWN = 2  # parts that the simulation has: fast and slow
_AHEAD = (0.0, 0.0, 3.0, 4.0)  # where to start: a part that is far too small has no slope to climb
_SLOWEST_BANDS = 3
_LEAST_DOF = 0.25
_UNSEEN = 8  # ordinates below the bands
_ALIKE = 1.0  # what each of them is worth that all sensors together tell of one, complex ordinates
_FIT_ROUNDS = 5
_LEAST_ROOT = 0.1  # cube root of a chi-square over its mean
_ALIKE_COLUMNS = 1e-12  # of a column's square: far above rounding, far below what any record tells apart
_FARTHEST = 5.0  # of a log factor by estimation error: a walk that was found as none may be anything below the rest

_Tuple = TypeVar("_Tuple", bound=tuple[Any, ...])


@dataclass(frozen=True, eq=False)
class SlowNoise:
    """Noise of block means, independent sensors; of one case, or of many at once.

    Attributes:
        n_samples: Of the record.
        coefficients: Of each part, in the atoms of a base, `(..., sensor, part, atom)`.
        centre, spread: Prior of the log factors, `(part,)`; of the parts beside the simulation there is one for all
            sensors, since those of an array are made alike.
        ahead: From the centre to where a fit starts.
    """

    n_samples: int
    coefficients: Tensor
    centre: Tensor
    spread: Tensor
    ahead: Tensor

    @classmethod
    def around(cls, base: NoiseSpectrum, dof: float, missed: float = 0.0) -> SlowNoise:
        """Around a simulation with a base `(..., sensor, atom)`, whose slowest bands are worth `dof`.

        A random walk of a share `missed` of its power at two cycles in the record is not unlikely beside it.
        """
        n_samples, block = base.n_samples, base.n_samples // N_BLOCKS
        constants = torch.tensor(_time_constants(n_samples), dtype=torch.float64)
        none = torch.zeros(1, dtype=torch.float64)
        fast = torch.cat([torch.ones(2, dtype=torch.float64), (constants < block).to(none), none])
        # AR1s of equal variance and log-spaced corners are flicker.
        flicker = torch.cat([none, none, -torch.expm1(-2 / constants), none])
        walk = torch.eye(len(flicker), dtype=torch.float64)[-1]
        lowest = torch.tensor([_LOWEST / n_samples], dtype=torch.float64)
        power = base.spectrum(lowest)  # (..., sensor, 1)
        beside = [power / replace(base, coefficients=one[None]).spectrum(lowest) * one for one in (flicker, walk)]
        known = math.hypot(_PRIOR_SD, 1 / math.sqrt(max(dof, _LEAST_DOF)))
        centre = torch.tensor([0.0, 0.0, *(c for c, _ in _BESIDE.values())], dtype=torch.float64)
        centre[-1] = math.log(math.exp(float(centre[-1])) + missed)
        spread = torch.tensor([_PRIOR_SD, known, *(s for _, s in _BESIDE.values())], dtype=torch.float64)
        parts = torch.stack([base.coefficients * fast, base.coefficients * (1 - fast), *beside], -2)
        return cls(n_samples, parts, centre, spread, torch.tensor(_AHEAD, dtype=torch.float64))

    @cached_property
    def parts(self) -> Tensor:
        """`S`, `(..., sensor, part, ordinate)`."""
        return self.coefficients @ _atom_variances(self.n_samples, self.n_samples // N_BLOCKS)

    @property
    def own(self) -> Tensor:
        """Variances of the ordinates as the simulation has them, `(..., sensor, ordinate)`."""
        return self.parts[..., :_OWN, :].sum(-2)

    def covariance(self, log_factors: Tensor) -> Tensor:
        """Of block means with factors `(sensor, part)`, exact up to a constant, `(sensor, block, block)`."""
        coefficients = torch.einsum("sp,spa->sa", log_factors.exp(), self.coefficients)
        return NoiseSpectrum(self.n_samples, coefficients).block_covariance(self.n_samples // N_BLOCKS, N_BLOCKS)


class Fit(NamedTuple):
    """Best log factors of a template, `x = 0` without one.

    Attributes:
        log_factors: `(..., sensor, part)`.
        value: Logarithm of likelihood times prior, `(..., sensor)`, without constants.
        variance: Of the ordinates, `(..., sensor, ordinate)`.
        size: `b`, `(..., sensor, column)`.
    """

    log_factors: Tensor
    value: Tensor
    variance: Tensor
    size: Tensor


class Told(NamedTuple):
    """What a simulation tells of slow noise.

    Attributes:
        values: Powers in bands, then mean squares of the first ordinates, `(..., sensor, place)`.
        atoms: What they are for each atom of a base with coefficient one, `(atom, place)`.
        dof: What they are worth, complex ordinates, `(place,)`.
        slowest_dof: The same of the slowest bands of the recording, beside what a fitted model's numbers may be off.
        n_samples: Of the recording.
        errors: What independent errors of unit variance in these numbers do to logarithms, `(sensor, place, error)`.
        missed: Share of the power at two cycles in the record of a random walk that the fit may have missed.
    """

    values: Tensor
    atoms: Tensor
    dof: Tensor
    slowest_dof: float
    n_samples: int
    errors: Tensor
    missed: float

    def noise(self) -> SlowNoise:
        """Of block means, in parts that may be wrong, each by its own factor."""
        return self.noise_of(self.coefficients())

    def noise_of(self, coefficients: Tensor) -> SlowNoise:
        """The same where the coefficients are known, `(..., sensor, atom)`."""
        return SlowNoise.around(NoiseSpectrum(self.n_samples, coefficients), self.slowest_dof, self.missed)

    def drawn(self, coefficients: Tensor, generator: torch.Generator) -> Told:
        """What another simulation of as many samples tells, of noise with coefficients `(..., sensor, atom)`."""
        expected = coefficients @ self.atoms
        # Chi-square by its cube root, which is normal (Wilson and Hilferty, 1931).
        spread = 1 / (9 * self.dof)
        normal = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
        root = (1 - spread + normal * spread.sqrt()).clamp(min=_LEAST_ROOT)
        if self.errors.shape[-1]:
            shape = (*expected.shape[:-2], self.errors.shape[-1], 1)
            errors = torch.randn(shape, generator=generator, dtype=torch.float64)
            off = (self.errors @ errors[..., None, :, :])[..., 0]  # (..., sensor, place)
            expected = expected * off.clamp(-_FARTHEST, _FARTHEST).exp()
        return self._replace(values=expected * root**3)

    def coefficients(self) -> Tensor:
        """Those of each sensor's atoms, `(..., sensor, atom)`, drawn to what all sensors together tell."""
        scale = self.values[..., :_SLOWEST_BANDS].mean(-1, keepdim=True)
        pooled = (self.values / scale).mean(-2, keepdim=True)
        common = _fitted(pooled, self.atoms, self.values.shape[-2] * self.dof, pooled)
        unseen = _atom_variances(self.n_samples, self.n_samples // N_BLOCKS)[:, :_UNSEEN]
        atoms = torch.cat([unseen, self.atoms], -1)
        dof = torch.cat([torch.full((_UNSEEN,), _ALIKE, dtype=torch.float64), self.dof])
        start = scale * (common @ atoms)
        return _fitted(torch.cat([start[..., :_UNSEEN], self.values], -1), atoms, dof, start)


def told(comparison: Comparison) -> Told:
    """What the simulation tells."""
    n, bands, signal, dof = (
        comparison.n_samples,
        comparison.bands,
        comparison.reference.steady,
        comparison.reference.dof,
    )
    every = NoiseSpectrum(n, torch.eye(len(_time_constants(n)) + _OTHER_ATOMS, dtype=torch.float64))
    first = slow_ordinates(signal)[..., :_UNSEEN].square().mean(0)
    atoms = _atom_variances(n, signal.shape[-1] // N_BLOCKS)[:, :_UNSEEN]
    worth = torch.full((_UNSEEN,), len(signal) / 2, dtype=torch.float64)
    seen = dof > 0
    slowest, missed, errors = float(dof[:_SLOWEST_BANDS].sum()), 0.0, dof.new_zeros(len(signal[0]), 1, 0)
    if (uncertainty := comparison.reference.uncertainty) is not None:
        ordinates = torch.arange(1, _UNSEEN + 1, dtype=torch.float64) / (2 * signal.shape[-1])
        errors = uncertainty.errors(torch.cat([bands.frequency[seen], ordinates]))
        slowest = 1 / (1 / slowest + float(uncertainty.variance(1 / dof.new_tensor([n])).mean()))
        missed = float(uncertainty.at_zero_power(_LOWEST / dof.new_tensor([n])).mean())
    return Told(
        torch.cat([comparison.reference.power[:, seen], first], -1),
        torch.cat([bands.mean_of(every.spectrum(bands.nodes))[:, seen], atoms], -1),
        torch.cat([dof[seen], worth]),
        slowest,
        n,
        errors,
        missed,
    )


def best_fit(noise: SlowNoise, y: Tensor, x: Tensor | None = None, start: Tensor | None = None) -> Fit:
    """Maximise the likelihood over log factors and size, by average information (Gilmour et al., 1995).

    Args:
        noise: Of `y`.
        y: Ordinates `(..., sensor, ordinate)`.
        x: Template `(..., column, ordinate)`, each column of a size of its own in every sensor.
        start: Log factors to start from, `(..., sensor, part)`.
    """
    theta = (noise.centre + noise.ahead).expand(*y.shape[:-1], -1) if start is None else start
    precision = noise.spread**-2
    precision = torch.cat([precision[:_OWN], precision[_OWN:] / y.shape[-2]])  # what is shared counts once
    best: Fit | None = None
    for _ in range(_ROUNDS):
        parts = theta.exp()[..., None] * noise.parts
        variance = parts.sum(-2)
        size, left = y.new_zeros(*y.shape[:-1], 0), y
        if x is not None:
            root, score = normal_equations(y, variance, x)
            size = torch.cholesky_solve(score[..., None], root)[..., 0]
            left = y - size @ x
        power = left.square() / variance
        off = theta - noise.centre
        value = -((power + variance.log()).sum(-1) + (off.square() * precision).sum(-1)) / 2
        now = Fit(theta, value, variance, size)
        best = now if best is None else where(value.sum(-1) > best.value.sum(-1), now, best)
        share = parts / variance[..., None, :]
        slope = (share @ (power - 1)[..., None])[..., 0] / 2 - off * precision
        information = (share * power[..., None, :]) @ share.mT / 2 + torch.diag(precision)
        step = _shared_step(information, slope).clamp(-_LONGEST_STEP, _LONGEST_STEP)
        theta = theta + step
        if float(step.abs().max()) < _CLOSE:
            break
    assert best is not None
    return best


def columns(y: Tensor, variance: Tensor, templates: Tensor) -> Tensor:
    """What templates of several columns say, each beside those before it, in standard deviations.

    Args:
        y: Ordinates `(..., sensor, ordinate)`.
        variance: Of each.
        templates: `(template, column, ordinate)`.

    Returns:
        `(..., sensor, template, column)`: their squares add up to twice the log likelihood ratio.
    """
    root, score = _normal_equations_of_all(y, variance, templates)
    return torch.linalg.solve_triangular(root, score[..., None], upper=False)[..., 0]


def column_sizes(y: Tensor, variance: Tensor, templates: Tensor) -> tuple[Tensor, Tensor]:
    """Sizes of the columns of each template alone, and their variances; arguments and shapes as in `columns`."""
    root, score = _normal_equations_of_all(y, variance, templates)
    spread = torch.cholesky_inverse(root).diagonal(dim1=-1, dim2=-2)
    return torch.cholesky_solve(score[..., None], root)[..., 0], spread


def normal_equations(y: Tensor, variance: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Of weighted least squares of columns `x` `(..., column, ordinate)` in each sensor.

    Returns:
        Cholesky root of the columns' products `(..., sensor, column, column)`, and theirs with the data.
    """
    weighted = x[..., None, :, :] / variance[..., None, :]  # (..., sensor, column, ordinate)
    return _root(weighted @ x[..., None, :, :].mT), (weighted @ y[..., None])[..., 0]


def scores(y: Tensor, variance: Tensor, templates: Tensor) -> tuple[Tensor, Tensor]:
    """Sizes `(..., sensor, template)` of each template alone and the information on them: weighted least squares."""
    information = (1 / variance) @ templates.square().mT
    return (y / variance) @ templates.mT / information, information


def ordinates(means: Tensor) -> Tensor:
    """Orthonormal cosine transforms of 256 means, without the constant: `(..., block)` -> `(..., ordinate)`."""
    return means @ cosines().mT


def slow_ordinates(signal: Tensor) -> Tensor:
    """Those of a signal, `(..., time)` -> `(..., ordinate)`."""
    return ordinates(block_means(signal))


@functools.lru_cache(maxsize=1)
def cosines() -> Tensor:
    """Rows of the DCT-II but the first, `(ordinate, block)`."""
    k = torch.arange(1, N_BLOCKS, dtype=torch.float64)[:, None]
    return math.sqrt(2 / N_BLOCKS) * (math.pi * k * (torch.arange(N_BLOCKS) + 0.5) / N_BLOCKS).cos()


@functools.lru_cache(maxsize=4)
def cell_differences(base: NoiseSpectrum, cell: int, n_cells: int) -> Tensor:
    """Covariance of differences of means over cells of any length, `(sensor, difference, difference)`."""
    return base.block_covariance(cell, n_cells).diff(dim=-1).diff(dim=-2)


def where(which: Tensor, these: _Tuple, others: _Tuple) -> _Tuple:
    """Of tuples of tensors `(..., any)` those of `these` where `which` `(...)` says so, else those of `others`."""
    chosen = [
        where(which, one, other)
        if isinstance(one, tuple)
        else torch.where(which.reshape(which.shape + (1,) * (one.ndim - which.ndim)), one, other)
        for one, other in zip(these, others, strict=True)
    ]
    return type(these)(*chosen)


@functools.lru_cache(maxsize=4)
def _atom_variances(n_samples: int, block: int) -> Tensor:
    """Exact variances of the ordinates of each atom with coefficient one, for any blocks, `(atom, ordinate)`."""
    return ((cosines() @ atom_covariances(n_samples, block, N_BLOCKS)) * cosines()).sum(-1)


def _fitted(values: Tensor, atoms: Tensor, dof: Tensor, start: Tensor) -> Tensor:
    """Coefficients `(..., atom)` of greatest likelihood for mean squares `(..., place)`, by scoring from `start`."""
    fitted, free = start, None
    for _ in range(_FIT_ROUNDS):
        weight = dof.sqrt() / fitted
        design = atoms * weight[..., None, :]  # (..., atom, place)
        moment = (design @ (weight * values)[..., None])[..., 0]
        coefficients = nonnegative_least_squares(design @ design.mT, moment, free)
        free = coefficients > 0
        fitted = coefficients @ atoms
    return coefficients


def _normal_equations_of_all(y: Tensor, variance: Tensor, templates: Tensor) -> tuple[Tensor, Tensor]:
    """As `normal_equations`, of every template `(template, column, ordinate)`."""
    n_templates, n_columns, _ = templates.shape
    products = (templates[:, :, None] * templates[:, None]).flatten(0, 2)
    gram = ((1 / variance) @ products.mT).unflatten(-1, (n_templates, n_columns, n_columns))
    score = ((y / variance) @ templates.flatten(0, 1).mT).unflatten(-1, (n_templates, n_columns))
    return _root(gram), score


def _root(gram: Tensor) -> Tensor:
    """Cholesky root of products `(..., column, column)`; columns that are alike but for rounding are kept apart."""
    size = gram.diagonal(dim1=-1, dim2=-2)
    return torch.linalg.cholesky(gram + torch.diag_embed(_ALIKE_COLUMNS * size))


def _shared_step(information: Tensor, slope: Tensor) -> Tensor:
    """Newton's step `(..., sensor, part)` with one factor for all sensors in the parts beside the simulation."""
    own, beside = slice(None, _OWN), slice(_OWN, None)
    rows = torch.cat([information[..., own, beside], slope[..., own, None]], -1)
    solved = torch.linalg.solve(information[..., own, own], rows)
    through, alone = solved[..., :-1], solved[..., -1]  # (..., sensor, own, beside), (..., sensor, own)
    left = information[..., beside, beside] - information[..., beside, own] @ through
    pull = slope[..., beside] - (through.mT @ slope[..., own, None])[..., 0]
    common = torch.linalg.solve(left.sum(-3), pull.sum(-2)[..., None])[..., None, :, :]  # (..., 1, beside, 1)
    rest = alone - (through @ common)[..., 0]
    return torch.cat([rest, common[..., 0].expand(*slope.shape[:-1], -1)], -1)
