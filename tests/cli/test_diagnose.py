"""`gyrofuse diagnose` from the outside."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Run
from pages import Page

import gyrofuse as gf
from gyrofuse.mismatch import MismatchReport

N, RATE = 2**13, 50.0
NOISE = gf.WhiteNoise(1.0) + gf.AR1(0.99, 1e-3)


def drawn(n: int, seed: int) -> torch.Tensor:
    return NOISE.simulate(n, batch=(2,), generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    turn = 2 * math.pi * 7.3 / RATE * torch.arange(N, dtype=torch.float64)
    recording = gf.Recording(drawn(N, 1) + 0.3 * turn.cos(), rate=RATE, unit="deg/s", sensors=("a", "b"))
    recording.save(tmp_path / "log.npz")
    gf.Recording(drawn(2 * N, 2), rate=RATE, unit="deg/s", sensors=("a", "b")).save(tmp_path / "sim.npz")
    (tmp_path / "model.json").write_text(json.dumps(NOISE.to_dict()))
    return tmp_path / "log.npz"


def test_prints_the_verdict_and_writes_what_is_asked_for(run: Run, log: Path):
    files = ("--json", "r.json", "--report", "r.html", "--corrected", "c.npz", "--model-out", "m.json")
    done = run("diagnose", log, "--simulation", "sim.npz", *files)
    assert (done.status, done.err) == (0, "")
    recording = gf.read_recording(log)
    report = gf.diagnose(recording, gf.read_recording("sim.npz"))
    assert done.out.startswith("Recording and simulation differ")
    assert [f.mechanism for f in report.findings] == ["vibration_tone"]
    assert done.out.strip() == f"{report}\nWritten: c.npz, m.json, r.json, r.html"
    told = json.loads(Path("r.json").read_text())
    assert told == {"recording": ["log.npz"], "simulation": "sim.npz", **report.to_dict()}
    assert json.loads(Path("m.json").read_text()) == report.model.to_dict()
    corrected = gf.read_recording("c.npz")
    torch.testing.assert_close(corrected.signal, report.correct(recording.signal), rtol=0, atol=0)
    assert (corrected.rate, corrected.unit, corrected.sensors) == (RATE, "deg/s", ("a", "b"))
    page = Page(Path("r.html").read_text())
    assert "log.npz against sim.npz" in page.text
    assert page.text.index("Recording and simulation differ") < page.text.index("Vibration tone")


def test_a_model_and_options(run: Run, log: Path, monkeypatch: pytest.MonkeyPatch):
    twins: list[int] = []

    def uniform(case: object, n_twins: int, generator: torch.Generator) -> torch.Tensor:
        twins.append(n_twins)
        return torch.rand(n_twins, dtype=torch.float64, generator=generator)

    # Half a minute of diagnoses of twins; tests/mismatch/test_engine.py judges what they tell.
    monkeypatch.setattr(sys.modules["gyrofuse.mismatch.diagnose"], "twin_p_values", uniform)
    done = run("diagnose", log, "--simulation", "model.json", "--sensors", "b", "--rest", "0:100", "--twins", 50)
    assert done.status == 0
    assert twins == [50]
    assert "vibration_tone" in done.out
    assert "sensor a" not in done.out
    strict = run("diagnose", log, "--simulation", "model.json", "--false-alarm", 1e-300)
    assert strict.status == 0
    assert strict.out.startswith("Recording and simulation agree")


def test_a_model_says_for_which_rate_and_unit_it_is(run: Run, log: Path):
    fitted = NOISE.to_dict() | {"rate": RATE, "unit": "deg/s"}
    Path("fitted.json").write_text(json.dumps(fitted))
    calm = gf.Recording(drawn(N, 3), rate=RATE, unit="deg/s")
    calm.to("rad/s").save("radians.npz")
    done = run("diagnose", "radians.npz", "--simulation", "fitted.json")
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith("Recording and simulation agree")
    Path("faster.json").write_text(json.dumps(fitted | {"rate": 2 * RATE}))
    refused = run("diagnose", log, "--simulation", "faster.json", "--json", "r.json")
    assert refused.status == 2
    assert "faster.json: expected a model for the 50 Hz of log.npz, got one that was fitted at 100 Hz" in refused.err
    assert not Path("r.json").exists()


def test_a_simulation_of_more_sensors_is_cut_to_those_asked_for(run: Run, log: Path):
    done = run("diagnose", log, "--simulation", "sim.npz", "--sensors", "b")
    assert done.status == 0
    part = gf.read_recording(log, sensors=["b"])
    assert done.out.strip() == str(gf.diagnose(part, gf.read_recording("sim.npz", sensors=["b"])))


def test_agreement_ends_with_status_0(run: Run, log: Path):
    gf.Recording(drawn(N, 3), rate=RATE, unit="deg/s").save("calm.npz")
    done = run("diagnose", "calm.npz", "--simulation", "sim.npz", "--report", "r.html")
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith("Recording and simulation agree")
    assert "Recording and simulation agree" in Page(Path("r.html").read_text()).text


def test_one_axis_of_several(run: Run, log: Path):
    axes = torch.stack([drawn(N, 4), drawn(N, 5)])
    gf.Recording(axes, rate=RATE, unit="deg/s", axes=("x", "y")).save("axes.npz")
    refused = run("diagnose", "axes.npz", "--simulation", "sim.npz")
    assert (refused.status, refused.out) == (2, "")
    assert "axes.npz: expected the sensors of one axis, got axes x, y; choose one with --axis" in refused.err
    gf.Recording(axes.flip(0), rate=RATE, unit="deg/s", axes=("x", "y")).save("other.npz")
    assert run("diagnose", "axes.npz", "--simulation", "other.npz", "--axis", "y").status == 0


def test_samples_that_are_missing_leave_the_longest_stretch(run: Run, log: Path):
    recording = gf.read_recording(log)
    recording.signal[0, 2000] = torch.nan
    recording.save(log, force=True)
    done = run("diagnose", log, "--simulation", "sim.npz", "--report", "r.html", "--corrected", "c.npz")
    assert done.status == 0
    told = f"Diagnosed on 40.02 to {N / RATE:.6g} s alone, {N - 2001} of {N} samples"
    counted = "Times count from the first sample that was diagnosed, at 40.02 s of the log."
    for sentence in (told, counted):
        assert sentence in " ".join(done.out.split())
        assert sentence in Page(Path("r.html").read_text()).text
    assert gf.read_recording("c.npz").n_samples == N - 2001


def test_gaps_of_the_simulation_and_a_recording_left_as_it_came_are_told(run: Run, log: Path):
    simulation = gf.read_recording("sim.npz")
    simulation.signal[1, 500] = torch.nan
    simulation.save("sim.npz", force=True)
    gf.Recording(drawn(N, 8), rate=RATE, unit="deg/s", sensors=("a", "b")).save(log, force=True)
    done = run("diagnose", log, "--simulation", "sim.npz", "--corrected", "c.npz")
    assert done.status == 0
    told = " ".join(done.out.split())
    assert f"Simulation: compared on 10.02 to {2 * N / RATE:.6g} s alone" in told
    assert "Nothing was found that can be taken off: c.npz is the recording as it came." in told
    torch.testing.assert_close(gf.read_recording("c.npz").signal, gf.read_recording(log).signal, rtol=0, atol=0)


def test_units_that_nobody_states_are_told(run: Run, log: Path):
    np.savez("bare.npz", gyro=drawn(N, 3).numpy(), fs=RATE)
    np.savez("other.npz", gyro=drawn(N, 4).numpy(), fs=RATE)
    for name, against, told in (
        (log, "bare.npz", "Units: bare.npz states none; its numbers are taken as deg/s."),
        ("bare.npz", "sim.npz", "Units: bare.npz states none; its numbers are taken as deg/s."),
        ("bare.npz", "other.npz", "Units: neither bare.npz nor other.npz states one; their numbers are compared"),
    ):
        done = run("diagnose", name, "--simulation", against)
        assert (done.status, told in " ".join(done.out.split())) == (0, True)
    assert "Units" not in run("diagnose", log, "--simulation", "sim.npz").out


def test_the_repaired_simulation_simulates_and_agrees(run: Run, log: Path):
    assert run("diagnose", log, "--simulation", "model.json", "--model-out", "m.json").status == 0
    simulated = run("simulate", "m.json", "--samples", N, "--rate", RATE, "--seed", 5, "--out", "s.npz")
    assert (simulated.status, simulated.err) == (0, "")
    assert "vibration_tone" in simulated.out
    for again in ("s.npz", "m.json"):
        done = run("diagnose", log, "--simulation", again)
        assert done.status == 0
        assert done.out.startswith("Recording and simulation agree")
    wrong = run("simulate", "m.json", "--samples", N, "--rate", 10, "--out", "t.npz")
    assert wrong.status == 2
    assert "expected 50 Hz, for which the model was fitted, got 10" in wrong.err
    assert run("simulate", "m.json", "--samples", N, "--rate", RATE, "--sensors", 2, "--out", "t.npz").status == 2


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--simulation", "nowhere.npz"), "nowhere.npz: no such file"),
        (("--simulation", "short.npz"), "short.npz: expected at least 4096 samples for a diagnosis, got 99"),
        (("--simulation", "slow.npz"), "slow.npz: expected samples at 50 Hz as in the recording, got 25 Hz"),
        (("--simulation", "three.npz"), "three.npz: expected 2 sensors as in the recording, got 3"),
        (("--simulation", "other.json"), "other.json: expected a model in JSON"),
        (("--simulation", "sim.npz", "--rest", "0:2"), "log.npz: expected at least 4096 samples"),
        (("--simulation", "sim.npz", "--rest", "5"), "`--rest`: expected START:STOP"),
        (("--simulation", "sim.npz", "--false-alarm", 2), "`--false-alarm`: expected a number between 0 and 1"),
        (("--simulation", "sim.npz", "--twins", 3), "`--twins`: expected 0, or 50 or more, got 3"),
        (("--simulation", "sim.npz", "--corrected", "c.csv"), "`--corrected`: expected a name that ends in .npz"),
        (("--simulation", "sim.npz", "--report", "nowhere/r.html"), "the folder nowhere does not exist"),
        (("--simulation", "sim.npz", "--corrected", "sim.npz"), "sim.npz: is in use by the same command"),
        ((), "Missing option '--simulation'"),
    ],
)
def test_refuses(run: Run, log: Path, options: tuple[object, ...], says: str):
    gf.Recording(drawn(99, 2), rate=RATE, unit="deg/s").save("short.npz")
    gf.Recording(drawn(N, 2), rate=RATE / 2, unit="deg/s").save("slow.npz")
    gf.Recording(drawn(N, 2)[[0, 1, 1]], rate=RATE, unit="deg/s").save("three.npz")
    Path("other.json").write_text('{"model": 1}')
    before = sorted(Path().iterdir())
    done = run("diagnose", log, *options)
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("error: ")
    assert done.err.count("\n") == 1
    assert says in done.err
    assert sorted(Path().iterdir()) == before


def test_files_are_replaced_with_force_only_and_whole_or_not_at_all(
    run: Run, log: Path, monkeypatch: pytest.MonkeyPatch
):
    Path("r.json").write_text("mine")
    diagnose = ("diagnose", log, "--simulation", "sim.npz", "--json", "r.json", "--corrected", "c.npz")
    refused = run(*diagnose)
    assert (refused.status, refused.out) == (2, "")
    assert "r.json: exists already" in refused.err
    monkeypatch.setattr(MismatchReport, "to_html", lambda *_, **__: Path("nowhere/x").write_text(""))
    assert run(*diagnose, "--force", "--report", "r.html").status == 2
    assert Path("r.json").read_text() == "mine"
    assert sorted(path.name for path in Path().iterdir()) == ["log.npz", "model.json", "r.json", "sim.npz"]


def test_what_was_guessed_on_reading_stands_on_the_page(run: Run, tmp_path: Path):
    generator = torch.Generator().manual_seed(2)
    recorded, simulated = (torch.randn(1, 4200, dtype=torch.float64, generator=generator) for _ in range(2))
    rows = np.c_[np.arange(4200) / 100, recorded[0]]
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="fs = 50 Hz\ntime,gx [deg/s]", fmt="%.6f")
    gf.Recording(simulated, rate=100.0, unit="deg/s").save(tmp_path / "sim.npz")
    done = run("diagnose", "log.csv", "--simulation", "sim.npz", "--report", "page.html")
    assert done.status == 0, done.err
    page = (tmp_path / "page.html").read_text()
    assert "the log states 50 Hz, the timestamps give 100 Hz, which is used" in page
    assert "time column &#39;time&#39; states no unit: read as s" in page


def test_corrected_axes_of_a_device_stay_its_axes(run: Run):
    noise = torch.stack([drawn(N, seed)[:1].expand(3, -1) * torch.tensor([[1.0], [2.0], [0.5]]) for seed in (1, 2)])
    noise = noise + torch.randn(noise.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    noise[0, 1] += torch.cos(2 * math.pi * 7.3 / RATE * torch.arange(N, dtype=torch.float64))
    for name, x in zip(("imu", "sim"), noise, strict=True):
        made = gf.Recording(x[:, None], rate=RATE, unit="deg/s", sensors=("imu",), axes=("x", "y", "z"))
        made.save(f"{name}.npz")
    done = run("diagnose", "imu.npz", "--simulation", "sim.npz", "--corrected", "clean.npz")
    assert (done.status, done.err) == (0, "")
    clean, came = gf.read_recording("clean.npz"), gf.read_recording("imu.npz")
    assert (clean.sensors, clean.axes) == (("imu",), ("x", "y", "z"))
    report = gf.diagnose(came, gf.read_recording("sim.npz"))
    torch.testing.assert_close(report.correct(came).signal, clean.signal)
    assert not torch.equal(clean.signal, came.signal)
