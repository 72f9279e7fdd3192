"""Non-negative least squares in batches, against SciPy one by one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import optimize

from gyrofuse._nnls import nonnegative_least_squares


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
