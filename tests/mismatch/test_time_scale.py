"""Recordings whose rate is not what the simulation has: lines that one factor moves, and noise where it shows."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import signal

import gyrofuse as gf
from gyrofuse.mismatch.detectors.lines.time_scales import common_ratio
from gyrofuse.mismatch.mechanisms.signals.time_scale import TimeScale
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

N, RATE = 16_384, 200.0
INFO = RecordingInfo(RATE, "deg/s", ("x", "y", "z"))


def sampled(seed: int, rate: float, lines: dict[float, float], corner: float | None = None) -> np.ndarray:
    """What three sensors put out at a rate, Hz: lines `{Hz: amplitude}`, and white noise behind a filter, if any."""
    g = np.random.default_rng(seed)
    noise, fine = g.standard_normal((3, 8 * N if corner else N)), 8 * rate
    if corner:
        noise = signal.sosfilt(signal.butter(3, corner, fs=fine, output="sos"), noise, axis=-1)[:, ::8] * 2
        noise += 0.1 * g.standard_normal((3, N))
    t = np.arange(N) / rate
    gains = np.array([[1.0], [0.8], [1.2]])
    return noise + sum(a * gains * np.cos(2 * np.pi * (f * t + g.uniform())) for f, a in lines.items())


def compared(recording: np.ndarray, simulation: np.ndarray) -> Comparison:
    lines = (31.0 / RATE, 52.7 / RATE)
    return Comparison.of(INFO, *(torch.from_numpy(x) for x in (recording, simulation[None]))).knowing(lines)


def report(recording: np.ndarray, simulation: np.ndarray) -> gf.MismatchReport:
    return gf.diagnose(*(gf.Recording(torch.from_numpy(x), rate=RATE, unit="deg/s") for x in (recording, simulation)))


@pytest.mark.slow
@pytest.mark.parametrize("rate", [208.0, 199.6])
def test_the_rate_is_told_to_some_ppm(rate: float) -> None:
    lines = {31.0: 0.5, 52.7: 0.4}
    found = report(sampled(1, rate, lines), sampled(2, RATE, lines))
    (finding,) = found.findings
    assert finding.mechanism == "time_scale"
    assert finding.parameters["rate"].low <= rate <= finding.parameters["rate"].high
    assert finding.parameters["rate"].high - finding.parameters["rate"].low < 1e-4 * rate
    assert "as where 200 Hz were" in finding.sentence
    assert not found.unexplained
    assert found.held_out.after < 1.5


def test_noise_moves_with_its_filter() -> None:
    lines = {31.0: 1.0, 52.7: 0.7}
    found = report(sampled(3, 216.0, lines, 50.0), sampled(4, RATE, lines, 50.0))
    (finding,) = found.findings
    assert finding.mechanism == "time_scale"
    assert bool(finding.effect.log_gain.any())
    # A filter of the third order: at 60 Hz, which is called 55.6 Hz, as at 60 Hz before.
    at = int((finding.effect.frequency - 0.3 * RATE / 216.0).abs().argmin())
    attenuated = [1 / (1 + (f / 50.0) ** 6) for f in (0.3 * RATE, 0.3 * RATE * RATE / 216.0)]
    assert float(2 * finding.effect.log_gain[:, at].mean()) == pytest.approx(
        math.log(attenuated[0] / attenuated[1]), rel=0.3
    )
    assert found.held_out.after < 2


def test_lines_that_have_nothing_to_do_with_each_other_say_nothing() -> None:
    simulation = sampled(5, RATE, {31.0: 0.5, 52.7: 0.4})
    for lines in ({31.0: 0.5, 54.0: 0.4}, {33.0: 0.5, 49.0: 0.4}, {32.24: 0.5}, {31.0: 0.5, 52.7: 0.4}):
        assert common_ratio(compared(sampled(6, RATE, lines), simulation)) is None
    # Nor do sizes that are others.
    assert common_ratio(compared(sampled(7, 208.0, {31.0: 2.5, 52.7: 0.1}), simulation)) is None


def test_by_chance_it_is_rare() -> None:
    g = np.random.default_rng(8)
    simulation, n_runs = sampled(9, RATE, {31.0: 0.5, 52.7: 0.4}), 40
    values = []
    for k in range(n_runs):
        lines = {float(f): 0.45 for f in g.uniform(25, 66, 3)}
        found = common_ratio(compared(sampled(100 + k, RATE, lines), simulation))
        values.append(1.0 if found is None else found.p_value)
    assert min(values) > 1e-3


def test_the_simulation_has_its_lines_elsewhere() -> None:
    lines = {31.0: 0.5, 52.7: 0.4}
    case = compared(sampled(11, 208.0, lines), sampled(12, RATE, lines))
    finding = TimeScale.detect_and_fit(case, 1e-3)
    assert finding is not None
    after = finding.repair(case, torch.Generator().manual_seed(1))
    assert after.reference.lines == pytest.approx([31.0 / 208.0, 52.7 / 208.0], rel=1e-5)
    power = torch.fft.rfft(after.reference.signal[0]).abs().mean(0)
    for f in (31.0, 52.7):
        new, old = (power[round(f / rate * N) + torch.arange(-1, 2)].max() for rate in (208.0, RATE))
        assert float(new) > 10 * float(old)
    assert TimeScale.detect_and_fit(after, 1e-3) is None


def test_sizes_that_stay_say_that_two_lines_moved_by_one_factor() -> None:
    simulation = sampled(8, RATE, {31.0: 0.5, 52.7: 0.4})
    alike, unlike = (
        common_ratio(compared(sampled(9, 208.0, {31.0: 0.5 * factor, 52.7: 0.4 / factor}), simulation))
        for factor in (1.0, 1.6)
    )
    assert alike is not None
    assert unlike is not None
    assert alike.p_value < unlike.p_value / 10
