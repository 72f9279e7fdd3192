"""Noise models fitted to recordings: by wavelet moments, by spectra, and which of several fits."""
