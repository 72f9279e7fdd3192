"""`gyrofuse rank` from the outside."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from conftest import Run
from pages import Page

import gyrofuse as gf


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.npz"
    models = gf.Model([gf.WhiteNoise(1.0)]), gf.WhiteNoise(1.0) + gf.RandomWalk(1e-2)
    generator = torch.Generator().manual_seed(0)
    signal = torch.stack([model.simulate(2000, generator=generator) for model in models])
    gf.Recording(signal, rate=100.0, unit="deg/s", sensors=("a", "b")).save(path)
    return path


def test_prints_the_table_and_the_fits_and_writes_what_is_asked_for(run: Run, log: Path):
    files = ("--json", "r.json", "--figure", "f.PNG", "--report", "r.html")
    done = run("rank", log, "--candidates", "WN, RW ,WN+RW", *files)
    assert (done.status, done.err) == (0, "")
    result = gf.rank_models(gf.read_recording(log), ["WN", "RW", "WN + RW"])
    assert result.names == ("WN", "WN + RW")
    assert str(result) in done.out
    assert all(str(fit) in done.out for fit in result.best)
    assert json.loads(Path("r.json").read_text()) == result.to_dict()
    assert Path("f.PNG").read_bytes().startswith(b"\x89PNG")
    page = Page(Path("r.html").read_text())
    assert "Noise models for log.npz" in page.text
    assert [row[0] for row in page.rows if row[-1] == "chosen"] == ["WN", "WN + RW"]
    assert page.tags.count("img") == 2


@pytest.mark.filterwarnings("ignore:`signal`")
def test_a_sensor_that_does_not_vary_is_left_out_of_the_figure(run: Run, log: Path):
    recording = gf.read_recording(log)
    recording.signal[0] = 1.0
    recording.save(log, force=True)
    done = run("rank", log, "--candidates", "WN,WN+RW", "--figure", "f.svg")
    assert done.status == 0
    drawn = Path("f.svg").read_text()
    assert "Sensor b" in drawn
    assert "1 sensor before it not ranked" in drawn


def test_sensors_and_stretch(run: Run, log: Path):
    done = run("rank", log, "--sensors", "b", "--rest", "0:10", "--confidence-level", 0.9)
    assert done.status == 0
    assert "1000 samples" in done.out
    assert "sensor b: WN + RW" in done.out
    assert "sensor a" not in done.out
    assert "90 % interval" in done.out


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--candidates", "WN, FOO"), "unknown process 'FOO'"),
        (("--candidates", "WN, WN"), "expected each composition once, got WN twice"),
        (("--json", "r.txt"), "`--json`: expected a name that ends in .json"),
        (("--rest", "5"), "`--rest`: expected START:STOP"),
        (("--report", "r.pdf"), "`--report`: expected a name that ends in .html"),
        (("--report", "nowhere/r.html"), "the folder nowhere does not exist"),
    ],
)
def test_refuses(run: Run, log: Path, options: tuple[str, ...], says: str):
    done = run("rank", log, *options)
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("error: ")
    assert done.err.count("\n") == 1
    assert says in done.err


def test_samples_that_are_missing_leave_the_longest_stretch(run: Run, log: Path):
    recording = gf.read_recording(log)
    recording.signal[0, [300, 1500]] = torch.nan
    recording.signal[1, 310] = torch.inf  # NaN in the log's recording
    recording.save(log, force=True)
    done = run("rank", log, "--candidates", "WN,WN+RW", "--report", "r.html", "--json", "r.json")
    assert done.status == 0
    told = "Ranked on 3.11 to 15 s alone, 1189 of 2000 samples, the longest stretch that no sensor lacks a sample of"
    assert told in " ".join(done.out.split())
    result = gf.rank_models(gf.read_recording(log).between(3.11, 15.0), ["WN", "WN + RW"])
    assert str(result) in done.out
    assert json.loads(Path("r.json").read_text()) == result.to_dict()
    assert told in Page(Path("r.html").read_text()).text
    whole = run("rank", log, "--candidates", "WN,WN+RW", "--rest", "4:14")
    assert "Ranked on" not in whole.out
    alone = run("rank", log, "--candidates", "WN,WN+RW", "--sensors", "b")
    assert "Ranked on 3.11 to 20 s alone, 1689 of 2000 samples" in alone.out
    assert "fewer --sensors" not in alone.out
    recording.signal[0, ::20] = torch.nan
    recording.save(log, force=True)
    refused = run("rank", log)
    assert (refused.status, refused.out) == (2, "")
    assert "log.npz: expected a stretch of at least 32 samples that no sensor lacks, got one of 19" in refused.err


def test_a_report_is_replaced_with_force_only(run: Run, log: Path):
    Path("r.html").write_text("mine")
    rank = ("rank", log, "--candidates", "WN", "--report", "r.html")
    refused = run(*rank)
    assert (refused.status, refused.out) == (2, "")
    assert "r.html: exists already" in refused.err
    assert Path("r.html").read_text() == "mine"
    assert run(*rank, "--force").status == 0
    assert Path("r.html").read_text().startswith("<!DOCTYPE html>")
