"""Logs that end the process that reads them, or never let it go: they are known, and the others are done."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

import gyrofuse as gf
from gyrofuse.fleet import Fuse, ResultStore, read_results
from gyrofuse.fleet.lightning import FusionModule, GyroArrayDataModule, ResultWriter, quiet_trainer
from gyrofuse.fleet.logs import groups_of, identity, state_of
from gyrofuse.fleet.processes import run_fleet
from gyrofuse.fleet.watchdog import Suspect, Watchdog, close_all, settle, suspects_in
from gyrofuse.fleet.workers import end_with_parent

pytest.importorskip("pyarrow")
forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")

DEADLY, ENDLESS = 1001, 1002  # samples


def entry(log: str, size: int = 1):
    return {"log": log, "path": f"/{log}", "size": size, "modified": 2}


def ended_at(folder: Path, *logs, pid: int | None = None) -> None:
    """What a process leaves behind that ended at some logs."""
    watch, before = Watchdog(folder), set(folder.iterdir())
    watch.begin(logs)
    (note,) = {*folder.iterdir()} - before
    content = note.read_bytes()
    watch.close()
    note.write_bytes(content if pid is None else content.replace(str(os.getpid()).encode(), str(pid).encode()))


def test_a_note_is_there_while_a_log_is_worked_on(tmp_path):
    watch = Watchdog(tmp_path)
    watch.begin([entry("a")])
    (note,) = tmp_path.iterdir()
    assert b'"/a"' in note.read_bytes()
    watch.begin([entry("b"), entry("c")])
    assert b'"/a"' not in note.read_bytes()
    watch.end()
    assert note.read_bytes() == b""
    watch.begin([entry("d")])
    close_all()
    assert not list(tmp_path.iterdir())


def test_a_log_found_twice_is_passed_over(tmp_path):
    ended_at(tmp_path, entry("a"))
    (found,) = settle(tmp_path)
    assert (found.final, found.words) == (False, "ended the process that read it; tried again after the others")
    assert suspects_in(tmp_path) == {"/a": Suspect(1, 2, 1, alone=False)}
    assert settle(tmp_path) == []
    ended_at(tmp_path, entry("a"))
    (found,) = settle(tmp_path)
    assert found.final
    assert found.words.startswith("ended the process that read it, twice;")
    assert suspects_in(tmp_path) == {}
    ended_at(tmp_path, entry("b"))
    settle(tmp_path)
    ended_at(tmp_path, entry("b", size=9))  # another log by now
    assert not settle(tmp_path)[0].final


def test_processes_that_were_ended_are_not_to_blame(tmp_path):
    ended_at(tmp_path, entry("a"), pid=1)
    ended_at(tmp_path, entry("b"), pid=2)
    assert settle(tmp_path, [7]) == []
    assert (list(tmp_path.glob("*.begun")), suspects_in(tmp_path)) == ([], {})
    ended_at(tmp_path, entry("a"), pid=1)
    assert [found.entry["log"] for found in settle(tmp_path, [1])] == ["a"]


def test_of_a_group_each_is_tried_alone(tmp_path):
    ended_at(tmp_path, entry("a"), entry("b"))
    settle(tmp_path)  # from outside, perhaps: they stay together
    assert not any(suspect.alone for suspect in suspects_in(tmp_path).values())
    ended_at(tmp_path, entry("a"), entry("b"))
    assert not any(found.final for found in settle(tmp_path))
    assert suspects_in(tmp_path) == {f"/{log}": Suspect(1, 2, 0, alone=True) for log in "ab"}
    for final in (False, True):
        ended_at(tmp_path, entry("b"))
        assert settle(tmp_path)[0].final == final
    assert suspects_in(tmp_path) == {"/a": Suspect(1, 2, 0, alone=True)}
    ended_at(tmp_path, entry("c"), entry("d"), pid=1)
    settle(tmp_path, [1])
    assert suspects_in(tmp_path)["/c"].alone


def test_damaged_notes_give_logs_their_chances_anew(tmp_path):
    (tmp_path / "x.begun").write_bytes(b"\x00\x01")
    (tmp_path / "suspects").write_bytes(bytes(40))
    assert settle(tmp_path) == []
    assert suspects_in(tmp_path) == {}


def test_suspects_come_last(tmp_path):
    logs = [tmp_path / name for name in "abcdef"]
    for i, log in enumerate(logs):
        log.write_bytes(bytes(10 - i))
    named = [identity(log) for log in logs]
    assert groups_of(logs, 2, last=[named[0]]) == (tuple(logs[2:4]), tuple(logs[4:6]), tuple(logs[0:2]))
    alone = groups_of(logs, 2, last=[named[0]], alone=[named[0]])
    assert alone == (tuple(logs[2:4]), tuple(logs[4:6]), (logs[1],), (logs[0],))


def forever(folder: Path) -> None:
    Watchdog(folder, timeout=0.1).begin([entry("a")])
    re.match(r"(a+)+$", "a" * 64 + "b")  # of C, and lets no other thread run


@forks
def test_a_log_that_takes_too_long_ends_its_process(tmp_path):
    process = multiprocessing.get_context("fork").Process(target=forever, args=(tmp_path,))
    process.start()
    process.join(60)
    assert process.exitcode == 1
    (found,) = settle(tmp_path)
    assert found.final
    assert found.words.startswith("took longer than 0.1 s; --timeout (`timeout`) gives more")


def orphan(alive) -> None:
    end_with_parent(lambda: None)
    alive.send("begun")
    time.sleep(600)


def parent(alive) -> None:
    multiprocessing.get_context("fork").Process(target=orphan, args=(alive,)).start()
    alive.close()
    time.sleep(600)


@forks
def test_a_process_whose_parent_is_gone_ends_while_it_waits():
    here, there = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=parent, args=(there,))
    process.start()
    there.close()
    assert here.recv() == "begun"
    process.kill()
    assert here.poll(60)
    with pytest.raises(EOFError):  # nobody has the other end any more
        here.recv()


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    folder.mkdir()
    generator = torch.Generator().manual_seed(0)
    lengths = {"0": 1000, "1": 1000, "2": 1000, "deadly": DEADLY, "endless": ENDLESS}
    for name, n_samples in lengths.items():
        noise = torch.randn(3, n_samples, generator=generator, dtype=torch.float64)
        gf.Recording(noise, rate=100.0, unit="deg/s").save(folder / f"{name}.npz")
    return folder


@dataclass(frozen=True)
class Perilous(Fuse):
    """A task whose library fails in C."""

    def rows(self, recordings):
        for recording in recordings:
            if recording.n_samples == DEADLY:
                os.kill(os.getpid(), signal.SIGSEGV)
            if recording.n_samples == ENDLESS:
                re.match(r"(a+)+$", "a" * 64 + "b")
        return super().rows(recordings)


def told(store: ResultStore) -> dict[str, str]:
    """Of each log, ok or why it failed."""
    return {Path(row["log"]).stem: row["error"] or row["status"] for row in read_results(store.path)[1]}


@forks
@pytest.mark.parametrize(("devices", "group_size"), [(1, 1), (2, 3)])
def test_the_others_are_done_in_one_run(logs: Path, devices: int, group_size: int):
    task, said = Perilous(), []
    store = ResultStore(logs.parent / "r.parquet", task.columns, task.settings)
    data = GyroArrayDataModule(logs, group_size=group_size)
    store.open()
    if devices == 2:
        (logs / "endless.npz").unlink()
        data = GyroArrayDataModule(logs, group_size=group_size)
    run_fleet(task, data, store, devices=devices, timeout=5.0, report=said.append)
    found = told(store)
    assert {name: found[name] for name in "012"} == dict.fromkeys("012", "ok")
    assert found["deadly"].startswith("ended the process that read it, twice; it is damaged, or")
    assert devices == 2 or found["endless"].startswith("took longer than 5 s")
    assert "deadly.npz: ended the process that read it, twice" in said[-1] or "endless.npz: took" in said[-1]
    assert sorted(path.name for path in logs.parent.iterdir()) == ["logs", "r.parquet"]


def test_a_run_of_ones_own_passes_over_what_ended_two_before(logs: Path):
    task = Fuse()
    store = ResultStore(logs.parent / "r.parquet", task.columns, task.settings)
    log = logs / "deadly.npz"
    key = {"log": str(log), "path": identity(log), **state_of(log)._asdict()}
    for _ in range(2):
        store.open()
        ended_at(store.parts, key)
    data = GyroArrayDataModule(logs, done=store.done())
    trainer = quiet_trainer(devices=1, callbacks=[ResultWriter(store)])
    trainer.predict(FusionModule(task), datamodule=data, return_predictions=False)
    found = told(store)
    assert found.pop("deadly").startswith("ended the process that read it, twice")
    assert set(found.values()) == {"ok"}


def test_what_failed_is_tried_once_when_asked(logs: Path):
    task = Fuse()
    store = ResultStore(logs.parent / "r.parquet", task.columns, task.settings)
    store.open()
    state = {name: state_of(logs / f"{name}.npz")._asdict() for name in "01"}
    for name, own in state.items():
        key = {"log": name, "path": identity(logs / f"{name}.npz"), **own}
        store.write([{**key, "status": "failed", "error": "before"}])
    time.sleep(0.05)  # clocks of file systems are coarse
    store.close()
    store.open()
    again = {"log": "1", "path": identity(logs / "1.npz"), **state["1"]}
    store.write([{**again, "status": "failed", "error": "now"}])
    assert store.done() == {identity(logs / "0.npz"), identity(logs / "1.npz")}
    assert store.done(since=store.opened) == {identity(logs / "1.npz")}


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="needs SIGHUP")
def test_a_closed_terminal_ends_a_command_as_asking_does(run):
    before = {number: signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGTERM)}
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        run("--version")
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN  # as nohup asks
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        run("--version")
        with pytest.raises(SystemExit) as ended:
            signal.raise_signal(signal.SIGHUP)
        assert ended.value.code == 128 + signal.SIGHUP
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
