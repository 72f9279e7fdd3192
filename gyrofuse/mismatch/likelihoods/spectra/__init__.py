"""Likelihood of spectra: data, noise of the reference, components, their fit and their choice."""
