"""Where a recording and a simulation differ, which physics was left out, and the simulation with it."""

from gyrofuse.mismatch.diagnose import diagnose
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.reporting.discrepancy import discrepancy
from gyrofuse.mismatch.reporting.report import MismatchReport
from gyrofuse.mismatch.several.board import diagnose_board
from gyrofuse.mismatch.several.board_report import BoardReport
from gyrofuse.mismatch.several.sessions import diagnose_sessions
from gyrofuse.mismatch.several.sessions_report import SessionsReport

__all__ = [
    "BoardReport",
    "Finding",
    "MismatchReport",
    "SessionsReport",
    "diagnose",
    "diagnose_board",
    "diagnose_sessions",
    "discrepancy",
]
