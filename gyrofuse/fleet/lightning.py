"""Fleets of logs under Lightning's `Trainer`: on one process or many, one machine or several.

Example:
    >>> task = Fuse("long")
    >>> store = ResultStore("results.parquet", task.columns, task.settings)
    >>> data = GyroArrayDataModule(["logs/"], done=store.done())
    >>> trainer = Trainer(devices=2, strategy="ddp", accelerator="cpu", callbacks=[ResultWriter(store)], logger=False)
    >>> trainer.predict(FusionModule(task), datamodule=data, return_predictions=False)
"""

from __future__ import annotations

import logging
import multiprocessing
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from datetime import timedelta
from functools import cached_property
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.callbacks import BasePredictionWriter, Callback
from lightning.pytorch.strategies import DDPStrategy
from torch.utils.data import DataLoader

from gyrofuse._base.checks import check_positive_integer
from gyrofuse.fleet.logs import find_logs, groups_of, identity
from gyrofuse.fleet.run import Log, LogGroups, rows_of
from gyrofuse.fleet.store.store import ResultStore
from gyrofuse.fleet.tasks import Fuse, Row, Task
from gyrofuse.fleet.watchdog import Suspect, Watchdog, close_all
from gyrofuse.fleet.workers import end_at_once, end_with_parent, start_method

# Timeout of processes that wait for each other: none in practice, as one may work on a long log for hours.
_PATIENCE = timedelta(days=365)


class GyroArrayDataModule(LightningDataModule):
    """Logs of arrays, read one after the other, in groups of any lengths and numbers of sensors, without padding.

    Args:
        paths: Files, folders and patterns, or one of them, as of `find_logs`.
        manifest: Text file with one name a line.
        group_size: Logs that a process takes at a time, and whose rows appear together. Short arrays of one shape
            are fitted together: more than one pays where logs are many and short.
        num_workers: Number of processes that read ahead.
        done: Identities of logs (`ResultStore.done`) that are left out, though the others stay in their groups.
        **options: Keyword arguments of `read_recording`, such as `axis`, `sensors`, `rate` and `unit`.

    Raises:
        FileNotFoundError: A name without files.
        ValueError: No log at all, a number below one, or a rate or scale that is not positive.
        TypeError: An option that `read_recording` does not have.
    """

    def __init__(
        self,
        paths: str | Path | Iterable[str | Path] = (),
        *,
        manifest: str | Path | None = None,
        group_size: int = 1,
        num_workers: int = 0,
        done: Collection[str] = (),
        **options: Any,
    ) -> None:
        super().__init__()
        self.logs = find_logs(paths, manifest=manifest)
        self.group_size = check_positive_integer("group_size", group_size)
        self.done = done
        self.suspects: Mapping[str, Suspect] = {}
        self.watch: Watchdog | None = None
        self.num_workers = num_workers
        self.options = LogGroups((), options).options  # wrong ones are refused here, and not in every row

    @cached_property
    def groups(self) -> tuple[tuple[Path, ...], ...]:
        """Groups of logs that are worked on together, without those that are done; fixed at the first use."""
        alone = [log for log, suspect in self.suspects.items() if suspect.alone]
        return groups_of(self.logs, self.group_size, self.done, last=self.suspects, alone=alone)

    def leave(self, done: Collection[str], suspects: Mapping[str, Suspect]) -> None:
        """Form the groups anew from the logs that are left.

        Args:
            done: Identities of logs that are left out.
            suspects: Logs at which a process crashed (`ResultStore.suspects`); they come last.
        """
        self.done, self.suspects = done, suspects
        self.__dict__.pop("groups", None)

    def predict_dataloader(self) -> DataLoader[tuple[Log, ...]]:
        """Groups of logs; Lightning distributes them over the processes, each once."""
        # Lightning's sampler wants one for each process at least; an empty group has no rows.
        idle = self.trainer.world_size - len(self.groups) if self.trainer and self.groups else 0
        groups = LogGroups([*self.groups, *[()] * idle], self.options, self.watch)
        # Of a batch of one group: samplers of distributed runs want batches.
        return DataLoader(groups, batch_size=1, collate_fn=_only, num_workers=self.num_workers)


class FusionModule(LightningModule):
    """One of the tasks of a fleet as a prediction: groups of logs in, rows of a table out.

    Args:
        task: `Fuse`, `Fit` or `Diagnose`; fusion by default.
    """

    def __init__(self, task: Task | None = None) -> None:
        super().__init__()
        self.task: Task = Fuse() if task is None else task

    def predict_step(self, batch: Sequence[Log], batch_idx: int = 0) -> list[Row]:
        """Rows of all logs of a group, those that failed included."""
        return rows_of(self.task, batch)


def _only(batch: Sequence[Any]) -> Any:
    (item,) = batch
    return item


class ResultWriter(BasePredictionWriter):
    """Writes rows to a table as they arrive; one process opens it, and completes it when all have finished.

    Args:
        store: Writer of the table, with the columns and settings of the module's task.
        force: Whether a table of other settings is replaced.
        timeout: Seconds that a log may take to be read, and again to be worked on; then its process ends, and on the
            next start the log gets a row that says so. None for no limit.

    Raises:
        ValueError: On setup, where the table is of another task, or of the same with other settings.
    """

    def __init__(self, store: ResultStore, *, force: bool = False, timeout: float | None = None) -> None:
        super().__init__(write_interval="batch")
        self.store = store
        self.force = force
        self.watch = Watchdog(store.parts, timeout)

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Open the table, before anyone writes."""
        super().setup(trainer, pl_module, stage)
        if isinstance(pl_module, FusionModule) and not self.store.holds(
            pl_module.task.columns, pl_module.task.settings
        ):
            raise ValueError(
                "`store`: expected the columns and settings of the module's task, got others; make it with "
                "ResultStore(path, task.columns, task.settings)"
            )
        if multiprocessing.parent_process() is not None:  # of whatever trainer
            end_with_parent(close_all)
        if trainer.is_global_zero:
            self.store.open(force=self.force)
        passed_over, suspects = trainer.strategy.broadcast((self.store.passed_over, self.store.suspects))
        data = getattr(trainer, "datamodule", None)
        if isinstance(data, GyroArrayDataModule):
            data.watch = self.watch
            if passed_over or suspects != data.suspects:
                data.leave({*data.done, *passed_over}, suspects)

    def on_predict_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, *_: Any) -> None:
        """Record which logs are worked on."""
        self.watch.begin([log.entry for log in batch])

    def write_on_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        prediction: Any,
        batch_indices: Sequence[int] | None,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int,
    ) -> None:
        """Add the rows of a group."""
        self.store.write(prediction)
        self.watch.end()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Remove the journal: an exception is no crash of a log."""
        self.watch.close()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Complete the table; here, since Lightning begins and ends no prediction where nothing is left to do."""
        self.watch.close()
        trainer.strategy.barrier("written")
        if trainer.is_global_zero:
            data = getattr(trainer, "datamodule", None)
            self.store.finish([identity(log) for log in data.logs] if isinstance(data, GyroArrayDataModule) else ())
        trainer.strategy.barrier("finished")


class _Worker(Callback):
    """Silences Lightning, and ends the processes that it starts together with their parent.

    The processes unpickle it before they begin.
    """

    def __init__(self) -> None:
        self.hushed = True  # something to pickle: without it, unpickling does nothing
        self._hush()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._hush()
        end_with_parent(close_all)

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Later than Lightning's own handlers of signals, which wait for the other processes."""
        end_at_once(close_all)

    @staticmethod
    def _hush() -> None:
        for name in ("lightning.pytorch", "lightning.fabric", "torch.multiprocessing.spawn"):
            logging.getLogger(name).setLevel(logging.ERROR)
        warnings.filterwarnings("ignore", module=r"lightning\.|torch\.")


def quiet_trainer(*, devices: int, accelerator: str = "cpu", callbacks: Sequence[Callback] = ()) -> Trainer:
    """A trainer for predictions alone, without messages and files.

    Args:
        devices: Number of processes, one for each device; more than one are forked from a process that computes
            nothing, or spawned where that is not possible.
        accelerator: `"cpu"`, `"gpu"` or `"auto"`.
        callbacks: Callbacks such as a `ResultWriter`.
    """
    return Trainer(
        devices=devices,
        accelerator=accelerator,
        strategy=DDPStrategy(start_method=start_method(accelerator), timeout=_PATIENCE) if devices > 1 else "auto",
        callbacks=[_Worker(), *callbacks],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
    )
