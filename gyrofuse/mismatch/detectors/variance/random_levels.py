"""Whether the level of the noise goes up and down at random all the time, and by which law."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from gyrofuse.mismatch.detectors.variance.noise_level import whitened_recording
from gyrofuse.mismatch.likelihoods.laws.random_level import RandomLevel
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_JUDGED


class LevelLaws(NamedTuple):
    """Laws of the sensors whose level goes up and down, one for each, or one for all of them."""

    sensors: tuple[int, ...]
    laws: tuple[RandomLevel, ...]
    together: bool

    def of(self, sensor: int) -> RandomLevel:
        """That of a sensor."""
        return self.laws[0 if self.together else self.sensors.index(sensor)]

    def rows(self, squares: Tensor) -> Sequence[Tensor]:
        """Squares `(sensor, block, time)` as each of the laws has them."""
        own = squares[list(self.sensors)]
        return [own.sum(0)] if self.together else list(own)

    def gain(self, squares: Tensor) -> float:
        """Over steady levels, nats."""
        return sum(float(law.gains(row).sum()) for law, row in zip(self.laws, self.rows(squares), strict=True))


@derived
def level_laws(comparison: Comparison) -> LevelLaws:
    """The likeliest laws of sensors whose level lasts and goes up and down often; of all at once where likelier."""
    squares, present, lasts, often = level_squares(comparison), 15.0, 2.0, 6.0  # nats, samples, times
    own = {
        i: law
        for i, rows in enumerate(squares)
        if float((law := RandomLevel.fitted(rows)).gains(rows).sum()) > present
        and law.samples > lasts
        and min(law.share, 1 - law.share) * rows.numel() * law.leave > often
    }
    each = LevelLaws(tuple(own), tuple(own.values()), False)
    if len(own) < 2:
        return each
    one = RandomLevel.fitted(squares[list(own)].sum(0), len(own))
    at_once = LevelLaws(tuple(own), (one,), True)
    return at_once if at_once.gain(squares) > each.gain(squares) else each


@derived
def level_squares(comparison: Comparison) -> Tensor:
    """Squares of the whitened recording in blocks, their means one, `(sensor, block, time)`."""
    white = whitened_recording(comparison)
    block = white.shape[-1] // N_JUDGED
    squares = white[:, : N_JUDGED * block].square().unflatten(-1, (N_JUDGED, block))
    return squares / squares.mean((-1, -2), keepdim=True)


def is_random_level(comparison: Comparison, gain: float) -> bool:
    """Whether noise of a random level is likelier than what gains so many nats over noise of a steady one."""
    return level_laws(comparison).gain(level_squares(comparison)) > gain
