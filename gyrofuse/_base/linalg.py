"""Linear algebra that says what is wrong with a covariance."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gyrofuse._base.results import named


class SingularCovarianceError(ValueError):
    """A covariance matrix of the array is not positive definite, so there are no optimal weights."""


def oriented_eigh(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues and eigenvectors of symmetric matrices, the largest entry of each vector positive.

    Its sign is the library's choice, hence another one on another device; where random numbers are mixed by the
    vectors, so would the result be.
    """
    values, vectors = torch.linalg.eigh(matrix)
    largest = vectors.gather(-2, vectors.abs().argmax(-2, keepdim=True))
    return values, vectors * torch.where(largest < 0, -1.0, 1.0).to(vectors)


def check_positive_definite(
    name: str,
    matrix: Tensor,
    labels: Sequence[str] | None = None,
    *,
    dtype: torch.dtype | None = None,
    least: float = 0.0,
) -> None:
    """Raise when any covariance of a batch is not positive definite, naming items, sensors and likely causes.

    Args:
        name: What the matrix is called in the message.
        matrix: `(..., sensor, sensor)`.
        labels: Names of the sensors, for the message.
        dtype: What the matrix was computed in, when that is less than its own.
        least: Smallest eigenvalue of the correlation matrix that what follows can work with.

    Raises:
        SingularCovarianceError: Non-finite entries, a sensor without variance, two equal sensors, or a smallest
            eigenvalue of the correlation matrix that is zero to rounding or below.
    """
    matrix = matrix.detach()
    n_sensors = matrix.shape[-1]
    names = list(labels) if labels is not None else [str(i + 1) for i in range(n_sensors)]
    variance = matrix.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(variance > 0, variance, 1.0).rsqrt()
    correlation = scale[..., :, None] * matrix * scale[..., None, :]
    finite = correlation.isfinite().all(-1).all(-1)
    smallest = torch.linalg.eigvalsh(torch.where(finite[..., None, None], correlation, 0.0))[..., 0]
    tolerance = max(10 * n_sensors * torch.finfo(dtype or matrix.dtype).eps, least)
    bad = ~finite | (variance <= 0).any(-1) | (smallest <= tolerance)
    if not bool(bad.any()):
        return
    where = ""
    item: tuple[int, ...] = ()
    if bad.ndim:
        items = bad.nonzero()
        shown = ", ".join(str(tuple(i)) for i in items[:5].tolist())
        where = f" at batch item(s) {shown}{', ...' if len(items) > 5 else ''} ({len(items)} of {bad.numel()})"
        item = tuple(items[0].tolist())
    raise SingularCovarianceError(
        f"{name} is not positive definite{where}: {_cause(matrix[item], correlation[item], names, tolerance)}"
    )


def geometric_mean(inverse: Tensor, other: Tensor) -> Tensor:
    """The positive `X` with `X D X = M`, the geometric mean of `D^-1` and `M`."""
    lower = torch.linalg.cholesky(inverse)
    values, vectors = torch.linalg.eigh(lower.mT @ other @ lower)
    root = (vectors * values.clamp(min=0).sqrt()[..., None, :]) @ vectors.mT
    half = torch.linalg.solve_triangular(lower.mT, root, upper=True)
    mean = torch.linalg.solve_triangular(lower, half, upper=False, left=False)
    return (mean + mean.mT) / 2


def _cause(matrix: Tensor, correlation: Tensor, names: Sequence[str], tolerance: float) -> str:
    huge = matrix.diagonal().isinf().nonzero().flatten().tolist()
    if huge:
        return f"numbers of sensor(s) {named(names, huge)} are too large to be squared; give them in another unit"
    missing = matrix.diagonal().isnan().nonzero().flatten().tolist()
    if missing:
        return (
            f"sensor(s) {named(names, missing)} have no complete window at some level; "
            "leave them out or use fewer levels"
        )
    if not bool(matrix.isfinite().all()):
        return "some sensors are never recorded together; leave one of them out"
    dead = (matrix.diagonal() <= 0).nonzero().flatten().tolist()
    if dead:
        return (
            f"sensor(s) {named(names, dead)} never change (dead or stuck); leave them out, or where their numbers are "
            "too small to be squared, give them in another unit"
        )
    equal = (correlation.abs() >= 1 - max(tolerance, 1e-9)).triu(1).nonzero().tolist()
    if equal:
        pairs = ", ".join(f"{names[i]} and {names[k]}" for i, k in equal[:5])
        return f"sensors {pairs} are copies of each other; keep one of each"
    return (
        "the sensors are linearly dependent, or the recording is too short for its number of sensors; "
        "leave sensors out, use more scales, or record longer"
    )
