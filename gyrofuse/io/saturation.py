"""Saturation: samples at the end of a sensor's range are not measured values and become missing samples."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gyrofuse._base.checks import check_n_samples, check_signal


def mask_saturated(signal: Tensor, full_scale: float | Tensor, *, guard: int = 1) -> Tensor:
    """Make saturated samples missing: NaN where `|signal| >= full_scale`, and in `guard` samples on either side.

    A filter between the clipping and the output smears clipped samples over their neighbours before and after the
    clipped values show: `guard` should be as long as that filter, one sample for a sensor without a filter.

    Args:
        signal: `(..., sensor, time)`.
        full_scale: Largest value that a sensor can give, one number or `(..., sensor)`; see `find_saturation`.
        guard: Number of samples on either side that become missing as well.

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
        guarded = nn.functional.max_pool1d(flat, 2 * guard + 1, stride=1, padding=guard)
        clipped = guarded.view(clipped.shape) > 0
    return torch.where(clipped, torch.nan, signal)


def find_saturation(signal: Tensor) -> Tensor:
    """Full scale of every sensor, from the number of equal samples at the largest or smallest value.

    Clipping is found where at least 5 samples, and more than 3 times as many as at the next value, are equal. Noise has
    fewer samples at its extremes; a rounded sinusoid takes its top value up to `1 / (sqrt(2) - 1) = 2.4` times as often
    as the value below.

    Args:
        signal: `(..., sensor, time)`; non-finite samples are left out.

    Returns:
        `(..., sensor)`, the smaller size of the ends at which samples are clipped; infinite where neither end is, and
        for a sensor without samples.

    Raises:
        TypeError: `signal` is not a floating point tensor.
    """
    check_signal("signal", signal)
    fewest, ratio = 5, 3.0  # of equal samples, as above
    full_scale = signal.new_full(signal.shape[:-1], torch.inf)
    if signal.shape[-1] == 0:
        return full_scale
    for sign in (1, -1):
        value = torch.where(signal.isfinite(), sign * signal, -torch.inf)
        top = value.amax(-1, keepdim=True)
        below = torch.where(value < top, value, -torch.inf)
        second = below.amax(-1, keepdim=True)
        n_top, n_second = (value == top).sum(-1), (value == second).sum(-1)
        clipped = (n_top >= fewest) & (n_top > ratio * n_second) & second.isfinite().squeeze(-1)
        full_scale = torch.where(clipped, torch.minimum(full_scale, top.squeeze(-1).abs()), full_scale)
    return full_scale


def check_full_scale(value: float | Tensor, sensors: torch.Size) -> Tensor:
    """Return full scales as a tensor.

    Args:
        value: One full scale, or one for each sensor.
        sensors: Shape of the sensors, `(..., sensor)`.

    Raises:
        ValueError: A full scale that is not above 0, or a shape that does not go with `sensors`.
    """
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
