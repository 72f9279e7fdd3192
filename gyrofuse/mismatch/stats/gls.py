"""Generalised least squares of a few columns in independent noise of known variances, for many designs at once."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class LeastSquares(NamedTuple):
    """Weighted least squares of one design, or of many.

    Attributes:
        size: Coefficients, `(..., sensor, column)`.
        variance: Their variances, `(..., sensor, column)`.
        z: Coefficients of the columns made orthogonal one after the other, in standard deviations, `(..., sensor,
            column)`: the sum of their squares is twice the log likelihood ratio.
    """

    size: Tensor
    variance: Tensor
    z: Tensor


def least_squares(y: Tensor, variance: Tensor, design: Tensor, ridge: float = 1e-12) -> LeastSquares:
    """Fit `y = size @ design` in every sensor, the variances of the data given.

    Args:
        y: Data, `(sensor, ordinate)`.
        variance: Variances of the data, `(sensor, ordinate)`.
        design: Columns, `(..., column, ordinate)`; leading axes are designs to fit one by one.
        ridge: Share of a column's square that keeps equal columns apart: far above rounding, far below the information
            of any record.
    """
    gram = torch.einsum("so,...co,...do->...scd", 1 / variance, design, design)
    score = torch.einsum("so,...co->...sc", y / variance, design)[..., None]
    root = torch.linalg.cholesky(gram + torch.diag_embed(ridge * gram.diagonal(dim1=-1, dim2=-2)))
    z = torch.linalg.solve_triangular(root, score, upper=False)
    spread = torch.cholesky_inverse(root).diagonal(dim1=-1, dim2=-2)
    return LeastSquares(torch.cholesky_solve(score, root)[..., 0], spread, z[..., 0])
