"""Test of what sensors share over a broad band: coherences pooled over neighbouring bands."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of, whitened_difference
from gyrofuse.mismatch.likelihoods.spectra.coherence import coherence_of
from gyrofuse.mismatch.likelihoods.spectra.data import block_spectra
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED
from gyrofuse.mismatch.stats.multiplicity import sidak


class Source(NamedTuple):
    """Coherence that the simulation does not have.

    Attributes:
        p_value: Of the strongest run of bands, for all runs.
        first, last: Its bands.
        pair: The two sensors that share most.
        independent: Whether the simulation's sensors have nothing of it, nor share anything in any other run.
    """

    p_value: float
    first: int
    last: int
    pair: tuple[int, int]
    independent: bool


def common_source_test(comparison: Comparison) -> TestResult:
    """Coherence that the simulation does not have, pooled over neighbouring bands, all pairs of sensors together."""
    found = common_source(comparison)
    if found is None:
        return TestResult("common", 1.0, "nothing to compare coherences of")
    i, j = (comparison.info.sensors[k] for k in found.pair)
    frequency = comparison.bands.frequency[found.first : found.last + 1]
    f = math.sqrt(float(frequency[0] * frequency[-1])) * comparison.info.rate
    return TestResult(
        "common",
        found.p_value,
        f"sensors share noise over a broad band around {f:.3g} Hz, most of all {i} and {j}",
        sensors=tuple(range(comparison.n_sensors)),
        levels=tuple(sorted({level_of(float(x)) for x in frequency})),
        frequency_hz=f,
    )


@derived
def common_source(comparison: Comparison) -> Source | None:
    """The most conspicuous coherence of a run of bands, in phase or not.

    The difference of coherence matrices is whitened by what both have in common: its entries then vary by
    `1/d + 1/s`, whatever noise the sensors share. Where the simulation has nothing of what the recording shows, its
    sensors are independent, and the recording's coherences vary by `1/d` around none.
    """
    # Standard deviations of what the simulation has along the recording's source: below the first it has nothing, of
    # one as long as the recording; below the second that may be taken for granted where it shares nothing else.
    absent, surely, shares_p_value = 1.5, 0.7, 0.1
    neighbours = 1.1  # variance of sums over bands, of which those next to each other are slightly correlated
    p, steady = comparison.n_sensors, comparison.steady_shares
    d, s = comparison.observed.coherence_dof * steady, comparison.reference.coherence_dof * steady
    known = (d >= 2 * p) & (s >= 2 * p)
    if p < 2 or int(known.sum()) < 2:
        return None
    one, other, d, s = comparison.observed.coherence[known], comparison.reference.coherence[known], d[known], s[known]
    white = whitened_difference(one, other, d, s)
    starts, ends = _runs(len(d))

    def sums(matrices: Tensor, dof: Tensor) -> Tensor:
        """Of whole runs, in units of their noise, with no diagonal."""
        total = torch.cat([torch.zeros(1, p, p, dtype=white.dtype), (matrices * dof[:, None, None]).cumsum(0)])
        weight = torch.cat([torch.zeros_like(dof[:1]), dof.cumsum(0)])
        size = ((weight[ends] - weight[starts]) * neighbours).sqrt()
        run = (total[ends] - total[starts]) / size[:, None, None]
        return run - torch.diag_embed(run.diagonal(dim1=-2, dim2=-1))

    difference, alone, reference = sums(white, d * s / (d + s)), sums(one, d), sums(other, s)
    found, nothing, counts = [], True, _counts(len(d))
    for real in (True, False):  # in phase but for signs, or any
        apart, observed, had = ((m.real.to(m.dtype) if real else m) for m in (difference, alone, reference))
        values, vectors = torch.linalg.eigh(observed)  # one source has one direction
        top = values.abs().argmax(-1)
        size, u = values.gather(-1, top[:, None])[:, 0], vectors[torch.arange(len(top)), :, top]
        along = torch.einsum("ri,rij,rj->r", u.conj(), had, u).real * size.sign()
        spread = (1 - u.abs().pow(4).sum(-1)).clamp(min=1e-9).sqrt()
        independent = along < absent * min(1.0, float(s.sum() / d.sum())) * spread
        largest = torch.where(independent, size.abs(), torch.linalg.eigvalsh(apart).abs().amax(-1))
        tails = torch.tensor([_tail(float(x), p, real) for x in largest], dtype=torch.float64)
        run = int((tails * counts).argmin())
        pairs = torch.triu_indices(p, p, 1)
        shared = (observed if bool(independent[run]) else apart)[run][pairs[0], pairs[1]].abs()
        sensors = pairs[:, int(shared.argmax())]
        bands = known.nonzero()[:, 0]
        first, last = int(bands[starts[run]]), int(bands[ends[run] - 1])
        value = sidak(float(tails[run]), 2 * float(counts[run]))
        absent = bool((along < surely * spread)[run])
        found.append(Source(value, first, last, (int(sensors[0]), int(sensors[1])), absent))
        shown = float(torch.linalg.eigvalsh(had).abs().max())
        nothing &= sidak(_tail(shown, p, real), 2 * len(largest)) > shares_p_value
    best = min(found, key=lambda source: source.p_value)
    return best._replace(independent=best.independent and nothing)


@derived
def shared_ordinates(comparison: Comparison) -> tuple[Tensor, Tensor]:
    """Complex ordinates that a sensor shares with the others, in the simulation and in the recording, `(sensor,)`.

    By squared coherences, less what chance gives them, as if both sides told equally much.
    """
    both, apart = block_spectra(comparison), 1 - torch.eye(comparison.n_sensors, dtype=torch.float64)
    sides = (
        both.reference.mean(torch.ones(N_FOLDS, dtype=torch.bool)),
        both.observed.mean(torch.ones(N_JUDGED, dtype=torch.bool)),
    )
    told = 1 / torch.stack([1 / d.clamp(min=1e-9) for _, d in sides]).sum(0)
    simulated, recorded = (
        (
            (told[:, None, None] * apart)
            * (coherence_of(matrices).abs().square() - 1 / d.clamp(min=1.0)[:, None, None])
        ).sum((0, -1))
        for matrices, d in sides
    )
    return simulated, recorded


def _tail(size: float, p: int, real: bool) -> float:
    """Upper tail of the largest eigenvalue, of either sign, of a Hermitian matrix of noise without a diagonal.

    Counted among drawn ones, and beyond the largest 40 by the law of its far tail, `l^k exp(-l^2 / (2 (1 - 1/p)))`.
    """
    counted = 40
    drawn = _noise_sizes(p, real)
    if size <= float(drawn[-counted]):
        return float((drawn >= size).sum() + 1) / (len(drawn) + 1)
    anchor = float(drawn[-counted])
    power = p - 1 if real else 2 * p - 2
    log_ratio = power * math.log(size / anchor) - (size**2 - anchor**2) / (2 * (1 - 1 / p))
    return min(counted / len(drawn) * math.exp(max(log_ratio, -700.0)), 1.0)


@functools.lru_cache(maxsize=16)
def _noise_sizes(p: int, real: bool) -> Tensor:
    """Largest eigenvalues of 4000 matrices of noise, sorted: a table of the law, the same in every diagnosis."""
    parts = torch.randn(2, 4000, p, p, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    upper = (torch.complex(parts[0], torch.zeros_like(parts[1]) if real else parts[1]) / math.sqrt(2)).triu(1)
    return torch.linalg.eigvalsh(upper + upper.mH).abs().amax(-1).sort().values


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


def _counts(n_bands: int) -> Tensor:
    """Runs that each stands for, `(run,)`: lengths have equal shares of the chances."""
    starts, ends = _runs(n_bands)
    _, kind, count = (ends - starts).unique(return_inverse=True, return_counts=True)
    return (count[kind] * len(count)).to(torch.float64)
