"""A fused array in sentences: which sensors carry it, and where it is better or worse than others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby

import torch
from torch import Tensor

from gyrofuse._base.page import number
from gyrofuse.fusion.multiscale_result import MultiScaleResult, well_observed
from gyrofuse.fusion.result import SVOResult

Fused = SVOResult | MultiScaleResult

# Relative difference between Allan deviations up to which they are called equal: far below their standard errors.
ALIKE = 0.005


def verdict(result: Fused) -> list[str]:
    """Sentences on which sensors carry the virtual gyro, and where its Allan deviation is lower and higher.

    Levels with fewer observations than sensors are left out of the comparisons, and a sentence says so, unless all
    levels are such.

    Args:
        result: Result of one array.
    """
    sentences = [f"Beware: {result.motion}."] if result.motion else []
    if isinstance(result, MultiScaleResult):
        sentences += [*_ends_in_words(result), *_bands_in_words(result)]
    else:
        sentences += _weights_in_words(result)
    if result.method != "equal":
        sentences.append(_compared(result, result.equal_wavelet_variance, "the plain mean"))
    sentences.append(_compared(result, result.wavelet_variance.amin(-1), "the best single sensor"))
    if isinstance(result, MultiScaleResult) and bool(_resolved(result).any()):
        one = result.single.virtual_wavelet_variance
        sentences.append(_compared(result, one, "one vector of weights for all scales"))
    return sentences + _few_in_words(result)


def _resolved(result: Fused) -> Tensor:
    """Levels `(level,)` that are known and, like all below them, hold no fewer observations than there are sensors."""
    return well_observed(result.dof, len(result.sensors)) & result.virtual_wavelet_variance.isfinite()


def _judged(result: Fused) -> Tensor:
    """Levels `(level,)` that comparisons are about: those that are resolved, or all where none is."""
    resolved = _resolved(result)
    return resolved if bool(resolved.any()) else torch.ones_like(resolved)


def _few_in_words(result: Fused) -> list[str]:
    """Where observations are fewer than sensors, and what follows for the comparisons and for the weights."""
    few = ~_resolved(result) & result.virtual_wavelet_variance.isfinite()
    if not bool(few.any()):
        return []
    most = number(result.dof[few].max().item(), 2)
    start = (
        f"From {_time(result, int(few.nonzero()[0]))} on, the recording holds fewer independent observations "
        f"({most} or less) than there are sensors"
    )
    left_out = ", so that the comparisons end before" if bool(_resolved(result).any()) else ""
    if result.method in ("svo", "multiscale") and bool((result.scale_weights[few] > 0).any()):
        return [
            f"{start}{left_out}: what it gains there follows from a model of the noise, and another recording has to "
            "confirm it."
        ]
    return [f"{start}{left_out or ': the comparisons are an indication and no more'}."]


def _ends_in_words(result: MultiScaleResult) -> list[str]:
    """What the virtual gyro gains at the shortest averaging time and at the longest that the recording resolves."""
    resolved = _resolved(result)
    longest = int(resolved.nonzero().max()) if bool(resolved.any()) else 0
    sentences = [_gained_at(result, 0, "the shortest averaging time")]
    if longest:
        phrase = "the longest averaging time with no fewer observations than sensors"
        sentences.append(_gained_at(result, longest, phrase))
    return sentences


def _gained_at(result: MultiScaleResult, level: int, phrase: str) -> str:
    """Allan deviation of the virtual gyro at one averaging time, with its interval, beside that of equal weights."""
    virtual, equal = result.virtual_wavelet_variance, result.equal_wavelet_variance
    ends = (virtual, *result.interval_of(virtual), equal)
    deviation, low, high, mean = (math.sqrt(2 * variance[level].item()) for variance in ends)
    unit = f" {result.unit}" if result.unit not in (None, "unknown") else ""
    less = 1 - deviation / mean
    if abs(less) > ALIKE:
        standing = f"is {_percent(abs(less))} {'lower' if less > 0 else 'higher'} than with equal weights"
    else:
        standing = f"is that of equal weights within {_percent(ALIKE)}"
    return (
        f"At {_time(result, level)}, {phrase}, the Allan deviation {standing}: "
        f"{number(deviation)}{unit}, {100 * result.confidence_level:g} % interval {number(low)} to "
        f"{number(high)}, against {number(mean)}."
    )


def _bands_in_words(result: MultiScaleResult) -> list[str]:
    """The sensors that weigh most in the fastest and in the slowest band."""
    first, last = (
        f"sensor {result.sensors[int(band.argmax())]} (weight {band.max().item():.3f})"
        for band in result.weights[[0, -1]]
    )
    if result.n_bands == 1:
        return [f"There is one band for all time scales, in which {first} weighs most."]
    return [
        f"Each of {result.n_bands} bands of time scales has its own weights: in the fastest band {first} weighs most, "
        f"in the slowest {last}."
    ]


def _weights_in_words(result: SVOResult) -> list[str]:
    if result.method == "equal":
        return [f"Every sensor has the weight 1/{len(result.sensors)}: this is the plain mean."]
    low, high = result.confidence_interval
    order = result.weights.abs().argsort(descending=True).tolist()
    if bool(low.isnan().any()):
        return [f"The largest weights are those of {_listed(result, order)}; they come without intervals."]
    certain = ((low > 0) | (high < 0)).tolist()
    carriers, others = ([i for i in order if certain[i] is wanted] for wanted in (True, False))
    percent = f"{100 * result.confidence_level:g} %"
    if not carriers:
        return [f"No sensor stands out: the {percent} interval of every weight holds 0."]
    sentences = [
        f"Sensors that carry the virtual gyro, with weights whose {percent} intervals exclude 0: "
        f"{_listed(result, carriers)}."
    ]
    if others:
        sentences.append(f"Sensors whose weights cannot be told from 0: {_listed(result, others)}.")
    if any(result.weights[i] < 0 for i in carriers):
        sentences.append("A negative weight subtracts an error that the sensor shares with the others.")
    return sentences


def _listed(result: SVOResult, which: Sequence[int], most: int = 8) -> str:
    """Sensors with their weights, as far as a sentence can bear."""
    shown = [f"{result.sensors[i]} (weight {result.weights[i].item():.3f})" for i in which[:most]]
    if len(which) > most:
        shown.append(f"{len(which) - most} more")
    return _joined(shown)


def _compared(result: Fused, other: Tensor, name: str) -> str:
    """Where the Allan deviation of the virtual gyro is lower than another one, and where it is higher."""
    judged = _judged(result)
    left_out = ~judged & result.virtual_wavelet_variance.isfinite()
    ratio = (result.virtual_wavelet_variance / other).sqrt()
    lower, higher = _where(result, 1 - ratio), _where(result, ratio - 1)
    start = "The Allan deviation of the virtual gyro is"
    if bool(left_out.any()):
        start = f"Up to {_time(result, int(judged.nonzero().max()))}, the Allan deviation of the virtual gyro is"
    if lower:
        rest = f"It is higher at {higher}." if higher else "It is nowhere higher."
        return f"{start} lower than that of {name} at averaging times of {lower}. {rest}"
    if higher:
        return f"{start} nowhere lower than that of {name}; it is higher at averaging times of {higher}."
    return f"{start} that of {name} within {_percent(ALIKE)} at every averaging time."


def _where(result: Fused, difference: Tensor) -> str:
    """Averaging times at which a difference counts, neighbours as a range, and how large it gets.

    Both are about the levels that the recording resolves; a few observations give large differences by chance.
    """
    large = _judged(result) & (difference > ALIKE)
    counts = large.tolist()
    runs = [list(run) for holds, run in groupby(range(len(counts)), counts.__getitem__) if holds]
    if not runs:
        return ""
    starts = [f"{number(result.tau[run[0]].item())} to " if len(run) > 1 else "" for run in runs]
    times = _joined([start + _time(result, run[-1]) for start, run in zip(starts, runs, strict=True)])
    level = int(torch.where(large, difference, -math.inf).argmax())
    if sum(counts) == 1:
        return f"{times}, by {_percent(difference[level].item())}"
    return f"{times}, by up to {_percent(difference[level].item())} (at {_time(result, level)})"


def _percent(fraction: float) -> str:
    percent = round(100 * fraction, 1)
    return f"{percent:.{0 if percent >= 10 else 1}f}\N{NO-BREAK SPACE}%"


def _time(result: Fused, level: int) -> str:
    return f"{number(result.tau[level].item())} {'s' if result.rate else 'samples'}"


def _joined(parts: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(parts[:-1]), *parts[-1:]]))
