"""Fusing a stream in which sensors leave and return: weights for the live ones, offsets that keep the output in place.

Sensor i feels the common rate, its own offset and noise, `x_i = rate + b_i + noise`. With weights `c_S` for the set S
of live sensors the virtual signal is

    y = sum_i c_S,i (x_i - b_i),   b_i <- b_i + a (x_i - b_i - y)

The offsets `b` are learnt from differences `x_i - y` alone, which the common rate is not in: it passes with a gain of
exactly 1, whatever the set is. As `sum_i c_S,i (x_i - b_i - y) = 0`, learning leaves `sum_i c_S,i b_i` as it is: while
the set stays the same, the output is the weighted sum of the live sensors minus a constant, with nothing of the
learning in it, and when the set changes the new constant makes the two outputs meet.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from gyrofuse._base.checks import check_n_samples, check_positive, check_positive_integer, check_signal
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse.fusion.result import SVOResult
from gyrofuse.fusion.weights.svo import ScaleWeights, resolve_scale_weights
from gyrofuse.io.saturation import check_full_scale

_RAMP_STEPS = 8  # in which a sensor that has returned gets its weight back
_BLOCK = 2**17  # sensor samples worked on at a time
# A level of fewer observations than this does not tell how long to average.
_TELLING = 4.0


def subset_weights(wccv: Tensor, scale_weights: ScaleWeights, live: Tensor) -> Tensor:
    """Optimal weights of any live subset of an array, from the covariance of all of it; differentiable.

    `c_S = A_SS^-1 1 / (1' A_SS^-1 1)` with `A = sum_j omega_j Gamma_j`: what a fit without the other sensors gives.
    A subset that comes up again and again, as when it varies over time, is solved once.

    Args:
        wccv: `(..., level, sensor, sensor)`, signal^2.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
        live: `(..., sensor)`, bool; its leading dimensions broadcast with those of `wccv`, so that
            `(time, sensor)` goes with one array.

    Returns:
        `(..., sensor)`, sum 1, 0 for a sensor that is not live; NaN where none is.

    Raises:
        TypeError: `wccv` is not a floating point tensor, or `live` is not boolean.
        ValueError: Wrong shape or scale weights.
        SingularCovarianceError: `A_SS` is not positive definite.

    References:
        [Z] equation (7).
    """
    if wccv.ndim < 3 or wccv.shape[-1] != wccv.shape[-2]:
        raise ValueError(f"`wccv`: expected (..., level, sensor, sensor), got shape {tuple(wccv.shape)}")
    if live.dtype != torch.bool:
        raise TypeError(f"`live`: expected a boolean tensor, got {live.dtype}; compare with something")
    if live.shape[-1:] != wccv.shape[-1:]:
        raise ValueError(f"`live`: expected (..., sensor) with {wccv.shape[-1]} sensors, got shape {tuple(live.shape)}")
    omega = resolve_scale_weights(scale_weights, wccv.shape[-3]).to(wccv)
    return _solve_subsets(_combined(wccv, omega), live, check=True)


class LiveSVO(nn.Module):
    """A virtual gyro of a stream in which sensors leave and return, without a step in its output.

    A missing (non-finite) sample takes its sensor out for as long as it lasts; the others go on with their own optimal
    weights. Output is NaN while no sensor is live. A sensor that is back after at most `hold` samples has its weight
    again at once, with the offset it left with. After longer its offset may have moved: it is watched for `settle`
    samples, which give its offset anew, and its weight then grows over as many again. Sensors that come back when
    no other is there to compare with are taken with the offsets they had.

    Until a sensor first leaves, the output is that of plain SVO. Later it is plain SVO less a constant: what the offset
    of a sensor did while it was away, nobody saw, and the output is kept where it was. Chunks of any length give what
    the whole stream gives at once.

    Differences between sensors also hold what their scale factors differ by, times the rate: under fast rotation the
    offsets, and with them the output after a change of the set, are off by a fraction of that.

    Args:
        result: Fit of the array at rest, `method` `"svo"`, `"inverse_variance"` or `"equal"`.
        time_constant: Samples over which offsets are averaged. By default a quarter of the wavelet length at which a
            sensor that leaves would step the output least, by the fit: half the averaging time of the smallest Allan
            deviation, since an exponential average looks back twice as far as its time constant.
        hold: Longest absence in samples after which a sensor is trusted; `time_constant` by default.
        settle: Samples that a sensor is watched after a longer absence; `time_constant` by default.
        full_scale: Values of this size or above are missing, one number or `(..., sensor)`. Without guard samples:
            `mask_saturated` has those.

    Raises:
        TypeError: `result` is not an `SVOResult`.
        ValueError: A result of another method, a number out of range, or full scales of another shape than the sensors.
        SingularCovarianceError: The combined covariance of the result is not positive definite.

    Example:
        >>> live = LiveSVO(fit_svo(calibration, "long"))
        >>> for chunk in chunks:  # each (..., sensor, time)
        ...     virtual = live(chunk)  # (..., time)
    """

    combined: Tensor
    time_constant: Tensor
    full_scale: Tensor
    offsets: Tensor
    gap: Tensor
    age: Tensor
    n_tracked: Tensor

    def __init__(
        self,
        result: SVOResult,
        *,
        time_constant: float | None = None,
        hold: int | None = None,
        settle: int | None = None,
        full_scale: float | Tensor | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(result, SVOResult):
            raise TypeError(
                f"`result`: expected an SVOResult, got {type(result).__name__}; "
                "fit the array at rest with fit_svo(signal)"
            )
        combined = _covariance_of(result)
        if time_constant is None:
            time = _tracking_time(result, combined)
        else:
            time = torch.full_like(combined[..., 0, 0], max(check_positive("time_constant", time_constant), 1.0))
        longest = round(time.max().item())
        self.hold = longest if hold is None else check_n_samples("hold", hold)
        self.settle = longest if settle is None else check_positive_integer("settle", settle)
        limit = check_full_scale(torch.inf if full_scale is None else full_scale, combined.shape[:-1])
        self.register_buffer("combined", combined)
        self.register_buffer("time_constant", time)
        self.register_buffer("full_scale", limit.to(combined))
        for name in _STATE:
            self.register_buffer(name, combined.new_empty(0))

    def reset(self) -> None:
        """Forget the stream: offsets, and which sensors were there."""
        for name in _STATE:
            setattr(self, name, self.combined.new_empty(0))

    def forward(self, signal: Tensor) -> Tensor:
        """Fuse the next chunk of the stream.

        Args:
            signal: `(..., sensor, time)`, right after the chunk before.

        Returns:
            `(..., time)`.

        Raises:
            TypeError: `signal` is not a floating point tensor.
            ValueError: Another number of sensors, or another batch shape than before.
        """
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
        for block in items.split(max(_BLOCK // max(n_items * n_sensors, 1), 1), dim=-1):
            if block.shape[-1]:
                live = block.isfinite() & (block.abs() < limit)
                virtual, state = self._advance(torch.where(live, block, 0.0).double(), live, combined, gain, state)
                fused.append(virtual.to(signal.dtype))
        for name, value in zip(_STATE, state, strict=True):
            setattr(self, name, value.reshape(*batch, -1))
        return torch.cat(fused, -1).view(*batch, n_samples)

    def extra_repr(self) -> str:
        """Show the numbers that were given or found."""
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
            # Trusted sensors share one gain, which keeps sum_i c_i b_i; those that settle have a plain mean.
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
        """Live samples of each sensor since it was last away for too long, `(item, sensor, time)`; and its last gap."""
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
            # Where no live sensor is trusted, the live ones have to be: those that were there before, if any.
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
        weights = _solve_subsets(combined.unsqueeze(-3), torch.stack(sets, -2)).mean(-2)
        return torch.where(some, weights, 0.0)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        # The shape of the stream is known only from what is loaded.
        for name in _STATE:
            loaded = state_dict.get(prefix + name)
            if loaded is not None:
                setattr(self, name, torch.empty_like(loaded, device=self.combined.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


class _State(NamedTuple):
    """What a stream carries on.

    Attributes:
        offsets: `(item, sensor)`.
        gap: Samples since each sensor was last live, `(item, sensor)`.
        age: Live samples since it was last away for too long, `(item, sensor)`.
        n_tracked: Samples so far with a live sensor, `(item, 1)`.
    """

    offsets: Tensor
    gap: Tensor
    age: Tensor
    n_tracked: Tensor


_STATE = _State._fields


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
    pairs = zip(reversed(shape), reversed(to), strict=False)
    return len(shape) <= len(to) and all(own in (1, other) for own, other in pairs)


def _solve_subsets(combined: Tensor, live: Tensor, *, check: bool = False) -> Tensor:
    """Weights `(..., sensor)` of live subsets, each distinct one solved once."""
    batch = torch.broadcast_shapes(combined.shape[:-2], live.shape[:-1])
    n_sensors = combined.shape[-1]
    item = torch.arange(combined[..., 0, 0].numel(), device=live.device).view(combined.shape[:-2]).expand(batch)
    item, masks = item.reshape(-1), live.expand(*batch, n_sensors).reshape(-1, n_sensors)
    code = item
    for word in masks.split(32, dim=-1):
        bits = (word.long() << torch.arange(word.shape[-1], device=word.device)).sum(-1)
        code = torch.unique((code << 32) | bits, return_inverse=True)[1]
    one = torch.zeros(int(code.max()) + 1 if code.numel() else 0, dtype=torch.int64, device=code.device)
    one[code] = torch.arange(len(code), device=code.device)  # any one of each kind
    mask = masks[one]
    both = mask[:, :, None] & mask[:, None, :]
    matrix = torch.where(
        both, combined.reshape(-1, n_sensors, n_sensors)[item[one]], torch.diag_embed(~mask).to(combined)
    )
    if check:
        check_positive_definite("the wavelet cross-covariance of live sensors combined over scales", matrix)
    solved = torch.linalg.solve(matrix, mask.to(combined))
    weights = solved / solved.sum(-1, keepdim=True)
    return weights[code].view(*batch, n_sensors)


def _combined(wccv: Tensor, omega: Tensor) -> Tensor:
    """`A = sum_j omega_j Gamma_j`, [Z] equation (6); levels that do not count may be unknown (NaN)."""
    return torch.einsum("j,...jik->...ik", omega, torch.where(omega[:, None, None] > 0, wccv, 0.0))


def _covariance_of(result: SVOResult) -> Tensor:
    """The matrix whose optimal weights, of all sensors and of any subset, are those of the result's method."""
    combined = _combined(result.wavelet_cross_covariance.double(), result.scale_weights.double())
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
    step = _solve_subsets(combined.unsqueeze(-3), others) - _solve_subsets(
        combined, torch.ones_like(others[0])
    ).unsqueeze(-2)
    variance = torch.einsum("...ai,...jik,...ak->...j", step, result.wavelet_cross_covariance.double(), step)
    telling = (result.degrees_of_freedom >= _TELLING) & variance.isfinite()
    level = torch.where(telling, variance, torch.inf).argmin(-1) + 1
    return torch.exp2(level.double() - 2).clamp(min=1.0)
