"""Power of all that is slower than some frequencies together.

Band by band a record has one or two ordinates of what is slow, whose ratio to the simulation's says next to nothing.
Divided by the smooth spectrum of the simulation's noise, those of 2 to 16 cycles per record are chi-square distributed
on both sides, and the ratio of their means is F distributed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse._base.transforms import cosine_ordinates
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.noise_spectrum import let_in
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.multiplicity import sidak


class SlowPower(NamedTuple):
    """The most surprising ratio.

    Attributes:
        p_value: For all sensors and frequencies.
        sensor: Position of the sensor.
        ratio: Of the recording's power to the simulation's.
        frequency: Below which it is, cycles per sample.
    """

    p_value: float
    sensor: int
    ratio: float
    frequency: float


@derived
def slow_power(comparison: Comparison) -> SlowPower | None:
    """Of the recording against the simulation.

    None where that is a fit, whose numbers say little of what is slow, or has next to nothing slow, as after a
    high-pass: there a record's ends are all that is seen.
    """
    if comparison.reference.uncertainty is not None or _nothing_slow(comparison):
        return None
    n, below, far = comparison.n_samples, (2, 4, 8, 16), math.log(2.5)  # cycles per record
    best = SlowPower(1.0, 0, 1.0, below[-1] / n)
    for cycles in below:
        own, others = (
            _mean_power(side, cycles / n, comparison) for side in (comparison.observed, comparison.reference)
        )
        if others[1] < cycles:  # too short to say
            continue
        ratio = own[0] / others[0]  # (sensor,)
        law = stats.f(own[1], others[1])
        tails = 2 * torch.from_numpy(law.sf(ratio.numpy())).minimum(torch.from_numpy(law.cdf(ratio.numpy())))
        described = (others[0].log().abs() < far) | (others[1] < 16)  # by the smooth spectrum, as stop bands are not
        tails = torch.where(described, tails, 1.0)
        sensor = int(tails.argmin())
        p_value = sidak(float(tails[sensor]), len(tails) * len(below))
        if p_value < best.p_value:
            best = SlowPower(p_value, sensor, float(ratio[sensor]), cycles / n)
    return best


def _nothing_slow(comparison: Comparison) -> bool:
    """Whether slow ordinates of a sensor hold little but what the ends of a record let in, as after a high-pass."""
    share, middle, n_frequencies, n = 0.05, 16, 1000, comparison.n_samples  # of white noise it is an 80th of that one
    f = torch.logspace(math.log10(1 / n), math.log10(0.5), n_frequencies, dtype=torch.float64)
    at = torch.tensor([middle / (2 * n)], dtype=torch.float64)
    density = comparison.base.spectrum(f)
    return bool((let_in(f, density, at, n) > share * comparison.base.spectrum(at)).any())


def _mean_power(side: Records, highest: float, comparison: Comparison) -> tuple[Tensor, int]:
    """Mean over ordinates below a frequency, cycles per sample, in units of the noise, and how many there are."""
    length = side.noise.shape[-1]
    count = math.floor(2 * length * highest)
    if count < 1:
        return torch.ones(comparison.n_sensors, dtype=torch.float64), 0
    f = torch.arange(1, count + 1, dtype=torch.float64) / (2 * length)
    ordinates = cosine_ordinates(side.noise.flatten(0, 1)).view_as(side.noise)
    power = ordinates[..., 1 : count + 1].square() / comparison.base.spectrum(f)
    return power.mean((0, -1)), count * len(power)
