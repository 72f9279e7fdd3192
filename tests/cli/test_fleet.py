"""`gyrofuse fleet`: one table of many logs, whatever happens to the logs or to the run."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from conftest import Run

import gyrofuse as gf
from gyrofuse.fleet import Fit, Fuse, ResultStore, find_logs, read_results
from gyrofuse.fleet.lightning import FusionModule, GyroArrayDataModule, ResultWriter, quiet_trainer
from gyrofuse.fleet.run import LogGroups, rows_of

pytest.importorskip("pyarrow")


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    folder.mkdir()
    generator = torch.Generator().manual_seed(0)
    for i in range(8):
        noise = torch.randn(3, 4000, generator=generator, dtype=torch.float64)
        gf.Recording(noise * torch.arange(1.0, 4.0)[:, None], rate=100.0, unit="deg/s").save(folder / f"{i}.npz")
    (folder / "empty.csv").write_bytes(b"")
    return folder


def spoil(log: Path) -> None:
    """Make a log useless in a way that only reading it can tell."""
    before = log.stat()
    log.write_bytes(bytes(before.st_size))
    os.utime(log, ns=(before.st_atime_ns, before.st_mtime_ns))


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "gyrofuse", "fleet", *map(str, arguments)]


def test_a_fleet_is_fused_into_a_table_and_told(run: Run, logs: Path):
    done = run(
        "fleet", "logs", "--out", "r.parquet", "--scale-weights", "long", "--json", "s.json", "--report", "r.html"
    )
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith("9 logs, 1 failed\n")
    assert "failed: logs/empty.csv: expected a log, found an empty file" in done.out
    settings, rows = read_results("r.parquet")
    assert settings["scale_weights"] == "long"
    assert [row["log"] for row in rows] == [f"logs/{i}.npz" for i in range(8)] + ["logs/empty.csv"]
    alone = gf.fit_svo(gf.read_recording(logs / "3.npz"), "long")
    assert rows[3]["weights"] == pytest.approx(alone.weights.tolist(), rel=1e-9)
    told = json.loads(Path("s.json").read_text())
    assert told["n_logs"] == 9
    assert told["failures"][0]["log"] == "logs/empty.csv"
    assert "9 logs, 1 of which could not be used." in Path("r.html").read_text()
    assert not Path(".r.parquet.parts").exists()


def test_the_same_command_does_what_is_left(run: Run, logs: Path):
    run("fleet", "logs", "--out", "r.parquet")
    before = Path("r.parquet").read_bytes()
    for i in range(8):
        spoil(logs / f"{i}.npz")  # finished ones are not read again
    assert run("fleet", "logs", "--out", "r.parquet").status == 0
    assert Path("r.parquet").read_bytes() == before
    (logs / "empty.csv").unlink()
    gf.Recording(torch.randn(3, 4000, dtype=torch.float64), rate=100.0).save(logs / "9.npz")
    assert run("fleet", "logs", "--out", "r.parquet").out.startswith("10 logs, 1 failed")


def test_a_log_that_was_replaced_is_done_again(run: Run, logs: Path):
    run("fleet", "logs", "--out", "r.parquet")
    before = {row["log"]: row for row in read_results("r.parquet")[1]}
    assert before["logs/3.npz"]["size"] == (logs / "3.npz").stat().st_size
    assert before["logs/3.npz"]["modified"] == (logs / "3.npz").stat().st_mtime_ns
    gf.Recording(torch.randn(3, 5000, dtype=torch.float64), rate=100.0).save(logs / "3.npz", force=True)
    (logs / "5.npz").write_bytes(b"no longer a log")
    (logs / "6.npz").unlink()
    assert run("fleet", "logs", "--out", "r.parquet").out.startswith("9 logs, 2 failed")
    after = {row["log"]: row for row in read_results("r.parquet")[1]}
    assert (after["logs/3.npz"]["n_samples"], after["logs/5.npz"]["status"]) == (5000, "failed")
    same = {name for name in before if after[name] == before[name]}
    assert same == set(before) - {"logs/3.npz", "logs/5.npz"}  # of a log that is gone, what is known of it


def test_a_table_among_its_logs_is_none_of_them_and_no_log_becomes_a_table(run: Run, logs: Path):
    assert run("fleet", "logs", "--out", "logs/r.parquet").out.startswith("9 logs, 1 failed")
    before = (logs / "r.parquet").read_bytes()
    assert run("fleet", "logs", "--out", "logs/r.parquet").out.startswith("9 logs, 1 failed")
    assert (logs / "r.parquet").read_bytes() == before
    (logs / "log.parquet").write_bytes(b"a log")
    done = run("fleet", "logs", "--out", "logs/log.parquet", "--force")
    assert (done.status, "logs/log.parquet: is no table of a fleet; choose another name" in done.err) == (2, True)
    assert (logs / "log.parquet").read_bytes() == b"a log"


def test_a_log_has_one_row_whatever_it_is_called(run: Run, logs: Path, tmp_path: Path, monkeypatch):
    run("fleet", "logs", "--out", "r.parquet")
    before = Path("r.parquet").read_bytes()
    (tmp_path / "link.npz").symlink_to(logs / "0.npz")
    for names in (["./logs/0.npz", "logs/../logs/1.npz"], [logs], ["link.npz"]):
        assert run("fleet", *names, "--out", "r.parquet").status == 0
        told = sorted(row["log"] for row in read_results("r.parquet")[1])
        assert told == [*(f"logs/{i}.npz" for i in range(8)), "logs/empty.csv"]
    monkeypatch.chdir(logs)
    assert run("fleet", ".", "--out", "../r.parquet").out.startswith("9 logs, 1 failed")
    monkeypatch.chdir(tmp_path)
    assert run("fleet", "logs", "--out", "r.parquet").status == 0
    assert Path("r.parquet").read_bytes() == before


def test_names_that_lead_nowhere_and_names_in_no_text_are_rows(run: Run, logs: Path):
    (logs / "link.npz").symlink_to("gone.npz")
    (logs / "round.npz").symlink_to("round.npz")
    (logs / "7.npz").rename(os.fsdecode(bytes(logs) + b"/\xff.npz"))
    Path("all.txt").write_bytes(b"logs\nabsent.npz\nno/*.npz\nlogs/\xff.npz\nlogs/\xfe.npz\n")
    done = run("fleet", "--manifest", "all.txt", "--out", "r.parquet", "--report", "r.html", "--json", "r.json")
    assert done.status == 0, done.err
    rows = {row["log"]: row for row in read_results("r.parquet")[1]}
    assert rows["logs/\\xff.npz"]["status"] == "ok"
    for name in ("logs/link.npz", "logs/round.npz", "absent.npz", "no/*.npz", "logs/\\xfe.npz"):
        assert rows[name]["error"] == "no such file; check the name and the folder"
    Path("absent.npz").write_bytes((logs / "0.npz").read_bytes())
    assert run("fleet", "--manifest", "all.txt", "--out", "r.parquet").out.startswith("14 logs, 5 failed")


def test_failed_logs_are_tried_again_when_asked(run: Run, logs: Path):
    run("fleet", "logs", "--out", "r.parquet")
    (logs / "empty.csv").write_text("gx,gy\n" + "\n".join(f"{i % 7},{i % 5}" for i in range(4000)))
    assert run("fleet", "logs", "--out", "r.parquet", "--rate", "100").status == 2  # other settings
    assert "1 failed" in run("fleet", "logs", "--out", "r.parquet").out
    again = run("fleet", "logs", "--out", "r.parquet", "--retry").out
    assert "rate" in again  # the log states none: it was read, and says another thing now


def test_fits_and_diagnoses(run: Run, logs: Path):
    done = run("fleet", "logs/0.npz", "logs/1.npz", "--out", "f.parquet", "--task", "fit", "--model", "WN")
    assert done.status == 0, done.err
    _, rows = read_results("f.parquet")
    assert [(row["log"], row["sensor"]) for row in rows] == [(f"logs/{i}.npz", s) for i in range(2) for s in "123"]
    assert [row["values"][0] for row in rows[:3]] == pytest.approx([1, 4, 9], rel=0.1)
    gf.Recording(torch.randn(3, 16_384, dtype=torch.float64), rate=100.0, unit="deg/s").save("long.npz")
    Path("m.json").write_text(json.dumps(gf.WhiteNoise(4.0).to_dict()))
    done = run("fleet", "long.npz", "--out", "d.parquet", "--task", "diagnose", "--simulation", "m.json")
    assert done.status == 0, done.err
    assert "1 of 1 differ\n  parameter_shift: 1 logs" in done.out
    Path("m.json").write_text(json.dumps(gf.WhiteNoise(1.0).to_dict()))
    gone_on = run("fleet", "long.npz", "logs", "--out", "d.parquet", "--task", "diagnose", "--simulation", "m.json")
    assert (gone_on.status, "d.parquet: is of other settings (simulation_sha256 " in gone_on.err) == (2, True)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("gone.npz",), "gone.npz: no such file or folder; check the name"),
        ((), "`paths`: expected logs"),
        (("logs", "--out", "r.csv"), "`--out`: expected a name that ends in .parquet, got 'r.csv'"),
        (("logs", "--devices", "0"), "`--devices`"),
        (("logs", "--group", "0"), "`--group`"),
        (("logs", "--task", "diagnose"), "`--simulation`: expected what to compare with"),
        (("logs", "--task", "fit", "--model", "WN + nonsense"), "nonsense"),
        (("logs", "--method", "magic"), "--method"),
        (("logs", "--method", "multiscale"), "`--method`: expected one with a weight for each sensor"),
        (("logs", "--scale-weights", "tall"), "`--scale-weights`: expected flat, short, long"),
        (("logs", "--out", "f.parquet"), "f.parquet: expected the name of a file, found a folder; choose another name"),
        (("logs", "--out", "f.parquet", "--force"), "f.parquet: expected the name of a file, found a folder"),
        (("logs", "--out", "no/r.parquet"), "the folder no does not exist; create it first"),
        (("logs", "--scale-weights", "1,-1"), "`scale_weights`: expected finite numbers >= 0, not all zero"),
        (("logs", "--scale-weights", "1,nan"), "`scale_weights`: expected finite numbers >= 0, not all zero"),
        (("logs", "--rate", "-1"), "`rate`: expected a finite number > 0"),
        (("logs", "--scale", "0"), "`scale`: expected a finite number other than 0"),
        (("logs", "--false-alarm", "3"), "`--false-alarm`: expected with --task diagnose alone, got fuse; leave"),
        (("logs", "--model", "WN"), "`--model`: expected with --task fit alone, got fuse; leave it out"),
        (("logs", "--task", "fit", "--virtual"), "`--virtual`: expected with --task fuse alone, got fit"),
        (("logs", "--task", "fit", "--method", "svo"), "`--method`: expected with --task fuse alone, got fit"),
        (
            ("logs", "--task", "diagnose", "--simulation", "logs/0.npz", "--false-alarm", "3"),
            "`false_alarm`: expected a number between 0 and 1",
        ),
        (("logs", "--accelerator", "abacus"), "`--accelerator`: expected cpu, gpu or auto, got 'abacus'"),
    ],
)
def test_bad_requests_are_refused_before_any_work(run: Run, logs: Path, arguments, says):
    Path("f.parquet").mkdir()
    before = sorted(Path().rglob("*"))
    done = run("fleet", *arguments)
    assert done.status == 2
    assert says in done.err
    assert done.err.count("\n") == 1
    assert sorted(Path().rglob("*")) == before


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a computer without a GPU")
def test_an_accelerator_that_is_not_there_is_refused(run: Run, logs: Path):
    done = run("fleet", "logs", "--accelerator", "gpu")
    assert done.status == 2
    assert "`--accelerator`: expected 1 of the kind gpu, which this computer does not have" in done.err
    assert done.err.count("\n") == 1
    assert sorted(Path().iterdir()) == [Path("logs")]


def test_logs_that_all_fail_are_told_by_the_exit_status(run: Run, logs: Path):
    done = run("fleet", "logs/empty.csv", "--out", "r.parquet")
    assert (done.status, done.err) == (1, "")
    assert done.out.startswith("1 logs, 1 failed\n")
    assert read_results("r.parquet")[1][0]["status"] == "failed"
    assert run("fleet", "logs/empty.csv", "logs/0.npz", "--out", "r.parquet").status == 0


def test_two_processes_give_the_same_table_also_of_one_log(run: Run, logs: Path, tmp_path: Path):
    asked = [["fleet", paths, "--group", "3", "--out"] for paths in ("logs", "logs/0.npz")]
    script = (
        "from gyrofuse.cli import main\n"
        f"for i, words in enumerate({asked}):\n"
        "    try:\n"
        "        main([*words, f'{i}-two.parquet', '--devices', '2'])\n"
        "    except SystemExit as ended:\n"
        "        assert not ended.code\n"
    )
    two = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert (two.returncode, two.stderr) == (0, "")
    for i, words in enumerate(asked):
        run(*words, f"{i}.parquet")
        assert Path(f"{i}.parquet").read_bytes() == Path(f"{i}-two.parquet").read_bytes()


def test_a_trainer_of_ones_own_gives_the_same_table(run: Run, logs: Path, tmp_path: Path):
    run("fleet", "logs", "--out", "one.parquet")
    script = tmp_path / "own.py"
    script.write_text(
        "from pathlib import Path\n"
        "from lightning.pytorch import Trainer\n"
        "from gyrofuse.fleet import Fuse, ResultStore\n"
        "from gyrofuse.fleet.lightning import FusionModule, GyroArrayDataModule, ResultWriter\n"
        "task = Fuse()\n"
        "for _ in range(2):  # the second time nothing is left\n"
        "    store = ResultStore('own.parquet', task.columns, task.settings)\n"
        "    data = GyroArrayDataModule(['logs'], done=store.done())\n"
        "    trainer = Trainer(devices=2, strategy='ddp', accelerator='cpu', callbacks=[ResultWriter(store)],\n"
        "                      logger=False, enable_checkpointing=False, enable_progress_bar=False)\n"
        "    trainer.predict(FusionModule(task), datamodule=data, return_predictions=False)\n"
        "    if trainer.is_global_zero:\n"
        "        print(len(data.groups), Path('own.parquet').read_bytes() == Path('one.parquet').read_bytes())\n"
    )
    own = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True)
    assert own.returncode == 0, own.stderr
    assert own.stdout.splitlines() == ["9 True", "0 True"]
    assert not Path(".own.parquet.parts").exists()


def own_run(folder: Path, store: ResultStore, module: FusionModule) -> None:
    data = GyroArrayDataModule([folder], done=store.done())
    trainer = quiet_trainer(devices=1, callbacks=[ResultWriter(store)])
    trainer.predict(module, datamodule=data, return_predictions=False)


def test_a_run_of_ones_own_with_nothing_left_completes_the_table(logs: Path, tmp_path: Path):
    task = Fuse()
    store = ResultStore(tmp_path / "r.parquet", task.columns, task.settings)
    own_run(logs, store, FusionModule(task))
    before = store.path.read_bytes()
    own_run(logs, store, FusionModule(task))
    assert store.path.read_bytes() == before
    assert not store.parts.exists()
    store.path.unlink()  # as if stopped between the last row and the table
    store.open()
    for log in find_logs([logs]):
        store.write(rows_of(task, LogGroups([[log]], {})[0]))
    own_run(logs, store, FusionModule(task))
    assert store.path.read_bytes() == before
    assert not store.parts.exists()


def test_a_table_of_another_task_is_refused_before_any_work(logs: Path, tmp_path: Path):
    for task in (Fit("WN"), Fuse("long"), Fuse(virtual=True)):
        store = ResultStore(tmp_path / "r.parquet", Fuse().columns, Fuse().settings)
        with pytest.raises(ValueError, match=r"`store`: expected the columns and settings of the module's task"):
            own_run(logs, store, FusionModule(task))
    assert sorted(tmp_path.iterdir()) == [logs]


def test_data_modules_take_one_path_and_options_of_reading_alone(logs: Path):
    for path in (logs / "0.npz", str(logs / "0.npz")):
        assert GyroArrayDataModule(path, rate=100.0).logs == (logs / "0.npz",)
    with pytest.raises(TypeError, match=r"`foo`: expected an option of read_recording \(axis, .*; leave it out"):
        GyroArrayDataModule(logs, foo=3)
    with pytest.raises(ValueError, match="`rate`: expected a finite number > 0"):
        GyroArrayDataModule(logs, rate=-1.0)


@pytest.mark.skipif(os.name == "nt", reason="processes of Windows have no SIGTERM to catch")
def test_a_run_that_is_asked_to_stop_does_not_finish_its_work_first(logs: Path, tmp_path: Path):
    for i in range(8, 200):  # more than it could do before the test ends
        shutil.copy(logs / "0.npz", logs / f"{i}.npz")
    store = ResultStore(tmp_path / "r.parquet", Fuse().columns, {})
    with subprocess.Popen(
        command("logs", "--out", "r.parquet", "--devices", 2), cwd=tmp_path, stderr=subprocess.PIPE, text=True
    ) as process:
        while store.n_parts < 2 and process.poll() is None:
            time.sleep(0.005)
        process.terminate()
        _, said = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM
    assert "stopped; what is finished is kept, start again to go on" in said
    assert 2 <= store.n_parts < 200
    assert not store.path.exists()


@pytest.mark.parametrize("devices", [1, 2])
def test_a_killed_run_goes_on_where_it_was(run: Run, logs: Path, tmp_path: Path, devices: int):
    manifest = tmp_path / "all.txt"
    manifest.write_text("".join(f"logs/{i}.npz\n" for i in range(8)))
    run("fleet", "--manifest", manifest, "--out", "whole.parquet")
    store = ResultStore(tmp_path / "r.parquet", Fuse().columns, {})
    asked = command("--manifest", manifest, "--out", "r.parquet", "--devices", devices)
    with subprocess.Popen(asked, cwd=tmp_path, stderr=subprocess.DEVNULL) as process:
        while store.n_parts < 2 and process.poll() is None:
            time.sleep(0.005)
        os.kill(process.pid, signal.SIGKILL)
    done = store.done()
    assert len(done) >= 2
    for log in done:
        spoil(Path(log))  # finished ones are not done again
    if not (tmp_path / "r.parquet").exists():
        assert run("fleet", "--manifest", manifest, "--out", "r.parquet").status == 0
    assert Path("r.parquet").read_bytes() == Path("whole.parquet").read_bytes()
    assert not store.parts.exists()
