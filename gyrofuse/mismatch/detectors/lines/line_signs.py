"""Signs of the simulation's lines: sensors in which all of them have the opposite phase to that in the others.

Phases count from when a record began, and a simulator may draw those of each sensor by itself: phases between sensors
mean something only where they agree on both sides better than chance would have it. Where they agree but for half a
turn in some sensors, these are mounted the other way round.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.lines.line_sizes import line_sizes
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.known_lines import line_parts


class LineSigns(NamedTuple):
    """Signs of sensors, most of which are 1.

    Attributes:
        sign: `(sensor,)`, 1 or -1.
        p_value: Probability that random phases of all lines agree so well.
    """

    sign: Tensor
    p_value: float


@derived
def line_signs(comparison: Comparison) -> LineSigns | None:
    """Those that agree in all lines that all sensors show plainly; None without any, or where phases do not agree."""
    sizes, plain, reach = line_sizes(comparison), 10.0, 4.0  # standard deviations of an amplitude, and of a phase
    if sizes is None or comparison.n_sensors < 2:
        return None
    ratios = (sizes.sd / sizes.observed).hypot(sizes.simulated_sd / sizes.reference)  # sd of phases, (sensor, line)
    shown = (ratios < math.sqrt(2) / plain).all(0)
    lines = tuple(itertools.compress(comparison.reference.lines, shown.tolist()))
    if not lines:
        return None
    own, simulated = (line_parts(side.signal[0], lines) for side in (comparison.observed, comparison.reference))
    turn = own * simulated.conj()  # (sensor, line)
    turn = (turn * turn[:1].conj())[1:]  # against the first sensor
    sd = torch.hypot(ratios[1:, shown], ratios[:1, shown])
    signs = torch.where(turn.real < 0, -1.0, 1.0).to(torch.float64)
    off = (turn * signs).angle().abs()
    if bool((off > reach * sd).any()) or bool((signs != signs[:, :1]).any()):
        return None
    # Of phases at random, by either sign of the sensors; the lines have to agree on it.
    agree = (2 * float((off / sd).max()) * sd / math.pi).clamp(max=1.0)
    p_value = float(agree.log().sum().exp()) * 0.5 ** ((len(lines) - 1) * len(signs))
    sign = torch.cat([torch.ones(1, dtype=torch.float64), signs[:, 0]])
    return LineSigns(sign if float(sign.sum()) >= 0 else -sign, p_value)
