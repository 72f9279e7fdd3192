"""Baselines: other weights of an array from the same wavelet cross-covariance."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from gyrofuse._base.deprecation import renamed_arguments
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse.fusion.weights.svo import (
    ScaleWeights,
    check_levels,
    checked_combination,
    optimal_weights,
    resolve_scale_weights,
)
from gyrofuse.wavelets.moments import combined_covariance


def equal_weights(wccv: Tensor) -> Tensor:
    """The plain mean: `1/p` for each of p sensors.

    Args:
        wccv: `(..., level, sensor, sensor)`; only its shape, dtype and device matter.

    Returns:
        `(..., sensor)`.
    """
    n_sensors = wccv.shape[-1]
    return wccv.new_full((*wccv.shape[:-3], n_sensors), 1 / n_sensors)


def inverse_variance_weights(wccv: Tensor, scale_weights: ScaleWeights = "flat") -> Tensor:
    """Weights `1/A_ii`, normalised to sum 1: optimal when the sensors do not correlate.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.

    Returns:
        `(..., sensor)`.

    Raises:
        TypeError: `wccv` is not a floating point tensor.
        ValueError: Wrong shape or scale weights.
        SingularCovarianceError: A sensor never changes, or has no complete window at a level that counts.
    """
    combined = combined_covariance(wccv, resolve_scale_weights(scale_weights, check_levels(wccv)))
    variances = torch.diag_embed(combined.diagonal(dim1=-2, dim2=-1))
    check_positive_definite("the diagonal of the wavelet cross-covariance combined over scales", variances)
    return precision_weights(combined)


def precision_weights(combined: Tensor) -> Tensor:
    """`1/A_ii`, normalised to sum 1.

    Args:
        combined: `A`, `(..., sensor, sensor)`.

    Returns:
        `(..., sensor)`.
    """
    precision = combined.diagonal(dim1=-2, dim2=-1).reciprocal()
    return precision / precision.sum(-1, keepdim=True)


def nonnegative_weights(wccv: Tensor, scale_weights: ScaleWeights = "flat") -> Tensor:
    """Weights of the smallest wavelet variance among those that are not negative; differentiable.

    `min c' A c` with `1'c = 1`, `c >= 0`, `A = sum_j omega_j Gamma_j`: exact, by an active set. A sensor whose optimal
    weight is negative gets weight 0.

    Args:
        wccv: `(..., level, sensor, sensor)`, positive definite when combined.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.

    Returns:
        `(..., sensor)`, sum 1, none negative.

    Raises:
        TypeError: `wccv` is not a floating point tensor.
        ValueError: Wrong shape or scale weights.
        SingularCovarianceError: `A` is not positive definite (a dead or duplicated sensor, say).

    References:
        Lawson & Hanson, Solving Least Squares Problems, chapter 23.
    """
    combined = checked_combination(wccv, scale_weights)
    used = _nonnegative_set(combined.detach().double())
    solved = _solve_within(combined, used, torch.ones_like(combined[..., 0])).clamp(min=0)
    return solved / solved.sum(-1, keepdim=True)


@renamed_arguments(degrees="dof")
def shrinkage_weights(wccv: Tensor, scale_weights: ScaleWeights, dof: Tensor) -> Tensor:
    """Optimal weights when the correlations of each level are shrunk towards those of the neighbouring levels.

    Rests on no model of the noise, only on correlations that change little from level to level. How little is estimated
    from the data, see `shrunk_covariance`. The variances of the sensors stay as measured.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
        dof: `(..., level)`, degrees of freedom of each level.

    Returns:
        `(..., sensor)`, sum 1, may be negative.

    Raises:
        TypeError: `wccv` is not a floating point tensor.
        ValueError: Wrong shape or scale weights.
    """
    omega = resolve_scale_weights(scale_weights, check_levels(wccv))
    shrunk, _ = shrunk_covariance(wccv, neighbouring_correlations(wccv, dof), dof)
    return optimal_weights(combined_covariance(shrunk, omega))


def neighbouring_correlations(
    wccv: Tensor, dof: Tensor, *, decay: float = 0.15, sufficient: float = 1000.0, floor: float = 1e-6
) -> Tensor:
    """Cross-covariance with the variances of each level and the mean correlations of its neighbouring levels.

    Levels at a distance `d` count by `decay^d` times their degrees of freedom.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        dof: Degrees of freedom, `(..., level)`.
        decay: Factor by which a level counts less for each step of distance; with 0.15 the mean is mostly that of the
            level below, which holds twice as many observations.
        sufficient: Degrees of freedom from which a level keeps its own correlations: these are known to 3 %.
        floor: Share of uncorrelated noise that keeps the mean regular.

    Returns:
        The same shape and dtype.
    """
    variance = wccv.diagonal(dim1=-2, dim2=-1)
    size = (variance[..., :, None] * variance[..., None, :]).sqrt()
    correlation = wccv / size
    known = correlation.isfinite().all(-1).all(-1)
    level = torch.arange(wccv.shape[-3], device=wccv.device)
    distance = (level[:, None] - level).abs().double()
    near = torch.where(distance > 0, decay**distance, 0.0) * torch.where(known, dof, 0.0)[..., None, :]
    near = (near / near.sum(-1, keepdim=True)).to(wccv)  # (..., level, level)
    correlation = torch.where(known[..., None, None], correlation, 0.0)
    target = torch.einsum("...jk,...kio->...jio", near, correlation)
    identity = torch.eye(wccv.shape[-1], dtype=wccv.dtype, device=wccv.device)
    target = size * ((1 - floor) * target + floor * identity)
    needy = known & (dof < sufficient) & (near.sum(-1) > 0)
    return torch.where(needy[..., None, None], target, wccv)


def shrunk_covariance(wccv: Tensor, target: Tensor, dof: Tensor) -> tuple[Tensor, Tensor]:
    """Wavelet cross-covariance shrunk towards a target, by an amount of the largest likelihood (empirical Bayes).

    `(eta_j Gamma_j + nu T_j) / (eta_j + nu)`: the mean of the posterior when `Gamma_j` is Wishart with `eta_j` degrees
    of freedom and its expectation inverse Wishart around `T_j` with the weight of `nu` observations at every level.
    `nu` maximises

        sum_j ln G((n + eta_j)/2) - ln G(n/2) + n p ln(nu)/2 - (n + eta_j)/2 sum_i ln(nu + eta_j lambda_ij),

    `n = nu + p + 1`, `G` the multivariate gamma function, `lambda_ij` the eigenvalues of `T_j^-1 Gamma_j`. Levels
    with many observations decide how much the target counts at levels with few.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        target: The same shape, positive definite. Levels at which it equals `wccv` do not count.
        dof: `(..., level)`, degrees of freedom `eta_j`.

    Returns:
        The shrunk covariance, the same shape and dtype, and `nu` `(...)`.
    """
    n_sensors = wccv.shape[-1]
    gamma, centre, eta = wccv.detach().double(), target.detach().double(), dof.double()
    known = (gamma.isfinite() & centre.isfinite()).all(-1).all(-1) & (centre.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    informative = known & (gamma != centre).any(-1).any(-1)
    identity = torch.eye(n_sensors, dtype=gamma.dtype, device=gamma.device)
    lower = torch.linalg.cholesky(torch.where(informative[..., None, None], centre, identity))
    half = torch.linalg.solve_triangular(lower, torch.where(informative[..., None, None], gamma, identity), upper=False)
    ratio = torch.linalg.solve_triangular(lower, half.mT, upper=False)
    eigenvalues = torch.linalg.eigvalsh(ratio).clamp(min=0)  # (..., level, sensor)

    # Half a power of two apart from 1/2 observation to 2**30, which leaves the target alone.
    nu = torch.exp2(torch.arange(-2, 61, dtype=torch.float64, device=gamma.device) / 2)
    n, many = nu + n_sensors + 1, nu + n_sensors + 1 + eta[..., None]  # (..., level, nu)
    prior = torch.special.multigammaln(many / 2, n_sensors) - torch.special.multigammaln(n / 2, n_sensors)
    penalty = (nu[:, None] + (eta[..., None] * eigenvalues)[..., None, :]).log().sum(-1)
    likelihood = prior + (n * n_sensors * nu.log() - many * penalty) / 2
    best = torch.where(informative[..., None], likelihood, 0.0).sum(-2).argmax(-1)
    chosen = nu[best]
    share = (chosen[..., None] / (chosen[..., None] + eta)).to(wccv)[..., None, None]
    return torch.where(known[..., None, None], (1 - share) * wccv + share * target.to(wccv), wccv), chosen


def _nonnegative_set(matrix: Tensor, *, most_turns: int = 1000, tolerance: float = 1e-12) -> Tensor:
    """Sensors in use `(..., sensor)` where `x >= 0`, `A x - 1 >= 0` and `x' (A x - 1) = 0`.

    From a feasible `x` go towards the minimum within the set in use: as far as the first sensor that reaches zero,
    which leaves the set, or all the way, after which the sensor of the steepest descent enters. The variance falls with
    each turn.

    Args:
        matrix: `A`, `(..., sensor, sensor)`.
        most_turns: Number of turns at most; about two for each sensor are usual.
        tolerance: Size of `A x - 1` that is zero but for rounding.
    """
    n_sensors = matrix.shape[-1]
    # In units of each sensor all numbers are of order 1; signs and sets stay what they are.
    unit = matrix.diagonal(dim1=-2, dim2=-1).rsqrt()
    correlation = unit[..., :, None] * matrix * unit[..., None, :]
    sensor = torch.arange(n_sensors, device=matrix.device)
    used, x = torch.ones_like(unit, dtype=torch.bool), torch.zeros_like(unit) + unit.mean(-1, keepdim=True)
    for _ in range(most_turns):
        aim = _solve_within(correlation, used, unit)
        share = torch.where(used & (aim <= 0), x / (x - aim).clamp(min=torch.finfo(x.dtype).tiny), torch.inf)
        step, leaving = share.min(-1, keepdim=True)
        blocked = step.isfinite()
        x = torch.where(used, x + step.clamp(max=1.0) * (aim - x), 0.0).clamp(min=0.0)
        excess = (correlation @ x[..., None])[..., 0] / unit - 1
        least, entering = torch.where(used, torch.inf, excess).min(-1, keepdim=True)
        done = ~blocked & (least >= -tolerance)
        used = torch.where(blocked, used & (sensor != leaving), used | ((sensor == entering) & ~done))
        if bool(done.all()):
            return used
    warnings.warn(
        f"nonnegative weights: {int((~done).sum())} of {done.numel()} not at their optimum, for the sensors are "
        "linearly dependent to rounding; they are feasible",
        stacklevel=3,
    )
    return used


def _solve_within(matrix: Tensor, used: Tensor, right: Tensor) -> Tensor:
    """Solve the rows and columns in use; zero elsewhere."""
    both = used[..., :, None] & used[..., None, :]
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return torch.linalg.solve(torch.where(both, matrix, identity), torch.where(used, right, 0.0))
