"""Delays between sensors that share a motion: by phases, in samples and parts of one, and not of filters."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import signal

import gyrofuse as gf
from gyrofuse.mismatch.detectors.spectra.delays import fitted_delays, phases_of, sensor_delays
from gyrofuse.mismatch.mechanisms.signals.sensor_delay import SensorDelay
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import N_JUDGED

N, RATE = 16_384, 200.0
ALL = torch.ones(N_JUDGED, dtype=torch.bool)


def moved(seed: int, late: tuple[float, ...], sd: float = 3.0) -> np.ndarray:
    """Sensors with one motion below 20 Hz, which comes late by so many samples, and noise of their own."""
    g, fine = np.random.default_rng(seed), 10
    motion = signal.sosfilt(signal.butter(2, 0.2 / fine, output="sos"), g.standard_normal(fine * (N + 40)))
    motion *= sd / motion.std()
    own = [motion[fine * 20 - round(fine * k) :][: fine * N : fine] for k in late]
    return np.stack(own) + g.standard_normal((len(late), N))


def compared(late: tuple[float, ...], sd: float = 3.0, seed: int = 1) -> Comparison:
    info = RecordingInfo(RATE, "deg/s", tuple(str(i) for i in range(len(late))))
    still = tuple(0.0 for _ in late)
    return Comparison.of(
        info, torch.from_numpy(moved(seed, late, sd)), torch.from_numpy(moved(seed + 1, still, sd))[None]
    )


def report(recording: np.ndarray, simulation: np.ndarray) -> gf.MismatchReport:
    return gf.diagnose(*(gf.Recording(torch.from_numpy(x), rate=RATE, unit="deg/s") for x in (recording, simulation)))


def test_the_likelihood_is_highest_at_the_delay_and_sees_differences_alone() -> None:
    phases = phases_of(compared((0.0, 0.0, 2.0)), ALL)
    grid = torch.linspace(-4, 4, 81, dtype=torch.float64)
    likely = phases.likelihood(torch.stack([0 * grid, 0 * grid, grid], -1))
    assert float(grid[likely.argmax()]) == pytest.approx(2.0, abs=0.11)
    best = fitted_delays(phases).delay
    assert float(phases.likelihood(best + 5)) == pytest.approx(float(phases.likelihood(best)), rel=1e-9)
    assert float(phases.likelihood(best)) >= float(likely.max())


@pytest.mark.parametrize("late", [(0.0, 0.0, 2.0), (0.0, 0.5, 0.0, 0.0), (1.3, 0.0, 0.0), (0.0, -3.0)])
def test_delays_are_told_in_parts_of_a_sample(late: tuple[float, ...]) -> None:
    found = SensorDelay.detect_and_fit(compared(late), 1e-4)
    assert found is not None
    assert found.sensors == tuple(i for i, k in enumerate(late) if k)
    for i, k in enumerate(late):
        if k:
            assert found.parameters[f"delay[{i}]"].value == pytest.approx(5.0 * k, abs=0.3)


def test_chance_is_no_delay() -> None:
    runs = [SensorDelay.detect_and_fit(compared((0.0, 0.0, 0.0), seed=10 + 2 * k), 0.05) for k in range(20)]
    assert sum(run is not None for run in runs) <= 4
    assert sensor_delays(compared((0.0, 0.0), 0.3)) is None  # which share next to nothing


def test_it_is_the_one_cause_and_gone_after_the_repair() -> None:
    told = report(moved(3, (0.0, 0.0, 2.0)), moved(4, (0.0, 0.0, 0.0)))
    (found,) = told.findings
    assert found.mechanism == "sensor_delay"
    assert found.sensors == (2,)
    assert "later in sensor 3 than in the others, by up to 1" in found.sentence
    assert not told.unexplained
    assert told.held_out.before > 10
    assert told.held_out.after < 2


@pytest.mark.slow
@pytest.mark.parametrize(("order", "corner"), [(1, 0.1), (1, 0.3), (2, 0.2), (4, 0.25)])
def test_a_filter_of_one_that_is_moved_with_others_is_no_delay(order: int, corner: float) -> None:
    """It turns the phase of what they share as well, and no source in common does."""
    filtered = moved(5, (0.0, 0.0, 0.0))
    filtered[1] = signal.lfilter(*signal.butter(order, 2 * corner), filtered[1])
    told = report(filtered, moved(6, (0.0, 0.0, 0.0)))
    (found,) = told.findings
    assert (found.mechanism, found.sensors) == ("low_pass", (1,))
    assert found.parameters["corner[1]"].value == pytest.approx(corner * RATE, rel=0.03)
    assert not told.unexplained
    assert told.held_out.after < 2


@pytest.mark.slow
def test_a_filter_is_told_where_what_moves_the_sensors_is_a_hump() -> None:
    """Which is in both, and none that stands out."""

    def shaken(seed: int) -> np.ndarray:
        g = np.random.default_rng(seed)
        shared = signal.sosfilt(signal.butter(2, [0.3, 0.5], "bandpass", output="sos"), g.standard_normal(N))
        return 2 * shared * np.linspace(0.8, 1.2, 6)[:, None] + g.standard_normal((6, N))

    filtered = shaken(5)
    filtered[4] = signal.lfilter(*signal.butter(2, 0.5), filtered[4])
    (found,) = report(filtered, shaken(6)).findings
    assert (found.mechanism, found.sensors) == ("low_pass", (4,))
    assert found.parameters["corner[4]"].value == pytest.approx(0.25 * RATE, rel=0.03)
