"""A model as a least-squares problem: columns, their slopes, and the way back to parameters."""

from __future__ import annotations

import pytest
import torch

import gyrofuse as gf
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.processes import AR1, Sinusoid

TAU = 2.0 ** torch.arange(1, 21, dtype=torch.float64)


def test_columns_are_wavelet_variances_of_unit_size():
    structure = ModelStructure((gf.WhiteNoise(), gf.AR1(), gf.RandomWalk(), gf.Drift(), gf.Sinusoid()), held=False)
    phi, beta = torch.tensor(0.99, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    shape = torch.stack([AR1.to_unconstrained(phi), Sinusoid.to_unconstrained(beta)])
    linear = torch.tensor([2.0, 0.5, 1e-4, 1e-6, 0.36], dtype=torch.float64)
    expected = gf.WhiteNoise(2.0) + gf.AR1(0.99, 0.5) + gf.RandomWalk(1e-4) + gf.Drift(1e-3) + gf.Sinusoid(0.6, 0.3)
    torch.testing.assert_close(
        structure.columns(TAU, shape) @ linear, expected.wavelet_variance(20), rtol=1e-10, atol=0
    )
    torch.testing.assert_close(structure.params(linear, shape), expected.params, rtol=1e-12, atol=0)


@pytest.mark.parametrize("x", [[8.4, -0.3, -5.0], [0.1, 3.0, 1.0], [0.0, 9.5, -10.0], [-1.5, 0.5, 6.0]])
def test_slopes_are_the_derivatives(x):
    structure = ModelStructure((gf.AR1(), gf.AR1(), gf.Sinusoid(), gf.WhiteNoise()), held=False)
    at = torch.tensor(x, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda v: structure.columns(TAU, v), at)
    expected = torch.stack([jacobian[:, k, k] for k in range(3)], -1)
    size = expected.abs().amax(0)
    torch.testing.assert_close(structure.slopes(TAU, at) / size, expected / size, rtol=1e-6, atol=1e-10)


def test_ar1s_come_from_slow_to_fast_and_sinusoids_from_high_to_low():
    structure = ModelStructure((gf.AR1(), gf.AR1(), gf.Sinusoid(), gf.Sinusoid()), held=True)
    linear = torch.tensor([[1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0]])
    shape = torch.tensor([[0.5, 3.0, -2.0, 1.0], [3.0, 0.5, 1.0, -2.0]])
    got_linear, got_shape = structure.ordered(linear, shape)
    torch.testing.assert_close(got_shape, torch.tensor([[3.0, 0.5, 1.0, -2.0]] * 2))
    torch.testing.assert_close(got_linear, torch.tensor([[2.0, 1.0, 4.0, 3.0], [1.0, 2.0, 3.0, 4.0]]))
    assert structure.name == "2*AR1 + 2*SIN"
    assert structure.free_nonlinear == [0, 1]
