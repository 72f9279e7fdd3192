"""The Haar wavelet filter bank: a function, and the same as fixed conv1d layers.

Level `j = 1..J` has filters of length `tau_j = 2**j`:

    W_{j,t} = (mean of the newest tau_j/2 samples - mean of the previous tau_j/2 samples) / 2

computed by the undecimated (a trous) pyramid, two taps a level:

    W_{j+1,t} = (v_{j,t} - v_{j,t-h}) / 2,   v_{j+1,t} = (v_{j,t} + v_{j,t-h}) / 2,   h = 2**j,  v_0 = x.

The pyramid only averages, so it is well conditioned; differences of long cumulative sums are not.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

from gyrofuse._base.checks import check_n_levels, check_positive_integer, check_signal


def haar_coefficients(signal: Tensor, n_levels: int | None = None) -> list[Tensor]:
    """Haar (MODWT) coefficients of every sensor at levels 1 to `n_levels`, without boundary coefficients.

    A coefficient whose window holds a missing (non-finite) sample is NaN. The mean of each sensor, which the
    filters ignore, is removed first so that float32 keeps its digits under a large offset.

    Args:
        signal: `(..., sensor, time)`, any unit.
        n_levels: Number of levels J; the largest with `2**J <= time` by default.

    Returns:
        A list over level of `(..., sensor, time - 2**j + 1)`, in the unit of the signal; entry `t` belongs to
        the window that ends at sample `t + 2**j - 1`.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: The shape is not `(..., sensor, time)`, or the signal is too short for `n_levels`.

    References:
        [Z] section II; Percival & Walden, Wavelet Methods for Time Series Analysis, ch. 5.
    """
    check_signal("signal", signal)
    return _pyramid(signal, _kernel(signal), check_n_levels(n_levels, signal.shape[-1]))


def coefficients_by_level(signal: Tensor, n_levels: int) -> Iterator[Tensor]:
    """Coefficients of one level after the other, so that no more than one level is in memory.

    Args:
        signal: `(..., time)`; a non-finite sample is missing.
        n_levels: Number of levels J.

    Yields:
        `(..., time - 2**j + 1)` for `j = 1..J`; NaN where the window holds a missing sample.
    """
    known = torch.where(signal.isfinite(), signal, torch.nan)
    smooth = known - known.nanmean(-1, keepdim=True)
    for level in range(n_levels):
        past, now = smooth[..., : -(2**level)], smooth[..., 2**level :]
        yield (now - past) / 2
        smooth = (now + past) / 2


class HaarFilterBank(nn.Module):
    """`haar_coefficients` as fixed, depthwise, dilated conv1d layers without trainable parameters.

    The same kernel serves every sensor and level, so one module takes arrays of any number of sensors.

    Args:
        n_levels: Number of levels J.
    """

    kernel: Tensor

    def __init__(self, n_levels: int) -> None:
        super().__init__()
        self.n_levels = check_positive_integer("n_levels", n_levels)
        # float64 holds +-1/2 exactly; the kernel follows the dtype of the signal, not the other way round.
        self.register_buffer("kernel", _kernel(torch.empty(0, dtype=torch.float64)), persistent=False)

    def forward(self, signal: Tensor) -> list[Tensor]:
        """Map a signal to its coefficients.

        Args:
            signal: `(..., sensor, time)`.

        Returns:
            A list over level of `(..., sensor, time - 2**j + 1)`.

        Raises:
            TypeError, ValueError: As `haar_coefficients`.
        """
        check_signal("signal", signal)
        check_n_levels(self.n_levels, signal.shape[-1])
        return _pyramid(signal, self.kernel.to(signal.dtype), self.n_levels)

    def extra_repr(self) -> str:
        """Show the number of levels."""
        return f"n_levels={self.n_levels}"


def _kernel(like: Tensor) -> Tensor:
    """The two-tap wavelet and scaling filters, `(filter, 1, tap)`, oldest tap first."""
    return torch.tensor([[[-0.5, 0.5]], [[0.5, 0.5]]], dtype=like.dtype, device=like.device)


def _pyramid(signal: Tensor, kernel: Tensor, n_levels: int) -> list[Tensor]:
    leading = signal.shape[:-1]
    known = torch.where(signal.isfinite(), signal, torch.nan)
    # Depthwise: every sensor of every batch item is a conv1d item of its own with one channel.
    smooth = (known - known.nanmean(-1, keepdim=True)).reshape(-1, 1, signal.shape[-1])
    coefficients = []
    for level in range(n_levels):
        both = functional.conv1d(smooth, kernel, dilation=2**level)  # (item, filter, time)
        coefficients.append(both[:, 0].reshape(*leading, both.shape[-1]))
        smooth = both[:, 1:]
    return coefficients
