"""Tests of spectral lines: their amplitudes, chirps, clocks."""
