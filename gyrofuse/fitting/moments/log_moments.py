"""Logarithms of wavelet variances as moments, more nearly normal than the variances at few degrees of freedom.

With `eta = 2 nu^2 / V_jj` degrees of freedom `ln nu^` has mean `ln nu + digamma(eta / 2) - ln(eta / 2)` and variance
`trigamma(eta / 2)`; correlations are those of `V`.
"""

from __future__ import annotations

from torch import Tensor


def log_residual(variance: Tensor, expected: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals of the logarithms, less their bias, and their covariance, both in units of the variances themselves.

    Multiplied by `nu(theta)`, they have the derivatives `-d nu / d theta` of the plain residuals `nu^ - nu(theta)`.

    Args:
        variance: Measured, `(..., level)`.
        expected: `nu(theta)`, the same.
        covariance: `V(theta)`, `(..., level, level)`.
    """
    spread = covariance.diagonal(dim1=-2, dim2=-1)
    half = expected.square() / spread  # eta / 2
    residual = (variance / expected).log() - half.digamma() + half.log()
    sd = expected * half.polygamma(1).sqrt() / spread.sqrt()
    return expected * residual, sd[..., :, None] * covariance * sd[..., None, :]
