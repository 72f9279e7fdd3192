"""The table of a fleet and its parts: damage, two runs at once, rows that do not fit."""

from __future__ import annotations

import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from gyrofuse.fleet import Fuse, ResultStore, read_results
from gyrofuse.fleet.run import LogGroups, rows_of

pa = pytest.importorskip("pyarrow")


def row(log: str, **more):
    return {"log": log, "status": "ok", "weights": [0.5, 0.5], "axis": None, **more}


def store_at(path: Path, **settings) -> ResultStore:
    return ResultStore(path, Fuse().columns, {"task": "fuse", **settings})


@pytest.fixture
def store(tmp_path: Path) -> ResultStore:
    """One with three parts, not finished."""
    store = store_at(tmp_path / "r.parquet")
    store.open()
    for log in "abc":
        store.write([row(log)])
    return store


def part_of(store: ResultStore, log: str) -> Path:
    (part,) = (p for p in store.parts.glob("*.parquet") if pa.parquet.read_table(p)["log"].to_pylist() == [log])
    return part


def flip(path: Path, where: float) -> None:
    """One bit, at a share of the file."""
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 1
    path.write_bytes(content)


def test_names_that_are_no_text_are_written_out(tmp_path):
    rng = np.random.default_rng(0)
    names = np.array(["\ud800", "b\udcff"])
    np.savez(tmp_path / "s.npz", gyro=rng.standard_normal((2, 3000)), fs=100.0, sensors=names, unit="deg/s")
    store = store_at(tmp_path / "r.parquet")
    store.open()
    store.write(rows_of(Fuse(), LogGroups([[tmp_path / "s.npz"]], {})[0]))
    store.finish(sorted(store.done()))
    (read,) = read_results(store.path)[1]
    assert (read["status"], read["sensors"][0]) == ("ok", "\\ud800")
    assert read["sensors"][1].startswith("b\\")


def test_a_row_that_does_not_fit_gives_way_to_one_that_says_so(tmp_path):
    store = store_at(tmp_path / "r.parquet")
    store.open()
    store.write([row("a"), row("b", n_samples="many"), row("c\ud800", n_samples=2**70), row("d")])
    store.finish(["a", "b", "c\\ud800", "d"])
    rows = read_results(store.path)[1]
    assert [(r["log"], r["status"]) for r in rows] == [
        ("a", "ok"),
        ("b", "failed"),
        ("c\\ud800", "failed"),
        ("d", "ok"),
    ]
    assert all(r["error"].startswith("its rows do not fit the table (") for r in rows[1:3])


@pytest.mark.parametrize("content", [b"", bytes(500), b"PAR1 and no more"])
def test_without_its_head_a_store_knows_its_settings(store, content):
    (head,) = store.parts.glob("*.head")
    head.write_bytes(content)
    with pytest.raises(FileExistsError, match=r"r\.parquet: is of other settings"):
        store_at(store.path, scale_weights="long").open()
    again = store_at(store.path)
    again.open()
    assert again.done() == {"a", "b", "c"}
    assert again.finish(["a", "b", "c"]) == 3


def test_the_head_is_written_once(store):
    (head,) = store.parts.glob("*.head")
    before = head.stat()
    store_at(store.path).open()
    assert (head.stat().st_ino, head.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


@pytest.mark.parametrize("where", [0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.999])
def test_a_part_with_one_wrong_bit_is_done_again(store, where):
    whole = store_at(store.path.with_name("w.parquet"))
    whole.open()
    for log in "abc":
        whole.write([row(log)])
    whole.finish(["a", "b", "c"])
    flip(part_of(store, "b"), where)
    with pytest.warns(UserWarning, match=r"r.parquet: 1 of its parts damaged, .*; the logs in it are done again"):
        assert store.done() == {"a", "c"}
    store.write([row("b")])
    store.finish(["a", "b", "c"])
    assert store.path.read_bytes() == whole.path.read_bytes()


def test_a_part_that_is_damaged_at_the_end_stops_a_table_of_too_few_rows(store):
    assert store.done() == {"a", "b", "c"}
    flip(part_of(store, "b"), 0.5)
    with (
        pytest.warns(UserWarning, match="1 of its parts damaged"),
        pytest.raises(OSError, match=r"r.parquet: parts of it were damaged; what is sound is kept, start again"),
    ):
        store.finish(["a", "b", "c"])
    assert not store.path.exists()
    assert store.done() == {"a", "c"}


def test_a_table_without_all_rows_is_told(store):
    with pytest.warns(UserWarning, match="r.parquet: has no rows of 2 of 5 logs; start again to go on"):
        store.finish(list("abcde"))


def test_a_damaged_table_is_told_kept_and_mended(tmp_path, monkeypatch):
    monkeypatch.setattr("gyrofuse.fleet.store.table._MAX_LOGS", 2)
    store = store_at(tmp_path / "r.parquet")

    def fill(logs) -> None:
        store.open()
        for log in logs:
            store.write([row(log, weights=[0.123456, 0.876544])])
        store.finish(list("abcd"))

    fill("abcd")
    before = store.path.read_bytes()
    damaged = bytearray(before)
    damaged[damaged.index(np.float64(0.123456).tobytes())] ^= 1  # of the first row group
    store.path.write_bytes(damaged)
    with pytest.raises(ValueError, match=r"r.parquet: is damaged \(.*; run the command that wrote it again"):
        read_results(store.path)
    with pytest.warns(UserWarning, match="r.parquet: damaged, by .* and it is kept as .*r.parquet.damaged"):
        left = set("abcd") - store.done()
    assert left == {"a", "b"}
    fill(sorted(left))
    assert store.path.read_bytes() == before
    assert (tmp_path / "r.parquet.damaged").read_bytes() == damaged


def test_what_is_renamed_is_on_the_disk_before_and_the_name_before_what_comes_then(store, monkeypatch):
    events: list[str] = []

    def told(name, function):
        def call(*arguments, **options):
            events.append(name)
            return function(*arguments, **options)

        return call

    monkeypatch.setattr(os, "fsync", told("sync", os.fsync))
    monkeypatch.setattr(Path, "replace", told("rename", Path.replace))
    monkeypatch.setattr(shutil, "rmtree", told("remove", shutil.rmtree))
    store.write([row("d")])
    assert events == ["sync", "rename", "sync"]
    events.clear()
    store.finish(list("abcd"))
    assert events == ["sync", "rename", "sync", "remove"]


def test_one_run_at_a_time(store):
    fcntl = pytest.importorskip("fcntl")
    store.close()
    (store.parts / "x.draft").write_bytes(b"of the other run")
    with (store.parts / "lock").open("r+b") as other:  # its own description of the file, as another process has
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(BlockingIOError, match=r"r.parquet: another run is at work on it \(process \d+ on .*; wait"):
            store_at(store.path).open()
        with pytest.raises(BlockingIOError, match="another run"):
            store_at(store.path, scale_weights="long").open(force=True)
        assert (store.parts / "x.draft").exists()
    store.open()
    pickle.loads(pickle.dumps(store)).open()  # as a process does that it is handed on to
    store_at(store.path).open()  # the same process is one run
    store.finish(list("abc"))
    assert list(store.path.parent.iterdir()) == [store.path]


def test_platforms_without_locks_go_on(store, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_):
        raise OSError(95, "Operation not supported")

    store.close()
    monkeypatch.setattr(fcntl, "flock", refuse)
    store_at(store.path).open()


def test_rows_that_cannot_be_written_say_whose_they_are(store, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pyarrow.parquet.write_table", full)
    with pytest.raises(OSError, match=r"r.parquet: rows of d and 1 more cannot be written \(.*No space"):
        store.write([row("d"), row("e")])
