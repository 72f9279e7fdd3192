"""A pulse, fitted to the samples around it: `x_i(t) = amplitude_i sin(pi u)^q`, `u = (t - t0) / width` from 0 to 1.

Of `q = 1` it is a half sine, of 2 a haversine, of next to 0 a rectangle (the shapes of IEC 60068-2-27).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import optimize
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER
from gyrofuse.mismatch.likelihoods.damped_tone import DampedTone, Surroundings

Limits = tuple[float, float]


class Pulse(NamedTuple):
    """One pulse.

    Attributes:
        onset: `t0`, samples.
        width: Samples.
        power: `q`.
    """

    onset: float
    width: float
    power: float

    def path(self, first: int, n: int) -> Tensor:
        """For an amplitude of one, at `n` samples from a first one on, `(time,)`."""
        u = (torch.arange(n, dtype=torch.float64) + first - self.onset) / self.width
        return torch.sin(math.pi * u.clamp(0, 1)).clamp(min=0).pow(self.power) * ((u > 0) & (u < 1))


class FittedPulse(NamedTuple):
    """A pulse with its amplitudes.

    Attributes:
        pulse: Onset, width and form.
        amplitude: `(sensor,)`; 0 where it is not.
        sd: Standard deviations of the amplitudes, `(sensor,)`.
        log_ratio: Log likelihood ratio of each sensor, `(sensor,)`.
    """

    pulse: Pulse
    amplitude: Tensor
    sd: Tensor
    log_ratio: Tensor


def fitted_pulse(around: Surroundings, onset: int, width: int, sensors: Sequence[int]) -> FittedPulse:
    """The likeliest pulse near a place and a width, in some sensors; of the three forms, or one between or beyond."""
    forms, which = (0.02, 1.0, 2.0), list(sensors)
    places, widths = (-0.6, -0.3, -0.1, 0.1, 0.3, 0.6), (0.6, 0.8, 1.1, 1.5, 2.1)  # in the width given
    tried = []
    for power in forms:
        starts = [Pulse(onset + k * width, factor * width, power) for k in places for factor in widths]
        gains = _gains(around, starts)[:, which].sum(-1)
        tried.append(_refined(around, starts[int(gains.argmax())], which))
    gain, best = max(tried, key=lambda entry: entry[0])
    more, free = _refined(around, best._replace(power=max(best.power, 0.3)), which, free=True)
    return sized(around, free if more > gain + 2 * NATS_PER_NUMBER else best, sensors)


def _refined(around: Surroundings, start: Pulse, which: list[int], *, free: bool = False) -> tuple[float, Pulse]:
    """Log likelihood ratio, and the likeliest pulse near a start; of any form where that is free."""

    def at(point: NDArray[np.float64]) -> Pulse:
        wide = start.width * math.exp(min(max(point[1], -2.0), 2.0))
        power = min(max(start.power * math.exp(point[2]), 0.02), 8.0) if free else start.power
        return Pulse(start.onset + point[0] * start.width, wide, power)

    n = 3 if free else 2
    simplex = np.concatenate([np.zeros((1, n)), np.diag((0.1, 0.2, 0.5)[:n])])
    found = optimize.minimize(
        lambda point: -float(_gains(around, [at(point)])[0, which].sum()),
        simplex[0],
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 100, "fatol": 1e-2, "xatol": 1e-3},
    )
    return -float(found.fun), at(found.x)


def sized(around: Surroundings, pulse: Pulse, sensors: Sequence[int]) -> FittedPulse:
    """A pulse with the amplitudes that fit best, in some sensors."""
    path = pulse.path(around.first, around.samples.shape[-1])[None]
    size, log_ratio = around.regression(path)
    there = torch.zeros(size.shape[-1], dtype=torch.bool)
    there[list(sensors)] = True
    # Of a normal variable with the likelihood ratio `z^2 / 2`, the amplitude over `z`.
    sd = size[0].abs() / (2 * log_ratio).clamp(min=1e-12).sqrt()
    return FittedPulse(pulse, size[0] * there, sd, log_ratio * there)


def width_limits(around: Surroundings, found: FittedPulse) -> Limits:
    """95 % limits of the width: others of the same middle, of forms that are as likely, samples."""
    least, reach, steps = 1.92, 0.5, 41  # nats behind; logarithm of the width
    which = (found.amplitude != 0).nonzero()[:, 0]
    middle, powers = found.pulse.onset + found.pulse.width / 2, {found.pulse.power, 0.02, 1.0, 2.0}
    for _ in range(4):
        widths = found.pulse.width * torch.linspace(-reach, reach, steps, dtype=torch.float64).exp()
        tried = [Pulse(middle - w / 2, w, power) for power in powers for w in widths.tolist()]
        gains = _gains(around, tried)[:, which].sum(-1).view(len(powers), -1).amax(0)
        likely = widths[gains > gains.max() - least]
        if len(likely) > 4:
            break
        reach /= 4
    return float(likely.min()), float(likely.max())


def other_course(around: Surroundings, found: FittedPulse, slow: float) -> float:
    """Log likelihood ratio of what is no pulse: one sample, a step, louder noise, or what rings or decays slowly.

    Args:
        around: Samples around the pulse.
        found: The pulse.
        slow: Time constant from which a jump that decays is a transient of the bias, samples.
    """
    which = (found.amplitude != 0).nonzero()[:, 0].tolist()
    pulse = found.pulse
    n = around.samples.shape[-1]
    t = torch.arange(n, dtype=torch.float64) + around.first
    steps = torch.stack([(t >= pulse.onset + k * pulse.width / 4).to(torch.float64) for k in range(5)])
    rings, least = around.fitted(DampedTone(round(pulse.onset), 0.5 / pulse.width, pulse.width), which), 0.5  # cycles
    rung = float(rings.log_ratio[which].sum()) if rings.tone.frequency * rings.tone.tau > least else 0.0
    jumps = float(around.each(steps)[:, which].sum(-1).max())
    return max(jumps, rung, around.of_no_course(which), _decaying(around, pulse, which, slow))


def _decaying(around: Surroundings, pulse: Pulse, which: list[int], shortest: float) -> float:
    """Log likelihood ratio of a jump near a pulse that decays with a time constant of so many samples or more."""
    t = torch.arange(around.samples.shape[-1], dtype=torch.float64) + around.first

    def gains(points: Sequence[Sequence[float]]) -> Tensor:
        onset, tau = torch.tensor(points, dtype=torch.float64).mT[..., None]
        since = (t - pulse.onset) / pulse.width - onset
        paths = torch.where(since < 0, 0.0, (-since.clamp(min=0) * pulse.width / tau).exp())
        return around.each(paths)[:, which].sum(-1)

    constants = [tau for times in (0.35, 0.7, 1.4, 2.8) if (tau := times * pulse.width) >= shortest]
    starts = [(k / 40, tau) for tau in constants for k in range(-8, 25)]  # onsets in widths
    if not starts:
        return 0.0
    found = optimize.minimize(
        lambda point: -float(gains([(point[0], max(point[1], shortest))])),
        starts[int(gains(starts).argmax())],
        method="Nelder-Mead",
        options={"maxfev": 60, "fatol": 1e-2, "xatol": 1e-3},
    )
    return -float(found.fun)


def _gains(around: Surroundings, pulses: Sequence[Pulse]) -> Tensor:
    """`(pulse, sensor)`."""
    n = around.samples.shape[-1]
    return around.each(torch.stack([pulse.path(around.first, n) for pulse in pulses]))
