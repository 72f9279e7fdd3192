"""Straight tracks through time and frequency: sums along them, their fit, and what noise makes."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.detectors.moving import track_fit, tracks
from gyrofuse.mismatch.detectors.moving.chirps import chirp_test
from gyrofuse.mismatch.mechanisms.transients.chirp import Chirp
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo


def noise(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def phase(n: int, first: float, last: float) -> Tensor:
    t = torch.arange(n, dtype=torch.float64)
    return 2 * math.pi * (first * t + (last - first) * t.square() / (2 * n))


def test_tracks_are_summed_over_all_segments() -> None:
    powers = noise(2, 8, 64).square()
    more = torch.arange(8)
    drift = tracks._drift(more, 8)
    assert torch.equal(drift[:, -1], more)
    assert torch.equal(drift[0], torch.zeros(8, dtype=torch.int64))
    moves = torch.tensor([3, 5, 11])  # the last one more than once around
    for move, sums in zip(moves.tolist(), tracks._tracks(powers, moves), strict=True):
        for d in range(8):
            at = [[(b + move * m + int(drift[d, m])) % 64 for m in range(8)] for b in range(64)]
            naive = [sum(float(powers[m, b]) for m, b in enumerate(along)) for along in at]
            np.testing.assert_allclose(sums[d].numpy(), naive)


@pytest.mark.parametrize(("n", "nats"), [(4096, 44.0), (65536, 50.0)])
@pytest.mark.parametrize(("first", "last"), [(0.1, 0.4), (0.3127, 0.2731)])
def test_a_track_is_found_by_what_the_whole_record_has_in_phase(n: int, nats: float, first: float, last: float) -> None:
    amplitude = 2 * math.sqrt(nats / (3 * n))  # of three sensors
    gains = torch.tensor([1.0, -1.0, 0.0, 1.0])[:, None]
    white = noise(3, 4, n) + amplitude * gains * phase(n, first, last).cos()
    found = tracks.strongest_sweep(white)
    assert (found.first, found.last) == pytest.approx((first, last), abs=2 / n)
    assert {0, 1, 3} <= set(found.sensors)
    assert found.turns == ()
    assert found.p_value < 1e-3


@pytest.mark.statistical
def test_few_tracks_are_lost_among_all_that_noise_has() -> None:
    n, found = 65536, 0
    for seed in range(8):
        first, last = np.random.default_rng(seed).uniform((0.0, 0.25), (0.25, 0.5))
        sensors = torch.arange(6) <= seed % 6
        gains = sensors * (1 - 2 * (torch.arange(6) % 2)) * math.sqrt(2 * 50 / (n / 2 * int(sensors.sum())))
        white = noise(seed, 6, n) + gains[:, None] * phase(n, first, last).cos()
        found += tracks.strongest_sweep(white).p_value < 1e-3
    assert found >= 6


@pytest.mark.statistical
def test_the_ends_of_a_strong_track_are_as_good_as_can_be() -> None:
    n, amplitude, of_bound = 16384, 0.17, []
    t = torch.arange(n, dtype=torch.float64) / n
    turns = 2 * math.pi * torch.stack([t - t.square() / 2, t.square() / 2, torch.ones_like(t)])  # of the ends, phase
    bound = torch.linalg.inv(amplitude**2 * turns @ turns.T)[:2, :2]  # Cramer-Rao, cycles over the record, two sensors
    for seed in range(16):
        first, last = np.random.default_rng(seed).uniform((0.05, 0.3), (0.2, 0.45))
        gains = amplitude * torch.tensor([1.0, -1.0, 0.0])[:, None]
        found = tracks.strongest_sweep(noise(seed, 3, n) + gains * phase(n, first, last).cos())
        off = n * torch.tensor([found.first - first, found.last - last], dtype=torch.float64)
        of_bound.append(float(off @ torch.linalg.solve(bound, off)))
    assert sum(of_bound) < stats.chi2(2 * len(of_bound)).isf(1e-3)


def test_a_track_that_folds_back_says_where() -> None:
    white = noise(5, 2, 8192) + 0.4 * phase(8192, 0.4, 0.6).cos()
    found = tracks.strongest_sweep(white)
    assert (found.first, found.last) == pytest.approx((0.4, 0.4), abs=1e-3)
    assert found.turns == (0.5,)


def test_gamma_tails_hold_where_they_are_tiny() -> None:
    powers = torch.tensor([0.0, 0.5, 20.0, 300.0], dtype=torch.float64)
    for shape in (1, 4, 16):
        expected = stats.gamma(shape).logsf(powers.numpy())
        got = track_fit._log_tail(shape, powers)
        np.testing.assert_allclose(got.numpy(), expected, rtol=1e-6, atol=1e-12)
        assert got[0] == 0.0


@pytest.mark.statistical
@pytest.mark.parametrize("n_sensors", [1, 3])
def test_noise_shows_no_track_more_often_than_it_says(n_sensors: int) -> None:
    p_values = [tracks.strongest_sweep(noise(seed, n_sensors, 4096)).p_value for seed in range(40)]
    alarms = sum(p < 0.05 for p in p_values)
    assert stats.binomtest(alarms, len(p_values), 0.05, alternative="greater").pvalue > 0.01
    assert min(p_values) < 0.9  # and says something


def test_pulses_are_no_line_that_moves() -> None:
    """They have all frequencies: two of them would have any track that passes."""
    n = 22_186
    pulse = torch.tensor([-100.0, -190.0, -130.0, -60.0])
    signal, simulation = noise(5, 3, n), noise(6, 1, 3, n)
    for at in (4836, 14_129):
        signal[:, at : at + 4] += pulse
    comparison = Comparison.of(RecordingInfo(1000.0, "deg/s", ("1", "2", "3")), signal, simulation)
    assert chirp_test(comparison).p_value > 1e-3


def test_a_loud_chirp_is_followed_to_its_ends():
    """Of 100 times the noise: where it begins the course has few samples, and goes on as beside them."""
    n, rate = 13763, 944.8
    t = torch.arange(n, dtype=torch.float64) / n
    low, high = 0.05, 0.42  # cycles per sample
    path = 10.0 * torch.cos(2 * math.pi * n * (low * t + (high - low) * t.square() / 2))
    g = torch.Generator().manual_seed(3)
    recording, simulation = (torch.randn(2, n, generator=g, dtype=torch.float64) for _ in range(2))
    recording[0] += path
    info = RecordingInfo(rate, "deg/s", ("a", "b"))
    found = Chirp.detect_and_fit(Comparison.of(info, recording, simulation[None]), 1e-3)
    assert found is not None
    assert isinstance(found.effect, Chirp)
    left = recording[0] - found.effect.path(n, rate)[0]
    assert float(left.var()) < 1.3
