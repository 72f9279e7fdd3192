"""Noise models of whole arrays, with covariances between sensors."""
