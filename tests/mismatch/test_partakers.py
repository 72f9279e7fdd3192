"""Which sensors take part: densities against SciPy, what is chance in which company, how often it is right."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from gyrofuse.mismatch.stats.inclusion import _SIZES, _least, _log_ratio, included_sensors


@pytest.mark.parametrize("dof", [1, 2, 3])
def test_the_ratio_is_that_of_noncentral_and_central_densities(dof: int):
    for x in (0.05, 2.0, 15.0, 300.0):
        expected = stats.ncx2.logpdf(x, dof, 15.0) - stats.chi2.logpdf(x, dof)
        assert _log_ratio(x, dof, 15.0) == pytest.approx(expected, rel=1e-9, abs=1e-9)
    least = _least(dof, 20.0)
    densities = [stats.ncx2.pdf(least, dof, 20.0 * s**2) for s in _SIZES]
    assert np.mean(densities) == pytest.approx(stats.chi2.pdf(least, dof), rel=1e-6)


def test_little_is_chance_beside_much_and_counts_beside_little():
    little, chance = 2.3**2, 0.04
    among_strong = torch.tensor([15.0**2, 14.0**2, little, 0.3], dtype=torch.float64)
    among_weak = torch.tensor([3.4**2, 3.1**2, little, 0.3], dtype=torch.float64)
    assert included_sensors(among_strong, 1, chance).positions == (0, 1)
    assert included_sensors(among_weak, 1, chance).positions == (0, 1, 2)
    assert included_sensors(among_weak, 1, chance).least < included_sensors(among_strong, 1, chance).least
    assert included_sensors(torch.tensor([0.1, 0.4, 0.2], dtype=torch.float64), 1, chance).positions == (1,)


def test_what_is_beyond_doubt_takes_part_beside_anything():
    strong = torch.tensor([100.0, 70.0, 20.0, 120.0, 50.0, 0.5], dtype=torch.float64).square()
    assert included_sensors(strong, 1, 0.04).positions == (0, 1, 2, 3, 4)
    assert included_sensors(torch.tensor([1e12, 1e9, 60.0, 2.0], dtype=torch.float64), 2, 0.04).positions == (0, 1, 2)
    assert included_sensors(torch.tensor([math.nan, 1.0], dtype=torch.float64), 1, 0.04).positions == (1,)


@pytest.mark.statistical
@pytest.mark.parametrize(("dof", "total", "share"), [(1, 60.0, 0.78), (1, 200.0, 0.985), (3, 60.0, 0.65)])
def test_the_exact_set_is_found_as_often_as_sizes_that_are_alike_allow(dof: int, total: float, share: float, draws):
    """Shares are of 3000 drawn arrays; a threshold of 0.7 % for each sensor finds 0.59, 0.975 and 0.49."""
    rng, right, n = np.random.default_rng(1), 0, draws(250, 500)
    for _ in range(n):
        members = rng.permutation(6)[: rng.integers(1, 7)]
        size = np.zeros(6)
        size[members] = rng.uniform(0.8, 1.25, len(members)) ** 2
        size *= total / size.sum()
        z = rng.standard_normal((6, dof))
        z[:, 0] += np.sqrt(size)
        found = included_sensors(torch.from_numpy((z**2).sum(-1)), dof, 0.04)
        right += found.which.tolist() == (size > 0).tolist()
    assert right / n > share - 3 * math.sqrt(share * (1 - share) / n)
