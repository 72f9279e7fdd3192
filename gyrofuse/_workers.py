"""How the processes of a fleet are started: forked from one that has imported what they need and has computed nothing.

Spawned processes import torch and Lightning again, each for itself, which takes seconds; a process that has computed
may hold threads or a GPU, which its forks do not get.
"""

from __future__ import annotations

import multiprocessing
import sys
from typing import Literal


def start_method(accelerator: str) -> Literal["forkserver", "spawn"]:
    """Way to start processes that compute there."""
    # Forks of a process that has loaded the frameworks of macOS may crash.
    forks = sys.platform == "linux" and accelerator == "cpu"
    return "forkserver" if forks else "spawn"


def begin_imports(accelerator: str) -> None:
    """Have the process that is forked import what is needed, while this one goes on."""
    if start_method(accelerator) == "forkserver":
        from multiprocessing import forkserver

        multiprocessing.set_forkserver_preload(["gyrofuse._preload"])
        forkserver.ensure_running()


def parent_lives() -> bool:
    """Whether whoever started this process still runs; True in one that nobody of Python's started."""
    parent = multiprocessing.parent_process()
    return parent is None or parent.is_alive()
