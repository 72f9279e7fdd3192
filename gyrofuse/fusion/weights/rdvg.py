"""The reduced-drift virtual gyro (RDVG): weights that are optimal for white noise and random walks alone.

Vaccaro and Zaki fit white noise of variances `R_i` and random walks of covariance `Q` to the Allan covariances of the
array, over non-overlapping clusters of `m` samples, `M = N/m` of them:

    AC_ij(m) = 1/(2(M-1)) sum_k (ybar_i,k+1 - ybar_i,k)(ybar_j,k+1 - ybar_j,k),   E AC_ij(m) = delta_ij R_i/m + Q_ij m/3

by generalised least squares over the scales `m = 2, 4, ..., 2^J`, `J = floor(log2 N) - 3`, sensor by sensor and then
pair by pair. The weights `Q^-1 1 / (1' Q^-1 1)` depend on the random walks only. `Q` may not be positive definite.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._base.checks import check_signal, largest_level
from gyrofuse._base.results import Result


@dataclass(frozen=True, eq=False)
class RDVGResult(Result):
    """Weights by RDVG and the noise model behind them. Batched over the leading dimensions of the signal.

    Attributes:
        weights: `(..., sensor)`, sum 1, may be negative; NaN where `Q` is singular.
        R: `(..., sensor)`, variance of the white noise, signal^2.
        Q: `(..., sensor, sensor)`, covariance of the steps of the random walks, signal^2 per sample.
        positive_definite: `(...)`, whether `Q` is positive definite. Otherwise the weights follow the formula, but
            minimise nothing.
    """

    weights: Tensor
    R: Tensor
    Q: Tensor
    positive_definite: Tensor
    _batched = ("weights", "R", "Q", "positive_definite")

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions; `()` for a single array."""
        return tuple(self.positive_definite.shape)

    def summary(self) -> str:
        """Weights and variances as text; the first item of a batch."""
        n_items, n_failed = self.positive_definite.numel(), int((~self.positive_definite).sum())
        rows = zip(*(self._first(v) for v in (self.weights, self.R, self.Q.diagonal(dim1=-2, dim2=-1))), strict=True)
        lines = [f"{'sensor':>6}  {'weight':>9}  {'R (signal^2)':>13}  {'Q (signal^2/sample)':>19}"]
        lines += [f"{i:>6}  {w:>+9.5f}  {r:>13.5g}  {q:>19.5g}" for i, (w, r, q) in enumerate(rows, 1)]
        if n_failed:
            lines.append(f"Q is not positive definite in {n_failed} of {n_items}: the weights there minimise nothing")
        return "\n".join(lines)

    @staticmethod
    def _first(values: Tensor) -> list[float]:
        return values.reshape(-1, values.shape[-1])[0].tolist()


def rdvg_weights(signal: Tensor) -> Tensor:
    """Weights of an array by RDVG; see `rdvg`, which also returns whether they minimise anything.

    Args:
        signal: `(..., sensor, time)`.

    Returns:
        `(..., sensor)`, sum 1, may be negative; NaN where the estimated `Q` is singular.

    Raises:
        TypeError, ValueError: As `rdvg`.
    """
    return _rdvg(signal).weights


def rdvg(signal: Tensor) -> RDVGResult:
    """White noise and random walks of an array by Allan covariances, and the weights they lead to.

    As published, with two cases that the publication leaves open: where no scale lies below an eighth of the scale with
    the smallest Allan variance, the shortest scale alone gives the first guess of `R`; a negative `R_i` or `Q_ii` stays
    in the result, but its first guess, which is positive, weighs the pairs.

    Args:
        signal: `(..., sensor, time)`, any unit, at least 32 samples. Missing (non-finite) samples: clusters that
            hold one are left out, pair by pair.

    Returns:
        Weights, `R`, `Q`, and whether `Q` is positive definite. Otherwise one warning counts the items, and
        nothing is raised, as the other items of a batch are good.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: Not `(..., sensor, time)`, too short, a sensor that never changes, or sensors without complete
            clusters in common at some scale.

    References:
        Vaccaro and Zaki, Reduced-drift virtual gyro from an array of low-cost gyros, Sensors 17(2), 352, 2017.
    """
    return _rdvg(signal)


def _rdvg(signal: Tensor) -> RDVGResult:
    check_signal("signal", signal)
    n_samples = signal.shape[-1]
    n_scales = largest_level(n_samples) - 3
    if n_scales < 2:
        raise ValueError(f"`signal`: expected at least 32 samples for two cluster sizes, got {n_samples}")
    covariances = _allan_covariances(signal.detach(), n_scales)
    if not bool(covariances.isfinite().all()):
        raise ValueError(
            "`signal`: expected clusters of every size that all sensors have, but missing samples leave none; "
            "give a stretch with fewer gaps"
        )
    if not bool((covariances.diagonal(dim1=-2, dim2=-1) > 0).all()):
        raise ValueError("`signal`: expected sensors that change, got one that is dead or stuck; leave it out")
    R, Q = fit_allan_covariances(covariances, n_samples)
    positive_definite = torch.linalg.cholesky_ex(Q).info == 0
    if not bool(positive_definite.all()):
        warnings.warn(
            f"RDVG: the estimated random walk covariance Q is not positive definite in "
            f"{int((~positive_definite).sum())} of {positive_definite.numel()} array(s); "
            "their weights follow the formula but minimise nothing",
            stacklevel=3,
        )
    return RDVGResult(_weights(Q).to(signal), R.to(signal), Q.to(signal), positive_definite)


def _weights(Q: Tensor) -> Tensor:
    """`Q^-1 1 / (1' Q^-1 1)`, NaN where `Q` is singular."""
    solved, info = torch.linalg.solve_ex(Q, Q.new_ones(Q.shape[:-1]))
    solved = torch.where(info[..., None] == 0, solved, torch.nan)
    return solved / solved.sum(-1, keepdim=True)


def _allan_covariances(signal: Tensor, n_scales: int) -> Tensor:
    """`AC_ij(m)` at `m = 2, 4, ..., 2**n_scales`: `(..., scale, sensor, sensor)`, float64; NaN without a pair."""
    means, scales = signal, []
    complete = bool(signal.sum().isfinite())
    for _ in range(n_scales):
        even = means.shape[-1] // 2 * 2
        # Clusters of m from those of m/2; a missing sample makes its clusters, and their steps, non-finite.
        means = (means[..., 0:even:2].double() + means[..., 1:even:2].double()) / 2
        steps = means.diff(dim=-1)
        if complete:
            scales.append(steps @ steps.mT / (2 * steps.shape[-1]))
        else:
            known = steps.isfinite()
            filled, counted = torch.where(known, steps, 0.0), known.double()
            scales.append(filled @ filled.mT / (2 * (counted @ counted.mT)))
    return torch.stack(scales, dim=-3)


def fit_allan_covariances(covariances: Tensor, n_samples: int) -> tuple[Tensor, Tensor]:
    """White noise variances and random walk covariance by generalised least squares.

    Args:
        covariances: `(..., scale, sensor, sensor)`, Allan covariances of clusters of `m = 2, 4, ...` samples.
        n_samples: Length N of the recording.

    Returns:
        `R` `(..., sensor)` and `Q` `(..., sensor, sensor)`.
    """
    size = torch.exp2(torch.arange(1, covariances.shape[-3] + 1, dtype=covariances.dtype, device=covariances.device))
    white, walk = _sampling_covariances(size, n_samples)
    variances = covariances.diagonal(dim1=-2, dim2=-1).mT  # (..., sensor, scale)

    # A first guess: white noise from the short scales, and the random walk that puts the minimum where it was found.
    smallest = size[variances.argmin(-1, keepdim=True)]
    short = (size < smallest / 8) | (size == size[0])
    both = short[..., :, None] & short[..., None, :]
    chosen = torch.where(both, white, torch.eye(len(size)).to(white))  # scales left out have a zero regressor
    R0 = _least_squares(chosen, (short / size)[..., None], torch.where(short, variances, 0.0))[..., 0]
    Q0 = 3 * R0 / smallest[..., 0].square()

    regressors = torch.stack([1 / size, size / 3], dim=-1)  # (scale, parameter)
    sampling = _scaled(white, R0.square()) + _scaled(walk, Q0.square())
    R, own = _least_squares(sampling, regressors, variances).unbind(-1)

    # Pairs: half the covariance, with products in place of squares and Q_ij taken as 0.
    positive_R, positive_Q = torch.where(R > 0, R, R0), torch.where(own > 0, own, Q0)
    sampling = _scaled(white, _products(positive_R) / 2) + _scaled(walk, _products(positive_Q) / 2)
    Q = _least_squares(sampling, regressors[:, 1:], covariances.movedim(-3, -1))[..., 0]
    return R, Q - torch.diag_embed(Q.diagonal(dim1=-2, dim2=-1) - own)


def _sampling_covariances(size: Tensor, n_samples: int) -> tuple[Tensor, Tensor]:
    """Covariance of Allan variances between scales, `CR(1)` and `CQ(1)`: `(scale, scale)` each."""
    m1, m2 = torch.minimum(size[:, None], size), torch.maximum(size[:, None], size)
    r, M1, M2 = m2 / m1, n_samples / m1, n_samples / m2
    pairs = (M1 - 1) * (M2 - 1) * r**2
    white = (3 * M2 - 4) / (pairs * m1**2)
    walk = ((12 * r**3 - 6 * r + 3) * M2 - 2 * (6 * r**3 - 3 * r + 2)) * m1**2 / (36 * pairs)
    return white, walk


def _least_squares(covariance: Tensor, regressors: Tensor, values: Tensor) -> Tensor:
    """`(X' C^-1 X)^-1 X' C^-1 y` for `C (..., scale, scale)`, `X (..., scale, parameter)`, `y (..., scale)`."""
    # In units of each scale's standard error, as the scales differ by many orders of magnitude.
    unit = covariance.diagonal(dim1=-2, dim2=-1).rsqrt()
    whitened = unit[..., None] * regressors
    weighted = torch.linalg.solve(unit[..., :, None] * covariance * unit[..., None, :], whitened)
    return torch.linalg.solve(weighted.mT @ whitened, (weighted.mT @ (unit * values)[..., None]))[..., 0]


def _scaled(matrix: Tensor, factors: Tensor) -> Tensor:
    """One matrix for each factor: `(..., scale, scale)`."""
    return factors[..., None, None] * matrix


def _products(values: Tensor) -> Tensor:
    return values[..., :, None] * values[..., None, :]
