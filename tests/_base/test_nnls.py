"""Non-negative least squares in batches, against SciPy one by one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import optimize

from gyrofuse._base import nnls as _nnls
from gyrofuse._base.nnls import nonnegative_least_squares


@pytest.mark.parametrize("n_unknown", [1, 2, 5, 9])
def test_solutions_are_those_of_scipy(n_unknown):
    generator = torch.Generator().manual_seed(n_unknown)
    columns = torch.randn(200, 14, n_unknown, generator=generator, dtype=torch.float64) + 0.7
    values = torch.randn(200, 14, generator=generator, dtype=torch.float64)
    got = nonnegative_least_squares(columns.mT @ columns, (columns.mT @ values[..., None])[..., 0])
    expected = np.stack([optimize.nnls(a, b)[0] for a, b in zip(columns.numpy(), values.numpy(), strict=True)])
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-11)
    assert (got == 0).any()
    assert (got >= 0).all()


def test_columns_of_very_different_sizes():
    generator = torch.Generator().manual_seed(1)
    columns = torch.rand(50, 12, 4, generator=generator, dtype=torch.float64)
    size = torch.tensor([1e-8, 1.0, 1e6, 1e-3], dtype=torch.float64)
    truth = torch.rand(50, 4, generator=generator, dtype=torch.float64) / size
    scaled = columns * size
    values = (scaled @ truth[..., None])[..., 0]
    got = nonnegative_least_squares(scaled.mT @ scaled, (scaled.mT @ values[..., None])[..., 0])
    torch.testing.assert_close(got, truth, rtol=1e-6, atol=0)


def test_two_equal_columns_share_and_keep_the_fit():
    generator = torch.Generator().manual_seed(2)
    column = torch.rand(12, 1, generator=generator, dtype=torch.float64)
    columns = torch.cat([column, column, torch.rand(12, 1, generator=generator, dtype=torch.float64)], -1)
    values = columns @ torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)
    got = nonnegative_least_squares(columns.mT @ columns, columns.mT @ values)
    torch.testing.assert_close(columns @ got, values, rtol=1e-6, atol=0)
    torch.testing.assert_close(got[:2].sum(), torch.tensor(1.5, dtype=torch.float64), rtol=1e-5, atol=0)


def test_spectra_that_are_nearly_the_same_are_told_apart_or_not_but_never_lost(monkeypatch) -> None:
    """Of AR1s three a decade exchanges may go round in circles: no more than rounding may be left to gain."""
    left_over, by_active_sets = [], _nnls._by_active_sets
    monkeypatch.setattr(_nnls, "_by_active_sets", lambda *given: left_over.append(1) or by_active_sets(*given))
    g = torch.Generator().manual_seed(3)
    f = torch.logspace(-4.5, -0.3, 50, dtype=torch.float64)
    phi = torch.exp(-2 * torch.pi * torch.logspace(-5, -1, 13, dtype=torch.float64))[:, None]
    walk = 1 / (4 * torch.sin(torch.pi * f).square())
    ar1s = 1 / (1 - 2 * phi * torch.cos(2 * torch.pi * f) + phi.square())
    columns = torch.cat([torch.ones_like(f)[None], walk[None], 1 / walk[None], ar1s])
    truth = columns[0] + 1e-8 * columns[1] + 1e-7 * columns[6]
    noise = torch.randn(1500, 50, generator=g, dtype=torch.float64) / torch.linspace(4, 60, 50, dtype=torch.float64)
    values = truth * (1 + noise).clamp(min=0.05)
    weights = torch.linspace(4, 60, 50, dtype=torch.float64) / values
    design = columns * weights[:, None]
    started = torch.rand(1500, len(columns), generator=g, dtype=torch.float64) < 0.3
    gram, moment = design @ design.mT, (design @ (weights * values)[..., None])[..., 0]
    got = nonnegative_least_squares(gram, moment, started)
    assert bool((got >= 0).all())
    assert left_over
    size = design.norm(dim=-1, keepdim=True)
    for row, one, coefficients in zip(design / size, weights * values, got * size[..., 0], strict=True):
        best = optimize.nnls(row.mT.numpy(), one.numpy())[1]
        assert float((row.mT @ coefficients - one).norm()) == pytest.approx(best, rel=1e-6)
