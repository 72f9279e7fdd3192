"""Haar wavelets of arrays: coefficients, variances, cross-covariances, and how far these may be off."""
