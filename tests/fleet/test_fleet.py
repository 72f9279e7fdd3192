"""Fleets of logs: which they are, rows of each, and the table that fills up."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

import gyrofuse as gf
from gyrofuse.fleet import Diagnose, Fit, Fuse, ResultStore, find_logs, read_results
from gyrofuse.fleet.logs import groups_of
from gyrofuse.fleet.run import Log, LogGroups, rows_of
from gyrofuse.fleet.tasks import relative_noise

pa = pytest.importorskip("pyarrow")


def array(seed: int, n_samples: int = 5000, n_sensors: int = 3) -> gf.Recording:
    noise = torch.randn(n_sensors, n_samples, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return gf.Recording(noise * torch.arange(1.0, n_sensors + 1)[:, None], rate=100.0, unit="deg/s")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    logs = tmp_path / "logs"
    (logs / "deep").mkdir(parents=True)
    for i, name in enumerate(["b.npz", "a.npz", "deep/c.npz"]):
        array(i).save(logs / name)
    (logs / "notes.md").write_text("no log")
    (logs / ".hidden.npz").write_bytes(b"")
    return logs


def names(logs) -> list[str]:
    return [log.name for log in logs]


def test_logs_are_those_of_files_folders_and_patterns_each_once(folder):
    assert names(find_logs([folder])) == ["a.npz", "b.npz", "c.npz"]
    assert names(find_logs([folder / "b.npz", folder])) == ["b.npz", "a.npz", "c.npz"]
    assert names(find_logs([folder / "*.npz"])) == ["a.npz", "b.npz"]
    assert names(find_logs([folder / "**" / "*.npz"])) == ["a.npz", "b.npz", "c.npz"]
    assert names(find_logs([folder / "notes.md"])) == ["notes.md"]  # named, it is taken; its row will say


def test_a_ros_folder_is_one_log(folder):
    (folder / "bag").mkdir()
    (folder / "bag" / "metadata.yaml").write_text("")
    (folder / "bag" / "0.db3").write_text("")
    assert names(find_logs([folder])) == ["a.npz", "b.npz", "bag", "c.npz"]


def test_a_manifest_names_logs_beside_itself_and_those_that_are_gone(folder):
    manifest = folder / "list.manifest"
    manifest.write_text("# first flights\nb.npz\n\ngone.npz\ndeep\n")
    assert names(find_logs([], manifest=manifest)) == ["b.npz", "gone.npz", "c.npz"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_manifests_of_windows_are_read(folder, encoding):
    (folder / "é.npz").write_bytes(b"")
    (folder / "list.txt").write_bytes("a.npz\r\né.npz\r\n".encode(encoding))
    assert names(find_logs([], manifest=folder / "list.txt")) == ["a.npz", "é.npz"]


def test_a_line_that_is_no_name_spoils_itself_alone(folder):
    (folder / "list.txt").write_bytes(b"a.npz\nb\0.npz\n*\0/*\n\xff\xfe.npz\n" + b"x" * 5000 + b"\n")
    logs = find_logs([], manifest=folder / "list.txt")
    assert [log.name.startswith(name) for log, name in zip(logs, ["a", "b", "*", "\udcff", "x"], strict=True)]
    groups = groups_of(logs, 5)
    rows = {row["log"].removeprefix(f"{folder}/"): row for row in rows_of(Fuse(), LogGroups(groups, {})[0])}
    assert rows.pop("a.npz")["status"] == "ok"
    assert {row["status"] for row in rows.values()} == {"failed"}
    nul = "expected the name of a file, found one with NUL bytes; save the list as UTF-8"
    assert [rows[name]["error"] for name in ("b\0.npz", "*\0/*")] == [nul, nul]


def test_a_folder_that_may_not_be_read_is_listed(folder, monkeypatch):
    scan = os.scandir

    def refuse(path):
        if str(path).endswith("deep"):
            raise PermissionError(13, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", refuse)
    assert names(find_logs([folder])) == ["a.npz", "b.npz", "deep"]
    (log,) = LogGroups([[folder / "deep"]], {})[0]
    assert log.recording is None
    assert "found another folder" in log.error


def test_names_that_stand_for_nothing_are_refused(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file or folder; check the name"):
        find_logs([folder / "gone.npz"])
    with pytest.raises(FileNotFoundError, match="no file fits the pattern"):
        find_logs([folder / "*.csv"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"`paths`: expected logs \(.npz .*found none"):
        find_logs([tmp_path / "empty"])


def test_groups_hold_every_log_once_the_largest_first(folder):
    array(9, n_samples=50_000).save(folder / "z.npz")
    logs = find_logs([folder])
    groups = groups_of(logs, 2)
    assert sorted(log for group in groups for log in group) == sorted(logs)
    assert "z.npz" in names(groups[0])
    left = groups_of(logs, 2, done={str(logs[0]), *map(str, groups[0])})
    assert left == ((logs[1],),)  # its neighbour is done, and it stays alone


def row(log: str, **more):
    return {"log": log, "status": "ok", "weights": [0.5, 0.5], "axis": None, **more}


def store_at(path: Path, **settings) -> ResultStore:
    return ResultStore(path, Fuse().columns, {"task": "fuse", **settings})


def test_a_table_fills_up_and_is_in_order(tmp_path):
    store = store_at(tmp_path / "r.parquet")
    store.open()
    store.write([row("c"), row("a", axis="x"), row("a", axis="y")])
    store.write([row("b", status="failed", error="empty")])
    assert store.n_parts == 2
    assert store.done() == {"a", "b", "c"}
    assert store.done(failed=False) == {"a", "c"}
    assert store.finish(["a", "b", "c"]) == 4
    settings, rows = read_results(store.path)
    assert settings == {"task": "fuse"}
    assert [(r["log"], r["axis"]) for r in rows] == [("a", "x"), ("a", "y"), ("b", None), ("c", None)]
    assert rows[0]["weights"] == [0.5, 0.5]
    assert rows[2]["error"] == "empty"
    assert list(tmp_path.iterdir()) == [store.path]


@pytest.mark.parametrize("task", [Fuse(virtual=True), Fit(), Diagnose(gf.WhiteNoise(1.0))], ids=lambda task: task.name)
def test_every_column_of_a_table_is_described(tmp_path, task):
    ResultStore(tmp_path / "r.parquet", task.columns, task.settings).finish([])
    fields = list(pa.parquet.read_schema(tmp_path / "r.parquet"))
    told = {field.name: (field.metadata or {}).get(b"description", b"").decode() for field in fields}
    assert {"log", "path", "size", "modified", *task.columns} <= set(told)
    assert all(len(words) > 5 for words in told.values())
    if task.name == "fuse":
        assert "corrected for the weights having been chosen on this one" in told["gain"]
        assert told["tau"].endswith(", s")
    if task.name == "diagnose":
        assert told["gain"].endswith(", nats")
    assert "largest fraction of missing samples" in told["missing"]


def test_a_table_grows_and_new_rows_replace_old_ones(tmp_path):
    store = store_at(tmp_path / "r.parquet")
    store.open()
    store.write([row("a"), row("b", status="failed")])
    store.finish(["a", "b"])
    store.open()
    assert store.done() == {"a", "b"}
    store.write([row("b", weights=[0.1, 0.9]), row("c")])
    store.finish(["b", "c"])
    _, rows = read_results(store.path)
    assert [(r["log"], r["status"], r["weights"][0]) for r in rows] == [
        ("a", "ok", 0.5),
        ("b", "ok", 0.1),
        ("c", "ok", 0.5),
    ]


def test_writing_the_same_logs_again_leaves_one_of_each(tmp_path):
    store = store_at(tmp_path / "r.parquet")
    store.open()
    for _ in range(2):
        store.write([row("a"), row("b")])
    assert store.n_parts == 1
    assert store.finish(["a", "b"]) == 2


def test_what_worked_counts_before_what_failed(tmp_path):
    store = store_at(tmp_path / "r.parquet")
    for logs in (["a", "b"], ["a"], ["a", "c"]):  # in whatever order their files come
        store.open()
        store.write([row(name, status="ok" if logs == ["a"] else "failed") for name in logs])
    assert store.done(failed=False) == {"a"}
    store.finish(["a", "b", "c"])
    assert [r["status"] for r in read_results(store.path)[1]] == ["ok", "failed", "failed"]


def test_a_part_that_was_cut_short_is_done_again(tmp_path):
    store = store_at(tmp_path / "r.parquet")
    store.open()
    store.write([row("a")])
    store.write([row("b")])
    part = min(store.parts.glob("*.parquet"))
    part.write_bytes(part.read_bytes()[:-20])
    (store.parts / "x.draft").write_bytes(b"half")
    store.open()
    with pytest.warns(UserWarning, match="1 of its parts damaged"):
        assert len(store.done()) == 1
    assert not list(store.parts.glob("*.draft"))


def test_large_tables_are_written_in_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr("gyrofuse.fleet.store.table._MAX_LOGS", 3)
    store = store_at(tmp_path / "r.parquet")
    store.open()
    logs = [f"{i:02d}" for i in range(10)]
    for name in reversed(logs):
        store.write([row(name)])
    assert store.finish(logs) == 10
    assert [r["log"] for r in read_results(store.path)[1]] == logs
    with pa.parquet.ParquetFile(store.path) as file:
        assert file.num_row_groups == 4


def test_only_a_run_of_the_same_settings_goes_on(tmp_path):
    store_at(tmp_path / "r.parquet", scale_weights=(0.5, 0.5)).open()
    store_at(tmp_path / "r.parquet", scale_weights=[0.5, 0.5]).open()
    other = store_at(tmp_path / "r.parquet", scale_weights="long")
    with pytest.raises(FileExistsError, match=r"other settings \(scale_weights \[0.5, 0.5\] instead of 'long'\)"):
        other.open()
    other.open(force=True)
    (tmp_path / "t.parquet").write_bytes(b"mine")
    with pytest.raises(FileExistsError, match="no table of a fleet; choose another name"):
        store_at(tmp_path / "t.parquet").open()
    ResultStore(tmp_path / "u.parquet", {}, {"task": "fuse"}).finish([])
    with pytest.raises(FileExistsError, match="of other columns, written by another version; choose another name"):
        store_at(tmp_path / "u.parquet").open()
    (tmp_path / "u.parquet").unlink()
    with pytest.raises(FileNotFoundError, match="does not exist; create it first"):
        store_at(tmp_path / "no" / "r.parquet").open()
    with pytest.raises(ValueError, match="expected a table that `gyrofuse fleet` wrote"):
        read_results(tmp_path / "t.parquet")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_results(tmp_path / "u.parquet")


def test_a_full_disk_stops_the_run_and_keeps_what_is_finished(tmp_path, monkeypatch):
    store = store_at(tmp_path / "r.parquet")
    store.open()
    store.write([row("a")])

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pyarrow.parquet.write_table", full)
    with pytest.raises(OSError, match=r"cannot be written \(.*No space left.*what is finished is kept"):
        store.write([row("b")])
    assert store.done() == {"a"}
    assert not list(store.parts.glob("*.draft"))


def test_bad_logs_get_rows_and_those_beside_them_theirs(folder):
    (folder / "empty.csv").write_bytes(b"")
    (folder / "cut.npz").write_bytes((folder / "a.npz").read_bytes()[:2000])
    constant = array(0)
    gf.Recording(torch.ones_like(constant.signal), rate=100.0).save(folder / "d.npz")
    logs = LogGroups([find_logs([folder])], {})[0]
    rows = {Path(r["log"]).name: r for r in rows_of(Fuse("long"), logs)}
    assert {name for name, r in rows.items() if r["status"] == "ok"} == {"a.npz", "b.npz", "c.npz"}
    assert rows["empty.csv"]["error"] == "expected a log, found an empty file; record or copy it again"
    assert "cannot be read" in rows["cut.npz"]["error"]
    assert "never change (dead or stuck)" in rows["d.npz"]["error"]
    alone = gf.fit_svo(array(1), "long")  # a.npz
    np.testing.assert_allclose(rows["a.npz"]["weights"], alone.weights, rtol=1e-9)
    assert rows["a.npz"]["sensors"] == ["1", "2", "3"]
    assert rows["a.npz"]["rate"] == pytest.approx(100.0)


def test_rows_say_whether_their_recording_is_long_enough():
    drifting = gf.parse_model("WN(variance=1e-6) + RW(variance=1)").simulate(
        64, batch=(5,), generator=torch.Generator().manual_seed(0)
    )
    recordings = [array(1), gf.Recording(drifting, rate=100.0), gf.Recording(drifting.flip(0), rate=100.0)]
    long, *short = rows_of(Fuse("long"), [Log(str(i), r) for i, r in enumerate(recordings)])
    assert (long["enough"], long["warnings"]) == (True, [])
    for row, recording in zip(short, recordings[1:], strict=True):
        data = gf.fit_svo(recording, "long").enough_data()
        assert (row["enough"], row["warnings"]) == (False, [str(data)])
        assert row["scale_weights"] == pytest.approx(gf.fit_svo(recording, "long").scale_weights.tolist())
    (equal,) = rows_of(Fuse(method="equal"), [Log("log", array(1))])
    assert (equal["enough"], equal["warnings"]) == (None, [])


def test_arrays_of_one_shape_are_fitted_together_to_the_same(folder):
    recordings = [array(i) for i in range(4)] + [array(7, n_samples=6000), array(8, n_sensors=4)]
    logs = [Log(str(i), r) for i, r in enumerate(recordings)]
    rows = rows_of(Fuse("long", virtual=True), logs)
    assert [r["log"] for r in rows] == list("012345")
    for r, recording in zip(rows, recordings, strict=True):
        alone = gf.fit_svo(recording, "long")
        low, high = alone.confidence_interval
        np.testing.assert_allclose(r["weights"], alone.weights, rtol=1e-9)
        np.testing.assert_allclose(r["low"], low, rtol=1e-6)
        np.testing.assert_allclose(r["high"], high, rtol=1e-6)
        np.testing.assert_allclose(r["virtual"], alone.virtual(recording), rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(np.square(r["gain"]), alone.gain_over_equal().estimate, rtol=1e-6)
        np.testing.assert_allclose(r["tau"], alone.tau)


def test_axes_have_rows_of_their_own():
    signal = torch.stack([array(1).signal, array(2).signal])
    recording = gf.Recording(signal, rate=100.0, unit="deg/s", axes=("x", "y"))
    rows = rows_of(Fuse(), [Log("log", recording)])
    assert [r["axis"] for r in rows] == ["x", "y"]
    np.testing.assert_allclose(rows[1]["weights"], gf.fit_svo(array(2)).weights, rtol=1e-9)
    fits = rows_of(Fit("WN"), [Log("log", recording)])
    assert [(r["axis"], r["sensor"]) for r in fits] == [(a, s) for a in "xy" for s in "123"]
    np.testing.assert_allclose([r["values"][0] for r in fits[:3]], [1, 4, 9], rtol=0.1)
    assert fits[0]["quantities"][0] == "angle random walk N"
    assert gf.model_from_dict(json.loads(fits[0]["model"])).param_names == ("white_noise.variance",)


def test_a_diagnosis_says_what_is_left_out():
    recording = array(3, n_samples=16_384)
    tone = 0.2 * torch.sin(2 * torch.pi * 12.5 * recording.time)
    differs = gf.Recording(recording.signal + tone, rate=100.0, unit="deg/s")
    simulation = gf.WhiteNoise(torch.tensor([1.0, 4.0, 9.0], dtype=torch.float64))
    task = Diagnose(simulation, source="model.json")
    same, other = rows_of(task, [Log("same", recording), Log("other", differs)])
    assert (same["mismatch"], same["mechanisms"]) == (False, [])
    assert other["mismatch"]
    assert other["mechanisms"] == ["vibration_tone"]
    assert "12.5" in other["sentences"][0]
    assert other["gain"] > 0


def test_a_simulation_of_the_same_name_and_other_numbers_is_another_setting():
    one, same, other = (Diagnose(gf.WhiteNoise(v), source="model.json").settings for v in (1.0, 1.0, 2.0))
    assert one == same
    assert one["simulation"] == other["simulation"]
    assert one != other
    recording = array(0)
    warm = gf.Recording(recording.signal, rate=100.0, unit="deg/s", channels={"temperature": recording.time})
    settings = [Diagnose(r).settings for r in (recording, array(0), array(1), recording.to("rad/s"), warm)]
    assert settings[0] == settings[1]
    assert all(settings[0] != s for s in settings[2:])
    with pytest.raises(TypeError, match=r"`simulation`: expected a Recording or a noise model, got str; read"):
        Diagnose("model.json")


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (lambda: Fuse("longest"), "`scale_weights`: expected 'flat', 'short', 'long'"),
        (lambda: Fuse((1.0, -1.0)), "`scale_weights`: expected finite numbers >= 0"),
        (lambda: Fuse(method="foo"), "`method`: expected one of 'auto', 'svo'"),
        (lambda: Fuse(confidence_level=95), "`confidence_level`: expected a number between 0 and 1"),
        (lambda: Fit(confidence_level=95), "`confidence_level`: expected a number between 0 and 1"),
        (lambda: Diagnose(gf.WhiteNoise(1.0), false_alarm=3), "`false_alarm`: expected a number between 0 and 1"),
    ],
)
def test_bad_options_are_refused_when_a_task_is_made(made, says):
    with pytest.raises(ValueError, match=says):
        made()


def test_relative_noise_is_that_of_known_levels():
    variance = torch.tensor([[1.0, 4.0, 16.0], [4.0, 4.0, 1.0], [torch.nan, 4.0, 4.0]], dtype=torch.float64)
    # Over the medians 4 and 4: ratios of deviations 1/2, 1, 2 and 1, 1, 1/2; a level with a gap has the rest.
    noise = relative_noise(variance[:2])
    np.testing.assert_allclose(noise, np.sqrt([0.5, 1.0, 1.0]))
    assert bool(relative_noise(torch.full((2, 3), torch.nan)).isnan().all())
    even = torch.tensor([[1.0, 2.0, 4.0, 9.0]], dtype=torch.float64)
    np.testing.assert_allclose(relative_noise(even), np.sqrt([1 / 3, 2 / 3, 4 / 3, 3.0]))
    gap = torch.tensor([[1.0, 2.0, torch.nan, 6.0]], dtype=torch.float64)
    np.testing.assert_allclose(relative_noise(gap), np.sqrt([1 / 2, 1.0, torch.nan, 3.0]))
