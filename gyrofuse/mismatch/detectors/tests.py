"""All tests together."""

from __future__ import annotations

from collections.abc import Callable

from gyrofuse._base.results import readable
from gyrofuse.mismatch.detectors.lines.clocks import clock_test
from gyrofuse.mismatch.detectors.lines.interleaving import interleaving_test
from gyrofuse.mismatch.detectors.lines.ring_downs import ring_down_test
from gyrofuse.mismatch.detectors.moving.channel_tracks import moving_test
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.slow.channels import channel_test
from gyrofuse.mismatch.detectors.slow.hysteresis import hysteresis_test
from gyrofuse.mismatch.detectors.slow.line_gains import line_gain_test
from gyrofuse.mismatch.detectors.slow.scans import slow_test
from gyrofuse.mismatch.detectors.slow.simulated_course import simulated_course_test
from gyrofuse.mismatch.detectors.spectra.band_tests import coherence_test, line_test, spectrum_test
from gyrofuse.mismatch.detectors.spectra.peaks import peak_test
from gyrofuse.mismatch.detectors.spectra.pooled_coherence import common_source_test
from gyrofuse.mismatch.detectors.spectra.shape_scan import shape_test
from gyrofuse.mismatch.detectors.values.values import values_test
from gyrofuse.mismatch.detectors.variance.haar_kurtosis import jump_test
from gyrofuse.mismatch.detectors.variance.noise_level import variance_test
from gyrofuse.mismatch.detectors.variance.outliers import outliers_test
from gyrofuse.mismatch.detectors.variance.pulses import pulse_test
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.multiplicity import sidak

TESTS: tuple[Callable[[Comparison], TestResult], ...] = (
    values_test,
    outliers_test,
    channel_test,
    line_gain_test,
    line_test,
    interleaving_test,
    moving_test,
    clock_test,
    ring_down_test,
    pulse_test,
    jump_test,
    slow_test,
    simulated_course_test,
    hysteresis_test,
    variance_test,
    spectrum_test,
    shape_test,
    peak_test,
    coherence_test,
    common_source_test,
)


def run_tests(
    comparison: Comparison,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> tuple[TestResult, ...]:
    """Results of all tests, in their order.

    Args:
        comparison: Recording and simulation.
        progress: Function of the name of the next test, and of the share of tests that are done.
    """
    results = []
    for number, test in enumerate(TESTS):
        progress(readable(test.__name__), number / len(TESTS))
        results.append(test(comparison))
    return tuple(results)


def family_wise_p_value(results: tuple[TestResult, ...]) -> float:
    """p value of all tests together: the smallest, corrected for their number."""
    return sidak(min(result.p_value for result in results), len(results))
