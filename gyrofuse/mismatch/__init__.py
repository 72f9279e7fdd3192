"""Where a recording and a simulation differ, which physics was left out, and the simulation with it."""

from gyrofuse.mismatch.agreement import discrepancy
from gyrofuse.mismatch.engine import diagnose
from gyrofuse.mismatch.mechanism import Finding
from gyrofuse.mismatch.report import MismatchReport

__all__ = ["Finding", "MismatchReport", "diagnose", "discrepancy"]
