"""Other ways to weigh the sensors of an array, from the same wavelet cross-covariance."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from gyrofuse._base.linalg import check_positive_definite
from gyrofuse.fusion.weights.svo import combine, counting, optimal_weights

# How far below 1 the variance that a sensor would bring may seem, in units of the least, by rounding.
_TOLERANCE = 1e-12
_MOST_TURNS = 1000  # some two for each sensor are usual
# How fast the levels beside a level lose their say with distance, degrees of freedom from which it needs none, and
# the share of uncorrelated noise that keeps their mean regular.
_FADING, _MANY_DEGREES, _FLOOR = 0.15, 1000.0, 1e-6
# Observations that a target may be worth, half a power of two apart; with the last it stands alone.
_WORTH = torch.exp2(torch.arange(-2, 61, dtype=torch.float64) / 2)


def equal_weights(wccv: Tensor) -> Tensor:
    """The plain mean: `1/p` for each of p sensors.

    Args:
        wccv: `(..., level, sensor, sensor)`; only its shape, dtype and device matter.

    Returns:
        `(..., sensor)`.
    """
    n_sensors = wccv.shape[-1]
    return wccv.new_full((*wccv.shape[:-3], n_sensors), 1 / n_sensors)


def inverse_variance_weights(wccv: Tensor, scale_weights: Tensor) -> Tensor:
    """Weights `1/A_ii`, normalised to sum 1: optimal when the sensors do not correlate.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        scale_weights: `(level,)`.

    Returns:
        `(..., sensor)`.

    Raises:
        SingularCovarianceError: A sensor never changes, or has no complete window at a level that counts.
    """
    combined = combine(counting(wccv, scale_weights), scale_weights)
    variances = torch.diag_embed(combined.diagonal(dim1=-2, dim2=-1))
    check_positive_definite("the diagonal of the wavelet cross-covariance combined over scales", variances)
    return precision_weights(combined)


def precision_weights(combined: Tensor) -> Tensor:
    """`1/A_ii`, normalised to sum 1, of `A (..., sensor, sensor)`."""
    precision = combined.diagonal(dim1=-2, dim2=-1).reciprocal()
    return precision / precision.sum(-1, keepdim=True)


def nonnegative_weights(wccv: Tensor, scale_weights: Tensor) -> Tensor:
    """Weights of the smallest wavelet variance among those that are not negative; differentiable.

    `min c' A c` with `1'c = 1`, `c >= 0`, `A = sum_j omega_j Gamma_j`: exactly, by an active set. A sensor that would
    serve only by being subtracted gets weight 0.

    Args:
        wccv: `(..., level, sensor, sensor)`, positive definite when combined.
        scale_weights: `(level,)`.

    Returns:
        `(..., sensor)`, sum 1, none negative.

    Raises:
        SingularCovarianceError: `A` is not positive definite (a dead or duplicated sensor, say).

    References:
        Lawson & Hanson, Solving Least Squares Problems, chapter 23.
    """
    combined = combine(counting(wccv, scale_weights), scale_weights)
    check_positive_definite("the wavelet cross-covariance combined over scales", combined)
    used = _nonnegative_set(combined.detach().double())
    solved = _solve_within(combined, used, torch.ones_like(combined[..., 0])).clamp(min=0)
    return solved / solved.sum(-1, keepdim=True)


def shrinkage_weights(wccv: Tensor, scale_weights: Tensor, degrees: Tensor) -> Tensor:
    """Optimal weights when the correlations of each level are drawn towards those of the levels beside it.

    No model of the noise is needed, only that correlations change little from level to level; how little, the data
    tell: see `shrunk_covariance`. The variances of the sensors stay as measured.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        scale_weights: `(level,)`.
        degrees: `(..., level)`, degrees of freedom of each level.

    Returns:
        `(..., sensor)`, sum 1, may be negative.
    """
    shrunk, _ = shrunk_covariance(wccv, neighbouring_correlations(wccv, degrees), degrees)
    return optimal_weights(combine(counting(shrunk, scale_weights), scale_weights))


def neighbouring_correlations(wccv: Tensor, degrees: Tensor) -> Tensor:
    """Cross-covariance with the variances of each level and the mean correlations of the levels beside it.

    Levels at a distance `d` count by `0.15^d` times their degrees of freedom: mostly the level below, which holds
    twice as many observations. Levels with many degrees of freedom need no help and stay as they are.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        degrees: `(..., level)`.

    Returns:
        The same shape and dtype.
    """
    variance = wccv.diagonal(dim1=-2, dim2=-1)
    size = (variance[..., :, None] * variance[..., None, :]).sqrt()
    correlation = wccv / size
    known = correlation.isfinite().all(-1).all(-1)
    level = torch.arange(wccv.shape[-3], device=wccv.device)
    distance = (level[:, None] - level).abs().double()
    near = torch.where(distance > 0, _FADING**distance, 0.0) * torch.where(known, degrees, 0.0)[..., None, :]
    near = (near / near.sum(-1, keepdim=True)).to(wccv)  # (..., level, level)
    correlation = torch.where(known[..., None, None], correlation, 0.0)
    target = torch.einsum("...jk,...kio->...jio", near, correlation)
    identity = torch.eye(wccv.shape[-1], dtype=wccv.dtype, device=wccv.device)
    target = size * ((1 - _FLOOR) * target + _FLOOR * identity)
    needy = known & (degrees < _MANY_DEGREES) & (near.sum(-1) > 0)
    return torch.where(needy[..., None, None], target, wccv)


def shrunk_covariance(wccv: Tensor, target: Tensor, degrees: Tensor) -> tuple[Tensor, Tensor]:
    """Wavelet cross-covariance drawn towards a target, by as much as the data bear the target out.

    `(eta_j Gamma_j + nu T_j) / (eta_j + nu)`: the mean of the posterior when `Gamma_j` is Wishart with `eta_j` degrees
    of freedom and its expectation inverse Wishart around `T_j`, worth `nu` observations at every level. `nu` has the
    largest likelihood,

        sum_j ln G((n + eta_j)/2) - ln G(n/2) + n p ln(nu)/2 - (n + eta_j)/2 sum_i ln(nu + eta_j lambda_ij),

    `n = nu + p + 1`, `G` the multivariate gamma function, `lambda_ij` the eigenvalues of `T_j^-1 Gamma_j`. Levels that
    are well determined tell how far the target can be trusted where they are not.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        target: The same shape, positive definite. Levels that equal `wccv` are taken to tell nothing.
        degrees: `(..., level)`, degrees of freedom `eta_j`.

    Returns:
        The shrunk covariance, the same shape and dtype, and `nu` `(...)`.
    """
    n_sensors = wccv.shape[-1]
    gamma, centre, eta = wccv.detach().double(), target.detach().double(), degrees.double()
    known = (gamma.isfinite() & centre.isfinite()).all(-1).all(-1) & (centre.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    telling = known & (gamma != centre).any(-1).any(-1)
    identity = torch.eye(n_sensors, dtype=gamma.dtype, device=gamma.device)
    lower = torch.linalg.cholesky(torch.where(telling[..., None, None], centre, identity))
    half = torch.linalg.solve_triangular(lower, torch.where(telling[..., None, None], gamma, identity), upper=False)
    ratio = torch.linalg.solve_triangular(lower, half.mT, upper=False)
    eigenvalues = torch.linalg.eigvalsh(ratio).clamp(min=0)  # (..., level, sensor)

    nu = _WORTH.to(gamma.device)  # (worth,)
    n, many = nu + n_sensors + 1, nu + n_sensors + 1 + eta[..., None]  # (..., level, worth)
    gain = torch.special.multigammaln(many / 2, n_sensors) - torch.special.multigammaln(n / 2, n_sensors)
    spread = (nu[:, None] + (eta[..., None] * eigenvalues)[..., None, :]).log().sum(-1)
    likelihood = gain + (n * n_sensors * nu.log() - many * spread) / 2
    best = torch.where(telling[..., None], likelihood, 0.0).sum(-2).argmax(-1)
    worth = nu[best]
    share = (worth[..., None] / (worth[..., None] + eta)).to(wccv)[..., None, None]
    return torch.where(known[..., None, None], (1 - share) * wccv + share * target.to(wccv), wccv), worth


def _nonnegative_set(matrix: Tensor) -> Tensor:
    """Sensors in use `(..., sensor)` where `x >= 0`, `A x - 1 >= 0` and `x' (A x - 1) = 0`.

    From a feasible `x` go towards the minimum within the set in use: as far as the first sensor that reaches zero,
    which leaves the set, or all the way, and then let in the sensor that would gain most. The variance falls each turn.
    """
    n_sensors = matrix.shape[-1]
    # In units of each sensor all numbers are of order 1; signs and sets stay what they are.
    unit = matrix.diagonal(dim1=-2, dim2=-1).rsqrt()
    correlation = unit[..., :, None] * matrix * unit[..., None, :]
    sensor = torch.arange(n_sensors, device=matrix.device)
    used, x = torch.ones_like(unit, dtype=torch.bool), torch.zeros_like(unit) + unit.mean(-1, keepdim=True)
    for _ in range(_MOST_TURNS):
        aim = _solve_within(correlation, used, unit)
        share = torch.where(used & (aim <= 0), x / (x - aim).clamp(min=torch.finfo(x.dtype).tiny), torch.inf)
        step, leaving = share.min(-1, keepdim=True)
        blocked = step.isfinite()
        x = torch.where(used, x + step.clamp(max=1.0) * (aim - x), 0.0).clamp(min=0.0)
        excess = (correlation @ x[..., None])[..., 0] / unit - 1
        least, entering = torch.where(used, torch.inf, excess).min(-1, keepdim=True)
        done = ~blocked & (least >= -_TOLERANCE)
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
