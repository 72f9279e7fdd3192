"""A course of the bias that only the simulation has, looked for as in a recording."""

from __future__ import annotations

from dataclasses import replace

from gyrofuse.mismatch.detectors.exchanged import exchanged
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.slow.scans import steady_course_test
from gyrofuse.mismatch.signals.comparison import Comparison


def may_have_a_course(comparison: Comparison) -> bool:
    """Whether the simulation may: a fitted model has none, and of several records each would have one of its own."""
    return len(comparison.reference.signal) == 1 and comparison.reference.uncertainty is None


def simulated_course_test(comparison: Comparison) -> TestResult:
    """A step, a drift or a warm-up of the simulation that the recording is without."""
    name = "simulated course"
    if not may_have_a_course(comparison):
        return TestResult(name, 1.0, "the simulation is no single record that could have a course of its own")
    found = steady_course_test(exchanged(comparison))
    return replace(found, test=name, words=f"in the simulation alone {found.words}", time_s=None)
