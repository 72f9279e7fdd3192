"""Start and end of the processes of a fleet: forked from one that has imported what they need and computed nothing.

Spawned processes import torch and Lightning again, each for itself, which takes seconds; a process that has computed
may hold threads or a GPU, which its forks do not get.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Literal

OUTSIDE = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


def start_method(accelerator: str) -> Literal["forkserver", "spawn"]:
    """Start method of processes that compute on an accelerator (`"cpu"`, `"gpu"` or `"auto"`)."""
    # Forks of a process that has loaded the frameworks of macOS may crash.
    forks = sys.platform == "linux" and accelerator == "cpu"
    return "forkserver" if forks else "spawn"


def begin_imports(accelerator: str) -> None:
    """Start the process that the others are forked from, whose imports run beside this process."""
    if start_method(accelerator) == "forkserver":
        from multiprocessing import forkserver

        # Forks import the main module, the command line; the second module freezes what both have imported.
        multiprocessing.set_forkserver_preload(["gyrofuse.cli", "gyrofuse.fleet.preload"])
        forkserver.ensure_running()


def end_with_parent(leave: Callable[[], None], poll: float = 0.1, patience: float = 60.0) -> None:
    """End this process when its parent ends, at once and whatever it waits for or works on.

    Nothing happens in a process that Python's multiprocessing did not start.

    Args:
        leave: Function that is called before.
        poll: Time between two checks whether this process knows its parent, s: it does not while it is being made.
        patience: Time after which it counts as a process without a parent, s; to be made takes seconds at most.
    """

    def watch() -> None:
        for _ in range(round(patience / poll)):
            parent = multiprocessing.parent_process()
            if parent is not None:
                parent.join()
                leave()
                os._exit(1)
            time.sleep(poll)

    threading.Thread(target=watch, daemon=True).start()


def end_at_once(leave: Callable[[], None]) -> None:
    """End a process that another one started at once on a signal to end, and not when its work is done.

    Args:
        leave: Function that is called before.
    """
    if multiprocessing.parent_process() is None or threading.current_thread() is not threading.main_thread():
        return

    def end(number: int, _: object) -> None:
        leave()
        os._exit(128 + number)

    for number in OUTSIDE:
        if signal.getsignal(number) != signal.SIG_IGN:  # as nohup asks
            signal.signal(number, end)


def ended_from_outside(status: int | None) -> bool:
    """Whether a process with this exit status ended on a signal from outside, or without an error."""
    return status is None or status == 0 or any(status in (-number, 128 + number) for number in OUTSIDE)
