"""The trap of the blind proof: its likelihood against sums over all paths, and how far it is from Gaussian noise."""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_normal

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from blind.analog import consumer_base
from blind.likelihood import coefficients, grid
from blind.traps import Noise, Trap, beyond_its_twin, log_likelihood

TRAP, STEP, BLOCKS = Trap(3.0, 1.5), 1.3, 8
NOISE = Noise(0.5, np.array([0.7, 1.0]), np.array([0.2, 0.05]), np.array([0.2 / 0.51, 4.0]))


def rng(seed=0):
    return np.random.default_rng(seed)


def covariance(noise, n):
    """Of block means, (block, block)."""
    total = noise.white * np.eye(n)
    for phi, kick, start in zip(noise.phi, noise.kicks, noise.start, strict=True):
        into = np.tril(phi ** np.subtract.outer(np.arange(n), np.arange(n)).clip(0))  # of every kick
        first = phi ** np.arange(1, n + 1)
        total += kick * into @ into.T + start * np.outer(first, first)
    return total


def over_all_paths(y, noise, trap, step):
    """Likelihood of each record by the 256 paths."""
    law = multivariate_normal(np.zeros(BLOCKS), covariance(noise, BLOCKS))
    stay = np.exp(-trap.rate)
    upper = trap.up / (trap.up + trap.down)
    total = np.zeros(len(y))
    for path in range(2**BLOCKS):
        states = (path >> np.arange(BLOCKS)) & 1
        chance = (1 - upper, upper)[states[0]]
        for before, after in pairwise(states):
            chance *= stay * (before == after) + (1 - stay) * (1 - upper, upper)[after]
        total += chance * law.pdf(y - step * (states - 0.5))
    return total


def test_likelihood_of_noise_is_the_multivariate_normal():
    y = NOISE.records(3, BLOCKS, rng())
    law = multivariate_normal(np.zeros(BLOCKS), covariance(NOISE, BLOCKS))
    np.testing.assert_allclose(NOISE.log_likelihood(y), law.logpdf(y), rtol=1e-10)


def test_noise_has_its_covariance():
    records = NOISE.records(20_000, BLOCKS, rng())
    np.testing.assert_allclose(records.T @ records / len(records), covariance(NOISE, BLOCKS), atol=0.2)


def test_likelihood_that_follows_all_paths_is_the_sum_over_them():
    y = NOISE.records(3, BLOCKS, rng()) + STEP * (TRAP.path(BLOCKS, rng(1)) - 0.5)
    found = log_likelihood(y, NOISE, TRAP, STEP, rng(), paths=2 ** (BLOCKS + 1))
    np.testing.assert_allclose(found, np.log(over_all_paths(y, NOISE, TRAP, STEP)), rtol=1e-10)


def test_few_paths_have_the_right_likelihood_on_average():
    y = np.tile(NOISE.records(1, BLOCKS, rng()) + STEP * (TRAP.path(BLOCKS, rng(1)) - 0.5), (2000, 1))
    found = np.exp(log_likelihood(y, NOISE, TRAP, STEP, rng(2), paths=4))
    error = found.mean() - over_all_paths(y[:1], NOISE, TRAP, STEP)[0]
    assert found.std() > 0
    assert abs(error) < 4 * found.std() / np.sqrt(len(found))


def test_path_has_the_dwells():
    path = Trap(50.0, 150.0).path(400_000, rng())
    switches = np.abs(np.diff(path)).sum()
    assert abs(path.mean() - 0.25) < 0.02
    assert abs(switches - 2 * 400_000 / 200) < 4 * np.sqrt(4000)


def test_path_has_the_spectrum():
    n, trap = 4096, Trap(20.0, 10.0)
    power = np.mean([coefficients(trap.path(n, generator)) ** 2 for generator in rng().spawn(200)], axis=0)
    ratio = (power / trap.spectrum(grid(n))).reshape(-1, 315).mean(axis=1)
    np.testing.assert_allclose(ratio, 1, atol=0.05)


def test_a_trap_is_the_farther_from_its_twin_the_larger_it_is():
    """From nothing, and for a level that hardly drowns by what is known of it: it has two values, not a normal law."""
    base, trap = consumer_base(rng(), 200.0, relaxators=1), Trap(600.0, 400.0)
    white = np.sqrt(base.white[0])
    told = [beyond_its_twin(base, 0, 16384, trap, size * white, rng(5)) for size in (1e-3, 0.3, 1.0)]
    assert abs(told[0]) < 0.05
    assert told[0] < told[1] < told[2]
    assert told[2] > 30


@pytest.mark.parametrize("block", [1, 10])
def test_noise_of_block_means_is_that_of_the_base(block):
    """Variance of differences of block means over a few blocks, where walk, relaxator and white noise all show."""
    base = consumer_base(rng(1), 200.0, relaxators=1)
    x = base.copies(0, 60).simulate(20_000, rng(2))
    means = x.reshape(60, -1, block).mean(axis=-1)
    drawn = Noise.of(base, 0, block).records(60, means.shape[1], rng(3))
    for lag in (1, 5, 100):
        ours, theirs = (np.var(r[:, lag:] - r[:, :-lag]) for r in (drawn, means))
        assert ours == pytest.approx(theirs, rel=0.05)
