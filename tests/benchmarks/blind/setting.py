"""What is on the table: how many sensors, how fast, how long, and how many of the sensors an effect is in."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

SENSORS = (1, 2, 3, 4, 6, 8, 9, 12, 16)
RATES = (50.0, 2000.0)  # Hz
REACHES = ("one", "some", "all")
SHARES = (0.5, 1.0, 2.0)  # length of a simulation over that of the recording
SHORTEST = 4096  # samples that a diagnosis asks for, of a simulation as well


class Setting(NamedTuple):
    """Of one case. `reach` and `shares` are None where effects and kinds draw them by themselves."""

    n_samples: int
    rate: float
    n_sensors: int = 6
    reach: str | None = None
    shares: tuple[float, ...] = (1.0, 2.0, 4.0)


def drawn(n_samples: int, rng: np.random.Generator) -> Setting:
    """A setting as some user has it, of at most so many samples: a power of two only by chance."""
    shortest = max(0.4, SHORTEST / min(SHARES) / n_samples)
    return Setting(
        int(n_samples * rng.uniform(min(shortest, 1.0), 1.0)),
        float(math.exp(rng.uniform(math.log(RATES[0]), math.log(RATES[1])))),
        int(rng.choice(SENSORS)),
        str(rng.choice(REACHES)),
        SHARES,
    )
