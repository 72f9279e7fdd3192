"""The examples run as printed and do what they say."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scripts import run_script

import gyrofuse as gf

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def run(name: str, *arguments: object, cwd: Path) -> str:
    done = run_script(EXAMPLES / name, *arguments, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


def refused(name: str, *arguments: object, cwd: Path) -> str:
    done = run_script(EXAMPLES / name, *arguments, cwd=cwd)
    assert done.returncode == 2
    return done.stderr


def test_fuse_log(tmp_path: Path):
    noise = gf.parse_model("WN(variance=1) + RW(variance=1e-4)")
    signal = noise.simulate(4000, batch=(3,), generator=torch.Generator().manual_seed(0))
    recording = gf.Recording(signal, rate=100.0, unit="deg/s")
    recording.save(tmp_path / "log.npz")
    out = run("fuse_log.py", "log.npz", cwd=tmp_path)
    virtual = gf.read_recording(tmp_path / "virtual.npz")
    expected = gf.fit_svo(recording, "long").virtual(recording)
    torch.testing.assert_close(virtual.signal[0], expected)
    assert virtual.unit == "deg/s"
    assert "Virtual gyro (SVO) of 3 sensors" in out


def test_pipeline(tmp_path: Path):
    out = run("pipeline.py", "--arrays", 20, "--samples", 2048, cwd=tmp_path)
    median, worst = (float(out.split(word)[1].split()[0].strip(",")) for word in ("median", "worst"))
    assert median < 1  # the virtual gyro beats the plain mean where its scale weights look
    assert worst < 1.05


@pytest.mark.parametrize("chunk", [5000, 7777])
def test_stream(tmp_path: Path, chunk: int):
    noise = gf.parse_model("WN(variance=1) + RW(variance=1e-4)")
    signal = noise.simulate(20_000, batch=(3,), generator=torch.Generator().manual_seed(0))
    np.save(tmp_path / "log.npy", signal.numpy())
    run("stream.py", "log.npy", "--levels", 10, "--chunk", chunk, "--out", "virtual.npy", cwd=tmp_path)
    weights = gf.svo_weights(gf.wavelet_cross_covariance(signal, 10), "long")
    np.testing.assert_allclose(
        np.load(tmp_path / "virtual.npy"), weights.numpy() @ signal.numpy(), rtol=1e-9, atol=1e-9
    )


@pytest.mark.statistical
def test_blind_bias(tmp_path: Path):
    """A step looks like a random walk thousands of times as large."""
    out = run("blind_bias.py", "--quick", cwd=tmp_path)
    as_recorded, corrected = (
        float(word) for word in next(v for v in out.splitlines() if v[:4] == "step").split()[2::3]
    )
    assert as_recorded > 1000
    assert corrected < 10


def test_robust_fit(tmp_path: Path):
    signal = torch.randn(1, 20_000, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    signal[:, ::5000] += 50
    gf.Recording(signal, rate=100.0).save(tmp_path / "log.npz")
    out = run("robust_fit.py", "log.npz", "--levels", 8, cwd=tmp_path)
    classic, robust = (float(word) for word in out.split("white_noise.variance")[1].replace("[", " ").split()[0:4:3])
    assert classic > 1.4
    assert abs(robust - 1) < 0.05
    assert (tmp_path / "robust_fit.png").stat().st_size > 10_000


def test_field(tmp_path: Path):
    out = run("field.py", "--hours", 0.1, cwd=tmp_path)
    assert "Sensor 5 has its sign flipped" in out
    assert "Left out: 5" in out
    # No step when sensors leave and return: far less than the mean of whatever is there makes.
    step, naive = (float(out.split(word)[1].split()[0]) for word in ("is ", "whatever is there: "))
    assert step < 0.01 * naive


@pytest.mark.statistical
def test_real_mismatch(tmp_path: Path, shared: Path):
    out = run(
        "real_mismatch.py", "--data", shared / "data", "--only", "broad", "--quick", "--out", "found", cwd=tmp_path
    )
    page = (tmp_path / "found" / "real.md").read_text()
    cells = next(line for line in page.splitlines() if "| broad_other_trial |" in line).split("|")
    assert float(cells[3]) < float(cells[2]) / 3, "the repaired simulation predicts another recording"
    shares = [line.split("|")[1:3] for line in page.splitlines() if line.endswith(" % |")]
    assert shares[0][0].strip() == "quantization"
    assert sum(float(share.strip(" %")) for _, share in shares) == pytest.approx(100, abs=0.5)
    assert (tmp_path / "found" / "broad_other_trial.html").is_file()
    # 4000 deg/s over 2^16 steps of this device's converter
    assert page.count("rounded to steps of 0.001065 rad/s in all sensors") == 1
    assert out.count("rounded to steps of 0.001065 rad/s in all sensors") == 2  # the report, and the page after it


def test_real_mismatch_names_the_files_that_it_lacks(tmp_path: Path):
    told = refused("real_mismatch.py", "--data", tmp_path, "--only", "broad", cwd=tmp_path)
    assert "expected a folder with broad_trials.npz" in told


@pytest.mark.statistical
def test_vibration_flight(tmp_path: Path):
    out = run("vibration_flight.py", "--quick", "--figure", "f.png", cwd=tmp_path)
    rows = {line[:46].strip(): [float(cell) for cell in line[46:].split()] for line in out.splitlines()[3:-1]}
    assert len(rows) == 6
    assert sum("by the array, tone at 11.3 Hz" in name for name in rows) == 3
    mean, svo = (next(cells for name, cells in rows.items() if name.startswith(what)) for what in ("plain", "SVO"))
    assert svo[0] < mean[0]
    assert all(0.4 < made / claimed < 2.5 for made, claimed, *_ in rows.values())
    assert (tmp_path / "f.png").stat().st_size > 10_000


def test_long_recording(tmp_path: Path):
    options = ("--samples", 70_000, "--levels", 10, "--scale-weights", "short")
    command = [sys.executable, EXAMPLES / "long_recording.py", *options, "--check"]  # its memory is its own
    done = subprocess.run([*map(str, command)], check=True, capture_output=True, text=True, cwd=tmp_path)
    out = done.stdout
    assert float(out.split("Largest difference of a weight")[1].split(",")[0]) < 1e-12
    peak, before = (float(out.split(word)[1].split()[0]) for word in ("Peak memory of a process", "of which"))
    assert before <= peak < 1000  # MB
    # The same samples whatever the chunks, or every number of the table would be another.
    again = run("long_recording.py", *options, "--chunk", 7777, cwd=tmp_path)
    assert again.split("values in")[0] == out.split("values in")[0]


def test_long_recording_refuses_more_levels_than_samples(tmp_path: Path):
    told = refused("long_recording.py", "--samples", 1000, "--levels", 10, cwd=tmp_path)
    assert "--levels: expected at most 9 for 1000 samples" in told


def test_train_scale_weights(tmp_path: Path):
    out = run("train_scale_weights.py", "--quick", "--out", "kept", "--figure", "learnt.png", cwd=tmp_path)
    saved = torch.load(tmp_path / "kept" / "best.ckpt", weights_only=True)["state_dict"]["logits"].softmax(0)
    levels = out.split("long\n")[1].split("\n\n")[0].splitlines()
    printed = [float(line.split()[1]) for line in levels]
    np.testing.assert_allclose(printed, saved, atol=1e-4)
    # Flat scale weights, from which it starts, have 0.3 there.
    assert sum(printed[-3:]) > 0.6, "the angle after a minute is made of what lasts about a minute"
    ratios = {line[:20].strip(): line[20:].replace(",", "").split() for line in out.splitlines() if "[" in line}
    assert float(ratios["flat"][2].strip("[")) > 1, "out of sample better than what it starts from"
    equal, rival = float(ratios["equal weights"][1]), float(ratios["long"][1])
    assert equal > rival
    verdict = out.split("The learnt scale weights ")[1]
    assert verdict.startswith("beat" if float(ratios["long"][2].strip("[")) > 1 else "do NOT beat")
    assert (tmp_path / "learnt.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--horizon", "1000"], "--horizon: expected 1 to 8192 samples, half of the stretch"),
        (["--out", "."], "--out: expected a new or empty folder"),
    ],
)
def test_train_scale_weights_refuses(tmp_path: Path, options: list[str], message: str):
    (tmp_path / "mine.txt").touch()
    assert message in refused("train_scale_weights.py", *options, cwd=tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"mine.txt"}
