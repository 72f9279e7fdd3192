"""Where a function of one unknown, with or without several valleys, rises above a height, for many items at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_VALUES, _CLOSER, _ROUNDS = 10, 4, 2
# Standard deviations from the estimate at which there is another look.
_NEAR = (-3.0, -1.5, 1.5, 3.0)
_FROM_ZERO = 9.0  # nats over which the logarithm of a variance falls to what might as well be zero

Rise = Callable[[Tensor, Tensor], Tensor]


def grid(own: Tensor, sd: Tensor, least: Tensor, most: Tensor) -> Tensor:
    """Where to look, `(item, value)`, ascending: all over the range, and near the estimate `own`."""
    share = torch.linspace(0, 1, _VALUES, dtype=own.dtype, device=own.device)
    wide = least[:, None] + (most - least)[:, None] * share
    near = own[:, None] + sd[:, None] * own.new_tensor(_NEAR)
    near = torch.where(near.isfinite(), near, least[:, None]).clamp(least[:, None], most[:, None])
    return torch.cat([wide, near], -1).sort(-1)[0]


def crossings(rise: Rise, own: Tensor, values: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Outermost ends of where `rise <= z^2`.

    Args:
        rise: Of items `(n,)` at values `(n,)`.
        own: Where it is zero, `(item,)`.
        values: Where to look first, `(item, value)`; then closer and closer about the two crossings.
        z: Standard deviations, `(item,)`.

    Returns:
        Lower and upper end, `(item,)`, infinite where the grid ends before.
    """
    everyone = torch.arange(len(own), device=own.device)
    values = torch.cat([values, own[:, None]], -1)
    height = torch.where(values == own[:, None], -z[:, None], _heights(rise, everyone, values, z))
    values, order = values.sort(-1)
    height = height.gather(-1, order)
    held, n = height <= 0, values.shape[-1]
    place = torch.arange(n, device=own.device)
    ends = []
    for sign, at in ((-1, torch.where(held, place, n).amin(-1)), (1, torch.where(held, place, -1).amax(-1))):
        crossed = ((at + sign >= 0) & (at + sign < n)).nonzero()[:, 0]
        pair = torch.stack([at, at + sign], -1)[crossed]
        limit = torch.full_like(own, sign * torch.inf)
        limit[crossed] = _closer(
            rise, crossed, values[crossed].gather(-1, pair), height[crossed].gather(-1, pair), z[crossed]
        )
        ends.append(limit)
    return ends[0], ends[1]


def _closer(rise: Rise, items: Tensor, ends: Tensor, heights: Tensor, z: Tensor) -> Tensor:
    """Root between a value that is held and one that is not, `(item, 2)`, the nearest to the latter, `(item,)`."""
    inside, outside = ends.unbind(-1)
    inside = torch.where(inside.isinf(), outside - _FROM_ZERO, inside)
    outside = torch.where(outside.isinf(), inside - _FROM_ZERO, outside)
    share = torch.linspace(0, 1, _CLOSER + 2, dtype=ends.dtype, device=ends.device)
    place = torch.arange(_CLOSER + 2, device=ends.device)
    for _ in range(_ROUNDS if len(items) else 0):
        values = inside[:, None] + (outside - inside)[:, None] * share
        found = _heights(rise, items, values[:, 1:-1], z)
        found = torch.cat([heights[:, :1], found, heights[:, 1:]], -1)
        last = torch.where(found <= 0, place, 0).amax(-1, keepdim=True)
        pair = torch.cat([last, last + 1], -1)
        (inside, outside), heights = values.gather(-1, pair).unbind(-1), found.gather(-1, pair)
    below, above = heights.unbind(-1)
    return inside + (outside - inside) * (below / (below - above)).clamp(0, 1)


def _heights(rise: Rise, items: Tensor, values: Tensor, z: Tensor) -> Tensor:
    """Standard deviations above `z` at values `(item, value)`; infinite where there is no answer."""
    n_items, n = values.shape
    found = rise(items.repeat_interleave(n), values.flatten()).sqrt().view(n_items, n)
    return (found - z[:, None]).nan_to_num(nan=torch.inf)
