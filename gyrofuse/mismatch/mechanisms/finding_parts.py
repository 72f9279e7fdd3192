"""What a finding says of its effect: numbers with their limits, and the best rival."""

from __future__ import annotations

import math
from typing import NamedTuple

_BETTER_SD = 2.0  # standard deviations of a difference of two scores, from which an alternative is better


class Parameter(NamedTuple):
    """A number with its limits at the confidence level of the diagnosis."""

    value: float
    low: float
    high: float
    unit: str

    @classmethod
    def around(
        cls, value: float, reach: float, unit: str, *, least: float = -math.inf, most: float = math.inf
    ) -> Parameter:
        """Limits as far below a number as above it, within what it can be."""
        return cls(value, max(value - reach, least), min(value + reach, most), unit)

    @classmethod
    def within(cls, value: float, factor: float, unit: str) -> Parameter:
        """Limits at so many times a number, and at its part."""
        return cls(value, value / factor, value * factor, unit)

    @classmethod
    def exact(cls, value: float, unit: str) -> Parameter:
        """A number that the values themselves show."""
        return cls(value, value, value, unit)


class Alternative(NamedTuple):
    """The rival that scores best in the place of a finding, all other findings in.

    Attributes:
        mechanism: Name of the mechanism.
        gain: Its held-out score, nats.
        sd: Standard deviation of the difference between both scores, block by block.
    """

    mechanism: str
    gain: float
    sd: float

    def beats(self, gain: float) -> bool:
        """Whether it scores higher than the finding's `gain`: beyond chance, and a 300th to which forms are true."""
        return self.gain > gain + max(_BETTER_SD * self.sd, abs(gain) / 300)
