"""`gyrofuse rank` from the outside."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from conftest import Run

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
    done = run("rank", log, "--candidates", "WN, RW ,WN+RW", "--json", "r.json", "--figure", "f.png")
    assert (done.status, done.err) == (0, "")
    result = gf.rank_models(gf.read_recording(log), ["WN", "RW", "WN + RW"])
    assert result.names == ("WN", "WN + RW")
    assert str(result) in done.out
    assert all(str(fit) in done.out for fit in result.best)
    assert json.loads(Path("r.json").read_text()) == result.to_dict()
    assert Path("f.png").read_bytes().startswith(b"\x89PNG")


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
    ],
)
def test_refuses(run: Run, log: Path, options: tuple[str, ...], says: str):
    done = run("rank", log, *options)
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("error: ")
    assert done.err.count("\n") == 1
    assert says in done.err
