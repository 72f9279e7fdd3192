"""Witnesses of what is small and broad: powers and coherences pooled over neighbouring bands."""

from __future__ import annotations

import functools
import math

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import Evidence, corrected
from gyrofuse.mismatch.witnesses import level_of, power_tails

_DRAWN, _COUNTED = 4000, 40  # matrices of noise, and those of them beyond which the tail is not counted
_NEIGHBOURS = 1.1  # bands next to each other are slightly correlated


def shape_witness(case: Case) -> Evidence:
    """Broad differences of power: log ratios pooled over neighbouring bands and over sensors, against noise alone."""
    one, other, worth = case.recorded.power, case.simulated.power, _worth(case)
    if not bool((worth > 0).any()):
        return Evidence("shape", 1.0, "the simulation is too short to compare spectra with")
    scores = _normal_scores(power_tails(case), one > other)
    scores = torch.where(worth > 0, scores.nan_to_num(nan=0.0), 0.0)  # (sensor, band)
    weights = worth.sqrt()
    pooled, spread = _windows(scores * weights, weights, case)
    z = pooled / spread.clamp(min=1e-12)
    row, column = divmod(int(z.abs().argmax()), z.shape[1])
    p = 2 * float(stats.norm.sf(float(z.abs().max())))
    first, last, sensors = _window_of(row, column, case)
    f = math.sqrt(float(case.bands.frequency[first] * case.bands.frequency[last])) * case.scene.rate
    inside = slice(first, last + 1)
    log_ratio = float(
        ((one / other).log() * weights.square())[list(sensors), inside].sum()
        / weights[inside].square().sum()
        / len(sensors)
    )
    return Evidence(
        "shape",
        corrected(p, z.numel()),
        f"power is {math.exp(log_ratio):.3g} times the simulation's over a broad band around {f:.3g} Hz",
        sensors=sensors,
        levels=tuple(sorted({level_of(float(case.bands.frequency[b])) for b in range(first, last + 1)})),
        frequency_hz=f,
    )


def common_witness(case: Case) -> Evidence:
    """Coherence that the simulation does not have, pooled over neighbouring bands, all pairs of sensors together.

    The difference of coherence matrices is whitened by what both have in common: its entries then vary by
    `1/d + 1/s`, whatever noise the sensors share.
    """
    p, d, s = case.n_sensors, case.recorded.dof, case.simulated.dof
    known = (d >= 2 * p) & (s >= 2 * p)
    if p < 2 or int(known.sum()) < 2:
        return Evidence("common", 1.0, "nothing to compare coherences of")
    one, other, d, s = case.recorded.coherence[known], case.simulated.coherence[known], d[known], s[known]
    both = (d[:, None, None] * one + s[:, None, None] * other) / (d + s)[:, None, None]
    root = torch.linalg.cholesky(both)
    left = torch.linalg.solve_triangular(root, one - other, upper=False)
    white = torch.linalg.solve_triangular(root, left.mH, upper=False)
    pairs = torch.triu_indices(p, p, 1)
    worth = d * s / (d + s)
    starts, ends = _runs(len(d))
    total = torch.cat([torch.zeros(1, p, p, dtype=white.dtype), (white * worth[:, None, None]).cumsum(0)])
    weight = torch.cat([torch.zeros_like(worth[:1]), worth.cumsum(0)])
    sums = (total[ends] - total[starts]) / ((weight[ends] - weight[starts]) * _NEIGHBOURS).sqrt()[:, None, None]
    sums = sums - torch.diag_embed(sums.diagonal(dim1=-2, dim2=-1))
    size = torch.linalg.eigvalsh(sums).abs().amax(-1)  # one source has one direction
    run = int(size.argmax())
    first, last = int(starts[run]), int(ends[run]) - 1
    sums = sums[:, pairs[0], pairs[1]]
    pair = int(sums[run].abs().argmax())
    i, j = (case.scene.sensors[int(k[pair])] for k in pairs)
    frequency = case.bands.frequency[known]
    f = math.sqrt(float(frequency[first] * frequency[last])) * case.scene.rate
    return Evidence(
        "common",
        corrected(_tail(float(size[run]), p), len(size)),
        f"sensors share noise over a broad band around {f:.3g} Hz, most of all {i} and {j}",
        sensors=tuple(range(p)),
        levels=tuple(sorted({level_of(float(x)) for x in frequency[first : last + 1]})),
        frequency_hz=f,
    )


def _tail(size: float, p: int) -> float:
    """Upper tail of the largest eigenvalue, of either sign, of a Hermitian matrix of noise without a diagonal.

    Counted among drawn ones, and beyond them by the law of its far tail, `l^(2p - 2) exp(-l^2 / (2 (1 - 1/p)))`.
    """
    drawn = _noise_sizes(p)
    if size <= float(drawn[-_COUNTED]):
        return float((drawn >= size).sum() + 1) / (len(drawn) + 1)
    anchor = float(drawn[-_COUNTED])
    log_ratio = (2 * p - 2) * math.log(size / anchor) - (size**2 - anchor**2) / (2 * (1 - 1 / p))
    return min(_COUNTED / len(drawn) * math.exp(max(log_ratio, -700.0)), 1.0)


@functools.lru_cache(maxsize=8)
def _noise_sizes(p: int) -> Tensor:
    """Largest eigenvalues of noise, sorted."""
    parts = torch.randn(2, _DRAWN, p, p, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    upper = (torch.complex(parts[0], parts[1]) / math.sqrt(2)).triu(1)
    return torch.linalg.eigvalsh(upper + upper.mH).abs().amax(-1).sort().values


def _worth(case: Case) -> Tensor:
    d, s = case.recorded.dof, case.simulated.dof
    return d * s / (d + s).clamp(min=1e-9)


def _normal_scores(tails: Tensor, above: Tensor) -> Tensor:
    size = torch.special.ndtri((tails / 2).clamp(min=1e-300)).abs()
    return torch.where(above, size, -size)


def _windows(scores: Tensor, weights: Tensor, case: Case) -> tuple[Tensor, Tensor]:
    """Sums of scores over runs of bands, for each sensor and all, `(row, column)`, and their spreads.

    Powers of sensors that share noise go together: their correlation is the squared coherence.
    """
    n_bands = scores.shape[-1]
    coherence = torch.maximum(case.recorded.coherence.abs(), case.simulated.coherence.abs()).square()
    together = coherence.sum((-1, -2)) * weights.square()  # variance of the sum over sensors in a band
    rows = torch.cat([scores, scores.sum(0, keepdim=True)])
    variances = torch.cat([weights.square().expand_as(scores), together[None]])
    starts, ends = _runs(n_bands)

    def sums(values: Tensor) -> Tensor:
        total = torch.cat([torch.zeros_like(values[:, :1]), values.cumsum(-1)], -1)
        return total[:, ends] - total[:, starts]

    return sums(rows), (sums(variances) * _NEIGHBOURS).sqrt()


def _runs(n_bands: int) -> tuple[Tensor, Tensor]:
    """First band and the band after the last, of runs of 2, 4, 8, .. bands that overlap by half, and of all."""
    starts, ends, length = [0], [n_bands], 2
    while length < n_bands:
        for first in range(0, n_bands - length + 1, max(length // 2, 1)):
            starts.append(first)
            ends.append(first + length)
        starts.append(n_bands - length)
        ends.append(n_bands)
        length *= 2
    return torch.tensor(starts), torch.tensor(ends)


def _window_of(row: int, column: int, case: Case) -> tuple[int, int, tuple[int, ...]]:
    starts, ends = _runs(len(case.bands.dof))
    sensors = tuple(range(case.n_sensors)) if row == case.n_sensors else (row,)
    return int(starts[column]), int(ends[column]) - 1, sensors
