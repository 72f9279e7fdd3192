"""How far the spectra of a fitted model may be off.

Parameters `theta` that were estimated with a covariance `C` move the logarithms of the spectra of all sensors together,

    cov(log S_i(f), log S_k(g)) = J_i(f) C J_k(g)',   J_i(f) = d log S_i(f) / d theta,

to first order (delta method). It is not scatter of one band beside another: what lies outside the tangent space that
the rows of `J` span no error of estimation can make.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.estimation import EstimatedFrom
from gyrofuse.noise.model import Model

_PER_OCTAVE = 16  # frequencies of the information integral: derivatives of log spectra change over octaves
_AT_ONCE = 32  # frequencies, to bound memory: each has (sensor, sensor, parameter) derivatives
# Of the largest eigenvalue of a scaled information matrix, below which a direction changes no spectrum: rounding of its
# entries is some 1e-13, and an AR1 without variance has a `phi` that changes nothing at all.
_NO_INFORMATION = 1e-10


@dataclass(frozen=True, eq=False)
class SpectralUncertainty:
    """Of an array model that was estimated.

    Attributes:
        model: Noise model.
        covariance: `C` of the numbers in `model.param_names`, `(parameter, parameter)`.
        n_samples: Of each sensor, that they were estimated from.
        at_zero: Variances that were estimated as zero, `(parameter,)`.
    """

    model: ArrayModel
    covariance: Tensor
    n_samples: int
    at_zero: Tensor

    @classmethod
    def of(cls, model: ArrayModel) -> SpectralUncertainty | None:
        """Of a model that knows its record; None of one whose numbers are known.

        A variance at zero has no spread where it was estimated. Here it has that of the information in as many samples,
        and so have all numbers where the fit gave none.
        """
        estimate = model.estimated_from
        if estimate is None:
            return None
        n_params = len(model.param_names)
        given = torch.full((n_params, n_params), torch.nan, dtype=torch.float64)
        if estimate.param_cov is not None:
            given = estimate.param_cov.detach().to(torch.float64)
        fitted = given.diagonal().isfinite()
        none = given.diagonal() == 0
        covariance = given.nan_to_num(nan=0.0)
        if bool((none | ~fitted).any()):
            least = _inverse_information(model, estimate.n_samples)
            covariance = torch.where(~fitted[:, None] | ~fitted, least, covariance)
            covariance[none, none] = least.diagonal()[none]
        return cls(model, covariance, estimate.n_samples, torch.tensor(list(_zeros(model))))

    @cached_property
    def root(self) -> Tensor:
        """`R` with `R R' = C`, `(parameter, error)`: independent errors of unit variance."""
        size = self.covariance.diagonal().clamp(min=0).sqrt()
        scale = torch.where(size > 0, 1 / size, 0.0)
        values, vectors = torch.linalg.eigh(self.covariance * scale[:, None] * scale)
        return size[:, None] * vectors * values.clamp(min=0).sqrt()

    def rows(self, f: Tensor) -> Tensor:
        """`J`, `(sensor, frequency, parameter)`, at frequencies `(frequency,)` in cycles per sample."""
        rows = [
            (slopes / spectra[..., None]).diagonal(dim1=1, dim2=2).movedim(-1, 0)  # (sensor, frequency, parameter)
            for spectra, slopes in _linearised(self.model, f)
        ]
        return torch.cat(rows, 1)

    def errors(self, f: Tensor) -> Tensor:
        """`J R`, `(sensor, frequency, error)`: what independent errors of unit variance do to log spectra."""
        return self.rows(f) @ self.root

    def variance(self, f: Tensor) -> Tensor:
        """Of log spectra, `diag(J C J')`, `(sensor, frequency)`."""
        return self.errors(f).square().sum(-1)

    @property
    def shares_noise(self) -> bool:
        """Whether what sensors share was estimated as well."""
        return any(matrix.ndim == 2 for _, matrix in self.model.components)

    def at_zero_power(self, f: Tensor) -> Tensor:
        """Standard deviations of processes that were estimated as zero, over the spectrum, `(sensor, frequency)`."""
        rows = self.rows(f)[..., self.at_zero]
        return (rows.square() * self.covariance.diagonal()[self.at_zero]).sum(-1).sqrt()


def as_array(model: Model, n_sensors: int) -> ArrayModel:
    """Independent sensors with the parameters `(sensor, parameter)` of a model, or all with the same `(parameter,)`.

    The same numbers for all sensors are one estimate, whose errors they share.
    """
    params, estimate = model.params, model.estimated_from
    if params.ndim == 2 and len(params) == 1 < n_sensors:  # one sensor's, for all
        params, estimate = params[0], own_record(estimate, 0)
    if params.ndim == 2:
        own = [own_record(estimate, i) for i in range(n_sensors)]
        return ArrayModel.from_sensors(
            [model.with_params(row, estimated_from=one) for row, one in zip(params, own, strict=True)]
        )
    one = model.with_params(params, estimated_from=estimate)
    array = ArrayModel.from_sensors([one] * n_sensors)
    alone = SpectralUncertainty.of(ArrayModel.from_sensors([one]))
    if alone is None:
        return array
    n_drifts = int(any(process.deterministic for process in model.processes))
    noise = len(alone.covariance) - n_drifts
    shared = alone.covariance[:noise, :noise].repeat(n_sensors, n_sensors)
    whole = torch.block_diag(shared, *torch.zeros(n_drifts, 1, 1, dtype=torch.float64))
    return ArrayModel(array.components, estimated_from=EstimatedFrom(alone.n_samples, whole))


def own_record(estimate: EstimatedFrom | None, i: int) -> EstimatedFrom | None:
    """What one of several sensors was estimated from."""
    if estimate is None or estimate.param_cov is None:
        return estimate
    return EstimatedFrom(estimate.n_samples, estimate.param_cov[i])


def _zeros(model: ArrayModel) -> Iterator[bool]:
    """Whether each number in `param_names` is a variance of zero."""
    for process, matrix in model.components:
        if matrix.ndim == 2:
            yield from (i == j and float(matrix[i, i]) == 0 for i, j in torch.triu_indices(*matrix.shape).mT.tolist())
            yield from (False for name in process.parameters if name in ("phi", "beta"))
        else:
            yield from (name == "variance" and bool(value == 0) for name, value in process.parameters.items())


def _linearised(model: ArrayModel, f: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Spectra `(frequency, sensor, sensor)` and derivatives `(.., parameter)` of some frequencies at a time."""
    for some in f.split(_AT_ONCE):
        yield model.spectrum(some), model.spectrum_jacobian(some)


def _inverse_information(model: ArrayModel, n_samples: int) -> Tensor:
    """Covariance of efficient estimates from so many samples, `(parameter, parameter)`: Whittle's information inverted.

    `F_kl = T int_0^1/2 tr(S^-1 dS_k S^-1 dS_l) df`. Parameters that change no spectrum have none, and zeros here.
    """
    n_cells = math.ceil(_PER_OCTAVE * math.log2(n_samples))
    edges = torch.logspace(math.log10(0.5 / n_samples), math.log10(0.5), n_cells + 1, dtype=torch.float64)
    widths, middles = edges.diff(), (edges[1:] * edges[:-1]).sqrt()
    information = torch.zeros(len(model.param_names), len(model.param_names), dtype=torch.float64)
    for width, (spectra, slopes) in zip(widths.split(_AT_ONCE), _linearised(model, middles), strict=True):
        relative = torch.linalg.solve(spectra[:, None], slopes.movedim(-1, 1))  # (frequency, parameter, sensor, sensor)
        information += n_samples * torch.einsum("f,fkij,flji->kl", width, relative, relative)
    size = information.diagonal().sqrt()
    scale = torch.where(size > 0, 1 / size, 0.0)
    inverse = torch.linalg.pinv(information * scale[:, None] * scale, rtol=_NO_INFORMATION, hermitian=True)
    return inverse * scale[:, None] * scale
