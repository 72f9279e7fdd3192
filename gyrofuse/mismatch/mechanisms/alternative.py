"""The best rival of a finding."""

from __future__ import annotations

from typing import NamedTuple

_BETTER_SD = 2.0  # standard deviations of a difference of two scores, from which an alternative is better


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
