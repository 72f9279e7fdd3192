"""Whether the level of the noise goes up and down at random all the time, and by which law."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.detectors.variance.noise_level import whitened_recording
from gyrofuse.mismatch.detectors.variance.normality import gaussian_sensors
from gyrofuse.mismatch.likelihoods.laws.heavy_tails import heavy_tailed
from gyrofuse.mismatch.likelihoods.laws.random_level import RandomLevel
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_JUDGED
from gyrofuse.mismatch.signals.prediction_errors import left_out


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
    """The likeliest laws of sensors whose level lasts and goes up and down often; of all at once where likelier.

    Plainly likelier than heavy tails of each sample by itself, and than the law of the simulation.
    """
    squares, present, lasts, often = level_squares(comparison), 15.0, 2.0, 6.0  # nats, samples, times
    white, own = _flat_recording(comparison), dict[int, RandomLevel]()
    for i, rows in enumerate(squares):
        law = RandomLevel.fitted(rows)
        turns = min(law.share, 1 - law.share) * rows.numel() * law.leave
        if law.samples <= lasts or turns <= often:
            continue
        rival = max(heavy_tailed(white[i]), _simulated_gain(comparison, i, rows))
        if float(law.gains(rows).sum()) > rival + present:
            own[i] = law
    each = LevelLaws(tuple(own), tuple(own.values()), False)
    if len(own) < 2:
        return each
    one = RandomLevel.fitted(squares[list(own)].sum(0), len(own))
    at_once = LevelLaws(tuple(own), (one,), True)
    return at_once if at_once.gain(squares) > each.gain(squares) else each


def _simulated_gain(comparison: Comparison, sensor: int, squares: Tensor) -> float:
    """Of the law that the simulation has, scaled to squares `(block, time)`; 0 where its noise is normal."""
    if bool(gaussian_sensors(comparison.reference)[sensor]):
        return 0.0
    simulated = _in_blocks(_flat(left_out(comparison.reference).white[:, sensor]).flatten())
    return float(RandomLevel.fitted(simulated).gains(squares).sum())


@derived
def level_squares(comparison: Comparison) -> Tensor:
    """Squares of the whitened recording in blocks, their means one, `(sensor, block, time)`."""
    return _in_blocks(_flat_recording(comparison))


@derived
def _flat_recording(comparison: Comparison) -> Tensor:
    return _flat(whitened_recording(comparison))


def _in_blocks(values: Tensor) -> Tensor:
    """Squares of `(..., time)` in blocks, their means one."""
    block = values.shape[-1] // N_JUDGED
    squares = values[..., : N_JUDGED * block].square().unflatten(-1, (N_JUDGED, block))
    return squares / squares.mean((-1, -2), keepdim=True)


def _flat(white: Tensor) -> Tensor:
    """Whitened samples `(..., time)` of one power at all frequencies: filters not yet known colour them.

    What is coloured goes up and down as if its level did.
    """
    n, narrow = white.shape[-1], 512  # bands
    transform, width = torch.fft.rfft(white), max(n // (2 * narrow), 16)
    power = squared_modulus(transform)
    rows = power.view(-1, 1, power.shape[-1])
    rows = torch.nn.functional.pad(rows, (width, width), mode="reflect")
    smooth = torch.nn.functional.avg_pool1d(rows, 2 * width + 1, 1).view(power.shape)
    least = 0.03 * smooth.mean(-1, keepdim=True)  # in a stop band is what leaks in
    return torch.fft.irfft(transform / smooth.maximum(least).clamp(min=1e-300).sqrt(), n=n)


def is_random_level(comparison: Comparison, gain: float) -> bool:
    """Whether noise of a random level is likelier than what gains so many nats over noise of a steady one."""
    return level_laws(comparison).gain(level_squares(comparison)) > gain
