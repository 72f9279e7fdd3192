"""Whether power differs from the simulation's by more than it does by itself."""

from __future__ import annotations

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.normality import gaussian_sensors
from gyrofuse.mismatch.shape_scan import shape_witness
from gyrofuse.mismatch.witnesses import spectrum_witness


def power_differs(case: Case, level: float) -> bool:
    """Whether a test of spectra says so where noise is not Gaussian of a steady level; True where it is.

    Likelihoods of spectra take ordinates for independent, and with levels that vary by themselves gain any number of
    nats from what is chance.

    Args:
        case: Recording and simulation.
        level: p value of one witness that would be a mismatch.
    """
    if bool(gaussian_sensors(case.simulated).all()):
        return True
    return min(spectrum_witness(case).p_value, shape_witness(case).p_value) <= level
