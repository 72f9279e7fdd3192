"""How far estimated wavelet moments can be off.

Until a model of the noise says more, a level with `M_j` coefficients of filter length `tau_j` is taken to hold

    eta_j = max(k_j M_j / tau_j, 1),   k_1 = 4/3,   k_j = 280/151 = 1.85 for j >= 2

independent observations: at level 1 what white noise has, which is less there than a random walk has; above, what a
random walk has for large tau, the slowest of the usual gyro errors. That is on the safe side for faster ones (white
noise comes to 3 M_j / tau_j, so that its intervals come out a quarter wider than they need be).

Neighbouring levels correlate by 0.53 where the wavelet variance falls like white noise and by 0.89 where it rises like
a random walk; between the two the correlation follows the slope found, and over several levels it multiplies.

Coefficients are taken to be Gaussian: heavier tails need wider intervals than these. Levels that hold about one
observation cannot tell how far off they are: where such levels decide, weights are less certain than they seem.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse._result import ConfidenceInterval

_WHITE_NOISE_DEGREES_AT_LEVEL_1 = 4 / 3
_RANDOM_WALK_DEGREES = 280 / 151
_WHITE_NOISE_CORRELATION = 0.53
_RANDOM_WALK_CORRELATION = 0.887


def degrees_of_freedom(counts: Tensor) -> Tensor:
    """Equivalent degrees of freedom of wavelet variances.

    Args:
        counts: `(..., level)`, number of coefficients `M_j` of each level.

    Returns:
        `(..., level)`, at least 1.
    """
    levels = torch.arange(1, counts.shape[-1] + 1, dtype=torch.float64, device=counts.device)
    factor = torch.where(levels == 1, _WHITE_NOISE_DEGREES_AT_LEVEL_1, _RANDOM_WALK_DEGREES)
    return (factor * counts * torch.exp2(-levels)).clamp(min=1.0)


def chi_square_interval(variance: Tensor, degrees: Tensor, confidence_level: float = 0.95) -> ConfidenceInterval:
    """Interval of a wavelet variance whose estimate follows a scaled chi-square law.

    `[eta nu / q_{1 - a/2}, eta nu / q_{a/2}]` with the quantiles `q` of chi-square with `eta` degrees of freedom.

    Args:
        variance: Estimates, any shape.
        degrees: Equivalent degrees of freedom, broadcastable to `variance`.
        confidence_level: Probability that the interval holds the true value.

    Returns:
        Limits of the shape of `variance`.
    """
    from scipy import stats

    eta = degrees.detach().cpu().numpy()
    tail = (1 - confidence_level) / 2
    low, high = (torch.as_tensor(stats.chi2.ppf(q, eta)).to(variance) for q in (1 - tail, tail))
    scaled = degrees.to(variance) * variance
    return ConfidenceInterval(scaled / low, scaled / high)


def weights_interval(
    weights: Tensor, covariance: Tensor, degrees: Tensor, confidence_level: float = 0.95
) -> ConfidenceInterval:
    """Interval of each weight, by Student's t.

    Args:
        weights: `(..., sensor)`.
        covariance: `(..., sensor, sensor)` of the estimated weights themselves.
        degrees: `(..., sensor)`, degrees of freedom of each variance; infinite for a normal law.
        confidence_level: Probability that the interval holds the true value.

    Returns:
        Limits `(..., sensor)`.
    """
    from scipy import stats

    quantile = stats.t.ppf((1 + confidence_level) / 2, degrees.detach().cpu().numpy())
    half = torch.as_tensor(quantile).to(weights) * covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    return ConfidenceInterval(weights - half, weights + half)


def svo_weights_covariance(
    wccv: Tensor, scale_weights: Tensor, weights: Tensor, degrees: Tensor
) -> tuple[Tensor, Tensor]:
    """Covariance of estimated SVO weights for Gaussian coefficients, by the delta method.

    `dc = -B dA c` with `B = (I - c 1') A^-1`, and for `eta_j` Gaussian observations
    `Cov(B dGamma_j c) = (B Gamma_j B' (c' Gamma_j c) + B Gamma_j c c' Gamma_j B') / eta_j`. As in a regression, the
    weights fit the residual `c' A c` to the `n_i = B_ii c' A c / V_ii` observations that weight `i` rests on, of which
    `n_i - p + 1` are left to tell its size; the covariance is made larger by what the fewest `n_i` ask for.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        scale_weights: `(level,)`.
        weights: `(..., sensor)`, the SVO weights of these.
        degrees: `(..., level)`, equivalent degrees of freedom.

    Returns:
        `(..., sensor, sensor)`, covariance of the weights themselves (already divided by the sample size), and its
        degrees of freedom `(..., sensor)`, at least 1.

    References:
        [Z] Theorem 2, with a Gaussian model in place of its resampled V.
    """
    combined = torch.einsum("j,...jik->...ik", scale_weights, wccv)
    inverse = torch.linalg.inv(combined)
    influence = inverse - weights[..., :, None] * inverse.sum(-2, keepdim=True)  # B: (..., sensor, sensor)
    fused = torch.einsum("...jik,...k->...ji", wccv, weights)  # Gamma_j c: (..., level, sensor)
    variance = torch.einsum("...i,...ji->...j", weights, fused).clamp(min=0)  # c' Gamma_j c
    factor = torch.cat(
        [variance.sqrt()[..., None, None] * _square_root(wccv), fused[..., None]], dim=-1
    )  # (..., level, sensor, sensor + 1)
    correlation = _level_correlation(wccv)
    covariance = _sum_over_levels(influence[..., None, :, :] @ factor, scale_weights, degrees, correlation)
    residual = torch.einsum("...i,...ik,...k->...", weights, combined, weights)
    observations = influence.diagonal(dim1=-2, dim2=-1) * residual[..., None] / covariance.diagonal(dim1=-2, dim2=-1)
    left = (observations - weights.shape[-1] + 1).clamp(min=1)
    inflation = (observations / left).clamp(min=1).amax(-1)
    return inflation[..., None, None] * covariance, left


def inverse_variance_weights_covariance(
    wccv: Tensor, scale_weights: Tensor, weights: Tensor, degrees: Tensor
) -> Tensor:
    """Covariance of estimated inverse-variance weights for Gaussian coefficients, by the delta method.

    `dc_i = -c_i (dA_ii / A_ii - sum_k c_k dA_kk / A_kk)` and `Cov(gamma_ii,j, gamma_kk,j) = 2 gamma_ik,j^2 / eta_j`.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        scale_weights: `(level,)`.
        weights: `(..., sensor)`, the inverse-variance weights of these.
        degrees: `(..., level)`, equivalent degrees of freedom.

    Returns:
        `(..., sensor, sensor)`.
    """
    # In units of A_ii, so that the squares of small variances stay within the range of the floats.
    unit = torch.einsum("j,...jii->...i", scale_weights, wccv).rsqrt()
    relative = unit[..., None, :, None] * wccv * unit[..., None, None, :]
    influence = weights[..., :, None] * weights[..., None, :] - torch.diag_embed(weights)
    factor = influence[..., None, :, :] @ _square_root(2 * relative.square())
    return _sum_over_levels(factor, scale_weights, degrees, _level_correlation(wccv))


def _level_correlation(wccv: Tensor) -> Tensor:
    """Correlation `(..., level, level)` of wavelet variances between levels, from the slope of the sensors' mean."""
    variance = wccv.diagonal(dim1=-2, dim2=-1).log2().mean(-1)
    # A level without a variance has no slope: the larger correlation is the safe one.
    slope = variance.diff(dim=-1).nan_to_num(nan=1.0).clamp(-1, 1)
    share = (slope + 1) / 2
    neighbour = _WHITE_NOISE_CORRELATION + (_RANDOM_WALK_CORRELATION - _WHITE_NOISE_CORRELATION) * share
    distance = torch.nn.functional.pad(neighbour.log().cumsum(-1), (1, 0))
    return torch.exp(-(distance[..., :, None] - distance[..., None, :]).abs())


def _sum_over_levels(factor: Tensor, scale_weights: Tensor, degrees: Tensor, correlation: Tensor) -> Tensor:
    """`sum_jk r_jk w_j w_k F_j F_k' / sqrt(eta_j eta_k)` for factors `(..., level, sensor, column)`."""
    scaled = factor * (scale_weights / degrees.sqrt())[..., None, None]
    return torch.einsum("...jk,...jin,...kmn->...im", correlation, scaled, scaled)


def _square_root(matrix: Tensor) -> Tensor:
    """Symmetric square root of positive semi-definite matrices."""
    values, vectors = torch.linalg.eigh(matrix)
    return (vectors * values.clamp(min=0).sqrt()[..., None, :]) @ vectors.mT
