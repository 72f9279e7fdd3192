"""A fitted multi-scale virtual gyro: weights of every band, and the causal filter that applies them."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse._base.checks import check_signal
from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse.fusion.result import SVOResult
from gyrofuse.fusion.uncertainty.cross_fitting import CrossFit
from gyrofuse.fusion.virtual_gyro import CrossFittedGyro
from gyrofuse.io.recording import Recording
from gyrofuse.io.signals import as_recording
from gyrofuse.wavelets.tiles import tile_length


def fuse_bands(weights: Tensor, signal: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Fuse every band of a signal with its own weights, causally and without delay.

    With `s_k,t` the mean of the last `2**k` samples and `d_k = s_{k-1} - s_k`,

        y = sum_{k=1..K} c_k' d_k + c_{K+1}' s_K = x_1 + sum_{k=0..K} a_k' s_k(x - x_1),

    where `a_0 = c_1` and `a_k = c_{k+1} - c_k`, as the weights of each band sum to 1. Only differences from the first
    sensor are filtered; what all sensors have in common passes unchanged, to the last bit. The means come from the
    pyramid `s_k,t = (s_{k-1,t} + s_{k-1,t-h}) / 2`, `h = 2**(k-1)`, which has no running sum to drift.

    A time at which any sensor lacks its sample gives NaN and is left out of all means; so is the time before the
    start. A mean that has seen fewer than `2**k` samples is that of those.

    Args:
        weights: `(..., band, sensor)`, each band sums to 1; the shortest time scale first.
        signal: `(..., sensor, time)`.
        state: Past of the filter, `(..., sensor, 2**(bands - 1) - 1)`, as returned; the start of a stream by default.

    Returns:
        The virtual signal `(..., time)` and the state after it.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: `signal` or `state` does not fit the weights.
    """
    check_signal("signal", signal)
    n_bands, n_sensors = weights.shape[-2:]
    if signal.shape[-2] != n_sensors:
        raise ValueError(
            f"`signal`: expected (..., sensor, time) with the {n_sensors} sensors that the weights are for, "
            f"got shape {tuple(signal.shape)}"
        )
    shape = (*signal.shape[:-1], 2 ** (n_bands - 1) - 1)
    if state is None:
        state = signal.new_zeros(shape)
    elif state.shape != shape:
        raise ValueError(f"`state`: expected shape {shape} for this signal, got {tuple(state.shape)}")
    # Weights a_0, a_1, ... of the means: c_1, c_2 - c_1, ...; the first sensor is the reference.
    steps = torch.cat([weights[..., :1, 1:], weights[..., 1:, 1:].diff(dim=-2, prepend=weights[..., :1, 1:])], dim=-2)
    steps = steps.to(signal.dtype)
    if torch.compiler.is_compiling():
        return _filter(steps, signal, state)
    # Tiles of time that pass through all bands while they are in cache, no shorter than the state they carry.
    tile = max(tile_length(signal.shape[:-1].numel(), signal.device, None), shape[-1])
    outputs = []
    for chunk in signal.split(tile, dim=-1):
        output, state = _filter(steps, chunk, state)
        outputs.append(output)
    return torch.cat(outputs, dim=-1), state


def _filter(steps: Tensor, signal: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
    """`fuse_bands` with weights as steps `(..., band, sensor - 1)`.

    The state holds, for each pyramid level, the last `h` of its means and, in the last row, of how many samples each
    mean is taken over.
    """
    time = signal.shape[-1]
    known = signal.isfinite().all(-2, keepdim=True)
    first = signal[..., :1, :]
    mean = torch.where(known, signal[..., 1:, :] - first, 0.0)  # (..., sensor - 1, time)
    count = known.to(signal.dtype)  # (..., 1, time)
    fused = steps[..., :1, :] @ mean
    kept = []
    for band in range(1, steps.shape[-2]):
        lag = 2 ** (band - 1)
        before = state[..., lag - 1 : 2 * lag - 1]
        means = torch.cat([before[..., :-1, :], mean], dim=-1)
        counts = torch.cat([before[..., -1:, :], count], dim=-1)
        kept.append(torch.cat([means[..., time:], counts[..., time:]], dim=-2))
        past, n_past = means[..., :time], counts[..., :time]
        n_both = count + n_past
        # Weighted by counts: 1/2 within the stream, 0 before its start.
        mean = torch.lerp(mean, past, n_past / n_both.clamp(min=1.0))
        count = n_both
        fused = fused + steps[..., band : band + 1, :] @ mean
    virtual = torch.where(known, first + fused, torch.nan).squeeze(-2)
    return virtual, torch.cat(kept, dim=-1) if kept else state


def well_observed(dof: Tensor, n_sensors: int) -> Tensor:
    """Levels that, like all levels below them, hold no fewer observations than there are sensors.

    Args:
        dof: Independent observations, `(..., level)`.
        n_sensors: Number of sensors.

    Returns:
        `(..., level)`, bool.
    """
    return (dof >= n_sensors).int().cumprod(-1).bool()


@dataclass(frozen=True, eq=False)
class MultiScaleResult(CrossFittedGyro):
    """A fitted multi-scale virtual gyro. Batched over the leading dimensions of the signal; index it to get one item.

    Attributes:
        weights: `(..., band, sensor)`; each band sums to 1, weights may be negative. Band `k = 1..K` is the difference
            between the means over the last `2**(k-1)` and `2**k` samples, the last band the mean over `2**K`.
        fused_wavelet_variance: `(..., level)`, wavelet variance of the recording itself fused with these weights,
            signal^2; too small, as the weights were chosen in it.
        cross_fit: How the wavelet variance in other recordings compares with that in this one.
        optimal_wavelet_variance: `(..., level)`, estimate of the smallest wavelet variance that one vector of weights
            can have at that level alone, `1 / (1' S_j^-1 1)`, signal^2, where `S_j` is `Gamma_j` shrunk towards the
            level below; too small at the last levels. No lower bound of `virtual_wavelet_variance`: bands weigh the
            time scales within a level separately, and weights are chosen from the same recording.
        single: One vector of weights for all scales, by `fit_svo` from the same recording and scale weights.
    """

    weights: Tensor
    fused_wavelet_variance: Tensor
    cross_fit: CrossFit
    optimal_wavelet_variance: Tensor
    single: SVOResult

    degrees_of_freedom = RenamedAttribute("dof")
    _batched = ("weights", "fused_wavelet_variance", "cross_fit", "optimal_wavelet_variance", "single")
    _contents = tuple(
        (
            "method sensors axes rate unit n_samples motion n_bands weights scale_weights tau dof "
            "wavelet_cross_covariance wavelet_variance virtual_wavelet_variance in_sample_wavelet_variance "
            "optimal_wavelet_variance equal_wavelet_variance single_wavelet_variance single_weights"
        ).split()
    )
    _keys: ClassVar[dict[str, str]] = {"dof": "degrees_of_freedom"}

    @property
    def method(self) -> str:
        """How the weights were chosen, `"multiscale"`."""
        return "multiscale"

    @property
    def n_bands(self) -> int:
        """Number of bands."""
        return self.weights.shape[-2]

    @property
    def wavelet_cross_covariance(self) -> Tensor:  # type: ignore[override]  # read through from `single`
        """`(..., level, sensor, sensor)`, signal^2."""
        return self.single.wavelet_cross_covariance

    @property
    def single_wavelet_variance(self) -> Tensor:
        """Wavelet variance of one vector of weights for all scales, in other recordings, `(..., level)`."""
        return self.single.virtual_wavelet_variance

    @property
    def single_weights(self) -> Tensor:
        """One vector of weights for all scales, `(..., sensor)`."""
        return self.single.weights

    @property
    def sensors(self) -> tuple[str, ...]:  # type: ignore[override]  # read through from `single`
        """Name of each sensor."""
        return self.single.sensors

    @property
    def axes(self) -> tuple[str, ...]:  # type: ignore[override]  # read through from `single`
        """Names along the leading dimension, empty when it has none."""
        return self.single.axes

    @property
    def rate(self) -> float | None:  # type: ignore[override]  # read through from `single`
        """Sampling rate in Hz, when known."""
        return self.single.rate

    @property
    def unit(self) -> str | None:  # type: ignore[override]  # read through from `single`
        """Unit of the signal, when known."""
        return self.single.unit

    @property
    def n_samples(self) -> int:  # type: ignore[override]  # read through from `single`
        """Length of the signal."""
        return self.single.n_samples

    @property
    def scale_weights(self) -> Tensor:  # type: ignore[override]  # read through from `single`
        """`(level,)`, sum 1: how much each level counts, relative to its optimum."""
        return self.single.scale_weights

    @property
    def dof(self) -> Tensor:
        """`(..., level)`, independent observations of the virtual gyro that a level holds."""
        return self.single.dof

    @property
    def confidence_level(self) -> float:
        """Confidence level of the intervals."""
        return self.single.confidence_level

    @property
    def in_sample_wavelet_variance(self) -> Tensor:
        """Wavelet variance of the recording itself fused with these weights, `(..., level)`."""
        return self.fused_wavelet_variance

    @property
    def motion(self) -> str:
        """A warning that the array seems to have moved while it was fitted, or an empty string."""
        return self.single.motion

    def virtual(self, signal: Tensor | Recording) -> Tensor:
        """Fuse a signal with these weights: `(..., sensor, time)` to `(..., time)`.

        A sample that any sensor lacks is NaN; the signal starts anew, see `MultiScaleSVO` for streams.

        Args:
            signal: `(..., sensor, time)`, or a `Recording`.

        Raises:
            TypeError: Neither a floating point tensor nor a `Recording`.
            ValueError: Another number of sensors.
        """
        return fuse_bands(self.weights, as_recording(signal).values)[0]

    def _summary_of_one(self) -> str:
        shown = self.sensors[:11]  # columns of weights in a line of text
        more = f" (first {len(shown)} of {len(self.sensors)} sensors)" if len(shown) < len(self.sensors) else ""
        lines = [
            self._headline(f"Multi-scale virtual gyro ({self.n_bands} bands)"),
            "",
            f"Weights of each band of time scale tau{more}",
            f"{f'tau ({self.time_unit})':>13}  " + " ".join(f"{name[:8]:>8}" for name in shown),
        ]
        places = [f"{tau:.6g}" for tau in self.tau[: self.n_bands - 1].tolist()] + ["longer"]
        lines += [
            f"{place:>13}  " + " ".join(f"{weight:>+8.4f}" for weight in row[: len(shown)])
            for place, row in zip(places, self.weights.tolist(), strict=True)
        ]
        columns = {
            "best sensor": self.wavelet_variance.amin(-1),
            "equal": self.equal_wavelet_variance,
            "one vector": self.single_wavelet_variance,
            "virtual": self.virtual_wavelet_variance,
        }
        lines += ["", *self._deviation_table("of the virtual gyro and one vector in other recordings", columns)]
        few = ~well_observed(self.dof, len(self.sensors)) & self.virtual_wavelet_variance.isfinite()
        if bool(few.any()):
            start = f"{self.tau[int(few.nonzero()[0])].item():.6g} {self.time_unit}"
            most = self.dof[few].max().item()
            caution = (
                f"Few observations: from {start} on, {most:.2g} or less, fewer than sensors; what is gained there "
                "follows from a model of the noise, and another recording has to confirm it."
            )
            lines += ["", textwrap.fill(caution, 110)]
        if self.motion:
            lines += ["", f"Warning: {self.motion}."]
        return "\n".join(lines)
