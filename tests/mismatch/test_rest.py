"""Where a recording begins or ends with a hand on it."""

from __future__ import annotations

import pytest
import torch
from mismatch_draws import normal
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.detectors.variance.rest import stretch_at_rest

N = 8000
MODEL = gf.ArrayModel.from_sensors([gf.Model([gf.WhiteNoise(1.0)])] * 3)


def moved(seed: int, *stretches: tuple[int, int], gyros: bool = True) -> tuple[Tensor, Tensor]:
    """Noise, ten times as loud in some stretches."""
    g = torch.Generator().manual_seed(seed)
    gyro, acceleration = normal(3, N, g=g), normal(3, N, g=g)
    for first, end in stretches:
        acceleration[:, first:end] *= 10
        if gyros:
            gyro[:, first:end] *= 10
    return gyro, acceleration


@pytest.mark.slow
def test_a_start_and_an_end_that_move_are_told():
    gyro, acceleration = moved(1, (0, 410), (7700, N))
    rest = stretch_at_rest(gyro, acceleration, normal(3, N, g=torch.Generator().manual_seed(2)))
    assert rest == pytest.approx((410, 7700), abs=40)
    recording = gf.Recording(gyro, rate=100.0, unit="deg/s", channels={"acceleration": acceleration})
    report = gf.diagnose(recording, MODEL)
    assert report.notes[0].startswith("The recording is at rest from 4.4 s to 76.8 s only")
    assert report.notes[0] in str(report)


@pytest.mark.parametrize(
    ("stretches", "gyros"), [((), True), (((3000, 3400),), True), (((0, 400),), False), (((0, 6000),), True)]
)
def test_rest_and_what_is_no_start_are_not(stretches: tuple[tuple[int, int], ...], gyros: bool):
    """Nothing that moves, something in the middle, accelerometers alone, most of the recording."""
    gyro, acceleration = moved(3, *stretches, gyros=gyros)
    assert stretch_at_rest(gyro, acceleration, normal(3, N, g=torch.Generator().manual_seed(4))) is None


def test_what_moves_in_the_simulation_as_well_is_no_start():
    (gyro, acceleration), (simulation, _) = moved(5, (0, 400)), moved(6, (0, 400))
    assert stretch_at_rest(gyro, acceleration, simulation) is None
