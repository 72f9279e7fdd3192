"""The methods that weigh the sensors of an array: their names, their estimators, and what a report says of them."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from gyrofuse.fusion.weights.baselines import (
    equal_weights,
    inverse_variance_weights,
    nonnegative_weights,
    shrinkage_weights,
)
from gyrofuse.fusion.weights.model_assisted import assisted_covariance
from gyrofuse.fusion.weights.svo import optimal_weights
from gyrofuse.wavelets.intervals import equivalent_dof
from gyrofuse.wavelets.moments import combined_covariance

# Methods of `fit_svo`, each with the sentences that explain it in a report.
METHODS = {
    "auto": (
        "Model-assisted SVO, unless SVO with shrinkage or plain SVO does better on data held out by three standard "
        "errors, and plain SVO where the recording is too short to hold data out: the weights minimise the wavelet "
        "variance of the virtual gyro, summed over scales with the scale weights of the table."
    ),
    "svo": (
        "Scale-wise variance optimisation (SVO): the weights minimise the wavelet variance of the virtual gyro, "
        "summed over scales with the scale weights of the table (Zhang, Cucci, Molinari, Guerrier, IEEE Transactions "
        "on Signal Processing 70, 2022, equations 6 and 7). They sum to 1 and may be negative."
    ),
    "model_assisted": (
        "Model-assisted SVO: the weights minimise the wavelet variance of the virtual gyro, summed over scales with "
        "the scale weights of the table, where the last scales, of few observations, are those of a smooth noise "
        "model fitted to the others."
    ),
    "shrinkage": (
        "SVO with shrinkage: the weights minimise the wavelet variance of the virtual gyro, summed over scales with "
        "the scale weights of the table, where scales of few observations are drawn towards those beside them."
    ),
    "nonnegative": (
        "Nonnegative SVO: the weights minimise the wavelet variance of the virtual gyro, summed over scales with the "
        "scale weights of the table, and none is negative."
    ),
    "inverse_variance": (
        "Inverse variance: every sensor is weighted by the reciprocal of its wavelet variance, summed over scales "
        "with the scale weights of the table; correlation between sensors is ignored."
    ),
    "equal": ("Equal weights: the virtual gyro is the plain mean of the sensors."),
    "rdvg": (
        "Reduced-drift virtual gyro (Vaccaro and Zaki, Sensors 17, 2017): the weights minimise the random walk in a "
        "model of white noise and random walk. Nothing makes the estimated covariance of the random walks, Q, "
        "positive definite; where it is not, the weights follow the formula but minimise nothing."
    ),
}
# What a report says of the multi-scale virtual gyro.
MULTISCALE = (
    "Multi-scale virtual gyro: every sensor is split, causally and without delay, into bands of time scales that add "
    "up to it, and each band is fused with its own weights, which sum to 1 and may be negative. Together they "
    "minimise the wavelet variance of the virtual gyro relative to the least that one vector of weights for that "
    "level alone would leave, averaged with the scale weights of the table. The weights come without intervals, and "
    "so do the ratios: virtual gyro and plain mean are made of the same samples, so that their ratio is known better "
    "than the interval of either says, but weights flatter themselves in the recording that they were chosen from."
)
# What the intervals of `fit_svo` can rest on.
COVARIANCES = ("model", "block_bootstrap", "resampling", "none")

# Weights `(..., sensor)` from wavelet cross-covariance `(..., level, sensor, sensor)`, number of coefficients
# `(..., level)` and scale weights `(level,)`. Levels with a scale weight of 0 may help to estimate the others.
ESTIMATORS: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "model_assisted": lambda wccv, counts, omega: _optimal(assisted_covariance(wccv, counts), omega),
    "shrinkage": lambda wccv, counts, omega: shrinkage_weights(wccv, omega, equivalent_dof(counts)),
    "svo": lambda wccv, counts, omega: _optimal(wccv, omega),
    "nonnegative": lambda wccv, counts, omega: nonnegative_weights(wccv, omega),
    "inverse_variance": lambda wccv, counts, omega: inverse_variance_weights(wccv, omega),
    "equal": lambda wccv, counts, omega: equal_weights(wccv),
}


def _optimal(wccv: Tensor, omega: Tensor) -> Tensor:
    return optimal_weights(combined_covariance(wccv, omega))
