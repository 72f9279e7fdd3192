"""Whether power differs from the simulation's by more than it does by itself."""

from __future__ import annotations

from gyrofuse.mismatch.detectors.spectra.band_tests import spectrum_test
from gyrofuse.mismatch.detectors.spectra.shape_scan import shape_test
from gyrofuse.mismatch.detectors.variance.normality import gaussian_sensors
from gyrofuse.mismatch.signals.comparison import Comparison


def power_differs(comparison: Comparison, level: float) -> bool:
    """Whether a test of spectra says so where noise is not Gaussian of a steady level; True where it is.

    Likelihoods of spectra take ordinates for independent, and with levels that vary by themselves gain any number of
    nats from what is chance.

    Args:
        comparison: Recording and simulation.
        level: p value of one test that would be a mismatch.
    """
    if bool(gaussian_sensors(comparison.reference).all()):
        return True
    return min(spectrum_test(comparison).p_value, shape_test(comparison).p_value) <= level
