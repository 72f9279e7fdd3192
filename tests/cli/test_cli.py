"""The command line from the outside: what it prints, what it writes, and how it refuses."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Outcome, Run
from pages import Page

import gyrofuse as gf
from gyrofuse.cli import app as cli
from gyrofuse.cli import fuse
from gyrofuse.cli.simulate import save_recording

ROOT = Path(__file__).resolve().parents[2]


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.npz"
    signal = torch.tensor([[1.0], [2.0], [1.5]], dtype=torch.float64) * noise(3, 2000)
    gf.Recording(signal, rate=100.0, unit="deg/s", sensors=("a", "b", "c")).save(path)
    return path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def refused(outcome: Outcome, says: str) -> None:
    """Status 2, one line on stderr, and nothing on stdout."""
    assert outcome.status == 2
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1
    assert outcome.err.startswith("error: ")
    assert says in outcome.err


# What it does


def test_fuse_prints_the_summary_and_writes_what_is_asked_for(run: Run, log: Path):
    done = run(
        "fuse",
        log,
        "--scale-weights",
        "long",
        "--out",
        "v.npz",
        "--figure",
        "f.svg",
        "--json",
        "r.json",
        "--report",
        "r.html",
    )
    recording = gf.read_recording(log)
    result = gf.fit_svo(recording, "long")
    assert done == Outcome(0, done.out, "")
    assert done.out.startswith(result.summary())
    fused = gf.read_recording("v.npz")
    torch.testing.assert_close(fused.signal, result.virtual(recording)[None], rtol=0, atol=0)
    assert (fused.rate, fused.unit, fused.sensors) == (100.0, "deg/s", ("virtual",))
    np.testing.assert_array_equal(np.load("v.npz")["weights"], result.weights.numpy())
    assert json.loads(Path("r.json").read_text()) == result.to_dict()
    assert Path("f.svg").read_text().startswith("<?xml")
    assert "Virtual gyro of log.npz" in Path("r.html").read_text()
    assert sorted(path.name for path in Path().iterdir()) == ["f.svg", "log.npz", "r.html", "r.json", "v.npz"]


def test_fuse_with_weights_for_every_band(run: Run, log: Path):
    outputs = {"--out": "v.npz", "--figure": "f.svg", "--json": "r.json", "--report": "r.html"}
    words = [word for pair in outputs.items() for word in pair]
    done = run("fuse", log, "--method", "multiscale", "--scale-weights", "long", "--rest", "0:15", *words)
    recording = gf.read_recording(log)
    result = gf.fit_multiscale(recording.between(0, 15), "long")
    assert done == Outcome(0, done.out, "")
    assert done.out.startswith(result.summary())
    fused = gf.read_recording("v.npz")
    torch.testing.assert_close(fused.signal, result.virtual(recording)[None], rtol=0, atol=0)
    np.testing.assert_array_equal(np.load("v.npz")["weights"], result.weights.numpy())
    known = json.loads(Path("r.json").read_text())
    assert known == result.to_dict()
    page = Path("r.html").read_text()
    for text in ("Virtual gyro of log.npz", "Multi-scale virtual gyro", "Weights from 0 to 15 s of 20 s"):
        assert text in page
    for value in (weight for band in known["weights"] for weight in band):
        assert f"<td>{value:+.4f}</td>" in page
    for name in ("virtual", "equal", "optimal", "single"):
        for value in known[f"{name}_wavelet_variance"]:
            assert f"<td>{value:.3e}</td>" in page
    assert {path.name for path in Path().iterdir()} == {"log.npz", *outputs.values()}


def test_suffixes_may_be_upper_case(run: Run, log: Path):
    plain, upper = ["v.npz", "f.png", "r.json", "r.html"], ["V.NPZ", "F.PNG", "S.JSON", "S.HTML"]
    for names in (plain, upper):
        words = [word for pair in zip(("--out", "--figure", "--json", "--report"), names, strict=True) for word in pair]
        assert run("fuse", log, *words).status == 0
    assert {path.name for path in Path().iterdir()} == {"log.npz", *plain, *upper}
    assert Path("F.PNG").read_bytes().startswith(b"\x89PNG")
    assert torch.equal(gf.read_recording("V.NPZ").signal, gf.read_recording("v.npz").signal)
    assert run("fuse", log, "--out", "V.CSV").status == 0
    assert Path("V.CSV").read_text().startswith("time [s],")


def test_fuse_writes_text_that_is_read_back(run: Run, log: Path):
    assert run("fuse", log, "--out", "v.csv").status == 0
    lines = Path("v.csv").read_text().splitlines()
    assert lines[0] == "time [s],virtual_gyro [deg/s]"
    fused, recording = gf.read_recording("v.csv"), gf.read_recording(log)
    torch.testing.assert_close(fused.signal, gf.fit_svo(recording).virtual(recording)[None], rtol=0, atol=0)
    assert fused.unit == "deg/s"
    assert fused.rate == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("options", "arguments"),
    [
        ([], {}),
        (["--scale-weights", "short"], {"scale_weights": "short"}),
        (["--scale-weights", "1,0,3"], {"scale_weights": [1.0, 0.0, 3.0]}),
        (["--method", "inverse-variance", "--levels", "4"], {"method": "inverse_variance", "n_levels": 4}),
        (["--method", "equal", "--confidence-level", "0.5"], {"method": "equal", "confidence_level": 0.5}),
    ],
)
def test_options_reach_the_fit(run: Run, log: Path, options: list[str], arguments: dict[str, object]):
    assert gf.fit_svo(gf.read_recording(log), **arguments).summary() in run("fuse", log, *options).out


def test_weights_of_a_stretch_at_rest_fuse_everything(run: Run, tmp_path: Path):
    signal = torch.tensor([[1.0], [2.0], [1.5]], dtype=torch.float64) * noise(3, 2000)
    signal[:, 1000:] += 50 * torch.sin(torch.arange(1000, dtype=torch.float64) / 20)  # the array is moved
    recording = gf.Recording(signal, rate=100.0, unit="deg/s")
    recording.save(tmp_path / "moved.npz")
    assert "seems to have moved" in run("fuse", "moved.npz").out
    done = run("fuse", "moved.npz", "--rest", "0:10", "--out", "virtual.npz")
    assert done.status == 0
    assert "seems to have moved" not in done.out
    with np.load(tmp_path / "virtual.npz") as written:
        expected = gf.fit_svo(signal[:, :1000])
        np.testing.assert_allclose(written["weights"], expected.weights, rtol=1e-9)
        np.testing.assert_allclose(written["gyro"][0], expected.virtual(signal), rtol=1e-9)


def test_reading_options_reach_the_reader(run: Run, tmp_path: Path):
    counts = (1000 * noise(4, 500)).round().numpy()
    np.savez(tmp_path / "counts.npz", rates=counts, sensors=["1", "2", "3", "4"], acceleration=counts[:3])
    options = ("--rate", "50", "--unit", "rad/s", "--scale", "0.001", "--key", "rates", "--sensors", "3,1")
    done = run("info", "counts.npz", *options, "--json", "i.json")
    assert done.status == 0
    known = json.loads(Path("i.json").read_text())
    assert (known["rate"], known["unit"], known["sensors"]) == (50.0, "rad/s", ["3", "1"])
    np.testing.assert_allclose(known["mean"], 0.001 * counts[[2, 0]].mean(1))


def test_three_axes(run: Run, tmp_path: Path):
    gf.Recording(noise(3, 4, 1000), rate=100.0, axes=("x", "y", "z")).save(tmp_path / "three.npz")
    done = run("fuse", "three.npz", "--out", "v.npz", "--figure", "f.png", "--report", "r.html")
    result = gf.fit_svo(gf.read_recording("three.npz"))
    assert done.out.startswith(result.summary())
    fused = gf.read_recording("v.npz")
    assert (fused.axes, fused.sensors) == (("x", "y", "z"), ("virtual",))
    torch.testing.assert_close(fused.signal[:, 0], result.virtual(gf.read_recording("three.npz")), rtol=0, atol=0)
    one = run("fuse", "three.npz", "--axis", "y", "--out", "y.csv")
    assert one.out.startswith(result[1].summary().splitlines()[0])
    torch.testing.assert_close(gf.read_recording("y.csv").signal, fused.signal[1], rtol=0, atol=1e-12)


def test_axes_of_one_device_are_no_array(run: Run, tmp_path: Path):
    np.savez(tmp_path / "imu.npz", imu_gyr=noise(3, 500).numpy(), fs=100.0)
    done = run("fuse", "imu.npz")
    assert done.status == 2
    assert done.err == (
        "error: imu.npz: expected several devices to fuse, found one with the axes x, y, z; give the logs of all "
        "devices of the array\n"
    )


def test_info_shows_what_is_in_the_log(run: Run, tmp_path: Path):
    signal = noise(2, 400) + 3.0
    signal[1, 100:200] = math.nan
    sensors = ("[bold]x[/bold]", "a name that is far longer than eighty columns " * 3)
    recording = gf.Recording(signal, rate=50.0, unit="deg/s", sensors=sensors, channels={"temperature": noise(400)})
    recording.save(tmp_path / "log.npz")
    done = run("info", "log.npz", "--json", "i.json", "--report", "i.html")
    assert (done.status, done.err) == (0, "")
    lines = [line.strip() for line in done.out.splitlines()]
    for fact in (("rate", "50 Hz"), ("samples", "400"), ("duration", "8 s"), ("unit", "deg/s"), ("source", "log.npz")):
        assert any(line.split(None, 1) == list(fact) for line in lines)
    for i, name in enumerate(sensors):
        (line,) = (line for line in lines if line.startswith(name.strip()))
        assert ("0 %", "25 %")[i] in line
        assert f"{signal[i].nanmean().item():.4g}" in line
    assert any(line.split() == ["temperature", "400"] for line in lines)
    read = gf.read_recording("log.npz")
    for note in read.notes:
        assert note.sentence in done.out
    assert json.loads(Path("i.json").read_text()) == read.to_dict()
    assert "[bold]x[/bold]" in Path("i.html").read_text()


def test_info_of_a_log_without_any_sample(run: Run, tmp_path: Path):
    signal = noise(3, 100)
    signal[1] = math.nan
    for name in ("some.npz", "none.npz"):
        gf.Recording(signal, rate=50.0).save(tmp_path / name)
        done = run("info", name, "--json", f"{name}.json", "--report", f"{name}.html")
        assert (done.status, done.err) == (0, "")
        assert "100 %" in done.out
        assert json.loads(Path(f"{name}.json").read_text())["mean"][1] is None
        signal[:] = math.nan


def test_what_names_hold_does_not_steer_the_terminal(run: Run, tmp_path: Path):
    gf.Recording(noise(2, 100), rate=50.0, sensors=("\x1b[31mred", "b\x07")).save(tmp_path / "log.npz")
    for command in ("info", "fuse"):
        done = run(command, "log.npz")
        assert done.status == 0
        assert "?[31mred" in done.out
        assert "\x1b" not in done.out
        assert "\x07" not in done.out


def test_fit_prints_the_parameters_and_writes_what_is_asked_for(run: Run, log: Path):
    done = run(
        "fit",
        log,
        "--model",
        "WN",
        "--json",
        "r.json",
        "--model-out",
        "m.json",
        "--figure",
        "f.SVG",
        "--report",
        "r.html",
        "--confidence-level",
        0.9,
    )
    assert done.status == 0
    result = gf.fit_gmwm(gf.read_recording(log), "WN", confidence_level=0.9)
    assert str(result) in done.out
    assert json.loads(Path("r.json").read_text())["params"] == result.to_dict()["params"]
    assert b"<svg" in Path("f.SVG").read_bytes()
    page = Page(Path("r.html").read_text())
    assert "Noise of log.npz" in page.text
    assert page.tags.count("img") == 3
    assert "90 % interval" in page.text
    again = run("simulate", "m.json", "--samples", 100, "--rate", 100, "--out", "s.npz")
    assert again.status == 0
    assert gf.read_recording("s.npz").signal.shape == (3, 100)


def test_fit_lists_its_files_and_simulate_reads_what_it_wrote(run: Run, log: Path):
    fitted = run("fit", log, "--model", "WN", "--json", "f.json", "--figure", "f.png")
    assert "Written: f.png, f.json" in fitted.out
    again = run("simulate", "f.json", "--samples", 100, "--rate", 100, "--out", "s.npz")
    assert again.status == 0
    assert again.out.count("WhiteNoise(variance=") == 3
    assert "<batch" not in again.out
    assert gf.read_recording("s.npz").signal.shape == (3, 100)
    refused(
        run("simulate", "f.json", "--samples", 9, "--out", "t.npz", "--sensors", 5),
        "f.json is a model of 3 sensors; leave the option out",
    )


@pytest.mark.parametrize("option", ["--json", "--model-out"])
def test_a_model_knows_rate_and_unit_of_its_log(run: Run, log: Path, tmp_path: Path, option: str):
    gf.Recording(gf.read_recording(log).signal, rate=80.0, unit="rad/s").save(tmp_path / "radians.npz")
    assert run("fit", "radians.npz", "--model", "WN", option, "f.json").status == 0
    assert run("simulate", "f.json", "--samples", 100, "--out", "s.npz").status == 0
    again = gf.read_recording("s.npz")
    assert again.unit == "rad/s"
    assert again.rate == pytest.approx(80.0)
    assert run("simulate", "f.json", "--samples", 9, "--rate", 80, "--unit", "rad/s", "--out", "t.npz").status == 0
    for wrong, says in ((("--rate", 7), "expected 80 Hz"), (("--unit", "deg/s"), "expected rad/s")):
        refused(run("simulate", "f.json", "--samples", 9, *wrong, "--out", "u.npz"), says)
    refused(run("simulate", "WN(variance=1)", "--samples", 9, "--out", "u.npz"), "`--rate`: expected the sampling rate")


@pytest.mark.filterwarnings("ignore:`signal`. expected wavelet variances")
def test_one_dead_sensor_leaves_the_others_their_figure(run: Run, log: Path, tmp_path: Path):
    signal = gf.read_recording(log).signal.clone()
    signal[0] = 1.0
    gf.Recording(signal, rate=100.0, unit="deg/s").save(tmp_path / "dead.npz")
    assert run("fit", "dead.npz", "--model", "WN", "--figure", "f.png").status == 0
    assert Path("f.png").stat().st_size > 5000
    refused(run("fit", "dead.npz", "--model", "WN", "--model-out", "m.json"), "sensors that could all be fitted")


def test_a_stretch_beyond_the_log_and_a_strange_unit_are_told(run: Run, log: Path, tmp_path: Path):
    told = run("fit", log, "--model", "WN", "--rest", "0:1e9")
    assert told.status == 0
    assert "`--rest`: expected a stretch within 0 to" in told.err
    assert "`--rest`" not in run("fit", log, "--model", "WN", "--rest", "0:15").err
    signal = gf.read_recording(log).signal
    gf.Recording(signal, rate=50.0, unit="furlong").save(tmp_path / "strange.npz")
    fit = ("fit", "strange.npz", "--model", "WN")
    refused(run(*fit), "strange.npz: expected one of the units deg/s")
    refused(run(*fit), "found 'furlong' in 1; give one with unit= (--unit)")
    assert run(*fit, "--unit", "deg/s", "--scale", 1).status == 0
    refused(run(*fit, "--unit", "furlong"), "`--unit`: expected one of deg/s")
    rows = "".join(f"{k / 100},{k % 3}\n" for k in range(99))
    (tmp_path / "strange.csv").write_text(f"time,gyro_x [bananas]\n{rows}")
    refused(run("info", "strange.csv"), "found 'bananas'")
    (tmp_path / "m.json").write_text(json.dumps({**gf.WhiteNoise(1.0).to_dict(), "rate": 50.0, "unit": "furlong"}))
    simulate = ("simulate", "m.json", "--samples", 9, "--out", "o.npz")
    refused(run(*simulate), "m.json: expected 'unit' to be one of deg/s")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("fuse", "tiny.npz"), "tiny.npz: expected at least as many complete windows as sensors (3)"),
        (("fit", "tiny.npz", "--model", "WN + 3*AR1"), "tiny.npz: `model`: expected at most as many parameters"),
        (("rank", "tiny.npz"), "tiny.npz: expected at least 32 samples, got 3"),
        (("fuse", "log.npz", "--sensors", "q"), "log.npz: `sensors`: expected some of 'a', 'b', 'c', got 'q'"),
        (("fuse", "log.npz", "--levels", 99), "log.npz: `n_levels`: expected at most"),
        (("rank", "log.npz", "--rest", "1e8:1e9"), "log.npz: `start`, `stop`: expected a stretch within 0 to"),
    ],
)
def test_errors_name_the_log(run: Run, log: Path, tmp_path: Path, arguments: tuple[object, ...], says: str):
    gf.Recording(gf.read_recording(log).signal[:, :3], rate=50.0, unit="deg/s").save(tmp_path / "tiny.npz")
    refused(run(*arguments), says)


def test_kalibr_has_a_longest_correlation_time_of_white_noise(run: Run, log: Path):
    fit = ("fit", log, "--model", "WN + AR1", "--sensors", "b")
    assert run(*fit, "--kalibr", "k.yaml", "--kalibr-slow", 7.5).status == 0
    assert "correlation time of 7.5 s or more" in Path("k.yaml").read_text()


def test_fit_writes_kalibr_of_one_sensor(run: Run, log: Path):
    assert run("fit", log, "--model", "WN", "--sensors", "b", "--kalibr", "imu.yaml").status == 0
    assert "gyroscope_noise_density: " in Path("imu.yaml").read_text()
    refused(run("fit", log, "--model", "WN", "--kalibr", "all.yaml"), "expected one device, got a, b, c")
    assert not Path("all.yaml").exists()


def test_fit_writes_a_header_of_one_sensor(run: Run, log: Path):
    assert run("fit", log, "--model", "WN", "--sensors", "b", "--header", "noise.h").status == 0
    one = gf.fit_gmwm(gf.read_recording(log, sensors=["b"]), "WN")
    assert Path("noise.h").read_text() == gf.to_c_header(one.model.with_params(one.params[0]), 100.0, "deg/s")
    refused(run("fit", log, "--model", "WN", "--header", "all.h"), "`--header`: expected one sensor and axis, got 3")
    assert not Path("all.h").exists()


@pytest.mark.parametrize(
    ("options", "arguments", "says"),
    [
        (("--refine",), {"refine": True}, "From there the spectral (Whittle) likelihood was maximised."),
        (("--robust", 0.6), {"efficiency": 0.6}, "Wavelet variances are robust, of efficiency 0.6:"),
        (("--weighting", "diagonal"), {"weighting": "diagonal"}, "by the reciprocals of their variances"),
        (("--weighting", "identity", "--levels", 4), {"weighting": "identity", "n_levels": 4}, "all levels weighted"),
    ],
)
def test_options_reach_the_noise_fit(
    run: Run, log: Path, options: tuple[object, ...], arguments: dict[str, object], says: str
):
    done = run("fit", log, "--model", "WN", *options, "--report", "r.html")
    assert (done.status, done.err) == (0, "")
    assert str(gf.fit_gmwm(gf.read_recording(log), "WN", **arguments)) in done.out
    assert says in Page(Path("r.html").read_text()).text


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--model", "WN + FOO"), "unknown process 'FOO'"),
        (("--model", "WN + 5*AR1"), "at most as many parameters as"),
        (("--model", "WN(variance=1)"), "expected parameters to be estimated"),
        (("--model", "WN", "--kalibr", "imu.txt"), "`--kalibr`: expected a name that ends in .yaml or .yml"),
        (("--model", "WN", "--header", "noise.c"), "`--header`: expected a name that ends in .h"),
        (("--model", "WN", "--report", "r.pdf"), "`--report`: expected a name that ends in .html"),
        (("--model", "WN", "--report", "nowhere/r.html"), "the folder nowhere does not exist"),
        (("--model", "WN", "--refine", "--robust", "0.6"), "leave out --refine or --robust"),
        (("--model", "WN", "--robust", "0.3"), "expected 0.5 to 1, got 0.3"),
        (("--model", "WN + SIN", "--robust", "0.6"), "SIN"),
        (
            ("--model", "WN", "--unit", "banana"),
            "`--unit`: expected one of deg/s, mdeg/s, deg/h, rad/s, mrad/s, rpm, m/s^2, g, mg, ug, counts",
        ),
        (("--model", "WN", "--weighting", "equal"), "'equal' is not one of 'optimal', 'diagonal', 'identity'"),
    ],
)
def test_fit_refuses(run: Run, log: Path, tmp_path: Path, options: tuple[str, ...], says: str):
    before = contents(tmp_path)
    refused(run("fit", log, *options), says)
    assert contents(tmp_path) == before


def test_units_that_the_log_does_not_state(run: Run):
    signal = torch.randn(1, 500, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    gf.Recording(signal, rate=100.0).save("bare.npz")
    fit = ("fit", "bare.npz", "--model", "WN")
    refused(run(*fit, "--header", "n.h"), "where the log does not say, give its unit with --unit")
    assert "angle random walk" not in run(*fit).out
    for word, unit in (("dps", "deg/s"), ("rad/s", "rad/s")):  # what it says to do
        done = run(*fit, "--unit", word, "--header", "n.h", "--force")
        assert done.status == 0
        assert "angle random walk N" in done.out
        assert f"in {unit}" in Path("n.h").read_text()
    for unit in ("m/s^2", "g"):
        done = run(*fit, "--unit", unit, "--header", "n.h", "--force")
        assert done.status == 0
        assert "velocity random walk N" in done.out
        assert "angle random walk" not in done.out
        assert f"Noise of an accelerometer in {unit}" in Path("n.h").read_text()
        refused(run(*fit, "--unit", unit, "--kalibr", "k.yaml"), f"got unit '{unit}'; where the log does not say")
    done = run(*fit, "--unit", "counts")
    assert done.status == 0
    assert "random walk" not in done.out
    refused(run(*fit, "--unit", "counts", "--header", "other.h"), "got unit 'counts'; where the log does not say")
    done = run(*fit, "--unit", "deg/s", "--scale", 0.001, "--header", "other.h")  # and of counts
    assert done.status == 0
    simulate = ("simulate", "WN(variance=1)", "--samples", 100, "--rate", 10, "--out", "s.npz")
    refused(run(*simulate, "--unit", "furlong"), "`--unit`: expected one of deg/s")


def test_reports_of_fits_are_replaced_with_force_only(run: Run, log: Path):
    Path("r.html").write_text("mine")
    refused(run("fit", log, "--model", "WN", "--report", "r.html"), "r.html: exists already")
    assert Path("r.html").read_text() == "mine"
    assert run("fit", log, "--model", "WN", "--report", "r.html", "--force").status == 0
    assert Path("r.html").read_text().startswith("<!DOCTYPE html>")


def test_simulate_array_model(run: Run):
    model = gf.ArrayModel([(gf.WhiteNoise(1.0), [[2.0, 0.5], [0.5, 1.0]]), (gf.RandomWalk(1e-4), [1.0, 2.0])])
    Path("model.json").write_text(json.dumps(model.to_dict()))
    command = ("simulate", "model.json", "--samples", 500, "--rate", 20, "--seed", 7)
    done = run(*command, "--out", "a.npz", "--json", "s.json", "--report", "s.html")
    assert (done.status, done.err) == (0, "")
    recording = gf.read_recording("a.npz")
    expected = model.simulate(500, generator=torch.Generator().manual_seed(7))
    torch.testing.assert_close(recording.signal, expected, rtol=0, atol=0)
    assert (recording.rate, recording.unit) == (20.0, "deg/s")
    settings = json.loads(Path("s.json").read_text())
    assert (settings["seed"], settings["n_samples"], settings["model"]) == (7, 500, model.to_dict())
    run(*command, "--out", "a.csv")
    torch.testing.assert_close(gf.read_recording("a.csv").signal, expected, rtol=0, atol=0)


def test_simulate_sensors_of_one_model(run: Run):
    formula = "WN(variance=4) + RW(variance=1e-4)"
    assert (
        run(
            "simulate", formula, "--samples", 300, "--rate", 20, "--sensors", 3, "--unit", "rad/s", "--out", "a.npz"
        ).status
        == 0
    )
    recording = gf.read_recording("a.npz")
    assert (tuple(recording.signal.shape), recording.unit) == ((3, 300), "rad/s")
    Path("one.json").write_text(json.dumps(gf.WhiteNoise(1.0).to_dict()))
    done = run("simulate", "one.json", "--samples", 300, "--rate", 20, "--out", "b.npz")
    seed = int(
        done.out.split("seed ")[1].split(",")[0]
    )  # a random seed is told, so that the recording can be had again
    run("simulate", "one.json", "--samples", 300, "--rate", 20, "--out", "c.npz", "--seed", seed)
    assert Path("b.npz").read_bytes() == Path("c.npz").read_bytes()


def test_version_and_help(run: Run):
    assert run("--version") == Outcome(0, f"gyrofuse {gf.__version__}\n", "")
    for command in ("info", "fuse", "simulate", "demo"):
        text = run(command, "--help").out
        assert "--json" in text
        assert "--report" in text


def test_runs_as_a_module_and_loads_little():
    command = [sys.executable, "-X", "importtime", "-m", "gyrofuse", "--version"]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    assert done.stdout == f"gyrofuse {gf.__version__}\n"
    loaded = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "torch" in loaded
    assert not {"matplotlib", "jinja2", "torchmetrics"} & loaded


# How it refuses


def bad_logs(folder: Path) -> dict[str, Path]:
    good = folder / "good.npz"
    gf.Recording(noise(3, 200), rate=100.0).save(good)
    whole, signal = good.read_bytes(), noise(3, 200).numpy()
    good.unlink()
    dead, copied = signal.copy(), signal.copy()
    dead[1], copied[2] = 0.5, copied[0]
    junk = np.random.default_rng(0).bytes(3000)
    rows = "\n".join(",".join(f"{value:.6f}" for value in row) for row in signal.T)
    files = {
        "empty.npz": b"",
        "truncated.npz": whole[: len(whole) // 2],
        "junk.npz": junk,
        "empty.csv": b"",
        "truncated.csv": b"time,gx,gy,gz\n0.0,1",
        "junk.csv": junk,
        "text.npz": b"these are not numbers",
        "no_rate.csv": f"gyro1,gyro2,gyro3\n{rows}".encode(),
    }
    for name, content in files.items():
        (folder / name).write_bytes(content)
    arrays = {
        "one_sensor.npz": (signal[:1], 100.0),
        "one_sample.npz": (signal[:, :1], 100.0),
        "all_nan.npz": (np.full_like(signal, np.nan), 100.0),
        "dead.npz": (dead, 100.0),
        "copied.npz": (copied, 100.0),
        "negative_rate.npz": (signal, -100.0),
    }
    for name, (gyro, rate) in arrays.items():
        np.savez(folder / name, gyro=gyro, fs=rate)
    np.savez(folder / "no_rate.npz", gyro=signal)
    return {path.name: path for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("missing.npz", "missing.npz"),
        ("empty.npz", "empty.npz"),
        ("truncated.npz", "truncated.npz"),
        ("junk.npz", "junk.npz"),
        ("text.npz", "text.npz"),
        ("empty.csv", "empty.csv"),
        ("truncated.csv", "truncated.csv"),
        ("junk.csv", "junk.csv"),
        ("no_rate.csv", "--rate"),
        ("no_rate.npz", "--rate"),
        ("negative_rate.npz", "rate"),
        ("one_sensor.npz", "at least 2 sensors"),
        ("one_sample.npz", "at least 2 samples"),
        ("all_nan.npz", "no finite sample"),
        ("dead.npz", "never change"),
        ("copied.npz", "copies"),
    ],
)
def test_bad_logs_are_refused(run: Run, tmp_path: Path, name: str, says: str):
    bad_logs(tmp_path)
    before = contents(tmp_path)
    refused(run("fuse", name, "--out", "v.npz", "--figure", "f.png", "--json", "r.json", "--report", "r.html"), says)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--rest", "5"], "`--rest`: expected START:STOP in seconds"),
        (["--rest", "90:99"], "expected a stretch within 0 to 20 s, got 90 to 99 s"),
        (["--rate", "-100"], "`rate`"),
        (["--rate", "fast"], "--rate"),
        (["--scale-weights", "a,b"], "`--scale-weights`"),
        (["--scale-weights", "longish"], "`--scale-weights`"),
        (["--scale-weights", ""], "`--scale-weights`"),
        (["--scale-weights", "1,,2"], "`--scale-weights`"),
        (["--scale-weights", "1,-1"], "`scale_weights`"),
        (["--scale-weights", "0,0"], "`scale_weights`"),
        (["--scale-weights", "nan,1"], "`scale_weights`"),
        (["--scale-weights", ",".join("1" * 20)], "at most 10"),
        (["--scale-weights", "1,2,3", "--levels", "5"], "5 levels"),
        (["--levels", "0"], "`n_levels`"),
        (["--levels", "99"], "at most 10"),
        (["--confidence-level", "95"], "`confidence_level`"),
        (["--method", "magic"], "--method"),
        (["--sensors", "a,nobody"], "nobody"),
        (["--sensors", "a,b,a"], "expected each sensor once, got 'a' twice"),
        (["--method", "equal", "--covariance", "model"], "`--covariance`: model has no use"),
        (["--method", "nonnegative", "--covariance", "resampling"], "--method nonnegative gives no intervals"),
        (["--method", "rdvg", "--covariance", "block-bootstrap"], "leave the option out, or choose another method"),
        (["--axis", "q"], "'q'"),
        (["--mounting", "missing.json"], "missing.json"),
        (["--unknown"], "--unknown"),
        (["--out", "nowhere/v.npz"], "nowhere"),
        (["--out", "v.xlsx"], ".npz or .csv"),
        (["--figure", "f.bmp"], ".png"),
        (["--json", "r.txt"], ".json"),
        (["--report", "r.pdf"], ".html"),
        (["--json", "folder.json"], "something else"),
        (["--out", "log.npz", "--force"], "in use"),
        (["--report", "r.html", "--json", "taken.json"], "exists already"),
    ],
)
def test_bad_options_are_refused(run: Run, log: Path, tmp_path: Path, options: list[str], says: str):
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "taken.json").write_text("mine")
    before = contents(tmp_path)
    wanted = [] if "--figure" in options else ["--figure", "other.png"]
    refused(run("fuse", log, *options, *wanted), says)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--covariance", "model"], "--method multiscale gives no intervals of its weights"),
        (["--levels", "0"], "`n_levels`"),
        (["--levels", "99"], "at most 10"),
        (["--confidence-level", "95"], "`confidence_level`"),
        (["--scale-weights", "1,-1"], "`scale_weights`"),
        (["--sensors", "a"], "at least 2 sensors"),
        (["--report", "r.pdf"], ".html"),
        (["--report", "nowhere/r.html"], "nowhere"),
        (["--report", "taken.html"], "exists already"),
    ],
)
def test_bad_options_are_refused_for_bands(run: Run, log: Path, tmp_path: Path, options: list[str], says: str):
    (tmp_path / "taken.html").write_text("mine")
    before = contents(tmp_path)
    wanted = [] if "--report" in options else ["--report", "r.html"]
    refused(run("fuse", log, "--method", "multiscale", *options, *wanted), says)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("method", ["svo", "model-assisted", "multiscale"])
def test_methods_have_a_report(run: Run, tmp_path: Path, method: str):
    """One of a plain name, one of a name of two words and one of another class; the rest in tests/fusion."""
    wandering = noise(3, 1000) + 0.1 * noise(3, 1000, seed=1).cumsum(-1)
    gf.Recording(wandering, rate=100.0).save(tmp_path / "log.npz")
    done = run("fuse", "log.npz", "--method", method, "--covariance", "none", "--report", "r.html")
    assert (done.status, done.err) == (0, "")
    assert "How it was computed" in Path("r.html").read_text()


@pytest.mark.parametrize(
    ("model", "options", "says"),
    [
        ("missing.json", [], "missing.json"),
        ("junk.json", [], "junk.json"),
        ("list.json", [], "list.json"),
        ("other.json", [], "other.json"),
        ("nested.json", [], "lists within lists"),
        ("text.json", [], "expected 'processes' to be a list"),
        ("true.json", [], "expected 'rate' to be a number"),
        ("digits.json", [], "expected a number for variance"),
        ("WN(variance=-1)", [], "`variance`"),
        ("WN + RW", [], "to be estimated"),
        ("WN(variance=1", [], "`formula`"),
        ("WN(variance=1)", ["--samples", "0"], "--samples"),
        ("WN(variance=1)", ["--rate", "0"], "--rate"),
        ("WN(variance=1)", ["--sensors", "0"], "--sensors"),
        ("WN(variance=1)", ["--seed", "-1"], "--seed"),
        ("WN(variance=1)", ["--out", "a.txt"], ".npz or .csv"),
        ("array.json", ["--sensors", "2"], "--sensors"),
    ],
)
def test_bad_simulations_are_refused(run: Run, tmp_path: Path, model: str, options: list[str], says: str):
    (tmp_path / "junk.json").write_bytes(b"\xff\xfe{")
    (tmp_path / "list.json").write_text("[1, 2]")
    (tmp_path / "nested.json").write_text("[" * 100_000)
    (tmp_path / "text.json").write_text('{"processes": "WN"}')
    one = {"processes": [{"process": "white_noise", "variance": 1.0}]}
    (tmp_path / "true.json").write_text(json.dumps(one | {"rate": True}))
    (tmp_path / "digits.json").write_text(json.dumps(one).replace("1.0", "1" * 400))
    (tmp_path / "other.json").write_text('{"processes": [{"process": "Magic"}]}')
    array = gf.ArrayModel([(gf.WhiteNoise(1.0), [1.0, 2.0])])
    (tmp_path / "array.json").write_text(json.dumps(array.to_dict()))
    before = contents(tmp_path)
    refused(run("simulate", model, "--samples", 100, "--rate", 10, "--out", "a.npz", *options), says)
    assert contents(tmp_path) == before


def test_an_absurd_number_of_levels_is_refused(run: Run, log: Path):
    refused(run("fuse", log, "--levels", "1" + "0" * 30), "`n_levels`: expected at most")


def test_names_that_came_with_a_log_stay_cells_of_one_line(tmp_path: Path):
    """A unit or name with a comma, a line end or a formula: the file can be read back, and no cell is a formula."""
    unit = "x]\n=cmd|' /C calc'!A0,1"
    recording = gf.Recording(noise(3, 400), rate=100.0, unit=unit, sensors=("=a", "b,c", "d"))
    save_recording(recording, tmp_path / "o.csv")
    lines = (tmp_path / "o.csv").read_text().splitlines()
    assert len(lines) == 401
    assert not any(line.startswith(("=", "+", "-", "@")) for line in lines)
    assert gf.read_recording(tmp_path / "o.csv", unit="deg/s", scale=1.0).n_samples == 400


def test_a_page_of_a_file_whose_name_is_no_text(run: Run, tmp_path: Path):
    gf.Recording(noise(3, 400), rate=100.0).save(tmp_path / "log.npz")
    (tmp_path / "log.npz").rename(tmp_path / "b\udcff.npz")
    done = run("fuse", "b\udcff.npz", "--report", "o.html", "--covariance", "none")
    assert (done.status, done.err) == (0, "")
    assert "b\\udcff.npz" in (tmp_path / "o.html").read_text()


def test_missing_arguments_are_refused(run: Run):
    refused(run("fuse"), "LOG")
    refused(run("simulate", "WN(variance=1)", "--rate", 10, "--out", "a.npz"), "--samples")
    refused(run("info", "log.npz", "--rate"), "--rate")
    refused(run("bake"), "bake")


# What becomes of files


def test_the_mounting_is_never_replaced(run: Run, log: Path, tmp_path: Path):
    mounting = tmp_path / "mounting.json"
    mounting.write_text("{}")
    refused(run("fuse", log, "--mounting", mounting, "--json", mounting, "--force"), "in use")
    assert mounting.read_text() == "{}"


def test_existing_files_stay_without_force_and_are_replaced_with_it(run: Run, log: Path):
    names = {"--out": "v.npz", "--figure": "f.png", "--json": "r.json", "--report": "r.html"}
    for option, name in names.items():
        Path(name).write_bytes(b"mine")
        refused(run("fuse", log, option, name), f"{name}: exists already")
        assert Path(name).read_bytes() == b"mine"
    outputs = [word for pair in names.items() for word in pair]
    assert run("fuse", log, *outputs, "--force").status == 0
    assert all(Path(name).read_bytes() != b"mine" for name in names.values())
    assert {path.name for path in Path().iterdir()} == {"log.npz", *names.values()}


@pytest.mark.parametrize("method", ["svo", "multiscale"])
def test_a_late_failure_leaves_nothing_behind(
    run: Run, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
):
    def fail(*_: object, **__: object) -> str:
        raise ValueError("no ink")

    monkeypatch.setattr(fuse, "fusion_report", fail)
    Path("v.npz").write_bytes(b"mine")
    before = contents(tmp_path)
    outputs = ("--out", "v.npz", "--figure", "f.png", "--json", "r.json", "--report", "r.html")
    refused(run("fuse", log, "--method", method, *outputs, "--force"), "no ink")
    assert contents(tmp_path) == before


def test_a_defect_is_one_line_and_a_traceback_on_demand(
    run: Run, log: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    def fail(*_: object, **__: object) -> None:
        raise KeyError("lost")

    monkeypatch.setattr(fuse, "fit_svo", fail)
    done = run("fuse", log, "--out", "v.npz")
    assert done == Outcome(1, "", "error: unexpected KeyError: 'lost' (--debug shows where)\n")
    with pytest.raises(KeyError, match="lost"):
        cli.main(["--debug", "fuse", str(log), "--out", "v.npz"])
    assert list(contents(tmp_path)) == ["log.npz"]


def test_simulation_of_more_than_memory_holds_is_refused(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "much.npz"
    outcome = run("simulate", "WN(variance=1)", "--rate", 1, "--samples", 10**12, "--sensors", 3, "--out", out)
    refused(outcome, "`--samples`: expected what fits into ")
    assert not out.exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_standard_output_that_takes_nothing_is_named_and_files_are_written(log: Path) -> None:
    out = log.with_name("fused.npz")
    for arguments in (["--version"], ["fuse", str(log), "--out", str(out)]):
        with open("/dev/full", "w") as full:
            ended = subprocess.run(
                [sys.executable, "-m", "gyrofuse", *arguments], stdout=full, stderr=subprocess.PIPE, text=True
            )
        assert ended.returncode == 2
        assert ended.stderr.startswith("error: standard output: ")
        assert len(ended.stderr.splitlines()) == 1
    assert out.exists()


def unit_log(path: Path) -> Path:
    """A log of one device with gyros in deg/s and accelerometers in g."""
    rates, accelerations = noise(3, 4000), 0.01 * noise(3, 4000) + torch.tensor([[0.0], [0.0], [1.0]])
    table = np.c_[np.arange(4000) / 100, rates.T, accelerations.T]
    names = [f"{word}_{axis} [{unit}]" for word, unit in (("gyro", "deg/s"), ("acc", "g")) for axis in "xyz"]
    np.savetxt(path, table, delimiter=",", header=",".join(["time [s]", *names]), comments="")
    return path


def test_accelerometers_of_a_log(run: Run, tmp_path: Path):
    log = unit_log(tmp_path / "imu.csv")
    done = run("info", log, "--quantity", "acceleration", "--json", "i.json")
    assert done.status == 0, done.err
    known = json.loads(Path("i.json").read_text())
    assert (known["quantity"], known["unit"], known["axes"]) == ("acceleration", "g", ["x", "y", "z"])
    assert list(known["channels"]) == ["angular_rate"]
    done = run("fit", log, "--quantity", "acceleration", "--model", "WN", "--axis", "z", "--model-out", "z.json")
    assert done.status == 0, done.err
    assert "velocity random walk N" in done.out
    assert "angle random walk" not in done.out
    assert run("simulate", "z.json", "--samples", 5000, "--out", "sim.csv").status == 0
    assert gf.read_recording("sim.csv", quantity="acceleration").unit == "g"
    refused(run("info", "sim.csv"), 'read with quantity="acceleration" (--quantity acceleration)')
    done = run("rank", log, "--quantity", "acceleration", "--axis", "z", "--candidates", "WN, WN+RW")
    assert done.status == 0, done.err
    refused(run("info", log, "--quantity", "force"), "--quantity")


def test_kalibr_of_a_whole_unit(run: Run, tmp_path: Path):
    log = unit_log(tmp_path / "imu.csv")
    done = run("fit", log, "--model", "WN + RW", "--kalibr", "imu.yaml")
    assert done.status == 0, done.err
    gyros, accelerometers = (
        gf.fit_gmwm(gf.read_recording(log, quantity=quantity), "WN + RW") for quantity in ("rate", "acceleration")
    )
    assert Path("imu.yaml").read_text() == gf.to_kalibr(gyros, accelerometer=accelerometers)
    assert "_walk: 0.0" not in Path("imu.yaml").read_text()
    refused(run("fit", log, "--quantity", "acceleration", "--model", "WN", "--kalibr", "a.yaml"), "leave that out")


def test_simulated_accelerations(run: Run):
    simulate = ("simulate", "WN(variance=1)", "--rate", 50, "--samples", 100, "--quantity", "acceleration")
    done = run(*simulate, "--out", "a.npz")
    assert done.status == 0, done.err
    recording = gf.read_recording("a.npz", quantity="acceleration")
    assert (recording.quantity, recording.unit, recording.notes) == ("acceleration", "m/s^2", ())
    refused(run(*simulate, "--unit", "deg/s", "--out", "b.npz"), "expected that of deg/s, rate")


def test_columns_that_are_told_what_they_are(run: Run, tmp_path: Path):
    values = noise(3, 400).numpy()
    table = np.c_[np.arange(400) / 50, values.T]
    np.savetxt(tmp_path / "u.csv", table, delimiter=",", header="t0,u1,u2,u3", comments="")
    mapping = ("--map", "gyro_x [mdps]=u1", "--map", "gyro_y [mdps]=u3", "--map", "time [s]=t0")
    done = run("info", "u.csv", *mapping, "--json", "i.json")
    assert done.status == 0, done.err
    known = json.loads(Path("i.json").read_text())
    assert (known["rate"], known["unit"], known["axes"]) == (pytest.approx(50), "mdeg/s", ["x", "y"])
    np.testing.assert_allclose(np.ravel(known["mean"]), values[[0, 2]].mean(1))
    refused(run("info", "u.csv", "--map", "gyro_x=u9"), "expected a column 'u9' (`columns`, --map), found t0, u1")
    refused(run("info", "u.csv", "--map", "gyro_x"), "`--map`: expected NAME=COLUMN")
    refused(run("info", "u.csv", "--map", "foo=u1"), "`columns`: expected names such as gyro_x")
    refused(run("info", "u.csv", "--map", "gyro_x=u1", "--map", "gyro_y=u1"), "expected each column once, got 'u1'")


def test_a_limit_on_memory(run: Run, tmp_path: Path):
    log = unit_log(tmp_path / "imu.csv")
    refused(run("info", log, "--max-bytes", 1000), "allow more with max_bytes=")
