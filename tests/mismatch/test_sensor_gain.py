"""Gains of whole sensors: of a size by all bands and by what is shared, of a sign by what is shared and by lines."""

from __future__ import annotations

import math

import pytest
import torch
from bounds import at_most
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.detectors.lines.line_signs import line_signs
from gyrofuse.mismatch.mechanisms.values.sensor_gain import SensorGain
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.signals.comparison import Comparison

N, RATE = 16_384, 200.0
OWN = gf.parse_model("WN(variance=1) + AR1(phi=0.999,variance=1e-3) + RW(variance=1e-5)")
MOTION = gf.AR1(0.9, 2.0)


def sides(seed: int, p: int = 4, moved: float = 1.0, lines: tuple[float, ...] = ()) -> tuple[Tensor, Tensor]:
    """A recording and a simulation of the same law: noise of each sensor, a motion of all, and lines of all."""
    g, made = torch.Generator().manual_seed(seed), []
    for _ in range(2):
        signal = OWN.simulate(N, batch=(p,), generator=g) + moved * MOTION.simulate(N, generator=g)
        start = float(torch.rand((), generator=g))
        for k, line in enumerate(lines):
            signal = signal + 0.6 * torch.sin(2 * math.pi * (line * torch.arange(N, dtype=torch.float64) + start + k))
        made.append(signal)
    return made[0], made[1]


def compared(recording: Tensor, simulation: Tensor) -> Comparison:
    given = [gf.Recording(x, rate=RATE, unit="deg/s") for x in (recording, simulation)]
    return prepared(given[0], given[1], None, torch.Generator().manual_seed(0))


def turned(recording: Tensor, **gains: float) -> Tensor:
    """With gains of sensors by position."""
    factor = torch.ones(len(recording), 1, dtype=torch.float64)
    for name, value in gains.items():
        factor[int(name.removeprefix("s"))] = value
    return factor * recording


@pytest.mark.parametrize(("gain", "moved"), [(0.7, 1.0), (1.25, 1.0), (math.pi / 180, 1.0), (math.pi / 180, 0.0)])
def test_a_gain_is_found_with_its_limits(gain: float, moved: float):
    recording, simulation = sides(1, moved=moved)
    found = SensorGain.detect_and_fit(compared(turned(recording, s2=gain), simulation), 1e-4)
    assert found is not None
    assert found.sensors == (2,)
    limits = found.parameters["gain[2]"]
    assert limits.low < gain < limits.high
    assert limits.high / limits.low < 1.1


@pytest.mark.parametrize("louder", ["white", "walk"])
def test_another_level_of_one_noise_is_no_gain(louder: str):
    recording, simulation = sides(2)
    g = torch.Generator().manual_seed(3)
    added = 0.8 * torch.randn(N, generator=g, dtype=torch.float64)
    recording[1] += added if louder == "white" else 0.02 * added.cumsum(0)
    assert SensorGain.detect_and_fit(compared(recording, simulation), 1e-3) is None


@pytest.mark.slow
def test_a_sensor_the_other_way_round_is_seen_by_the_motion():
    recording, simulation = sides(4)
    report = gf.diagnose(turned(recording, s3=-1.0), simulation, rate=RATE)
    assert [finding.mechanism for finding in report.findings] == ["sensor_gain"]
    assert report.findings[0].sensors == (3,)
    assert report.findings[0].parameters["gain[3]"].value == -1.0
    assert report.unexplained == ()
    assert report.held_out.before > 50
    assert report.held_out.after < 1.5


def test_a_sensor_the_other_way_round_is_seen_by_lines():
    recording, simulation = sides(5, moved=0.0, lines=(0.06, 0.21))
    report = gf.diagnose(turned(recording, s0=-1.0), simulation, rate=RATE)
    assert [finding.mechanism for finding in report.findings] == ["sensor_gain"]
    assert report.findings[0].sensors == (0,)
    assert report.held_out.after < 1.5


@pytest.mark.slow
def test_lines_whose_phases_mean_nothing_have_no_sign():
    """Each sensor's own are drawn by themselves: signs agree by chance as often as their p value says."""
    n_runs, level, passed = 200, 0.05, 0
    model = gf.WhiteNoise(1.0) + gf.Sinusoid(0.6, 2 * math.pi * 0.11)
    for seed in range(n_runs):
        g = torch.Generator().manual_seed(seed)
        recording, simulation = (model.simulate(4096, batch=(3,), generator=g) for _ in range(2))
        signs = line_signs(compared(recording, simulation))
        passed += signs is not None and signs.p_value < level
    assert passed <= at_most(n_runs, level)


def test_the_same_on_both_sides_has_no_gain():
    for seed in range(6, 14):
        assert SensorGain.detect_and_fit(compared(*sides(seed, lines=(0.06,))), 0.01) is None
