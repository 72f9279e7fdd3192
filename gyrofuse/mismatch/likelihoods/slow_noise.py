"""Slow noise: a likelihood of block means that lets the simulation's noise be somewhat wrong.

Cosine ordinates `y_k` (DCT-II) of the means of 256 blocks do not contain a sensor's constant bias. They are independent
for white noise and random walks, and nearly so for what lies between:

    y_k ~ N(b x_k, sum_p e^theta_p S_pk)

with a template `x` of size `b`. `S_p` are the exact variances of the parts of the noise: what the simulation has faster
and slower than a block, and flicker and a random walk beside it. The log factors `theta` have a normal prior around the
simulation: without a prior the noise absorbs every slow effect, without freedom slow noise is taken for an effect.
Hypotheses are compared at the best `theta` of each.

The spectra in bands do not contain the first few ordinates, where slow effects are strongest. The simulation's noise is
therefore fitted to its bands and to its own first ordinates, shrunk towards what all sensors of the array have in
common.

References: Gilmour, Thompson and Cullis, Average information REML, Biometrics 51 (1995), 1440.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.nnls import nonnegative_least_squares
from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, block_means
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum, ar1_time_constants, atom_covariances, let_in
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.gls import least_squares

_PRIOR_SD = 0.35  # of log variances of the simulation's own parts, however long it is: a factor of 1.4
# Of flicker and of a random walk that the simulation does not have: log share of its power at two cycles in the record,
# the lowest frequency of which spectra say anything, and prior sd of that.
_BESIDE = ((-3.5, 2.0), (-4.5, 2.0))
_LOWEST = 2.0  # cycles in the record
_OWN = 2  # parts that the simulation has: fast and slow
_SLOWEST_BANDS = 3  # that say how well the simulation's slow noise is known
_UNSEEN = 8  # ordinates below the bands


@dataclass(frozen=True, eq=False)
class SlowNoise:
    """Noise of block means, sensors independent.

    Attributes:
        n_samples: Samples of the record.
        coefficients: Coefficients of each part in the atoms of a `NoiseSpectrum`, `(sensor, part, atom)`.
        centre, spread: Mean and sd of the prior of the log factors, `(part,)`; a part beside the simulation has one
            factor for all sensors, since sensors of an array are made alike.
        dof: Complex ordinates from which the simulation's slow noise is known.
    """

    n_samples: int
    coefficients: Tensor
    centre: Tensor
    spread: Tensor
    dof: float = math.inf

    @classmethod
    def around(cls, base: NoiseSpectrum, variance: float, missed: float, dof: float) -> SlowNoise:
        """Slow noise around a simulation with a base `(sensor, atom)`.

        Args:
            base: Noise of the simulation.
            variance: Variance of the log power in its slowest bands.
            missed: Power of a random walk that its fit may have missed, as a share at two cycles in the record.
            dof: Complex ordinates from which its slow noise is known.
        """
        constants = torch.tensor(ar1_time_constants(base.n_samples), dtype=torch.float64)
        none, both = torch.zeros(1, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
        fast = torch.cat([both, (constants < base.n_samples // N_BLOCKS).to(none), none])
        # AR1s of equal variance and log-spaced corners are flicker.
        flicker = torch.cat([none, none, -torch.expm1(-2 / constants), none])
        walk = torch.eye(len(flicker), dtype=torch.float64)[-1]
        lowest = torch.tensor([_LOWEST / base.n_samples], dtype=torch.float64)
        power = base.spectrum(lowest)  # (sensor, 1)
        beside = [power / replace(base, coefficients=one[None]).spectrum(lowest) * one for one in (flicker, walk)]
        (flicker_share, flicker_sd), (walk_share, walk_sd) = _BESIDE
        walk_share = math.log(math.exp(walk_share) + missed)
        return cls(
            base.n_samples,
            torch.stack([base.coefficients * fast, base.coefficients * (1 - fast), *beside], -2),
            torch.tensor([0.0, 0.0, flicker_share, walk_share], dtype=torch.float64),
            torch.tensor([_PRIOR_SD, math.sqrt(_PRIOR_SD**2 + variance), flicker_sd, walk_sd], dtype=torch.float64),
            dof,
        )

    @cached_property
    def parts(self) -> Tensor:
        """`S`, variances of the ordinates by each part, `(sensor, part, ordinate)`."""
        return self.coefficients @ _atom_variances(self.n_samples)

    @property
    def own(self) -> Tensor:
        """Variances of the ordinates in the simulation, `(sensor, ordinate)`."""
        return self.parts[:, :_OWN].sum(-2)

    def covariance(self, log_factors: Tensor) -> Tensor:
        """Covariances of block means `(sensor, block, block)` at log factors `(sensor, part)`, up to a constant."""
        coefficients = torch.einsum("sp,spa->sa", log_factors.exp(), self.coefficients)
        return NoiseSpectrum(self.n_samples, coefficients).block_covariance(self.n_samples // N_BLOCKS, N_BLOCKS)


class Fit(NamedTuple):
    """The most likely noise and sizes of a template.

    Attributes:
        log_factors: `theta`, `(sensor, part)`.
        value: Logarithm of likelihood times prior, `(sensor,)`, up to a constant.
        variance: Variances of the ordinates, `(sensor, ordinate)`.
        size: `b`, `(sensor, column)`.
    """

    log_factors: Tensor
    value: Tensor
    variance: Tensor
    size: Tensor

    def log_likelihood(self, y: Tensor, design: Tensor | None = None) -> float:
        """Log likelihood of ordinates `(sensor, ordinate)` without the prior, up to a constant."""
        left = y if design is None else y - self.size @ design
        return -float((left.square() / self.variance + self.variance.log()).sum()) / 2


def simulated_slow_noise(comparison: Comparison) -> SlowNoise:
    """The slow noise of a comparison's simulation, around which that of the recording may be."""
    n, side = comparison.n_samples, comparison.reference
    dof = max(float(side.dof[:_SLOWEST_BANDS].sum()), 0.25)  # where no band is seen, a factor of e^2
    variance, missed = 1 / dof, 0.0
    if side.uncertainty is not None:
        lowest = side.dof.new_tensor([1 / n])
        variance += float(side.uncertainty.variance(lowest).mean())
        missed = float(side.uncertainty.at_zero_power(_LOWEST * lowest).mean())
    return SlowNoise.around(NoiseSpectrum(n, slow_powers(comparison).coefficients(n)), variance, missed, dof)


def slow_powers(comparison: Comparison) -> SlowPowers:
    """Powers of a comparison's simulation, from which its slow noise is fitted."""
    n, bands, side = comparison.n_samples, comparison.bands, comparison.reference
    known = side.dof > 0
    every_atom = torch.eye(len(ar1_time_constants(n)) + 3, dtype=torch.float64)  # white, quantisation, AR1s, a walk
    return SlowPowers(
        torch.cat([side.power[:, known], own_ordinates(comparison, side)[..., :_UNSEEN].square().mean(0)], -1),
        torch.cat(
            [
                bands.mean_of(NoiseSpectrum(n, every_atom).spectrum(bands.nodes))[:, known],
                _atom_variances(n, side.signal.shape[-1] // N_BLOCKS)[:, :_UNSEEN],
            ],
            -1,
        ),
        torch.cat([side.dof[known], torch.full((_UNSEEN,), len(side.signal) / 2, dtype=torch.float64)]),
    )


class SlowPowers(NamedTuple):
    """Powers of a simulation in bands, and the mean squares of its first ordinates.

    Attributes:
        values: The powers, `(sensor, power)`, first ordinates last.
        atoms: Expected powers of each atom of a `NoiseSpectrum` with coefficient one, `(atom, power)`.
        dof: Independent complex ordinates behind each, `(power,)`.
    """

    values: Tensor
    atoms: Tensor
    dof: Tensor

    def coefficients(self, n_samples: int) -> Tensor:
        """Coefficients of each sensor's atoms, `(sensor, atom)`, shrunk towards those of all sensors together.

        The common spectrum counts as one complex ordinate at each of the first ordinates of the recording.

        Args:
            n_samples: Samples of the recording.
        """
        scale = self.values[:, :_SLOWEST_BANDS].mean(-1, keepdim=True)
        pooled = (self.values / scale).mean(0, keepdim=True)
        common = _scored(pooled, self.atoms, len(self.values) * self.dof, pooled)
        atoms = torch.cat([_atom_variances(n_samples)[:, :_UNSEEN], self.atoms], -1)
        dof = torch.cat([self.dof.new_ones(_UNSEEN), self.dof])
        prior = scale * (common @ atoms)
        return _scored(torch.cat([prior[:, :_UNSEEN], self.values], -1), atoms, dof, prior)


def _scored(values: Tensor, atoms: Tensor, dof: Tensor, start: Tensor, rounds: int = 5) -> Tensor:
    """Coefficients `(sensor, atom)` of greatest gamma likelihood for powers `(sensor, power)`, by Fisher scoring."""
    fitted, free = start, None
    for _ in range(rounds):
        weight = dof.sqrt() / fitted
        design = atoms * weight[:, None]  # (sensor, atom, power)
        moment = (design @ (weight * values)[..., None])[..., 0]
        coefficients = nonnegative_least_squares(design @ design.mT, moment, free)
        free = coefficients > 0
        fitted = coefficients @ atoms
    return coefficients


def best_fit(
    noise: SlowNoise, y: Tensor, design: Tensor | None = None, start: Tensor | None = None, rounds: int = 12
) -> Fit:
    """Maximise the likelihood over log factors and sizes, by average information (Gilmour et al., 1995).

    Args:
        noise: Noise of `y`.
        y: Ordinates `(sensor, ordinate)`.
        design: Template `(column, ordinate)`, each column with a size of its own in every sensor; none by default.
        start: Log factors to start from, `(sensor, part)`; by default the prior's centre, parts beside the simulation
            well above it, since a part that is far too small has no slope to climb.
        rounds: Newton steps at most.
    """
    ahead = noise.centre.new_tensor([0.0, 0.0, 3.0, 4.0])
    theta = (noise.centre + ahead).expand(len(y), -1) if start is None else start
    precision = noise.spread**-2
    precision = torch.cat([precision[:_OWN], precision[_OWN:] / len(y)])  # what is shared counts once
    best: Fit | None = None
    for _ in range(rounds):
        parts = theta.exp()[..., None] * noise.parts
        variance = parts.sum(-2)
        size, left = y.new_zeros(len(y), 0), y
        if design is not None:
            size = least_squares(y, variance, design).size
            left = y - size @ design
        power = left.square() / variance
        off = theta - noise.centre
        value = -((power + variance.log()).sum(-1) + (off.square() * precision).sum(-1)) / 2
        if best is None or float(value.sum()) > float(best.value.sum()):
            best = Fit(theta, value, variance, size)
        share = parts / variance[:, None]
        slope = (share @ (power - 1)[..., None])[..., 0] / 2 - off * precision
        information = (share * power[:, None]) @ share.mT / 2 + torch.diag(precision)
        step = _shared_step(information, slope).clamp(-1.5, 1.5)
        theta = theta + step
        if float(step.abs().max()) < 0.02:  # a fiftieth of a prior sd or less
            break
    assert best is not None
    return best


def _shared_step(information: Tensor, slope: Tensor) -> Tensor:
    """Newton's step `(sensor, part)` with one factor for all sensors in the parts beside the simulation."""
    own, beside = slice(None, _OWN), slice(_OWN, None)
    rows = torch.cat([information[:, own, beside], slope[:, own, None]], -1)
    solved = torch.linalg.solve(information[:, own, own], rows)
    through, alone = solved[..., :-1], solved[..., -1]  # (sensor, own, beside), (sensor, own)
    left = information[:, beside, beside] - information[:, beside, own] @ through
    pull = slope[:, beside] - (through.mT @ slope[:, own, None])[..., 0]
    common = torch.linalg.solve(left.sum(0), pull.sum(0))
    return torch.cat([alone - through @ common, common.expand(len(slope), -1)], -1)


def ordinates(means: Tensor) -> Tensor:
    """Orthonormal cosine transforms of 256 means, without the constant: `(..., block)` -> `(..., ordinate)`."""
    return means @ cosines().mT


def slow_ordinates(signal: Tensor) -> Tensor:
    """Cosine ordinates of the block means of signals, `(..., time)` -> `(..., ordinate)`."""
    return ordinates(block_means(signal))


def own_ordinates(comparison: Comparison, side: Records) -> Tensor:
    """Of one side, `(record, sensor, ordinate)`, without what its ends let in where the simulation has little else."""
    y, let = slow_ordinates(side.steady), _ends_let_in(comparison.reference)
    return torch.where(let[:, None], _without_ends(y), y) if bool(let.any()) else y


@derived
def _ends_let_in(side: Records) -> Tensor:
    """Sensors `(sensor,)` whose slowest ordinates are mostly let in by the ends, as after a high-pass: two numbers."""
    most, n = 3, side.bands.n_samples
    at = torch.arange(1, _UNSEEN + 1, dtype=torch.float64) / (2 * n)
    f = torch.logspace(-math.log10(2 * n), math.log10(0.5), 1000, dtype=torch.float64)
    own = side.density(at)
    return let_in(f, side.density(f), at, n).sum(-1) > most * own.sum(-1)


def _without_ends(y: Tensor) -> Tensor:
    """Ordinates `(..., ordinate)` without what the first and the last block have beyond their neighbours.

    By least squares in the slowest ordinates, in which nothing else is as large.
    """
    ends = cosines()[:, [0, -1]]  # (ordinate, end)
    low = ends[:_UNSEEN]
    size = torch.linalg.solve(low.mT @ low, low.mT @ y[..., :_UNSEEN, None])
    return y - (ends @ size)[..., 0]


def cosines() -> Tensor:
    """Rows of the DCT-II but the first, `(ordinate, block)`."""
    k = torch.arange(1, N_BLOCKS, dtype=torch.float64)[:, None]
    return math.sqrt(2 / N_BLOCKS) * (math.pi * k * (torch.arange(N_BLOCKS) + 0.5) / N_BLOCKS).cos()


def cell_differences(base: NoiseSpectrum, cell: int, n_cells: int) -> Tensor:
    """Covariance of differences of means over cells of any length, `(sensor, difference, difference)`."""
    return base.block_covariance(cell, n_cells).diff(dim=-1).diff(dim=-2)


def _atom_variances(n_samples: int, block: int | None = None) -> Tensor:
    """Exact variances of the ordinates of each atom with coefficient one, `(atom, ordinate)`.

    Args:
        n_samples: Samples of the record that sets the atoms' corners.
        block: Samples of a block; by default a 256th of the record.
    """
    autocovariance = atom_covariances(n_samples, block or n_samples // N_BLOCKS, N_BLOCKS)[:, 0]  # (atom, lag)
    products = torch.fft.irfft(squared_modulus(torch.fft.rfft(cosines(), n=2 * N_BLOCKS)), n=2 * N_BLOCKS)[:, :N_BLOCKS]
    return autocovariance[:, :1] + 2 * autocovariance[:, 1:] @ products[:, 1:].mT
