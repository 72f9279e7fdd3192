"""All witnesses together."""

from __future__ import annotations

from collections.abc import Callable

from gyrofuse.mismatch.detectors.lines.chirps import chirp_test
from gyrofuse.mismatch.detectors.lines.clocks import clock_test
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.slow.channels import channel_test
from gyrofuse.mismatch.detectors.slow.hysteresis import hysteresis_test
from gyrofuse.mismatch.detectors.slow.scans import slow_test
from gyrofuse.mismatch.detectors.spectra.band_tests import coherence_test, line_test, spectrum_test
from gyrofuse.mismatch.detectors.spectra.peaks import peak_test
from gyrofuse.mismatch.detectors.spectra.pooled_coherence import common_source_test
from gyrofuse.mismatch.detectors.spectra.shape_scan import shape_test
from gyrofuse.mismatch.detectors.values.values import values_test
from gyrofuse.mismatch.detectors.variance.noise_level import variance_test
from gyrofuse.mismatch.detectors.variance.outliers import jump_test, outliers_test
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.multiplicity import sidak

TESTS: tuple[Callable[[Comparison], TestResult], ...] = (
    values_test,
    outliers_test,
    channel_test,
    line_test,
    chirp_test,
    clock_test,
    jump_test,
    slow_test,
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
    """What every witness says; `progress` is told which is asked next, and the share of them that were."""
    evidence = []
    for number, witness in enumerate(TESTS):
        progress(witness.__name__.replace("_", " "), number / len(TESTS))
        evidence.append(witness(comparison))
    return tuple(evidence)


def family_wise_p_value(evidence: tuple[TestResult, ...]) -> float:
    """p value of all witnesses together: that of the most extreme, for having asked so many."""
    return sidak(min(e.p_value for e in evidence), len(evidence))
