"""Samples at the end of a sensor's range say only that the rate was beyond it: they are missing samples."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gyrofuse._base.checks import check_n_samples, check_signal

# The top value of a rounded sinusoid is met up to 1/(sqrt 2 - 1) = 2.4 times as often as the one below it, that of
# noise not even as often; more than this is a pile of clipped values.
_PILE = 3.0
_SMALLEST_PILE = 5


def mask_saturated(signal: Tensor, full_scale: float | Tensor, *, guard: int = 1) -> Tensor:
    """Make saturated samples missing: NaN where `|signal| >= full_scale`, and in `guard` samples on either side.

    A filter between the clipping and the output smears clipped samples over their neighbours before and after the
    full scale shows: `guard` should be as long as that filter, one sample for a sensor without.

    Args:
        signal: `(..., sensor, time)`.
        full_scale: Largest value that a sensor can give, one number or `(..., sensor)`; see `find_saturation`.
        guard: Samples on either side.

    Returns:
        A copy of the signal with NaN in place of those samples.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: A full scale that is not above 0 or of another shape than the sensors, or a guard that is not a
            whole number >= 0.
    """
    check_signal("signal", signal)
    limit = check_full_scale(full_scale, signal.shape[:-1]).to(signal)
    guard = check_n_samples("guard", guard)
    clipped = signal.abs() >= limit.unsqueeze(-1)
    if guard and clipped.numel():
        flat = clipped.reshape(1, -1, signal.shape[-1]).to(torch.float32)
        spread = nn.functional.max_pool1d(flat, 2 * guard + 1, stride=1, padding=guard)
        clipped = spread.view(clipped.shape) > 0
    return torch.where(clipped, torch.nan, signal)


def find_saturation(signal: Tensor) -> Tensor:
    """Full scale of every sensor, from the pile of equal values that clipping leaves at the largest or smallest one.

    A pile holds at least 5 samples and more than 3 times as many as have the next value: noise has fewer samples at
    its extremes, a rounded sinusoid 2.4 times as many at most.

    Args:
        signal: `(..., sensor, time)`; non-finite samples are left out.

    Returns:
        `(..., sensor)`, the smaller size of the two ends that are piled up; infinite where neither is, and where there
        is no sample.

    Raises:
        TypeError: `signal` is not a floating point tensor.
    """
    check_signal("signal", signal)
    full_scale = signal.new_full(signal.shape[:-1], torch.inf)
    if signal.shape[-1] == 0:
        return full_scale
    for sign in (1, -1):
        value = torch.where(signal.isfinite(), sign * signal, -torch.inf)
        top = value.amax(-1, keepdim=True)
        below = torch.where(value < top, value, -torch.inf)
        second = below.amax(-1, keepdim=True)
        n_top, n_second = (value == top).sum(-1), (value == second).sum(-1)
        piled = (n_top >= _SMALLEST_PILE) & (n_top > _PILE * n_second) & second.isfinite().squeeze(-1)
        full_scale = torch.where(piled, torch.minimum(full_scale, top.squeeze(-1).abs()), full_scale)
    return full_scale


def check_full_scale(value: float | Tensor, sensors: torch.Size) -> Tensor:
    """Return full scales as a tensor when all are above 0 and go with arrays of shape `sensors`, `(..., sensor)`."""
    limit = torch.as_tensor(value, dtype=torch.float64)
    if not bool((limit > 0).all()):
        raise ValueError(f"`full_scale`: expected numbers > 0, got {limit.tolist()}")
    try:
        fits = torch.broadcast_shapes(limit.shape, sensors)[-1] == sensors[-1]
    except RuntimeError:
        fits = False
    if not fits:
        raise ValueError(
            f"`full_scale`: expected one number, or one for each of {sensors[-1]} sensors in a shape that goes with "
            f"{tuple(sensors)}, got shape {tuple(limit.shape)}"
        )
    return limit
