"""The noise of a simulation as a non-negative sum of simple spectra: a description to weigh and to generate with.

Each sensor is white noise, quantisation noise, AR1s of fixed corner frequencies, and a random walk.
With fixed corners the fit to spectra is convex and needs no starting values.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import torch
from torch import Tensor

from gyrofuse._base.nnls import nonnegative_least_squares
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.psd import Bands
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.model import Model
from gyrofuse.noise.processes import AR1, Process, QuantizationNoise, RandomWalk, WhiteNoise
from gyrofuse.wavelets.lag_sums import block_mean_covariances

_ROUNDS = 5
_QUICK = 4.0  # samples: time constants of noise that is nearly white
_NEGLIGIBLE = 1e-3  # of the power in every band


@dataclass(frozen=True, eq=False)
class NoiseSpectrum:
    """Independent sensors, each a sum of simple processes.

    Attributes:
        n_samples: Of the records it describes, which sets the slowest corner.
        coefficients: `(sensor, atom)`, >= 0, signal^2: variances of white noise, of the angle's quantisation, of the
            AR1s' innovations, and of the walk's increments.
    """

    n_samples: int
    coefficients: Annotated[Tensor, Dims(("sensor", "atom"))]

    def spectrum(self, f: Tensor) -> Tensor:
        """Density per sample `(sensor, frequency)` at `f` cycles per sample."""
        return self.coefficients @ atom_spectra(self.n_samples, f)

    def of_ordinates(self, n: int) -> Tensor:
        """Variances of the cosine ordinates of a record of `n` samples, `(sensor, ordinate)`.

        Where noise has next to nothing slow, as after a high-pass, most of the slow ones is what the record's ends let
        in. It is the same two numbers in all of them: the more it is, the less they count.
        """
        f = (torch.arange(n, dtype=torch.float64) / (2 * n)).clamp(min=1 / n)
        density = self.spectrum(f)
        of_ends = let_in(f, density, f, n)
        return density.maximum(3 * of_ends).maximum(3 * of_ends.square() / density.clamp(min=1e-300))

    def fast(self) -> NoiseSpectrum:
        """What of it is white, or nearly."""
        quick = [True, True, *(tau < _QUICK for tau in ar1_time_constants(self.n_samples)), False]
        return NoiseSpectrum(self.n_samples, torch.where(torch.tensor(quick), self.coefficients, 0.0))

    def model(self) -> ArrayModel:
        """The same as an array of sensors, without atoms that nowhere matter."""
        return ArrayModel.from_sensors([self._sensor(row) for row in self.essential()])

    def shared_model(self, covariances: Tensor) -> ArrayModel:
        """An array whose sensors share noise, from covariances of every atom, `(atom, sensor, sensor)`."""
        pairs = zip(self._kinds(), covariances, strict=True)
        return ArrayModel([(kind(1.0), c) for kind, c in pairs if bool(c.any())])

    def block_covariance(self, block: int, n_blocks: int) -> Tensor:
        """Covariances of means over successive blocks, `(sensor, block, block)`, up to a constant."""
        return torch.einsum("sa,aij->sij", self.coefficients, atom_covariances(self.n_samples, block, n_blocks))

    def essential(self) -> Tensor:
        """Coefficients without those that give no more than a thousandth of the power anywhere."""
        f = torch.logspace(math.log10(1 / self.n_samples), math.log10(0.5), 100, dtype=torch.float64)
        shares = self.coefficients[..., None] * atom_spectra(self.n_samples, f)  # (sensor, atom, frequency)
        matters = (shares / shares.sum(1, keepdim=True)).amax(-1) > _NEGLIGIBLE
        return torch.where(matters, self.coefficients, 0.0)

    def _sensor(self, row: Tensor) -> Model:
        white, *others = zip(self._kinds(), row.tolist(), strict=True)
        return Model([kind(variance) for kind, variance in (white, *(pair for pair in others if pair[1]))])

    def _kinds(self) -> list[Callable[[float], Process]]:
        """The process of each atom, of its variance."""
        shaped = (partial(AR1, math.exp(-1 / tau)) for tau in ar1_time_constants(self.n_samples))
        return [WhiteNoise, QuantizationNoise, *shaped, RandomWalk]


def fit_base(power: Tensor, bands: Bands, n_samples: int, dof: Tensor) -> NoiseSpectrum:
    """Fit spectra `(sensor, band)` by the likelihood of their ordinates, Whittle's.

    Args:
        power: Densities per sample.
        bands: Where they are means.
        n_samples: Of the records to describe.
        dof: Complex ordinates of each band, `(band,)`; 0 leaves it out.
    """
    atoms = bands.mean_of(atom_spectra(n_samples, bands.nodes))  # (atom, band)
    root, known = dof.sqrt(), dof > 0
    fitted, free = torch.where(known, power, 1.0), None
    power = torch.where(known, power, 0.0)
    for _ in range(_ROUNDS):  # scoring: least squares with the variances of what was fitted last
        weights = root / fitted
        design = atoms * weights[:, None]  # (sensor, atom, band)
        coefficients = nonnegative_least_squares(
            design @ design.mT, (design @ (weights * power)[..., None])[..., 0], free
        )
        free = coefficients > 0
        fitted = coefficients @ atoms
    return NoiseSpectrum(n_samples, coefficients)


def let_in(f: Tensor, density: Tensor, at: Tensor, n: int) -> Tensor:
    """What the ends of a record of `n` samples add to its cosine ordinates at `at`, `(..., ordinate)`.

    Faster noise of density `S` adds `2/n int S / sin^2(pi f) df`, from twice the frequency on; of white noise a third
    of the lowest ordinate is that.

    Args:
        f: Frequencies, rising, cycles per sample, `(frequency,)`.
        density: Density there, `(..., frequency)`.
        at: Frequencies of the ordinates, `(ordinate,)`.
        n: Samples of the record.
    """
    weighed = density / torch.sin(math.pi * f).square()
    above = torch.nn.functional.pad(torch.cumulative_trapezoid(weighed.flip(-1), -f.flip(-1)), (1, 0)).flip(-1)
    return 2 / n * above[..., torch.bucketize(2 * at, f).clamp(max=len(f) - 1)]


@functools.lru_cache(maxsize=64)
def ar1_time_constants(n_samples: int) -> tuple[float, ...]:
    """Of the AR1s, samples: corners from one cycle in the record to a sixth of a cycle a sample.

    Three a decade are at most 4 % off an AR1 between them, which long records show: of these there are six a decade, to
    six tenths of a cycle a sample.
    """
    per_decade, highest = (6, 0.6) if n_samples >= 2**16 else (3, 1 / 6)
    count = round(math.log10(n_samples * highest) * per_decade) + 1
    return tuple(n_samples / (2 * math.pi) * 10 ** (-i / per_decade) for i in range(count))


def atom_covariances(n_samples: int, block: int, n_blocks: int) -> Tensor:
    """Covariances of block means, up to a constant, for each atom with coefficient one, `(atom, block, block)`."""
    constants = ar1_time_constants(n_samples)
    lags = torch.from_numpy(block_mean_covariances(block, n_blocks, constants))
    # Those of AR1s are for unit variance, coefficients are variances of innovations.
    lags[1:-1] /= -torch.expm1(-2 / torch.tensor(constants, dtype=torch.float64))[:, None]
    # The angle's quantisation telescopes over a block.
    quantized = torch.zeros_like(lags[:1])
    quantized[0, :2] = torch.tensor([2.0, -1.0]) / block**2
    lags = torch.cat([lags[:1], quantized, lags[1:]])
    at = torch.arange(n_blocks)
    return lags[:, (at[:, None] - at).abs()]


def atom_spectra(n_samples: int, f: Tensor) -> Tensor:
    """Spectra of the atoms with coefficient one, `(atom, frequency)`."""
    phi = torch.tensor([math.exp(-1 / tau) for tau in ar1_time_constants(n_samples)], dtype=torch.float64)[:, None]
    one = torch.ones((), dtype=torch.float64)
    return torch.cat(
        [
            WhiteNoise._spectrum(f, one)[None],
            QuantizationNoise._spectrum(f, one)[None],
            AR1._spectrum(f, phi, one),
            RandomWalk._spectrum(f, one)[None],
        ]
    )
