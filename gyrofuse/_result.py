"""What every result shares."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class ConfidenceInterval(NamedTuple):
    """Lower and upper limits of the same shape as the estimate."""

    low: Tensor
    high: Tensor
