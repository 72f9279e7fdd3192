"""Cells of time and frequency in which something seems to ring, and which of them a record run backwards has as well.

A line that wanders or comes and goes is reversible: half of its strongest cells stand out by more in the record run
backwards. Of a ring-down that has about half of the nats, at the same time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD
from gyrofuse.mismatch.stats.multiplicity import p_value_beyond_largest, p_value_beyond_reference


class RingCell(NamedTuple):
    """A cell of time and frequency that stands out.

    Attributes:
        onset: Sample.
        frequency: Cycles per sample.
        tau: Samples.
        length: Of its window, samples.
        log_ratio: Logarithm of its likelihood ratio.
        score: `v` of each sensor, `(sensor,)`.
    """

    onset: int
    frequency: float
    tau: int
    length: int
    log_ratio: float
    score: Tensor

    @property
    def sensors(self) -> tuple[int, ...]:
        """Positions of those in which it stands out, by a quarter of the most at least."""
        return tuple((self.score > max(NATS_AS_GOOD, float(self.score.max()) / 4)).nonzero()[:, 0].tolist())


class RingScan(NamedTuple):
    """The mean likelihood ratio of all cells, and those that stand out, the likeliest first.

    Attributes:
        log_ratio: Logarithm of the mean.
        n_cells: How many were searched.
        cells: The likeliest of each stretch of time.
    """

    log_ratio: float
    n_cells: int
    cells: tuple[RingCell, ...]

    @property
    def p_value(self) -> float:
        """Ville's bound: medians of frequencies are known to some tenths, and spend what it has to spare."""
        return math.exp(min(-self.log_ratio, 0.0))


def in_another_order(white: Tensor) -> Tensor:
    """Whitened samples `(sensor, time)` in one and the same disorder, whatever they are.

    Nothing that lasts is left of them, and samples are large as often: chance, where noise is heavy-tailed.
    """
    return white[:, torch.randperm(white.shape[-1], generator=torch.Generator().manual_seed(1))]


def strongest_by_chance(scan: RingScan, disordered: RingScan) -> float:
    """Log likelihood ratio that a cell of a scan has by chance: beside all others, and beside samples in disorder."""
    return max([math.log(scan.n_cells), *(cell.log_ratio for cell in disordered.cells[:1])])


def p_value_beside(own: RingScan, simulated: RingScan, disordered: RingScan) -> float:
    """p value of a scan of the recording beside one of the simulation, which may ring itself, and of its disorder."""
    beyond_all = p_value_beyond_reference(own.p_value, simulated.p_value)
    return max(beyond_all, p_value_beyond_cells(own, simulated), p_value_beyond_cells(own, disordered))


def p_value_beyond_cells(own: RingScan, other: RingScan) -> float:
    """p value of a scan's likeliest cells beside those of another one."""
    strongest = torch.tensor([cell.log_ratio for cell in other.cells], dtype=torch.float64)
    largest = torch.tensor(sorted((cell.log_ratio for cell in own.cells), reverse=True), dtype=torch.float64)
    return p_value_beyond_largest(largest, strongest, own.n_cells / max(other.n_cells, 1))


def apart(cells: Sequence[RingCell]) -> Iterator[RingCell]:
    """Of cells, the likeliest first, those that no likelier one comes near to, in time and frequency."""
    rows = [(cell.onset, cell.length, cell.frequency, cell.tau) for cell in cells]
    onset, length, frequency, tau = torch.tensor(rows, dtype=torch.float64).view(-1, 4).T
    left = torch.arange(len(cells))
    while len(left):
        first, left = left[0], left[1:]
        yield cells[int(first)]
        together = (onset[left] - onset[first]).abs() < torch.maximum(length[left], length[first])
        resolved = 2 / torch.minimum(tau[left], tau[first])
        left = left[~(together & ((frequency[left] - frequency[first]).abs() < resolved))]


def irreversible(found: RingScan, backwards: RingScan, n_samples: int) -> RingScan:
    """A scan without cells whose sensor has some of about their frequency that stand out as much backwards.

    Args:
        found: Scan of a record.
        backwards: Scan of the record run backwards. Of its cells those count that the record has no stronger one
            beside, and that last: short ones are clipped, and look alike in both directions.
        n_samples: Length of the record.
    """
    chance, as_strong, near = math.log(found.n_cells) + NATS_AS_GOOD, 0.8, 1 / 4  # nats; of the nats; of a frequency
    shortest = 64  # samples
    lasting = [cell for cell in backwards.cells if cell.log_ratio > chance and cell.tau >= shortest]
    own, back = _Cells.of(found.cells), _Cells.of(lasting)
    first = n_samples - back.onset - back.length
    together = (first < (own.onset + own.length)[:, None]) & (first + back.length > own.onset[:, None])
    reach = torch.maximum(near * own.frequency, 2 / own.tau)[:, None]
    beside = (back.sensor == own.sensor[:, None]) & ((back.frequency - own.frequency[:, None]).abs() <= reach)
    mirrored = (together & beside & (own.nats[:, None] >= back.nats)).any(0)
    near_own = (own.sensor == own.sensor[:, None]) & ((own.frequency - own.frequency[:, None]).abs() <= reach)
    strongest = torch.where(near_own, own.nats, 0.0).amax(-1, keepdim=True)
    stays = ~(beside & ~mirrored & (back.nats >= as_strong * strongest)).any(-1)
    if bool(stays.all()):
        return found
    cells = tuple(found.cells[k] for k in stays.nonzero()[:, 0].tolist())
    return RingScan(float(own.nats[stays].logsumexp(0)) - math.log(found.n_cells), found.n_cells, cells)


class _Cells(NamedTuple):
    """Numbers of cells, `(cell,)` each; the sensor is that with the highest score."""

    onset: Tensor
    length: Tensor
    frequency: Tensor
    tau: Tensor
    nats: Tensor
    sensor: Tensor

    @classmethod
    def of(cls, cells: Sequence[RingCell]) -> _Cells:
        rows = [(c.onset, c.length, c.frequency, c.tau, c.log_ratio, int(c.score.argmax())) for c in cells]
        return cls(*torch.tensor(rows, dtype=torch.float64).view(-1, 6).T)
