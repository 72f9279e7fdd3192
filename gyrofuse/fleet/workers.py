"""How the processes of a fleet are started: forked from one that has imported what they need and has computed nothing.

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
_LOOK = 0.1  # s between looks whether a process that is being made knows its parent
_FEWEST_LOOKS = 600  # of them, a minute: what is no child by then is none


def start_method(accelerator: str) -> Literal["forkserver", "spawn"]:
    """Way to start processes that compute there."""
    # Forks of a process that has loaded the frameworks of macOS may crash.
    forks = sys.platform == "linux" and accelerator == "cpu"
    return "forkserver" if forks else "spawn"


def begin_imports(accelerator: str) -> None:
    """Have the process that is forked import what is needed, while this one goes on."""
    if start_method(accelerator) == "forkserver":
        from multiprocessing import forkserver

        # Forks import the main module, the command line; the second module freezes what both have imported.
        multiprocessing.set_forkserver_preload(["gyrofuse.cli", "gyrofuse.fleet.preload"])
        forkserver.ensure_running()


def end_with_parent(leave: Callable[[], None]) -> None:
    """Have this process end when whoever started it is gone, whatever it waits for or works on then.

    Nothing happens in a process that nobody of Python's started.

    Args:
        leave: What is done before.
    """

    def watch() -> None:
        for _ in range(_FEWEST_LOOKS):  # called while a process is being made, its parent is not yet known
            parent = multiprocessing.parent_process()
            if parent is not None:
                parent.join()
                leave()
                os._exit(1)
            time.sleep(_LOOK)

    threading.Thread(target=watch, daemon=True).start()


def end_at_once(leave: Callable[[], None]) -> None:
    """Have a process that another one started end at once where it is asked to, and not when its work is done.

    Args:
        leave: What is done before.
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
    """Whether an exit status is that of a process that was asked to end, or that of one that ended well."""
    return status is None or status == 0 or any(status in (-number, 128 + number) for number in OUTSIDE)
