"""Checks of signals."""

from __future__ import annotations

import pytest
import torch

from gyrofuse._base.checks import check_signal


def test_thousands_of_sensors_with_fewer_samples_are_time_first():
    """Their covariances would take all memory there is."""
    with pytest.raises(ValueError, match=r"more sensors than samples; if time comes first, transpose"):
        check_signal("signal", torch.zeros(2000, 3))
    assert check_signal("signal", torch.zeros(900, 3)).shape == (900, 3)
    assert check_signal("signal", torch.zeros(2000, 2000)).shape == (2000, 2000)
