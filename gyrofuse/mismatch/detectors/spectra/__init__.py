"""Tests of spectra and coherences."""
