"""Arrays of sensors: processes with matrix-valued variances, their wavelet moments and sample paths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from gyrofuse._checks import check_positive_integer
from gyrofuse._paths import own_generator
from gyrofuse.processes import Drift, Model, Process

_SYMMETRY = 1e-8  # of the largest entry: printed digits may differ across the diagonal
_ROUNDING = 1e-12  # of the largest eigenvalue: how negative rounding alone may make the smallest


class ArrayModel:
    """Noise of an array: independent components, each a process with a matrix over the sensors.

    A component `(process, covariance)` has the autocovariance of the process times the covariance: white
    noise `R` plus random walk `Q` is `ArrayModel([(WhiteNoise(1.0), R), (RandomWalk(1.0), Q)])`. A component
    `(process, gains)` is one source that every sensor sees with its own gain: a common vibration, or the
    slopes of a `Drift`, which is deterministic and has gains only.

    Args:
        components: Pairs of a process with scalar parameters and either a covariance `(sensor, sensor)`,
            symmetric and positive semi-definite, or gains `(sensor,)`; tensors, arrays or nested lists.

    Raises:
        TypeError: Not pairs of a process and a matrix.
        ValueError: Not symmetric or not positive semi-definite within rounding, different numbers of sensors,
            batched parameters, or more than one drift.

    References:
        [Z] equations (10) and (13).
    """

    def __init__(self, components: Iterable[tuple[Process, Any]]):
        self.components = tuple(_checked(process, matrix) for process, matrix in components)
        if not self.components:
            raise ValueError("`components`: expected at least one (process, covariance), got none")
        sizes = sorted({matrix.shape[-1] for _, matrix in self.components})
        if len(sizes) > 1:
            raise ValueError(f"`components`: expected the same number of sensors in all, got {sizes}")
        if sum(isinstance(process, Drift) for process, _ in self.components) > 1:
            raise ValueError("`components`: expected at most one Drift, got more; add their gains")

    @classmethod
    def from_sensors(cls, models: Sequence[Model]) -> ArrayModel:
        """Array of independent sensors, each with a model of its own.

        Raises:
            ValueError: No sensor, batched parameters, or a drift that is to be estimated.
        """
        noise: list[tuple[Process, Tensor]] = []
        drifts = []
        unit = torch.eye(len(models), dtype=torch.float64)
        for gains, model in zip(unit, models, strict=True):
            for process in model.processes:
                if isinstance(process, Drift):
                    drifts.append(gains * process.params)
                else:
                    noise.append((process, gains))
        # Drifts are deterministic, hence not independent: those of all sensors are one component.
        return cls(noise + ([(Drift(1.0), torch.stack(drifts).sum(0))] if drifts else []))

    @property
    def n_sensors(self) -> int:
        """Number of sensors."""
        return self.components[0][1].shape[-1]

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
        shape = (*batch, self.n_sensors, n_samples)
        signal = torch.zeros(shape, dtype=torch.float64, device=generator.device)
        for process, matrix in self.components:
            root = _root(matrix).to(generator.device)
            sources = process.simulate(n_samples, batch=(*batch, root.shape[-1]), generator=generator)
            signal += root @ sources  # (sensor, source) (..., source, time)
        return signal.to(dtype)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists that `model_from_dict` reads back."""
        return {
            "components": [
                {**process.to_dict(), ("gains" if matrix.ndim == 1 else "covariance"): matrix.tolist()}
                for process, matrix in self.components
            ]
        }

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
        if isinstance(process, Drift):
            raise ValueError(f"{name}: a drift is deterministic; give the slopes as gains (sensor,)")
        _check_covariance(name, matrix.detach())
    return process, matrix


def _check_covariance(name: str, matrix: Tensor) -> None:
    asymmetry = (matrix - matrix.mT).abs().max()
    if asymmetry > _SYMMETRY * matrix.abs().max():
        raise ValueError(
            f"{name}: expected a symmetric matrix, got entries that differ from their mirror images "
            f"by {asymmetry.item():.3g}"
        )
    eigenvalues = torch.linalg.eigvalsh(matrix)
    if eigenvalues[0] < -_ROUNDING * eigenvalues.abs().max():
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
