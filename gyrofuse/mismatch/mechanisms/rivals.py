"""Rivals of a finding: as they are fitted in its place, and the best one as a finding tells it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from gyrofuse.mismatch.mechanisms.mechanism import Mechanism

_BETTER_SD = 2.0  # standard deviations of a difference of two scores, from which an alternative is better


class Rival(NamedTuple):
    """A mechanism fitted in the place of a finding of another one.

    Attributes:
        effect: Mechanism with its numbers.
        score: Log likelihood ratio in sample less what its numbers cost, nats; compared among rivals of one likelihood.
    """

    effect: Mechanism
    score: float


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
