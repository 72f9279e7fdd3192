"""Where a recording and a simulation differ, which physics was left out, and the simulation with it."""

from gyrofuse.mismatch.diagnose import diagnose
from gyrofuse.mismatch.diagnose_board import diagnose_board
from gyrofuse.mismatch.diagnose_sessions import diagnose_sessions
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.reporting.board_report import BoardReport
from gyrofuse.mismatch.reporting.discrepancy import discrepancy
from gyrofuse.mismatch.reporting.report import MismatchReport
from gyrofuse.mismatch.reporting.sessions_report import SessionsReport

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
