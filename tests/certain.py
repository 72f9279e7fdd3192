"""A cross-fit of weights that nobody chose from the data."""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse.fusion.uncertainty.cross_fitting import CrossFit
from gyrofuse.wavelets.intervals import chi_square_interval


def certain_fit(degrees: Tensor, confidence_level: float) -> CrossFit:
    """Of weights chosen beforehand, from the degrees of freedom `(..., level)` of each level alone."""
    one, nan = torch.ones_like(degrees), torch.full_like(degrees, torch.nan)
    low, high = chi_square_interval(one, degrees, confidence_level)
    return CrossFit(torch.zeros_like(one), low, high, one, nan, nan)
