"""Signs of drifts. Wavelet variances and spectra hold the square of a slope: its sign comes from the samples."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse.fitting.moments.inference import Estimates
from gyrofuse.noise.processes import Model


def rising(series: Tensor) -> Tensor:
    """Sign of the slope of a regression on time, `(item,)`.

    Args:
        series: Records, `(item, time)`; NaN = missing sample.
    """
    time = torch.arange(series.shape[-1], dtype=torch.float64, device=series.device)
    there = series.isfinite()
    rest = torch.where(there, series.to(torch.float64) - series.nanmean(-1, keepdim=True).to(torch.float64), 0.0)
    centre = (time * there).sum(-1, keepdim=True) / there.sum(-1, keepdim=True)
    return torch.where((rest * (time - centre)).sum(-1) < 0, -1.0, 1.0).to(torch.float64)


def drifts_of(model: Model) -> Tensor:
    """Whether each parameter is the slope of a drift, `(parameter,)`, bool.

    Args:
        model: Model whose parameters are asked about.
    """
    return torch.tensor([p.deterministic for p in model.processes for _ in p.parameters])


def with_drift_sign(estimates: Estimates, model: Model, sign: Tensor) -> Estimates:
    """Estimates with the signs of their drifts.

    Args:
        estimates: Estimates with slopes that are not negative.
        model: Model of the estimates.
        sign: Sign of the slopes, `(item,)`: 1 or -1.
    """
    column = drifts_of(model).to(sign.device)
    if not bool(column.any()):
        return estimates
    turn = torch.where(column, sign[:, None], 1.0)  # (item, parameter)
    low, high = estimates.low * turn, estimates.high * turn
    return replace(
        estimates,
        params=estimates.params * turn + 0.0,  # no -0
        covariance=estimates.covariance * turn[:, :, None] * turn[:, None, :],
        low=low.minimum(high) + 0.0,
        high=high.maximum(low) + 0.0,
    )
