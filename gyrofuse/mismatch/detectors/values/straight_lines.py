"""Samples on a straight line between two others, to the last digit: lost ones that were filled in by interpolation."""

from __future__ import annotations

from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.detectors.values.lattices import exact_lattices
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.segments import runs_of


class StraightLines(NamedTuple):
    """Which samples of the recording lie between their neighbours, and how often chance makes one, `(sensor,)`.

    Attributes:
        inside: Samples with a neighbour on either side of them, `(sensor, time)`; none where values have a grid.
        by_chance: Probability of one by the digits that values have.
        p_values: Of as many rows of them, beside those of the simulation.
    """

    inside: Tensor
    by_chance: Tensor
    p_values: Tensor


@derived
def straight_lines(comparison: Comparison) -> StraightLines:
    """Those of a recording; rows of them count once."""
    side, other = comparison.observed, comparison.reference
    inside, chance = _inside(side, comparison.as_came)
    theirs = _inside(other, other)[0]
    n, m = inside[0].numel(), theirs[0].numel()
    p_values = []
    for own, simulated, c in zip(inside, theirs, chance.tolist(), strict=True):
        rows = len(runs_of(own[0]))
        events = sum(len(runs_of(record)) for record in simulated)
        p_values.append(max(stats.poisson.sf(rows - 1, n * c), stats.binom.sf(rows - 1, rows + events, n / (n + m))))
    return StraightLines(inside[:, 0], chance, torch.tensor(p_values, dtype=torch.float64))


def _inside(side: Records, came: Records) -> tuple[Tensor, Tensor]:
    """Samples in the middle of two others, `(sensor, record, time)`, and their probability by chance, `(sensor,)`.

    Args:
        side: Records.
        came: The same before anything was taken off them: values on a grid lie on lines by chance.
    """
    signal = side.signal.movedim(1, 0)
    single = bool((signal.to(torch.float32).to(signal.dtype) == signal).all())
    last = 1e-6 if single else 1e-12  # digit that is left after some arithmetic, of the largest value
    digits = last * signal.abs().amax((1, 2))[:, None, None]
    bends, moves = signal.diff(n=2), signal.diff()[..., :-1] != 0  # what stands still is held, and on no line
    near = (bends.abs() <= digits) & moves
    near &= torch.tensor([own is None for own in exact_lattices(came)])[:, None, None]
    # As often as differences of samples that have nothing to do with each other are the same.
    unrelated = (signal[..., 140:] - signal[..., 90:-50]) - (signal[..., 53:-87] - signal[..., :-140])
    alike = ((unrelated.abs() <= digits).sum((1, 2)) + 1) / unrelated[0].numel()
    chance = alike * (unrelated.square().mean((1, 2)) / bends.square().mean((1, 2)).clamp(min=1e-300)).sqrt()
    return torch.nn.functional.pad(near, (1, 1)), chance.clamp(max=1.0)
