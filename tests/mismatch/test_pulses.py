"""Pulses: what pushes a sensor one way and is gone again, and what only looks like it."""

from __future__ import annotations

import math

import pytest
import torch
from mismatch_draws import normal
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.mechanisms.transients.pulses import Pulses
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

N, RATE = 16_384, 100.0
SCENE = RecordingInfo(RATE, "deg/s", ("1", "2"))


def compared(path: Tensor, seed: int) -> Comparison:
    """Of a path `(time,)` that both sensors have on white noise of variance one, the second half as much."""
    g = torch.Generator().manual_seed(seed)
    gains = torch.tensor([[1.0], [0.5]], dtype=torch.float64)
    return Comparison.of(SCENE, normal(2, N, g=g) + gains * path, normal(4, 2, N, g=g))


def half_sine(onset: float, width: float) -> Tensor:
    u = (torch.arange(N, dtype=torch.float64) - onset) / width
    return torch.sin(math.pi * u.clamp(0, 1))


def test_a_pulse_is_found_with_its_width():
    found = Pulses.detect_and_fit(compared(6 * half_sine(5000.4, 40.0), 1), 1e-3)
    assert found is not None
    assert found.sensors == (0, 1)
    width = found.parameters["width"]
    assert width.low < 0.4 < width.high
    assert found.time_s == pytest.approx(50.0, abs=0.05)


@pytest.mark.parametrize("late", [False, True])
def test_what_has_no_beginning_or_no_end_in_the_record_is_no_pulse(late: bool):
    """A bias that settles after the start, or is on its way at the end."""
    t = torch.arange(N, dtype=torch.float64)
    course = 4 * torch.exp(-(N - 1 - t if late else t) / 900)
    assert Pulses.detect_and_fit(compared(course, 2), 1e-3) is None


def test_a_strong_warm_up_is_that_alone():
    g = torch.Generator().manual_seed(3)
    t = torch.arange(N, dtype=torch.float64) / RATE
    signal = normal(3, N, g=g) + 6 * torch.exp(-t / 11.3)
    report = gf.diagnose(signal, gf.WhiteNoise(1.0), rate=RATE)
    assert [finding.mechanism for finding in report.findings] == ["warm_up_transient"]
    assert report.findings[0].parameters["time_constant"].value == pytest.approx(11.3, rel=0.05)
