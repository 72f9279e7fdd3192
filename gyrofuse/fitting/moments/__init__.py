"""The Generalised Method of Wavelet Moments."""
