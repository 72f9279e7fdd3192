"""Many logs at once: which they are, what is asked of each, and the table of answers."""

from gyrofuse.fleet.logs import find_logs
from gyrofuse.fleet.store.store import ResultStore
from gyrofuse.fleet.store.table import Column, read_results
from gyrofuse.fleet.tasks import Diagnose, Fit, Fuse

__all__ = ["Column", "Diagnose", "Fit", "Fuse", "ResultStore", "find_logs", "read_results"]
