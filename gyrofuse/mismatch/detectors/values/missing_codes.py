"""Codes that a converter never puts out: a bit that is stuck, or steps of its scale that are lost (missing codes).

A record that spreads over more than a few codes has as many of each remainder modulo a number, whatever its law (the
wrapped law of a normal variable is even to 1.5 % from half the modulus, sd, on). A remainder that is hardly met was
put out as another one: what its samples became shows in the shares of the others.

References:
    IEEE Std 1241-2010, Terminology and test methods for analog-to-digital converters: missing codes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.lattices import Lattice, code_lattices, distinct_values
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.records import Records


class CodeMap(NamedTuple):
    """What a converter makes of codes.

    Attributes:
        shifts: Of each remainder modulo their number: codes that it is put out above its own.
        bit: That is stuck; None where codes are missing in another way.
        shares: Of the remainders in the recording, `(remainder,)`.
        p_value: Of so few samples on one of those that are missing.
    """

    shifts: tuple[int, ...]
    bit: int | None
    shares: Tensor
    p_value: float


@derived
def missing_codes(comparison: Comparison) -> dict[int, CodeMap]:
    """Codes that sensors of the recording do not put out, and the simulation's do, by position of the sensor."""
    found = {}
    own, theirs = code_lattices(comparison.as_came), code_lattices(comparison.reference)
    for i, (lattice, other) in enumerate(zip(own, theirs, strict=True)):
        code_map = None if lattice is None else _code_map(comparison.as_came, i, lattice)
        if code_map is None:
            continue
        simulated = None if other is None else _shares(comparison.reference, i, other, len(code_map.shifts))
        lost = torch.tensor(code_map.shifts) != 0
        fewest = 0.3  # of the samples that these codes have where none is missing
        if simulated is None or float(simulated[lost].sum()) > fewest * float(lost.double().mean()):
            found[i] = code_map
    return found


def _code_map(side: Records, sensor: int, lattice: Lattice) -> CodeMap | None:
    """Of the smallest modulus of which a remainder is missing."""
    n, rare, least = side.signal.shape[-1], 0.02, 200  # of the samples of a code, and how many these are
    spread = float(side.signal[0, sensor].std()) / lattice.step
    for modulus in (3, 4, 5, 6, 8, 10, 16, 32, 64):
        if spread < modulus / 2 or n / modulus < least:
            continue
        shares = _shares(side, sensor, lattice, modulus)
        missing = shares * modulus < rare
        if not bool(missing.any()):
            continue
        maps = dict(_maps(missing.tolist()))
        shifts = min(maps, key=lambda one: float((_shares_of(one) - shares).square().sum()))
        chance = -n / modulus * (1 - rare) ** 2 / 2  # nats, of so few (Chernoff)
        return CodeMap(shifts, maps[shifts], shares, modulus * math.exp(max(chance, -700.0)))
    return _high_bit(side, sensor, lattice)


def _high_bit(side: Records, sensor: int, lattice: Lattice) -> CodeMap | None:
    """Of a stuck bit so high that single codes have few samples: half of all remainders in a row are missing."""
    signal, rare = side.signal[0, sensor], 0.01  # of the samples
    n, change = signal.shape[-1], float(signal.diff().square().mean().sqrt()) / lattice.step
    for bit in range(3, 20):
        half = 2**bit
        if change < half / 2:  # what moves less from sample to sample may stay on one side
            return None
        shares = _shares(side, sensor, lattice, 2 * half)
        windows = torch.cat([shares, shares[:-1]]).unfold(0, half, 1).sum(-1)[: 2 * half]
        least = (windows <= windows.min()).nonzero()[:, 0]
        if float(windows.min()) > rare or len(least) > half:
            continue
        lost = torch.zeros(2 * half, dtype=torch.bool)
        lost[(torch.arange(half) + int(least[len(least) // 2])) % (2 * half)] = True
        level = torch.where(lost, windows.min(), 1 - windows.min()) / half
        chance = max(-n / 4 * (1 - 2 * rare) ** 2, -700.0)  # nats, of so few in one half (Chernoff)
        return CodeMap(tuple(-half if one else 0 for one in lost.tolist()), bit, level, 2 * half * math.exp(chance))
    return None


def _shares(side: Records, sensor: int, lattice: Lattice, modulus: int) -> Tensor:
    """Of remainders of codes in the first record."""
    values, counts = distinct_values(side)[sensor]
    codes = ((values - lattice.offset) / lattice.step).round().long() % modulus
    total = torch.zeros(modulus, dtype=torch.float64).index_add(0, codes, counts.to(torch.float64))
    return total / total.sum()


def _maps(missing: list[bool]) -> Iterable[tuple[tuple[int, ...], int | None]]:
    """What may become of the remainders that are missing: a bit that is stuck, or the next code below or above."""
    m = len(missing)
    if m & (m - 1) == 0:
        bit = m.bit_length() - 2
        for value in (0, 1):
            # Codes count from a code of their own: where a bit changes is known up to that.
            for first in range(m):
                stuck = [((r - first) % m >= m // 2) == (value == 0) for r in range(m)]
                if stuck == missing:
                    step = -(m // 2) if value == 0 else m // 2
                    yield tuple(step if lost else 0 for lost in missing), bit
    for step in (-1, 1):
        shifts = []
        for r, lost in enumerate(missing):
            far = 0
            while lost and missing[(r + far) % m]:
                far += step
            shifts.append(far)
        yield tuple(shifts), None


def _shares_of(shifts: tuple[int, ...]) -> Tensor:
    """Shares of the remainders where each was as frequent before."""
    m = len(shifts)
    become = torch.tensor([(r + shift) % m for r, shift in enumerate(shifts)])
    return torch.bincount(become, minlength=m).to(torch.float64) / m
