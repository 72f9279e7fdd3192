"""Whittle's likelihood of the spectrum, and spectral lines."""
