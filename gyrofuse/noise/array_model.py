"""Arrays of sensors: processes with matrix-valued variances, their wavelet moments and sample paths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_batch, check_positive_integer, own_generator
from gyrofuse.noise.estimation import EstimatedFrom
from gyrofuse.noise.processes import Drift, Model, Process


class ArrayModel:
    """Noise of an array: independent components, each a process with a matrix over the sensors.

    A component `(process, covariance)` has the autocovariance of the process times the covariance: white
    noise `R` plus random walk `Q` is `ArrayModel([(WhiteNoise(1.0), R), (RandomWalk(1.0), Q)])`. A component
    `(process, gains)` is one source that every sensor sees with its own gain: a common vibration, or the
    slopes of a `Drift`, which is deterministic and has gains only.

    Args:
        components: Pairs of a process with scalar parameters and either a covariance `(sensor, sensor)`,
            symmetric and positive semi-definite, or gains `(sensor,)`; tensors, arrays or nested lists.
        estimated_from: Record that the numbers were estimated from, with their covariance in the order of
            `param_names`; None for an array whose numbers are known. A sum of arrays has none.

    Raises:
        TypeError: Not pairs of a process and a matrix.
        ValueError: Not symmetric or not positive semi-definite within rounding, different numbers of sensors,
            batched parameters, more than one drift, or a covariance of other parameters.

    References:
        [Z] equations (10) and (13).
    """

    def __init__(self, components: Iterable[tuple[Process, Any]], *, estimated_from: EstimatedFrom | None = None):
        self.components = tuple(_checked(process, matrix) for process, matrix in components)
        if not self.components:
            raise ValueError("`components`: expected at least one (process, covariance), got none")
        sizes = sorted({matrix.shape[-1] for _, matrix in self.components})
        if len(sizes) > 1:
            raise ValueError(f"`components`: expected the same number of sensors in all, got {sizes}")
        if sum(process.deterministic for process, _ in self.components) > 1:
            raise ValueError("`components`: expected at most one Drift, got more; add their gains")
        self.estimated_from = estimated_from
        if estimated_from is not None and not estimated_from.fits((len(self.param_names),)):
            raise ValueError(
                f"`estimated_from`: expected a covariance of the {len(self.param_names)} parameters in `param_names`, "
                f"got shape {tuple(estimated_from.param_cov.shape)}"  # type: ignore[union-attr]
            )

    @classmethod
    def from_sensors(cls, models: Sequence[Model]) -> ArrayModel:
        """Array of independent sensors, each with a model of its own.

        A batch of one, as the fit of one sensor gives it, is that sensor's. The array is estimated from the records
        that all its models were estimated from; numbers of different sensors then are uncorrelated. If one of the
        models counts as known, so does the array.

        Raises:
            ValueError: No sensor, a batch of more than one, or a drift that is to be estimated.
        """
        noise: list[tuple[Process, Tensor]] = []
        drifts = []
        unit = torch.eye(len(models), dtype=torch.float64)
        models = [_of_one_sensor(model) for model in models]
        for gains, model in zip(unit, models, strict=True):
            for process in model.processes:
                if process.deterministic:
                    drifts.append(gains * process.params)
                else:
                    noise.append((process, gains))
        # Drifts are deterministic, hence not independent: those of all sensors are one component.
        components = noise + ([(Drift(1.0), torch.stack(drifts).sum(0))] if drifts else [])
        return cls(components, estimated_from=_together(models, n_drifts=int(bool(drifts))))

    @property
    def n_sensors(self) -> int:
        """Number of sensors."""
        return self.components[0][1].shape[-1]

    @property
    def param_names(self) -> tuple[str, ...]:
        """Numbers that the spectra depend on, component by component, such as `2.covariance[0,1]` and `2.phi`.

        Of a component with a covariance the entries on and above the diagonal, row after row, then `phi` or `beta` of
        its process; of one with gains the parameters of its process.
        """
        names = []
        for k, (process, matrix) in enumerate(self.components, 1):
            if matrix.ndim == 2:
                names += [f"{k}.covariance[{i},{j}]" for i, j in torch.triu_indices(*matrix.shape).mT.tolist()]
            names += [f"{k}.{name}" for name in _own_params(process, matrix)]
        return tuple(names)

    def wavelet_cross_covariance(self, n_levels: int) -> Tensor:
        """Wavelet cross-covariance `(level, sensor, sensor)` of levels 1 to `n_levels` in theory, signal^2.

        Differentiable in parameters and covariances.

        Raises:
            ValueError: A parameter is to be estimated, or `n_levels` is below 1.
        """
        return self._mix([process.wavelet_variance(n_levels) for process, _ in self.components])

    def spectrum(self, f: Tensor | Sequence[float] | float) -> Tensor:
        """Continuous part of the cross-spectral density, `(frequency, sensor, sensor)`; see `Model.spectrum`.

        Raises:
            ValueError: A parameter is to be estimated.
        """
        return self._mix([process.spectrum(f) for process, _ in self.components])

    def spectrum_jacobian(self, f: Tensor) -> Tensor:
        """Derivatives of `spectrum` with respect to the numbers in `param_names`.

        Args:
            f: Frequencies `(frequency,)`, cycles per sample.

        Returns:
            `(frequency, sensor, sensor, parameter)`, float64.

        Raises:
            ValueError: A parameter is to be estimated.
        """
        slopes = []
        for process, matrix in self.components:
            covariance = matrix.outer(matrix) if matrix.ndim == 1 else matrix
            if matrix.ndim == 2:
                first, second = torch.triu_indices(*matrix.shape)
                entries = torch.zeros(*matrix.shape, len(first), dtype=torch.float64)
                place = torch.arange(len(first))
                entries[first, second, place] = entries[second, first, place] = 1.0
                slopes.append(process.spectrum(f)[:, None, None, None] * entries)
            own = process.spectrum_jacobian(f)[:, list(_own_params(process, matrix).values())]
            slopes.append(own[:, None, None] * covariance[..., None])
        return torch.cat(slopes, -1)

    def simulate(
        self,
        n_samples: int,
        *,
        batch: Sequence[int] = (),
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw independent recordings of the array; each process as in `Model.simulate`.

        Args:
            n_samples: Samples of each recording.
            batch: Shape of the independent recordings.
            generator: Source of randomness; by default a fresh one. The global one is never touched.
            dtype: Of the result; the computation is in float64.
            device: Of the result; by default that of `generator`, else the CPU.

        Returns:
            `(*batch, sensor, time)`, signal.

        Raises:
            ValueError: A parameter is to be estimated, or `generator` lives on another device.
        """
        n_samples = check_positive_integer("n_samples", n_samples)
        generator = own_generator(generator, device)
        shape = (*check_batch(batch), self.n_sensors, n_samples)
        signal = torch.zeros(shape, dtype=torch.float64, device=generator.device)
        for process, matrix in self.components:
            root = _root(matrix).to(generator.device)
            sources = process.simulate(n_samples, batch=(*batch, root.shape[-1]), generator=generator)
            signal += root @ sources  # (sensor, source) (..., source, time)
        return signal.to(dtype)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists that `model_from_dict` reads back."""
        plain: dict[str, Any] = {
            "components": [
                {**process.to_dict(), ("gains" if matrix.ndim == 1 else "covariance"): matrix.tolist()}
                for process, matrix in self.components
            ]
        }
        if self.estimated_from is not None:
            plain["estimated_from"] = self.estimated_from.to_dict()
        return plain

    def __add__(self, other: ArrayModel) -> ArrayModel:
        if not isinstance(other, ArrayModel):
            return NotImplemented
        return ArrayModel(self.components + other.components)

    def __repr__(self) -> str:
        return f"ArrayModel({self.n_sensors} sensors: {' + '.join(repr(p) for p, _ in self.components)})"

    def _mix(self, terms: list[Tensor]) -> Tensor:
        """Sum over components of its term `(...)` times its covariance: `(..., sensor, sensor)`."""
        covariances = torch.stack([m.outer(m) if m.ndim == 1 else m for _, m in self.components])
        return torch.einsum("k...,kab->...ab", torch.stack(terms).to(covariances.device), covariances)


def _of_one_sensor(model: Model) -> Model:
    """The model of a batch of one; others as they are."""
    values = [value for process in model.processes for value in process.parameters.values()]
    shapes = [value.shape for value in values if isinstance(value, Tensor) and value.ndim]
    if not shapes or any(shape.numel() != 1 for shape in shapes):
        return model
    params, record = model.params.reshape(-1), model.estimated_from
    if record is not None and record.param_cov is not None:
        record = replace(record, param_cov=record.param_cov.reshape(len(params), len(params)))
    return model.with_params(params, estimated_from=record)


def _own_params(process: Process, matrix: Tensor) -> dict[str, int]:
    """Parameters of a component's process that its matrix does not stand for, with their places among all."""
    return {
        name: at
        for at, name in enumerate(process.parameters)
        if matrix.ndim == 1 or name == process.shape_name  # a covariance stands for variance or squared amplitude
    }


def _together(models: Sequence[Model], n_drifts: int) -> EstimatedFrom | None:
    """What independent sensors were estimated from; drifts, which have no spectrum, come last and have variance 0."""
    records = [model.estimated_from for model in models if model.estimated_from is not None]
    if len(records) < len(models):
        return None
    shortest = min(one.n_samples for one in records)
    blocks = []
    for model, one in zip(models, records, strict=True):
        if one.param_cov is None:
            return EstimatedFrom(shortest)
        noise = torch.tensor([not p.deterministic for p in model.processes for _ in p.parameters])
        blocks.append(one.param_cov[noise][:, noise])
    return EstimatedFrom(shortest, torch.block_diag(*blocks, *torch.zeros(n_drifts, 1, 1, dtype=torch.float64)))


def _checked(process: Process, matrix: Any) -> tuple[Process, Tensor]:
    if not isinstance(process, Process):
        raise TypeError(f"`components`: expected a process such as AR1() in every pair, got {process!r}")
    if any(isinstance(value, Tensor) and value.ndim for value in process.parameters.values()):
        raise ValueError(f"`components`: expected scalar parameters, got a batch in {process!r}")
    matrix = torch.as_tensor(matrix, dtype=torch.float64)
    name = f"`components`: matrix of {type(process).__name__}"
    if matrix.ndim not in (1, 2) or matrix.numel() == 0 or matrix.shape[0] != matrix.shape[-1]:
        raise ValueError(
            f"{name}: expected a covariance (sensor, sensor) or gains (sensor,), got shape {tuple(matrix.shape)}"
        )
    if not bool(matrix.isfinite().all()):
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
    if matrix.ndim == 2:
        if process.deterministic:
            raise ValueError(f"{name}: a drift is deterministic; give the slopes as gains (sensor,)")
        _check_covariance(name, matrix.detach())
    return process, matrix


def _check_covariance(name: str, matrix: Tensor) -> None:
    symmetry = 1e-8  # share of the largest entry: printed digits may differ across the diagonal
    rounding = 1e-12  # share of the largest eigenvalue: how negative rounding alone may make the smallest
    asymmetry = (matrix - matrix.mT).abs().max()
    if asymmetry > symmetry * matrix.abs().max():
        raise ValueError(
            f"{name}: expected a symmetric matrix, got entries that differ from their mirror images "
            f"by {asymmetry.item():.3g}"
        )
    eigenvalues = torch.linalg.eigvalsh(matrix)
    if eigenvalues[0] < -rounding * eigenvalues.abs().max():
        raise ValueError(
            f"{name}: expected a positive semi-definite matrix, got eigenvalues from "
            f"{eigenvalues[0].item():.3g} to {eigenvalues[-1].item():.3g}"
        )


def _root(matrix: Tensor) -> Tensor:
    """Matrix `(sensor, source)` whose product with its transpose is the covariance."""
    if matrix.ndim == 1:
        return matrix[:, None]
    eigenvalues, vectors = torch.linalg.eigh(matrix)
    kept = eigenvalues > 0
    return vectors[:, kept] * eigenvalues[kept].sqrt()
