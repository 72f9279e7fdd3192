"""Whether large squares come together more than in another series.

Statistic: mean of `c_t = sum_(lag <= 15) x_t x_(t+lag)` of standardised squares. Null law: Student's `t`, with the
long-run variances of either series' `c_t`, which are not taken below 15, that of independent values.
"""

from __future__ import annotations

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.stats.long_run_variance import equal_means_score

LAGS = 15  # samples: longer bursts are seen by the level's range


def clustering_p_value(observed: Tensor, reference: Tensor) -> float:
    """One-sided p value of squares `(record, time)` that come together as those of the other ones do."""
    score, dof = equal_means_score(_products(observed), _products(reference), LAGS)
    return float(stats.t.sf(score, dof))


def _products(squares: Tensor) -> Tensor:
    x = squares - squares.mean(-1, keepdim=True)
    x = x / x.square().mean(-1, keepdim=True).sqrt()
    n = x.shape[-1] - LAGS
    return torch.stack([x[..., :n] * x[..., lag : n + lag] for lag in range(1, LAGS + 1)]).sum(0)
