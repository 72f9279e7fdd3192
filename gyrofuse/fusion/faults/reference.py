"""Reference of the parity test: the noise of a nominal array, and how much its power varies without a fault."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive_integer, largest_level
from gyrofuse._base.deprecation import RenamedAttribute, moved_names, renamed_arguments
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse._base.results import Result
from gyrofuse.fusion.faults.residuals import (
    Products,
    chunks_of,
    energies_of,
    own_variance,
    parity_matrix,
    window_products,
)
from gyrofuse.io.recording import Recording
from gyrofuse.io.signals import as_recording
from gyrofuse.wavelets.intervals import equivalent_dof

__getattr__ = moved_names(__name__, {"fit_parity": "gyrofuse.fusion.faults.reference.fit_parity_reference"})

# Number of independent observations of a level beyond the p - 2 that the weights of a difference use up: an F law with
# fewer than four degrees of freedom has no finite variance.
_FEWEST = 4
# Number of levels above the longest that fits into a window, by default: a window is compared with up to `2**4` windows
# before it, so that a step stays visible for as long.
_LOOK_BACK = 4


@dataclass(frozen=True, eq=False)
class ParityReference(Result):
    """A nominal array. Batched over the leading dimensions of the signal.

    Attributes:
        wavelet_cross_covariance: `(..., level, sensor, sensor)`, signal^2, of the levels that are tested.
        dof: `(..., level)`, independent observations of each level.
        power_variance: `(..., level, sensor)`, variance between nominal windows of the relative energy of the sensor's
            difference from the others, less the variance by sampling.
        own_variance: `(..., level, sensor)`, wavelet variance of the sensors themselves, without common motion.
        own_power_variance: `(..., level, sensor)`, as `power_variance` for the energy of the sensor itself.
        n_windows: `(..., level)`, effective number of windows behind `power_variance`.
        window: Length of the windows in samples; 0 without windows.
        sensors: Name of each sensor.
    """

    wavelet_cross_covariance: Tensor
    dof: Tensor
    power_variance: Tensor
    own_variance: Tensor
    own_power_variance: Tensor
    n_windows: Tensor
    window: int
    sensors: tuple[str, ...]
    degrees_of_freedom = RenamedAttribute("dof")
    spread = RenamedAttribute("power_variance")
    own_spread = RenamedAttribute("own_power_variance")
    _batched = ("wavelet_cross_covariance", "dof", "power_variance", "own_variance", "own_power_variance", "n_windows")
    _contents = ("sensors", "window", *_batched)
    _keys: ClassVar[dict[str, str]] = {
        "dof": "degrees_of_freedom",
        "power_variance": "spread",
        "own_power_variance": "own_spread",
    }

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions; `()` for a single array."""
        return tuple(self.dof.shape[:-1])

    @property
    def n_levels(self) -> int:
        """Number of levels that are tested."""
        return self.wavelet_cross_covariance.shape[-3]

    def summary(self) -> str:
        """Observations and variation of the noise power by level, as fixed-width text."""
        windows = f"windows of {self.window} samples" if self.window else "no windows: noise is taken to be stationary"
        dof = self.dof.reshape(-1, self.n_levels).amin(0)
        variance = torch.maximum(self.power_variance, self.own_power_variance).amax(-1)
        sd = variance.reshape(-1, self.n_levels).amax(0).sqrt()
        return "\n".join(
            [
                f"Healthy array of {len(self.sensors)} sensors, {windows}",
                f"{'level':>5}  {'observations':>12}  {'noise power varies by':>21}",
                *(f"{j + 1:>5}  {dof[j].item():>12.1f}  {100 * sd[j].item():>19.1f} %" for j in range(self.n_levels)),
            ]
        )


@renamed_arguments(healthy="signal", extra_spread="extra_sd")
def fit_parity_reference(
    signal: Tensor | Recording | Sequence[Tensor | Recording],
    window: int,
    *,
    extra_sd: float = 0.0,
    n_levels: int | None = None,
) -> ParityReference:
    """Fit the reference of the parity test to an array without faults, at rest.

    The reference is the wavelet cross-covariance, and the variance of the noise power of each sensor between windows at
    each scale: real sensors are not quite stationary. At least forty windows are needed, better a hundred and of
    different conditions.

    Args:
        signal: `(..., sensor, time)` or a `Recording`, or several of them; NaN = missing sample. Windows that lack a
            sensor, and a last window that is not full, are left out.
        window: Samples of the windows that will be tested.
        extra_sd: Standard deviation of the relative noise power between sessions, 0.3 say, where all of `signal` is
            of one session.
        n_levels: Number of levels at most. By default up to sixteen windows, as far as they hold enough observations.

    Returns:
        The reference.

    Raises:
        TypeError: `signal` is neither a floating point tensor nor a `Recording`.
        ValueError: Fewer than two sensors, too few samples, or a number out of range.
        SingularCovarianceError: A dead, duplicated or linearly dependent sensor.
    """
    stretches = [as_recording(s) for s in ([signal] if isinstance(signal, Tensor | Recording) else signal)]
    values = [stretch.values for stretch in stretches]
    if not values:
        raise ValueError("`signal`: expected at least one stretch, got none")
    for value in values:
        if value.shape[:-1] != values[0].shape[:-1]:
            raise ValueError(
                f"`signal`: expected stretches of the same sensors, got shapes {tuple(values[0].shape)} "
                f"and {tuple(value.shape)}"
            )
        window = check_window(window, value.shape[-1], "signal")
    if not 0 <= extra_sd < math.inf:
        raise ValueError(f"`extra_sd`: expected a finite number >= 0 such as 0.3, got {extra_sd!r}")
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
        equivalent_dof(n_products),
        stretches[0].sensors,
        window,
        n_levels=n_levels,
        name="signal",
    )
    tested = slice(plain.n_levels)
    products = Products(means[..., tested, :, :], counts[..., tested], torch.ones_like(live))
    gamma = plain.wavelet_cross_covariance
    energies = energies_of(products, *parity_matrix(gamma, products.live), plain.own_variance)
    power_variance, n_windows = _power_variance(energies.parity, products.counts)
    own_power_variance, _ = _power_variance(energies.own, products.counts)
    extra = extra_sd**2
    return replace(
        plain,
        power_variance=power_variance + extra,
        own_power_variance=own_power_variance + extra,
        n_windows=n_windows,
        window=window,
    )


def stationary_reference(
    wccv: Tensor,
    dof: Tensor,
    sensors: tuple[str, ...],
    window: int,
    *,
    n_levels: int | None = None,
    name: str,
) -> ParityReference:
    """Reference of stationary noise, of the levels with enough observations.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        dof: `(..., level)`, independent observations.
        sensors: Name of each sensor.
        window: Samples of the windows that will be tested.
        n_levels: Number of levels at most; up to sixteen windows by default.
        name: Name of the argument that all this is from, for messages.

    Raises:
        ValueError: Fewer than two sensors, or too few observations.
        SingularCovarianceError: A dead, duplicated or linearly dependent sensor.
    """
    n_sensors = wccv.shape[-1]
    if n_sensors < 2:
        raise ValueError(f"`{name}`: expected at least 2 sensors to compare, got {n_sensors}; give an array of gyros")
    enough = (dof - (n_sensors - 2) >= _FEWEST) & wccv.isfinite().all(-1).all(-1)
    usable = int(enough.reshape(-1, enough.shape[-1]).all(0).cumprod(0).sum())
    if usable == 0:
        raise ValueError(
            f"`{name}`: expected at least {n_sensors - 2 + _FEWEST} independent observations at level 1 "
            f"for {n_sensors} sensors, got {dof[..., 0].min().item():.1f}; record longer"
        )
    most = largest_level(window) + _LOOK_BACK if n_levels is None else check_positive_integer("n_levels", n_levels)
    usable = min(usable, most)
    kept = wccv[..., :usable, :, :].double()
    check_positive_definite("the wavelet cross-covariance of the healthy array", kept, sensors)
    zeros = torch.zeros_like(kept[..., 0])
    dof = dof[..., :usable].double().expand(kept.shape[:-2])
    return ParityReference(
        wavelet_cross_covariance=kept,
        dof=dof,
        power_variance=zeros,
        own_variance=own_variance(kept),
        own_power_variance=zeros,
        n_windows=torch.ones_like(dof),
        window=0,
        sensors=tuple(sensors),
    )


def check_window(window: int, n_samples: int, name: str) -> int:
    """Return `window` when it is a whole number of samples, 2 or more, that `name` has.

    Args:
        window: Samples of a window.
        n_samples: Samples of the signal.
        name: Name of the signal, for the message.

    Raises:
        ValueError: Any other value.
    """
    window = check_positive_integer("window", window)
    if window == 1:
        raise ValueError(
            "`window`: expected at least 2 samples, got 1; a single sample has no variation: give a longer window"
        )
    if window > n_samples:
        raise ValueError(
            f"`window`: expected at most the {n_samples} samples of `{name}`, got {window}; give a shorter window"
        )
    return window


def _power_variance(energy: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Variance of relative energies between windows beyond that of sampling.

    Args:
        energy: `(..., window, level, sensor)`.
        counts: Number of coefficients, `(..., window, level)`.

    Returns:
        The variance `(..., level, sensor)`, 0 where it is not significant at 5 %, and the effective number of windows
        `(..., level)`.
    """
    from scipy import stats

    share = (counts / counts.sum(-2, keepdim=True).clamp(min=1)).unsqueeze(-1)
    mean = (share * energy).sum(-3, keepdim=True)
    n_windows = 1 / share.square().sum(-3).clamp(min=torch.finfo(share.dtype).tiny)
    variance = (share * (energy / mean - 1).square()).sum(-3) * n_windows / (n_windows - 1).clamp(min=1)
    sampling = (share * 2 / equivalent_dof(counts).unsqueeze(-1)).sum(-3)
    chance = stats.chi2.ppf(0.95, (n_windows - 1).clamp(min=1).cpu().numpy())
    largest = torch.as_tensor(chance).to(sampling) / (n_windows - 1).clamp(min=1)
    clear = torch.where((n_windows >= 2) & (variance > sampling * largest), variance - sampling, 0.0)
    # At levels that cannot show a variance it is the mean of the others, weighted by their precision.
    known = sampling.clamp(min=torch.finfo(sampling.dtype).tiny).reciprocal().square()
    power_variance = torch.maximum(clear, (known * clear).sum(-2, keepdim=True) / known.sum(-2, keepdim=True))
    return power_variance, n_windows.squeeze(-1)
