"""A healthy array, as the parity test knows it: its noise, and how far that varies when nothing is wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive_integer, check_signal, largest_level
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse._base.results import listed, numbered
from gyrofuse.fusion.faults.residuals import (
    Products,
    chunks_of,
    energies_of,
    own_variance,
    parity_matrix,
    window_products,
)
from gyrofuse.io.recording import Recording
from gyrofuse.wavelets.equivalent_dof import degrees_of_freedom

# Observations that a level needs beyond what the weights of a difference take.
_FEWEST = 4
# By default windows are compared with what came before them over this many times their length, as a power of 2.
_LOOK_BACK = 4
# Confidence at which noise power is taken to vary by more than sampling.
_SIGNIFICANT = 0.95


@dataclass(frozen=True, eq=False)
class ParityReference:
    """A healthy array. Batched over the leading dimensions of the signal.

    Attributes:
        wavelet_cross_covariance: `(..., level, sensor, sensor)`, signal^2, of the levels that are tested.
        degrees_of_freedom: `(..., level)`, independent observations that it rests on.
        spread: `(..., level, sensor)`, variance between healthy windows of the relative energy of the sensor's
            difference from the others, beyond what sampling alone gives.
        own_variance: `(..., level, sensor)`, wavelet variance of the sensors themselves, without common motion.
        own_spread: The same as `spread` for these.
        n_windows: `(..., level)`, windows that the spread rests on, in effect.
        window: Their length in samples; 0 when there were none.
        sensors: Name of each sensor.
    """

    wavelet_cross_covariance: Tensor
    degrees_of_freedom: Tensor
    spread: Tensor
    own_variance: Tensor
    own_spread: Tensor
    n_windows: Tensor
    window: int
    sensors: tuple[str, ...]

    @property
    def n_levels(self) -> int:
        """Number of levels that are tested."""
        return self.wavelet_cross_covariance.shape[-3]

    def summary(self) -> str:
        """What the reference rests on, as fixed-width text."""
        windows = f"windows of {self.window} samples" if self.window else "no windows: noise is taken to be stationary"
        degrees = self.degrees_of_freedom.reshape(-1, self.n_levels).amin(0)
        spread = torch.maximum(self.spread, self.own_spread).amax(-1).reshape(-1, self.n_levels).amax(0).sqrt()
        return "\n".join(
            [
                f"Healthy array of {len(self.sensors)} sensors, {windows}",
                f"{'level':>5}  {'observations':>12}  {'noise power varies by':>21}",
                *(
                    f"{j + 1:>5}  {degrees[j].item():>12.1f}  {100 * spread[j].item():>19.1f} %"
                    for j in range(self.n_levels)
                ),
            ]
        )

    def __str__(self) -> str:
        return self.summary()

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain lists and numbers, ready for JSON (NaN as None)."""
        return {
            "sensors": list(self.sensors),
            "window": self.window,
            "wavelet_cross_covariance": listed(self.wavelet_cross_covariance),
            "degrees_of_freedom": listed(self.degrees_of_freedom),
            "spread": listed(self.spread),
            "own_variance": listed(self.own_variance),
            "own_spread": listed(self.own_spread),
            "n_windows": listed(self.n_windows),
        }


def fit_parity(
    healthy: Tensor | Recording | Sequence[Tensor | Recording],
    window: int,
    *,
    extra_spread: float = 0.0,
    n_levels: int | None = None,
) -> ParityReference:
    """Learn from a healthy array at rest what the parity test compares with.

    Besides the wavelet cross-covariance this is how much the noise power of each sensor varies from window to window
    at each scale: real sensors are not quite stationary, and what they do when nothing is wrong is no fault. The more
    windows, forty or better a hundred, and the more different the conditions they stem from, the better it is known.

    Args:
        healthy: `(..., sensor, time)` or a `Recording`, or several of them; NaN = missing sample. Windows that lack a
            sensor, and a last one that is not full, are left out.
        window: Samples of the windows that will be tested.
        extra_spread: Standard deviation of the relative noise power that other days bring on top, 0.3 say, where all
            of `healthy` is of one session.
        n_levels: Number of levels at most. By default up to sixteen windows, as far as they hold enough observations.

    Returns:
        The reference.

    Raises:
        TypeError: `healthy` is neither a floating point tensor nor a `Recording`.
        ValueError: Fewer than two sensors, too few samples, or a number out of range.
        SingularCovarianceError: A dead, duplicated or linearly dependent sensor.
    """
    stretches = [healthy] if isinstance(healthy, Tensor | Recording) else list(healthy)
    values = [stretch.signal if isinstance(stretch, Recording) else stretch for stretch in stretches]
    if not values:
        raise ValueError("`healthy`: expected at least one stretch, got none")
    for value in values:
        check_signal("healthy", value)
        if value.shape[:-1] != values[0].shape[:-1]:
            raise ValueError(
                f"`healthy`: expected stretches of the same sensors, got shapes {tuple(values[0].shape)} "
                f"and {tuple(value.shape)}"
            )
        window = check_window(window, value.shape[-1], "healthy")
    if not 0 <= extra_spread < math.inf:
        raise ValueError(f"`extra_spread`: expected a finite number >= 0 such as 0.3, got {extra_spread!r}")
    most = largest_level(window) + _LOOK_BACK if n_levels is None else check_positive_integer("n_levels", n_levels)
    most = max(min(most, *(largest_level(value.shape[-1]) for value in values)), 1)
    chunks = [chunk for value in values for chunk in chunks_of(value.detach(), window, most)]
    means, counts, live = (
        torch.cat(column, values[0].ndim - 2)
        for column in zip(*(window_products(chunk, window, most) for chunk in chunks), strict=True)
    )
    counts = torch.where(live.all(-1, keepdim=True), counts, 0.0)  # (..., window, level)
    n_products = counts.sum(-2)
    plain = stationary_reference(
        torch.einsum("...wj,...wjik->...jik", counts, means) / n_products[..., None, None],
        degrees_of_freedom(n_products),
        stretches[0].sensors if isinstance(stretches[0], Recording) else numbered(values[0].shape[-2]),
        window,
        n_levels=n_levels,
        name="healthy",
    )
    tested = slice(plain.n_levels)
    products = Products(means[..., tested, :, :], counts[..., tested], torch.ones_like(live))
    gamma = plain.wavelet_cross_covariance
    energies = energies_of(products, gamma, *parity_matrix(gamma, products.live), plain.own_variance)
    spread, n_windows = _spread(energies.parity, products.counts)
    own_spread, _ = _spread(energies.own, products.counts)
    extra = extra_spread**2
    return replace(plain, spread=spread + extra, own_spread=own_spread + extra, n_windows=n_windows, window=window)


def stationary_reference(
    wccv: Tensor,
    degrees: Tensor,
    sensors: tuple[str, ...],
    window: int,
    *,
    n_levels: int | None = None,
    name: str,
) -> ParityReference:
    """The levels that hold enough observations and are asked for, without any spread.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        degrees: `(..., level)`, independent observations.
        sensors: Their names.
        window: Samples of the windows to come.
        n_levels: Number of levels at most; up to sixteen windows by default.
        name: What to call the source of all this in messages.
    """
    n_sensors = wccv.shape[-1]
    if n_sensors < 2:
        raise ValueError(f"`{name}`: expected at least 2 sensors to compare, got {n_sensors}; give an array of gyros")
    enough = (degrees - (n_sensors - 2) >= _FEWEST) & wccv.isfinite().all(-1).all(-1)
    usable = int(enough.reshape(-1, enough.shape[-1]).all(0).cumprod(0).sum())
    if usable == 0:
        raise ValueError(
            f"`{name}`: expected at least {n_sensors - 2 + _FEWEST} independent observations at level 1 "
            f"for {n_sensors} sensors, got {degrees[..., 0].min().item():.1f}; record longer"
        )
    most = largest_level(window) + _LOOK_BACK if n_levels is None else check_positive_integer("n_levels", n_levels)
    usable = min(usable, most)
    kept = wccv[..., :usable, :, :].double()
    check_positive_definite("the wavelet cross-covariance of the healthy array", kept, sensors)
    zeros = torch.zeros_like(kept[..., 0])
    degrees = degrees[..., :usable].double().expand(kept.shape[:-2])
    return ParityReference(
        wavelet_cross_covariance=kept,
        degrees_of_freedom=degrees,
        spread=zeros,
        own_variance=own_variance(kept),
        own_spread=zeros,
        n_windows=torch.ones_like(degrees),
        window=0,
        sensors=tuple(sensors),
    )


def check_window(window: int, n_samples: int, name: str) -> int:
    """Return `window` when it is a whole number, 2 or more, of samples that `name` has."""
    window = check_positive_integer("window", window)
    if window == 1:
        raise ValueError("`window`: expected at least 2 samples, for one shows no course; got 1; give a longer window")
    if window > n_samples:
        raise ValueError(
            f"`window`: expected at most the {n_samples} samples of `{name}`, got {window}; give a shorter window"
        )
    return window


def _spread(energy: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Variance `(..., level, sensor)` of relative energies `(..., window, level, sensor)` between windows beyond that
    of sampling, 0 where it is no more than chance, and the number of windows `(..., level)` that it rests on, each
    counted by its share.
    """
    from scipy import stats

    share = (counts / counts.sum(-2, keepdim=True).clamp(min=1)).unsqueeze(-1)
    mean = (share * energy).sum(-3, keepdim=True)
    n_windows = 1 / share.square().sum(-3).clamp(min=torch.finfo(share.dtype).tiny)
    variance = (share * (energy / mean - 1).square()).sum(-3) * n_windows / (n_windows - 1).clamp(min=1)
    sampling = (share * 2 / degrees_of_freedom(counts).unsqueeze(-1)).sum(-3)
    chance = stats.chi2.ppf(_SIGNIFICANT, (n_windows - 1).clamp(min=1).cpu().numpy())
    largest = torch.as_tensor(chance).to(sampling) / (n_windows - 1).clamp(min=1)
    clear = torch.where((n_windows >= 2) & (variance > sampling * largest), variance - sampling, 0.0)
    # What some levels show clearly is to be expected at those that cannot show it: their mean, by what they know.
    known = sampling.clamp(min=torch.finfo(sampling.dtype).tiny).reciprocal().square()
    spread = torch.maximum(clear, (known * clear).sum(-2, keepdim=True) / known.sum(-2, keepdim=True))
    return spread, n_windows.squeeze(-1)
