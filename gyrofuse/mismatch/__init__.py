"""Where a recording and a simulation differ, which physics was left out, and the simulation with it."""

from gyrofuse.mismatch.diagnose import diagnose
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.reporting.discrepancy import discrepancy
from gyrofuse.mismatch.reporting.report import MismatchReport

__all__ = ["Finding", "MismatchReport", "diagnose", "discrepancy"]
