"""Haar wavelets of arrays: coefficients, variances, cross-covariances, and how far these may be off."""

from gyrofuse.wavelets.covariance import cross_covariance

__all__ = ["cross_covariance"]
