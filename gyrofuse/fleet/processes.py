"""A fleet on processes of its own: a log that crashes or hangs one is passed over, and the run goes on."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING

from torch.multiprocessing import ProcessExitedException, ProcessRaisedException, start_processes

from gyrofuse._base.deprecation import renamed_arguments
from gyrofuse.fleet.lightning import FusionModule, GyroArrayDataModule, ResultWriter, quiet_trainer
from gyrofuse.fleet.logs import identity
from gyrofuse.fleet.store.store import ResultStore
from gyrofuse.fleet.tasks import Task
from gyrofuse.fleet.watchdog import close_all
from gyrofuse.fleet.workers import begin_imports, end_with_parent, ended_from_outside, start_method

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

_AT_ONCE = getattr(signal, "SIGKILL", signal.SIGTERM)
_PORT = "MASTER_PORT"  # environment variable of the port of Lightning's processes, which each start chooses anew


@renamed_arguments(said="report")
def run_fleet(
    task: Task,
    data: GyroArrayDataModule,
    store: ResultStore,
    *,
    devices: int = 1,
    accelerator: str = "cpu",
    timeout: float | None = None,
    retry: bool = False,
    report: Callable[[str], None],
) -> None:
    """Work on all logs that are not done, and complete the table.

    Reading and computing are done in other processes, even if there is but one: a log that crashes its process is tried
    once more after all others, and then gets a row that says so.

    Args:
        task: Task for every log.
        data: The logs.
        store: Writer of the table, opened.
        devices: Number of processes.
        accelerator: Accelerator, as of `quiet_trainer`.
        timeout: Seconds that a log may take to be read, and again to be worked on; None for no limit.
        retry: Whether logs that failed before are tried again.
        report: Callback that gets a sentence on each log at which a process crashed.

    Raises:
        OSError: Rows or the table cannot be written, or a process ended while it worked on no log; finished rows are
            kept.
        RuntimeError: Exception of a process that is no error of the system.
    """
    begin_imports(accelerator)
    since = store.opened if retry else 0
    data.leave(store.done(since=since), store.suspects)
    while data.groups:
        processes: list[BaseProcess] = []
        try:
            _predict(task, data, ResultWriter(store, timeout=timeout), devices, accelerator, processes)
        except (ProcessExitedException, ProcessRaisedException) as error:
            found = store.settle(_to_blame(error, processes))
            if not found:
                raise _plain(error) from None
            for crash in found:
                report(f"{crash.entry['log']}: {crash.words}")
        except (SystemExit, KeyboardInterrupt) as stop:  # from outside: the others would work on
            for process in processes:
                if process.is_alive() and process.pid is not None:
                    os.kill(process.pid, _AT_ONCE)  # Lightning lets processes finish on SIGTERM
                process.join()
            store.forget()
            if isinstance(stop.__context__, KeyboardInterrupt):  # of which Lightning makes an exit
                raise KeyboardInterrupt from None
            raise
        else:
            if store.n_parts:  # a library may end its process as if all were well
                raise OSError(f"{store.path}: its processes ended before it was complete; start again to go on")
            return
        data.leave(store.done(since=since), store.suspects)
    store.finish([identity(log) for log in data.logs])


def _predict(
    task: Task,
    data: GyroArrayDataModule,
    writer: ResultWriter,
    devices: int,
    accelerator: str,
    processes: list[BaseProcess],
) -> None:
    """Run the processes once; the list `processes` is filled with them."""
    if devices == 1:
        given = (task, data, writer, accelerator)
        context = start_processes(_work_alone, given, 1, join=False, start_method=start_method(accelerator))
        processes += context.processes
        while not context.join():
            pass
        return
    port = os.environ.get(_PORT)
    trainer = quiet_trainer(devices=devices, accelerator=accelerator, callbacks=[writer])
    try:
        trainer.predict(FusionModule(task), datamodule=data, return_predictions=False)
    finally:
        processes += getattr(trainer.strategy.launcher, "procs", [])
        if port is None:
            os.environ.pop(_PORT, None)


def _work_alone(_: int, task: Task, data: GyroArrayDataModule, writer: ResultWriter, accelerator: str) -> None:
    """Work of a single process, without a connection to others."""
    end_with_parent(close_all)
    trainer = quiet_trainer(devices=1, accelerator=accelerator, callbacks=[writer])
    trainer.predict(FusionModule(task), datamodule=data, return_predictions=False)


def _to_blame(error: ProcessExitedException | ProcessRaisedException, processes: list[BaseProcess]) -> list[int]:
    """Processes that crashed; the others are ended when one crashes."""
    if isinstance(error, ProcessExitedException):
        return [] if ended_from_outside(error.exit_code) else [error.error_pid]
    # An exception may be the consequence of the crash of another process.
    raised = error.error_pid
    return [p.pid for p in processes if p.pid not in (None, raised) and not ended_from_outside(p.exitcode)]


def _plain(error: ProcessExitedException | ProcessRaisedException) -> Exception:
    if isinstance(error, ProcessExitedException):
        return OSError(f"a process ended early ({error}); what is finished is kept, start again to go on")
    kind, _, words = str(error).strip().rpartition("\n")[2].partition(": ")  # its last line is what was raised
    return (OSError if kind.endswith("Error") else RuntimeError)(words or kind)
