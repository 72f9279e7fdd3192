"""Sizes of known lines in blocks of time, and the channel that they follow."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_JUDGED
from gyrofuse.mismatch.signals.known_lines import line_parts
from gyrofuse.mismatch.stats.long_run_variance import long_run_variance
from gyrofuse.mismatch.stats.multiplicity import sidak


class LineGains(NamedTuple):
    """Course of the size of the strongest line that both sides have, against a channel.

    Attributes:
        channel: Name.
        row: Row of the channel.
        sizes: Over the mean of each sensor, in blocks, `(sensor, block)`.
        sd: Of one of them by noise, `(sensor,)`.
        course: The row less its mean, means over blocks, `(block,)`.
        slope: Relative change of the size for each unit of the channel, `(sensor,)`.
        slope_sd: Its standard deviation, `(sensor,)`.
        p_values: That a sensor follows no row of any channel, `(sensor,)`.
    """

    channel: str
    row: int
    sizes: Tensor
    sd: Tensor
    course: Tensor
    slope: Tensor
    slope_sd: Tensor
    p_values: Tensor


@derived
def line_gains(comparison: Comparison) -> LineGains | None:
    """Those of the row that they follow most closely; None without a channel, or without lines of two cycles a block.

    Blocks are 256, or fewer for lines so slow that these would not have two cycles. Slopes by least squares; what is
    left may wander by itself, which the long-run variance of the products allows for.
    """
    lines = comparison.reference.lines
    cycles, apart = 2.05, 4  # cycles of a line in a block (two are the taper's width), and its bins to its neighbours
    n_blocks, block, usable = 2 * N_BLOCKS, 0, list[float]()
    while not usable and n_blocks > N_JUDGED:
        n_blocks //= 2
        block = comparison.n_samples // n_blocks
        usable = [f for f in lines if f * block > cycles and (0.5 - f) * block > cycles]
    info = comparison.info
    rows = [(name, k, row) for name in info.channels for k, row in enumerate(info.channel_rows(name))]
    if not usable or not rows:
        return None
    whole = line_parts(comparison.recording, tuple(usable))  # (sensor, line)
    density = comparison.base.spectrum(torch.tensor(usable, dtype=torch.float64))
    clear = (whole.abs().square() / density).sum(0)
    best = int(clear.argmax())
    f, n = usable[best], block * n_blocks
    if any(abs(f - other) * block < apart for other in lines if other != f):
        return None
    sizes, sd = _sizes(comparison.recording[:, :n].unflatten(-1, (n_blocks, block)), f, density[:, best])
    if float(sd.min()) > 1.0:  # of the size: a line that no block shows follows nothing
        return None
    found = []
    for name, k, row in rows:
        course = row[:n].unflatten(-1, (n_blocks, block)).mean(-1)
        course = course - course.mean()
        spread = float(course.square().sum())
        if not bool(course.isfinite().all()) or spread == 0:
            continue
        slope = (sizes - 1) @ course / spread
        left = (sizes - 1 - slope[:, None] * course) * course
        scatter = [long_run_variance(one[None]) for one in left]
        dof = min(one.dof for one in scatter)
        variance = torch.tensor([one.value for one in scatter], dtype=torch.float64) * n_blocks
        slope_sd = variance.maximum(spread * sd.square()).sqrt() / spread
        p = torch.from_numpy(2 * stats.t.sf((slope.abs() / slope_sd).numpy(), dof))
        found.append(LineGains(name, k, sizes, sd, course, slope, slope_sd, p))
    if not found:
        return None
    most = min(found, key=lambda one: float(one.p_values.min()))
    corrected = [sidak(float(p), len(found)) for p in most.p_values]
    return most._replace(p_values=torch.tensor(corrected, dtype=torch.float64))


def line_gain_test(comparison: Comparison) -> TestResult:
    """A channel that the size of lines follows which both sides have."""
    gains = line_gains(comparison)
    if gains is None:
        return TestResult("line gain", 1.0, "no channel, or no line that both sides have")
    sensor = int(gains.p_values.argmin())
    return TestResult(
        "line gain",
        sidak(float(gains.p_values[sensor]), comparison.n_sensors),
        f"a line that both have is larger and smaller with {gains.channel} in sensor {comparison.info.sensors[sensor]}",
        sensors=(sensor,),
        channel=gains.channel,
    )


def _sizes(blocks: Tensor, f: float, density: Tensor) -> tuple[Tensor, Tensor]:
    """Sizes of a line in blocks `(sensor, block, time)` in its mean phase, over their mean, and their sd by noise."""
    count, length = blocks.shape[-2:]
    t = torch.arange(count * length, dtype=torch.float64).view(count, length)
    taper = torch.hann_window(length, periodic=True, dtype=torch.float64)
    basis = torch.polar(torch.ones_like(t), -2 * math.pi * f * t) * taper
    parts = 2 * (blocks * basis).sum(-1) / taper.sum()
    # A line that is known to a bin turns a little on the way: by a 16th of a cycle, or fewer, once that is undone.
    padded = 8 * count
    cycles = torch.fft.fft(parts, n=padded).abs().square().sum(0).argmax()
    turn = -2 * math.pi * cycles * torch.arange(count, dtype=torch.float64) / padded
    parts = parts * torch.polar(torch.ones_like(turn), turn)
    mean = parts.mean(-1, keepdim=True)
    sizes = (parts * mean.conj()).real / mean.abs().square()
    noise = 2 * density * float(taper.square().sum() / taper.sum().square())
    return sizes, noise.sqrt() / mean.abs()[:, 0]
