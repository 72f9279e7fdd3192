"""The time scale of a recording: lines of the simulation that are all there at frequencies that one factor gives.

Statistic: lines of the simulation that are gone and have a line of the recording of about their size at `r f`, `r` as
the first of them says it. Null law: lines of the recording anywhere, so that each further line meets one within a
distance by chance with the density of lines times that, and of any size within a factor of two, in logarithms; over all
pairs that may say `r`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.known_lines import amplitudes
from gyrofuse.mismatch.signals.lines import simulated_lines


class CommonRatio(NamedTuple):
    """Frequencies in the recording over those in the simulation: the rate of this over that of the other.

    Attributes:
        ratio, sd: The ratio, and its standard deviation.
        gone: Lines of the simulation that are not in the recording where they were, cycles per sample.
        matched: Those of them that the recording has at `ratio` times their frequency.
        p_value: p value of lines that have nothing to do with each other.
        gain: Log likelihood of the lines that moved, nats.
    """

    ratio: float
    sd: float
    gone: tuple[float, ...]
    matched: tuple[float, ...]
    p_value: float
    gain: float


class _Lines(NamedTuple):
    """Lines of one side: frequencies `(line,)`, their sd, amplitudes `(sensor, line)` and nats `(line,)`."""

    frequency: Tensor
    sd: Tensor
    amplitude: Tensor
    nats: Tensor

    def of(self, which: Tensor) -> _Lines:
        """Some of them."""
        return _Lines(self.frequency[which], self.sd[which], self.amplitude[:, which], self.nats[which])


@derived
def common_ratio(comparison: Comparison) -> CommonRatio | None:
    """The factor that most lines of the simulation agree on; None where no two of them do."""
    known = simulated_lines(comparison.reference)
    new = simulated_lines(comparison.observed)[len(comparison.observed.lines) :]
    if len(known) < 2 or len(new) < 2:
        return None
    before, after = (
        _lines(comparison, comparison.reference.signal, known),
        _lines(comparison, comparison.recording[None], new),
    )
    stays = (
        _lines(comparison, comparison.recording[None], known).amplitude.norm(dim=0) > before.amplitude.norm(dim=0) / 2
    )
    gone = before.of(~stays)
    best: CommonRatio | None = None
    least, most, like = 0.2, 5.0, 2.0  # ratios of rates, and of amplitudes
    ratios = after.frequency / gone.frequency[:, None]  # (line before, line after)
    sizes = after.amplitude.norm(dim=0) / gone.amplitude.norm(dim=0)[:, None]
    unlike = sizes.log().abs().maximum((1 / (2 * after.nats) + 1 / (2 * gone.nats[:, None])).sqrt())
    possible = (ratios > least) & (ratios < most) & (sizes > 1 / like) & (sizes < like)
    density = len(new) / math.log(most / least)  # of relative frequencies
    for i, j in possible.nonzero().tolist():
        ratio = float(ratios[i, j])
        # By how much the others are off, in units of their own frequency.
        off = (ratios / ratio - 1).abs().where(possible, math.inf)
        sd = torch.hypot(after.sd / after.frequency, (gone.sd / gone.frequency)[:, None])
        sd = torch.hypot(sd, sd[i, j])
        off, nearest = off.min(-1)
        meets = off < 4 * sd.gather(-1, nearest[:, None])[:, 0]
        meets[i] = True
        if int(meets.sum()) < max(2, len(gone.frequency) / 2):
            continue
        which = meets.nonzero()[:, 0]
        reach = off.maximum(sd.gather(-1, nearest[:, None])[:, 0])[which[which != i]]
        at = nearest[which]
        by_chance = (2 * density * reach).clamp(max=1).prod() * (unlike[which, at] / math.log(like)).clamp(max=1).prod()
        p_value = min(float(by_chance) * int(possible.sum()), 1.0)
        if best is None or p_value < best.p_value:
            weight = (sd[which, at] ** -2) / (sd[which, at] ** -2).sum()
            mean = float((weight * ratios[which, at]).sum())
            best = CommonRatio(
                mean,
                mean * float((sd[which, at] ** -2).sum().rsqrt()),
                tuple(gone.frequency.tolist()),
                tuple(gone.frequency[which].tolist()),
                p_value,
                float(after.nats[at].sum()),
            )
    return best


def _lines(comparison: Comparison, signal: Tensor, frequencies: tuple[float, ...]) -> _Lines:
    """Lines of signals `(record, sensor, time)`, with the Cramer-Rao bound of their frequencies but half a rounding."""
    f, n = torch.tensor(frequencies, dtype=torch.float64), signal.shape[-1]
    amplitude = amplitudes(signal, frequencies).mean(0)
    nats = (amplitude.square() / comparison.base.spectrum(f)).sum(0) * n / 4
    sd = (6 / nats.clamp(min=1.0)).sqrt() / (2 * math.pi * n)
    return _Lines(f, sd.clamp(min=1e-3 / n), amplitude, nats)
