"""Filters that take off what is slow, a band, or all but a band; and what they do to noise with heavy tails."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import signal

import gyrofuse as gf
from gyrofuse.mismatch import MismatchReport

RATE, N = 100.0, 16_000


def noise(seed: int, law: str = "normal", n: int = N) -> np.ndarray:
    rng = np.random.default_rng(seed)
    fast = rng.standard_normal((3, n)) if law == "normal" else rng.laplace(size=(3, n))
    return fast + signal.lfilter([0.002], [1, -0.9999], rng.standard_normal((3, n)))


def diagnosed(recording: np.ndarray, simulation: np.ndarray) -> MismatchReport:
    sides = (gf.Recording(torch.from_numpy(np.ascontiguousarray(x)), rate=RATE) for x in (recording, simulation))
    return gf.diagnose(*sides, generator=torch.Generator().manual_seed(0))


def filtered(x: np.ndarray, sensors: list[int], sections: np.ndarray) -> np.ndarray:
    made = x.copy()
    made[sensors] = signal.sosfilt(sections, x[sensors])
    return made


@pytest.mark.parametrize(
    ("design", "corner"),
    [(signal.butter(1, 2.0, "highpass", fs=RATE, output="sos"), 2.0),
     (signal.butter(2, 6.0, "highpass", fs=RATE, output="sos"), 6.0)],
)  # fmt: skip
def test_a_high_pass_has_its_corner_and_its_sensors(design: np.ndarray, corner: float) -> None:
    report = diagnosed(filtered(noise(1), [0, 2], design), noise(2))
    (finding,) = report.findings
    assert (finding.mechanism, finding.sensors) == ("high_pass", (0, 2))
    assert report.held_out.after < 1.5
    for i in finding.sensors:
        entry = finding.parameters[f"corner[{i}]"]
        assert entry.low < 1.02 * corner
        assert entry.high > 0.98 * corner
    assert not [u for u in report.unexplained if u.test == "slow"]  # of the sensor whose walk is as simulated


@pytest.mark.slow
def test_a_band_stop_of_high_order_is_a_notch() -> None:
    design = signal.butter(4, [15.0, 25.0], "bandstop", fs=RATE, output="sos")
    report = diagnosed(filtered(noise(3), [1], design), noise(4))
    (finding,) = report.findings
    assert (finding.mechanism, finding.sensors) == ("notch", (1,))
    assert finding.parameters["centre"].value == pytest.approx(19.7, rel=0.02)
    assert finding.parameters["width"].value == pytest.approx(10, rel=0.05)
    assert report.held_out.after < 1.5


@pytest.mark.slow
def test_a_band_pass_is_a_low_pass_and_a_high_pass() -> None:
    design = signal.butter(3, [4.0, 22.0], "bandpass", fs=RATE, output="sos")
    recording, simulation = (noise(seed, n=30_000) for seed in (5, 6))
    report = diagnosed(filtered(recording, [0, 1, 2], design), simulation)
    assert sorted(f.mechanism for f in report.findings) == ["high_pass", "low_pass"]
    assert report.held_out.after < 1.5


@pytest.mark.slow
def test_what_a_filter_leaves_of_heavy_tails_lacks_no_outliers() -> None:
    design = signal.butter(2, [12.0, 20.0], "bandstop", fs=RATE, output="sos")
    report = diagnosed(filtered(noise(7, "laplace"), [0, 1, 2], design), noise(8, "laplace"))
    assert [f.mechanism for f in report.findings] == ["notch"]


def test_a_sign_shows_in_what_sensors_share_a_little_of() -> None:
    root = np.linalg.cholesky(np.full((3, 3), 0.3) + 0.7 * np.eye(3))
    recording = np.array([[1.0], [1.0], [-1.0]]) * (root @ noise(9))
    report = diagnosed(recording, root @ noise(10))
    (finding,) = report.findings
    assert (finding.mechanism, finding.sensors) == ("sensor_gain", (2,))


def test_tones_may_all_be_twice_as_fast() -> None:
    t = np.arange(N) / RATE
    tones = [0.5 * np.cos(2 * np.pi * 7.31 * k * t) + 0.3 * np.cos(2 * np.pi * 17.77 * k * t) for k in (1, 2)]
    report = diagnosed(noise(11) + tones[1], noise(12) + tones[0])
    (finding,) = report.findings
    assert finding.mechanism == "time_scale"
    assert finding.parameters["ratio"].value == pytest.approx(2, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("times", [4.0, 2.5])
def test_a_sensor_slower_than_its_log_has_its_rate(times: float) -> None:
    fast = noise(13)
    recording = fast.copy()
    recording[1] = fast[1, (np.floor(np.arange(N) / times) * times).astype(int)]
    report = diagnosed(recording, noise(14))
    (finding,) = report.findings
    assert (finding.mechanism, finding.sensors) == ("stuck_samples", (1,))
    assert f"come at {RATE / times:g} Hz" in finding.sentence
    assert report.held_out.after < 1.5
