"""The demonstration: its array is the published one, its numbers are right, its files are there."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from pages import Page
from reference import published

import gyrofuse as gf
from gyrofuse.cli import app as cli
from gyrofuse.cli.demo import demo
from gyrofuse.cli.demo.demo import FILES, demo_array, run_demo
from gyrofuse.cli.demo.models import models_story, true_models

FIGURES = ["long.png", "models.png", "short.png", "truth.png"]
N_LEVELS = 12


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a short demonstration, and its story."""
    folder = tmp_path_factory.mktemp("demo")
    return folder, run_demo(folder, n_samples=2**N_LEVELS)


@pytest.fixture
def settings() -> dict:
    return published.table("zhang")


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


def test_story_and_files(ran: tuple[Path, str]):
    folder, story = ran
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    assert sorted(path.name for path in (folder / "figures").iterdir()) == FIGURES
    result = json.loads((folder / "result.json").read_text())
    assert result["n_samples"] == 2**N_LEVELS
    array = demo_array()
    truth = array.wavelet_cross_covariance(N_LEVELS)
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
    report = (folder / "report.html").read_text()
    assert "The array is simulated" in report
    least = f"Allan deviation up to {100 * (1 - gain.min().item()):.0f} % lower than that of their mean"
    assert least in report
    mismatch = json.loads((folder / "mismatch.json").read_text())
    short = " ".join(story[story.index("In short:") :].split())
    assert least in short
    names = [finding["mechanism"].replace("_", " ") for finding in mismatch["findings"]]
    if names:
        assert f"Found: {', '.join(names)}. " in short
        assert f"{mismatch['held_out']['before']:.3g} -> {mismatch['held_out']['after']:.3g}" in short
    else:
        assert "Nothing found" in short or "could not be named" in short
    models = json.loads((folder / "models.json").read_text())
    rows = re.findall(r"^ *(\d|virtual)  (WN[^ ]*(?: \+ [^ ]+)*) +([-\d.].*)$", story, re.MULTILINE)
    assert [row[0] for row in rows] == [*"123456", "virtual"]
    assert [row[1] for row in rows] == models["names"]
    for row, fit, truth in zip(rows, models["best"], true_models(array, weights), strict=True):
        walk, true_walk, *_ = row[2].split()
        white = fit["params"][0][fit["param_names"].index("white_noise.variance")]
        assert float(walk) == pytest.approx(60 * (white / 10) ** 0.5, rel=1e-3)  # deg/sqrt(h) at 10 Hz
        assert float(true_walk) == pytest.approx(60 * (truth.params[0].item() / 10) ** 0.5, rel=1e-3)
    page = Page((folder / "models.html").read_text())
    assert [row[0] for row in page.rows if row[-1] == "chosen"] == models["names"]
    assert "Sensor virtual" in page.text


def test_models_of_the_truth():
    array = demo_array()
    weights = torch.tensor([0.3, -0.1, 0.2, 0.4, 0.1, 0.1], dtype=torch.float64)
    *each, virtual = true_models(array, weights)
    truth = array.wavelet_cross_covariance(12)
    own = torch.stack([model.wavelet_variance(12) for model in each], -1)
    torch.testing.assert_close(own, truth.diagonal(dim1=-2, dim2=-1), rtol=1e-10, atol=0)
    fused = torch.einsum("i,jik,k->j", weights, truth, weights)
    torch.testing.assert_close(virtual.wavelet_variance(12), fused, rtol=1e-10, atol=0)


def test_a_fit_that_did_not_end_has_no_test():
    truths = [gf.WhiteNoise(1e-4) + gf.AR1(0.99, 1e-6)] * 2
    generator = torch.Generator().manual_seed(0)
    signal = torch.stack([truth.simulate(4096, generator=generator) for truth in truths])
    result = gf.rank_models(gf.Recording(signal, rate=10.0, unit="deg/s"), ["WN", "WN + AR1"])
    story = models_story(result, truths)
    assert "2 of 2 are found as that" in " ".join(story.split())
    assert "The J test refuses none of them." in story
    bad, good = result.best
    bad = replace(bad, converged=torch.tensor([False]))
    story = models_story(replace(result, best=(bad, good)), truths)
    assert "It says nothing of 1, whose wavelet moments were not fitted to the end." in " ".join(story.split())
    assert next(line for line in story.splitlines() if line.startswith("      1")).endswith(" -")
    bad = replace(bad, converged=torch.tensor([True]), p_value=torch.tensor([1e-5]))
    story = models_story(replace(result, best=(bad, good)), truths)
    assert "The J test refuses the model of 1." in " ".join(story.split())


def test_command_writes_its_folder_once(
    ran: tuple[Path, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    blank_images: None,
):
    monkeypatch.chdir(tmp_path)

    def ran_before(folder: Path) -> str:
        shutil.copytree(ran[0], folder, dirs_exist_ok=True)
        return ran[1]

    monkeypatch.setattr(demo, "run_demo", ran_before)

    def status(*options: str) -> int | str | None:
        with pytest.raises(SystemExit) as ended:
            cli.main(["demo", *options])
        return ended.value.code

    assert status("--json", "copy.json", "--report", "copy.html") in (0, None)
    out = capsys.readouterr().out
    assert "Report: gyrofuse-demo/report.html" in out
    assert "Noise models: gyrofuse-demo/models.html" in out
    assert Path("copy.json").read_bytes() == Path("gyrofuse-demo/result.json").read_bytes()
    assert Path("copy.html").read_bytes() == Path("gyrofuse-demo/report.html").read_bytes()
    Path("gyrofuse-demo/result.json").write_text("mine")
    assert status() == 2
    assert Path("gyrofuse-demo/result.json").read_text() == "mine"
    assert "gyrofuse-demo: exists already" in capsys.readouterr().err
    monkeypatch.setattr(demo, "run_demo", lambda folder: run_demo(folder, n_samples=2**N_LEVELS))  # it repeats itself
    assert status("--force") in (0, None)
    assert Path("gyrofuse-demo/result.json").read_bytes() == Path("copy.json").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy.html", "copy.json", "gyrofuse-demo"]


def test_a_failure_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(folder: Path) -> str:
        (folder / "report.html").write_text("half")
        raise ValueError("no ink")

    monkeypatch.setattr(demo, "run_demo", fail)
    with pytest.raises(SystemExit):
        cli.main(["demo", "--out", str(tmp_path / "out"), "--json", str(tmp_path / "copy.json")])
    assert list(tmp_path.iterdir()) == []
