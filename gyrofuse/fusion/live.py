"""Fusing a stream in which sensors leave and return: weights of the live sensors, and bumpless transfer by offsets.

Sensor i feels the common rate, its own offset and noise, `x_i = rate + b_i + noise`. With weights `c_S` for the set S
of live sensors the virtual signal is

    y = sum_i c_S,i (x_i - b_i),   b_i <- b_i + a (x_i - b_i - y)

The offsets `b` are learnt from differences `x_i - y` alone, which do not hold the common rate: the rate passes with a
gain of exactly 1, whatever the set is. As `sum_i c_S,i (x_i - b_i - y) = 0`, learning leaves `sum_i c_S,i b_i` as it
is: while the set stays the same, the output is the weighted sum of the live sensors minus a constant, independent of
the learning, and when the set changes the new constant joins the two outputs without a step.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from gyrofuse._base.checks import check_n_samples, check_positive, check_positive_integer, check_signal
from gyrofuse._base.deprecation import warn_deprecated
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse.fusion.layer import FittedModule
from gyrofuse.fusion.result import SVOResult
from gyrofuse.fusion.svo import fit_svo
from gyrofuse.fusion.weights.subsets import solve_subsets
from gyrofuse.fusion.weights.svo import ScaleWeights, check_scale_weights
from gyrofuse.io.recording import Recording
from gyrofuse.io.saturation import check_full_scale
from gyrofuse.wavelets.moments import combined_covariance

# Number of steps in which the weight of a sensor that has returned grows: each moves the output by an eighth of what a
# jump would.
_RAMP_STEPS = 8


class _State(NamedTuple):
    """State of a stream.

    Attributes:
        offsets: `(item, sensor)`.
        gap: Samples since each sensor was last live, `(item, sensor)`.
        age: Live samples since its last absence of more than `hold` samples, `(item, sensor)`.
        n_tracked: Samples so far with a live sensor, `(item, 1)`.
    """

    offsets: Tensor
    gap: Tensor
    age: Tensor
    n_tracked: Tensor


_STATE = _State._fields


class LiveSVO(FittedModule):
    """A virtual gyro of a stream in which sensors leave and return, without a step in its output.

    A missing (non-finite) sample takes its sensor out while it lasts; the others are fused with their own optimal
    weights. Output is NaN while no sensor is live. A sensor that is back after at most `hold` samples has its weight
    again at once, with the offset it left with. After a longer absence its offset may have moved: it is estimated
    again from `settle` samples, and the weight then grows over as many samples. Sensors that come back when no other is
    live keep their old offsets.

    Until a sensor first leaves, the output is that of plain SVO. Later it is plain SVO less a constant, as the
    drift of an offset during an absence is unknown. Chunks of any length give the same output as the whole stream at
    once.

    Differences between sensors also hold the difference of their scale factors times the rate: under fast rotation the
    offsets, and with them the output after a change of the set, are off by a fraction of it.

    Args:
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
        method: `"svo"`, `"inverse_variance"` or `"equal"`.
        n_levels: Number of levels J of the fit.
        time_constant: Samples over which offsets are averaged. By default a quarter of the wavelet length at which a
            sensor that leaves would step the output least: half the averaging time of the smallest Allan deviation, as
            an exponential average reaches back twice its time constant.
        hold: Longest absence in samples after which a sensor keeps its offset; `time_constant` by default.
        settle: Samples from which the offset is estimated after a longer absence; `time_constant` by default.
        full_scale: Values of this size or above are missing, one number or `(..., sensor)`. No guard samples as
            by `mask_saturated`.

    Raises:
        TypeError, ValueError: Bad scale weights, or a number out of range.

    Example:
        >>> live = LiveSVO("long")
        >>> live.fit(calibration)  # (..., sensor, time)
        >>> for chunk in chunks:  # each (..., sensor, time)
        ...     virtual = live(chunk)  # (..., time)
    """

    _fitted = ("combined", "time_constant", "full_scale", *_STATE)
    combined: Tensor
    time_constant: Tensor
    full_scale: Tensor
    offsets: Tensor
    gap: Tensor
    age: Tensor
    n_tracked: Tensor

    def __init__(
        self,
        scale_weights: ScaleWeights | SVOResult = "flat",
        *,
        method: str = "svo",
        n_levels: int | None = None,
        time_constant: float | None = None,
        hold: int | None = None,
        settle: int | None = None,
        full_scale: float | Tensor | None = None,
        result: SVOResult | None = None,
    ) -> None:
        super().__init__()
        if isinstance(scale_weights, SVOResult):
            result, scale_weights = scale_weights, scale_weights.scale_weights
        check_scale_weights(scale_weights)
        self.scale_weights, self.method, self.n_levels = scale_weights, method, n_levels
        self._time_constant = None if time_constant is None else check_positive("time_constant", time_constant)
        self._hold = None if hold is None else check_n_samples("hold", hold)
        self._settle = None if settle is None else check_positive_integer("settle", settle)
        self._limit = torch.inf if full_scale is None else full_scale
        for name in self._fitted:
            self.register_buffer(name, torch.empty(0, dtype=torch.float64))
        if result is not None:
            warn_deprecated("LiveSVO(result)", "LiveSVO.from_result(result)")
            self._take(result)

    @classmethod
    def from_result(cls, result: SVOResult, **options: Any) -> LiveSVO:
        """A layer with the weights of a fit.

        Args:
            result: Fit of the array at rest, by method `"svo"`, `"inverse_variance"` or `"equal"`.
            **options: `time_constant`, `hold`, `settle` and `full_scale`, as for the constructor.

        Raises:
            TypeError: `result` is not an `SVOResult`.
            ValueError: A result of another method, a number out of range, or full scales of another shape than the
                sensors.
            SingularCovarianceError: The combined covariance of the result is not positive definite.
        """
        if not isinstance(result, SVOResult):
            raise TypeError(
                f"`result`: expected an SVOResult, got {type(result).__name__}; "
                "fit the array at rest with fit_svo(signal)"
            )
        layer = cls(result.scale_weights, n_levels=result.n_levels, **options)
        layer._take(result)
        return layer

    def fit(self, signal: Tensor | Recording) -> SVOResult:
        """Choose the weights from a recording at rest and keep them; the stream begins anew.

        Args:
            signal: `(..., sensor, time)` or a `Recording`.

        Returns:
            The result of `fit_svo`.

        Raises:
            TypeError, ValueError, SingularCovarianceError: As `fit_svo` and `from_result`.
        """
        result = fit_svo(signal, self.scale_weights, method=self.method, n_levels=self.n_levels)
        self._take(result)
        return result

    def _take(self, result: SVOResult) -> None:
        combined = _covariance_of(result)
        if self._time_constant is None:
            time = _tracking_time(result, combined)
        else:
            time = torch.full_like(combined[..., 0, 0], max(self._time_constant, 1.0))
        limit = check_full_scale(self._limit, combined.shape[:-1]).to(combined)
        with torch.inference_mode(False):  # so that they can be used in training later
            self.combined, self.time_constant, self.full_scale = (v.detach().clone() for v in (combined, time, limit))
        self.method = result.method
        self.reset()

    @property
    def hold(self) -> int:
        """Longest absence in samples after which a sensor keeps its offset."""
        return round(self.time_constant.max().item()) if self._hold is None else self._hold

    @property
    def settle(self) -> int:
        """Samples from which the offset of a sensor is estimated after a longer absence."""
        return round(self.time_constant.max().item()) if self._settle is None else self._settle

    def reset(self) -> None:
        """Begin another stream: without offsets, and with no sensor seen yet."""
        for name in _STATE:
            setattr(self, name, self.combined.new_empty(0))

    def forward(self, signal: Tensor) -> Tensor:
        """Fuse the next chunk of the stream.

        Args:
            signal: `(..., sensor, time)`, right after the chunk before.

        Returns:
            `(..., time)`.

        Raises:
            RuntimeError: No weights yet.
            TypeError: `signal` is not a floating point tensor.
            ValueError: Another number of sensors, or another batch shape than before.
        """
        self.check_fitted()
        check_signal("signal", signal)
        batch = self._start(signal)
        n_items, n_sensors, n_samples = batch.numel(), *signal.shape[-2:]
        shape = (*batch, n_sensors)
        combined = self.combined.double().expand(*shape, n_sensors).reshape(n_items, n_sensors, n_sensors)
        gain = (1 / self.time_constant.double()).expand(batch).reshape(n_items, 1)
        limit = self.full_scale.expand(shape).reshape(n_items, n_sensors, 1)
        items = signal.reshape(n_items, n_sensors, n_samples)
        state = _State(*(getattr(self, name).reshape(n_items, -1) for name in _STATE))
        fused = [signal.new_empty(n_items, 0)]
        # 2**17 samples of sensors at a time: 1 MiB, so that all that is computed from them stays in cache.
        for block in items.split(max(131_072 // max(n_items * n_sensors, 1), 1), dim=-1):
            if block.shape[-1]:
                live = block.isfinite() & (block.abs() < limit)
                virtual, state = self._advance(torch.where(live, block, 0.0).double(), live, combined, gain, state)
                fused.append(virtual.to(signal.dtype))
        for name, value in zip(_STATE, state, strict=True):
            setattr(self, name, value.reshape(*batch, -1))
        return torch.cat(fused, -1).view(*batch, n_samples)

    def extra_repr(self) -> str:
        """Show the scale weights, or the numbers once they are fitted."""
        if self.combined.numel() == 0:
            return f"scale_weights={self.scale_weights!r}"
        times = self.time_constant.flatten().tolist()
        time = f"{times[0]:.6g}" if len(set(times)) == 1 else f"{min(times):.6g}..{max(times):.6g}"
        return f"n_sensors={self.combined.shape[-1]}, time_constant={time}, hold={self.hold}, settle={self.settle}"

    def _start(self, signal: Tensor) -> torch.Size:
        """Batch shape of the stream, and its state where there is none yet."""
        n_sensors, batch = self.combined.shape[-1], signal.shape[:-2]
        if signal.shape[-2] != n_sensors:
            raise ValueError(
                f"`signal`: expected (..., sensor, time) with the {n_sensors} sensors that were fitted, "
                f"got shape {tuple(signal.shape)}"
            )
        if self.offsets.numel() == 0:
            fitted = self.combined.shape[:-2]
            if fitted != batch[len(batch) - len(fitted) :]:
                raise ValueError(f"`signal`: expected batch shape {tuple(fitted)} as fitted, got {tuple(batch)}")
            wanted = self.full_scale.shape
            if not _expands(wanted, signal.shape[:-1]):
                raise ValueError(
                    f"`signal`: expected a batch shape that goes with `full_scale` of shape {tuple(wanted)}, "
                    f"got {tuple(batch)}"
                )
            self.offsets = self.combined.new_zeros(*batch, n_sensors)
            self.gap = torch.full_like(self.offsets, self.hold + 1, dtype=torch.int64)
            self.age = torch.zeros_like(self.gap)
            self.n_tracked = torch.zeros_like(self.gap[..., :1])
        elif self.offsets.shape[:-1] != batch:
            raise ValueError(
                f"`signal`: expected batch shape {tuple(self.offsets.shape[:-1])} as in the chunks before, "
                f"got {tuple(batch)}; call reset() to begin another stream"
            )
        return batch

    def _advance(
        self, signal: Tensor, live: Tensor, combined: Tensor, gain: Tensor, state: _State
    ) -> tuple[Tensor, _State]:
        """Fuse a block `(item, sensor, time)`, zero where not live, into `(item, time)`."""
        age, gap = self._ages(live, state)
        stage = torch.where(live, self._stage(age), 0)  # (item, sensor, time)
        n_tracked = state.n_tracked + live.any(-2).cumsum(-1)  # (item, time)

        # Segments in which no sensor of any item changes its stage.
        changed = (stage[..., 1:] != stage[..., :-1]).flatten(0, 1).any(0)
        starts = torch.cat([changed.new_zeros(1, dtype=torch.int64), changed.nonzero().flatten() + 1])
        segment = torch.zeros_like(stage[0, 0]).index_fill_(0, starts[1:], 1).cumsum(0)  # (time,)
        weights = self._weights(combined, stage[..., starts].permute(2, 0, 1))  # (segment, item, sensor)

        fused = torch.einsum("tnp,npt->nt", weights[segment], signal)
        with torch.no_grad():
            # Settled sensors share one gain, which keeps sum_i c_i b_i; the others have a plain mean.
            shared = torch.maximum(1 / n_tracked.clamp(min=1).to(gain), gain)
            mean = 1 / age.clamp(min=1).to(gain)
            rate = torch.where(stage > 1, shared.unsqueeze(-2), torch.where(stage == 1, mean, 0.0))
            kept, learnt = _averages(signal - fused.unsqueeze(-2), rate, starts, segment)
            offsets, constants = state.offsets, []
            for weight, keep, move, new in zip(weights, kept, 1 - kept, learnt, strict=True):
                constant = (weight * offsets).sum(-1, keepdim=True)
                constants.append(constant)
                offsets = torch.addcmul(torch.addcmul(new, keep, offsets), move, constant)
            constant = torch.cat(constants, -1)[:, segment]  # (item, time)
        virtual = torch.where(live.any(-2), fused - constant, torch.nan)
        return virtual, _State(offsets, gap, age[..., -1], n_tracked[..., -1:])

    def _ages(self, live: Tensor, state: _State) -> tuple[Tensor, Tensor]:
        """Live samples of each sensor since its last long absence, `(item, sensor, time)`; and its last gap."""
        time = torch.arange(live.shape[-1], device=live.device)
        seen = live.cumsum(-1)
        before = -1 - state.gap.unsqueeze(-1)
        last = torch.maximum(torch.where(live, time, before).cummax(-1).values, before)
        gap = time - 1 - torch.cat([before, last[..., :-1]], -1)
        anew = live & (gap > self.hold)  # begins to be counted again, after as many samples as in `origin`
        origin = seen - 1
        known = (state.age.unsqueeze(-1) + seen - live.long()) > 0
        while True:
            latest = torch.where(anew, time, -1).cummax(-1).values
            counted = torch.gather(origin, -1, latest.clamp(min=0))
            age = seen - torch.where(latest >= 0, counted, -state.age.unsqueeze(-1))
            # Where no live sensor has settled, live sensors count as settled: those with old offsets, if any.
            alone = live.any(-2) & ~(live & (age > self.settle)).any(-2)  # (item, time)
            if not bool(alone.any()):
                return age, time[-1] - last[..., -1]
            here = alone & (alone.cumsum(-1) == 1)
            candidates = live & known & here.unsqueeze(-2)
            chosen = torch.where(candidates.any(-2, keepdim=True), candidates, live & here.unsqueeze(-2))
            anew = anew | chosen
            origin = torch.where(chosen, seen - 1 - 2 * self.settle, origin)

    def _stage(self, age: Tensor) -> Tensor:
        """1 while a sensor settles, then up to `1 + _RAMP_STEPS` as its weight grows."""
        grown = ((age - self.settle) * _RAMP_STEPS + self.settle - 1).div(self.settle, rounding_mode="floor")
        return 1 + torch.where(age > self.settle, grown.clamp(1, _RAMP_STEPS), 0)

    def _weights(self, combined: Tensor, stage: Tensor) -> Tensor:
        """Weights `(segment, item, sensor)`: the mean over the steps of the ramp of those of the sensors so far."""
        sets = [stage > 1]
        for step in range(2, _RAMP_STEPS + 1):
            further = stage > step
            sets.append(torch.where(further.any(-1, keepdim=True), further, sets[-1]))
        some = sets[0].any(-1, keepdim=True)
        weights = solve_subsets(combined.unsqueeze(-3), torch.stack(sets, -2)).mean(-2)
        return torch.where(some, weights, 0.0)


def _averages(values: Tensor, rate: Tensor, starts: Tensor, segment: Tensor) -> tuple[Tensor, Tensor]:
    """The recursion `b <- (1 - rate) b + rate value` over each segment, as `b <- kept b + learnt`.

    Args:
        values: `(item, sensor, time)`.
        rate: The same shape; 1 at the first sample of a segment at most.
        starts: First sample of each segment.
        segment: Segment of each sample, `(time,)`.

    Returns:
        `kept` and `learnt`, `(segment, item, sensor)`.
    """
    whole = rate >= 1
    log = torch.where(whole, 0.0, torch.log1p(-rate)).cumsum(-1)
    ends = torch.cat([starts[1:] - 1, starts.new_full((1,), len(segment) - 1)])
    at_end = log[..., ends]
    before = nn.functional.pad(at_end[..., :-1], (1, 0))
    share = rate * torch.exp(at_end[..., segment] - log)
    learnt = torch.zeros_like(at_end).index_add_(-1, segment, share * values)
    kept = torch.where(whole[..., starts], 0.0, torch.exp(at_end - before))
    return kept.permute(2, 0, 1), learnt.permute(2, 0, 1)


def _expands(shape: torch.Size, to: torch.Size) -> bool:
    return len(shape) <= len(to) and all(n in (1, m) for n, m in zip(reversed(shape), reversed(to), strict=False))


def _covariance_of(result: SVOResult) -> Tensor:
    """The matrix whose optimal weights, of all sensors and of any subset, are those of the result's method."""
    combined = combined_covariance(result.wavelet_cross_covariance.double(), result.scale_weights)
    check_positive_definite("the wavelet cross-covariance combined over scales", combined, result.sensors)
    if result.method == "svo":
        return combined
    if result.method == "inverse_variance":
        return torch.diag_embed(combined.diagonal(dim1=-2, dim2=-1))
    if result.method == "equal":
        return torch.eye(combined.shape[-1]).to(combined).expand_as(combined).clone()
    raise ValueError(
        f"`result`: expected a fit by 'svo', 'inverse_variance' or 'equal', got {result.method!r}; "
        "fit the array by one of these"
    )


def _tracking_time(result: SVOResult, combined: Tensor) -> Tensor:
    """Time constant in samples for which a sensor that leaves steps the output least, at least 1."""
    n_sensors = combined.shape[-1]
    others = ~torch.eye(n_sensors, dtype=torch.bool, device=combined.device)
    step = solve_subsets(combined.unsqueeze(-3), others) - solve_subsets(
        combined, torch.ones_like(others[0])
    ).unsqueeze(-2)
    variance = torch.einsum("...ai,...jik,...ak->...j", step, result.wavelet_cross_covariance.double(), step)
    # A level of fewer than four observations has its smallest variance by chance.
    judged = (result.dof >= 4) & variance.isfinite()
    level = torch.where(judged, variance, torch.inf).argmin(-1) + 1
    return torch.exp2(level.double() - 2).clamp(min=1.0)
