"""What heat does to a bias: bent lines, loops, each sensor's own lag, and a heater that is switched on late."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import gyrofuse as gf
from gyrofuse.mismatch.detectors.slow.line_gains import line_gain_test
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.signals.comparison import RecordingInfo

N, RATE = 16_384, 50.0
T = np.arange(N) / RATE
MODEL = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-9)


def noise(seed: int, sensors: int = 3) -> np.ndarray:
    return MODEL.simulate(N, batch=(sensors,), generator=torch.Generator().manual_seed(seed)).numpy()


def diagnosed(recording: np.ndarray, temperature: np.ndarray | None = None) -> gf.MismatchReport:
    channels = {} if temperature is None else {"temperature": torch.from_numpy(temperature)}
    return gf.diagnose(gf.Recording(torch.from_numpy(recording), rate=RATE, unit="deg/s", channels=channels), MODEL)


def within(parameter: gf.Parameter, truth: float, times: float = 1.7) -> bool:
    """Whether limits hold, several of 95 % as one."""
    middle, half = (parameter.low + parameter.high) / 2, (parameter.high - parameter.low) / 2
    return abs(truth - middle) < times * half


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.statistical)])
def test_a_line_may_be_bent_twice(seed: int) -> None:
    g = np.random.default_rng(seed)
    temperature = 25 + 25 * np.linspace(-1, 1, N) + np.cumsum(g.standard_normal(N)) * 0.01
    u = (temperature - 25) / 25
    (found,) = diagnosed(noise(seed) + np.array([[1.0], [0.7], [-0.8]]) * (u**3 - 0.5 * u), temperature).findings
    assert found.mechanism == "temperature_drift"
    assert "in a line that is bent" in found.sentence
    assert within(found.parameters["cubic[0]"], 1.0 / 25**3)
    assert found.parameters["cubic[0]"].unit == "deg/s/K^3"


def test_each_sensor_may_lag_by_a_time_of_its_own() -> None:
    temperature = 25 + 15 * np.sin(2 * math.pi * 2.2 * T / T[-1])
    change = np.gradient(temperature, T)
    sizes = np.array([[0.02, 0.1], [0.015, -0.1], [-0.01, 0.2]])
    (found,) = diagnosed(noise(5) + sizes @ np.stack([temperature, change]), temperature).findings
    assert found.mechanism == "temperature_drift"
    assert "and its rate of change" in found.sentence
    for i, (size, of_change) in enumerate(sizes):
        assert within(found.parameters[f"coefficient[{i}]"], size)
        assert within(found.parameters[f"change[{i}]"], of_change, 2.0)
    assert found.parameters["change[0]"].unit == "deg/s per K/s"
    # The repaired simulation follows the temperature that it is given.
    info = RecordingInfo(RATE, "deg/s", ("x", "y", "z"), {"temperature": torch.from_numpy(temperature)})
    drift = found.effect.apply(torch.zeros(3, N, dtype=torch.float64), info, torch.Generator())
    truth = torch.from_numpy(sizes @ np.stack([temperature, change]))
    assert float((drift - truth).std(-1).max()) < 0.02


def test_a_bias_that_follows_the_rate_of_change_alone_is_named_where_the_record_begins_in_the_middle_of_it() -> None:
    """The course is steepest at the start, and what a lag from equilibrium would make of that has another shape."""
    courses = 10 * np.exp(-5 * T / T[-1]), 2 * np.sin(2 * math.pi * 3.3 * T / T[-1] + 1)
    temperature = 25 - courses[0] + courses[1]
    change = np.gradient(temperature, T)
    course = np.array([[1.5], [0.0], [-0.8]]) * change / np.abs(change).max()
    measured = temperature + 0.01 * np.random.default_rng(3).standard_normal(N)
    (found,) = diagnosed(noise(8) + course, measured).findings
    assert (found.mechanism, found.sensors) == ("temperature_drift", (0, 2))
    assert "and its rate of change" in found.sentence
    for i, size in ((0, 1.5), (2, -0.8)):
        assert within(found.parameters[f"change[{i}]"], size / np.abs(change).max(), 2.0)


@pytest.mark.slow
def test_of_equals_the_cause_that_was_recorded_is_named() -> None:
    """A sine of one period is as good as the temperature that has it."""
    angle = 2 * math.pi * 3 * T / T[-1]
    temperature = 25 + 15 * np.sin(angle) + 0.02 * np.random.default_rng(2).standard_normal(N)
    (found,) = diagnosed(noise(7) + np.array([[0.3], [0.3], [-0.2]]) * np.sin(angle - 0.3), temperature).findings
    assert (found.mechanism, found.channel) == ("temperature_drift", "temperature")
    (found,) = diagnosed(noise(7) + np.array([[0.3], [0.3], [-0.2]]) * np.sin(angle - 0.3)).findings
    assert found.mechanism == "bias_oscillation"


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.statistical)])
def test_a_heater_that_is_switched_on_is_one_cause(seed: int) -> None:
    onset, tau = 110.0, 18.0
    sizes = np.array([[0.8], [-0.5], [0.4]])
    course = -np.expm1(-np.clip(T - onset, 0, None) / tau)
    (found,) = diagnosed(noise(seed) + sizes * course).findings
    assert found.mechanism == "warm_up_transient"
    assert within(found.parameters["onset"], onset)
    assert within(found.parameters["time_constant"], tau)
    assert all(within(found.parameters[f"size[{i}]"], float(size)) for i, size in enumerate(sizes[:, 0]))
    assert found.effect.happened_once


@pytest.mark.slow
@pytest.mark.parametrize(("name", "course"), [("step", 1.0 * (T > 150)), ("ramp", np.clip(T - 150, 0, None) / 100)])
def test_steps_and_ramps_stay_what_they_are(name: str, course: np.ndarray) -> None:
    found = diagnosed(noise(11) + np.array([[0.8], [-0.5], [0.4]]) * course).findings
    assert [f.mechanism for f in found] == [name]


@pytest.mark.slow
@pytest.mark.parametrize("f", [3.1, 0.9])  # of the slow one 256 blocks would have a cycle each
def test_a_scale_factor_that_follows_temperature_is_seen_in_what_moves_the_device(f: float) -> None:
    temperature = 25 + 15 * T / T[-1]
    swing = 3 * np.sin(2 * np.pi * f * T)
    slope = np.array([[0.02], [0.0], [-0.01]])
    recording = gf.Recording(
        torch.from_numpy(noise(41) + swing * (1 + slope * (temperature - 32.5))),
        rate=RATE,
        channels={"temperature": torch.from_numpy(temperature), "other": torch.from_numpy(np.cos(T / 7))},
    )
    report = gf.diagnose(recording, gf.Recording(torch.from_numpy(noise(42) + swing), rate=RATE))
    (found,) = report.findings
    assert (found.mechanism, found.sensors, found.channel) == ("scale_factor", (0, 2), "temperature")
    assert all(within(found.parameters[f"slope[{i}]"], 100 * float(slope[i, 0])) for i in (0, 2))
    assert report.held_out.gain > 100
    assert not report.unexplained


def test_a_line_that_swells_by_itself_follows_no_channel() -> None:
    g = np.random.default_rng(5)
    wander = np.cumsum(g.standard_normal(N)) * 0.004
    swing = np.sin(2 * np.pi * 3.1 * T)
    channels = {"temperature": torch.from_numpy(25 + np.cumsum(g.standard_normal(N)) * 0.01)}
    recording = gf.Recording(torch.from_numpy(noise(43) + 3 * swing * (1 + wander)), rate=RATE, channels=channels)
    comparison = prepared(
        recording, gf.Recording(torch.from_numpy(noise(44) + 3 * swing), rate=RATE), None, torch.Generator()
    )
    assert line_gain_test(comparison).p_value > 0.001
