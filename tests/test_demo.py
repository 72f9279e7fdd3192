"""The demonstration: its array is the published one, its numbers are right, its files are there."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch

import gyrofuse as gf
from gyrofuse import cli
from gyrofuse.demo import FILES, demo_array, run_demo

FIGURES = ["long.png", "short.png", "truth.png"]


@pytest.fixture(scope="module")
def settings(shared: Path) -> dict:
    return json.loads((shared / "reference" / "paper_settings.json").read_text())["svo"]


def test_array_is_the_published_one(settings: dict):
    (white, *slow), matrices = zip(*demo_array().components, strict=True)
    assert white.params.item() == 1
    assert [(process.phi, process.variance) for process in slow] == [(phi, 1.0) for phi in settings["phi"]]
    for matrix, name in zip(matrices, ("R", "P1", "P2", "P3"), strict=True):
        torch.testing.assert_close(matrix, torch.tensor(settings[name], dtype=torch.float64), rtol=1e-12, atol=0)


@pytest.mark.parametrize("scales", ["long", "short"])
def test_true_weights_are_the_published_ones(settings: dict, scales: str):
    truth = demo_array().wavelet_cross_covariance(19)
    weights = gf.svo_weights(truth, settings[f"scale_weights_{scales}"])
    expected = torch.tensor(settings["true_weights"][f"case2_{scales}"], dtype=torch.float64)
    torch.testing.assert_close(weights, expected, rtol=0, atol=1e-9)
    virtual = torch.einsum("i,jik,k->j", weights, truth, weights)
    published = torch.tensor(settings["true_wavelet_variance_of_virtual"][f"case2_{scales}"], dtype=torch.float64)
    torch.testing.assert_close(virtual, published, rtol=1e-6, atol=0)


def test_story_and_files(tmp_path: Path):
    story = run_demo(tmp_path, n_samples=2**15)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(FILES)
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == FIGURES
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["n_samples"] == 2**15
    array = demo_array()
    truth = array.wavelet_cross_covariance(15)
    best = gf.svo_weights(truth, "long")
    rows = re.findall(r"^ +(\d)  +([-+][\d.]+)  \[ *([-+][\d.]+), ([-+][\d.]+)\]  +([-+][\d.]+)$", story, re.MULTILINE)
    numbers = torch.tensor([[float(value) for value in row[1:]] for row in rows], dtype=torch.float64)
    expected = [result["weights"], *result["confidence_interval"].values(), best.tolist()]
    torch.testing.assert_close(numbers.T, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=6e-5)
    weights = torch.tensor(result["weights"], dtype=torch.float64)
    gain = (torch.einsum("i,jik,k->j", weights, truth, weights) / truth.mean((-1, -2))).sqrt()
    *_, in_truth, _ = next(line for line in story.splitlines() if line.startswith("         0.1")).split()
    assert float(in_truth) == pytest.approx(gain[0].item(), rel=1e-3)
    held = int(((numbers[:, 1] <= best) & (best <= numbers[:, 2])).sum())
    assert f"the intervals hold {held} of 6" in " ".join(story.split())
    report = (tmp_path / "report.html").read_text()
    assert "The array is simulated" in report


def test_command_writes_its_folder_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "run_demo", lambda folder: run_demo(folder, n_samples=2**12))

    def status(*options: str) -> int | str | None:
        with pytest.raises(SystemExit) as ended:
            cli.main(["demo", *options])
        return ended.value.code

    assert status("--json", "copy.json", "--report", "copy.html") in (0, None)
    assert "Report: gyrofuse-demo/report.html" in capsys.readouterr().out
    assert Path("copy.json").read_bytes() == Path("gyrofuse-demo/result.json").read_bytes()
    assert Path("copy.html").read_bytes() == Path("gyrofuse-demo/report.html").read_bytes()
    Path("gyrofuse-demo/result.json").write_text("mine")
    assert status() == 2
    assert Path("gyrofuse-demo/result.json").read_text() == "mine"
    assert "gyrofuse-demo: exists already" in capsys.readouterr().err
    assert status("--force") in (0, None)
    assert Path("gyrofuse-demo/result.json").read_bytes() == Path("copy.json").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy.html", "copy.json", "gyrofuse-demo"]


def test_a_failure_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(folder: Path) -> str:
        (folder / "report.html").write_text("half")
        raise ValueError("no ink")

    monkeypatch.setattr(cli, "run_demo", fail)
    with pytest.raises(SystemExit):
        cli.main(["demo", "--out", str(tmp_path / "out"), "--json", str(tmp_path / "copy.json")])
    assert list(tmp_path.iterdir()) == []
