"""Test of linear chirps: a spectral line whose frequency moves steadily, as that of a machine that runs up.

Statistic: power of whitened records on the best straight track through time and frequency, segments in phase. Null law:
Gamma, corrected for the tracks searched (`tracks`).
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import CHANCE
from gyrofuse.mismatch.detectors.moving.tracks import Sweep, strongest_sweep
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.likelihoods.spectra.coherence import decorrelated
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import ENDS, left_out, whitened_without
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.level_scan import local_level


def chirp_test(comparison: Comparison) -> TestResult:
    """A line whose frequency moves, that the simulation does not have."""
    found, p_value = _strongest(comparison), _p_value(comparison)
    first, last = (f * comparison.info.rate for f in (found.first, found.last))
    where = comparison.info.named(found.sensors, "all sensors")
    by_way = "".join(f", by way of {turn * comparison.info.rate:g} Hz" for turn in found.turns)
    return TestResult(
        "sweep",
        p_value,
        f"a line that moves from {first:.4g} Hz to {last:.4g} Hz{by_way} in {where}",
        sensors=found.sensors,
        levels=tuple(sorted({level_of(max(f, 1 / comparison.n_samples)) for f in (found.first, found.last)})),
    )


def swept(comparison: Comparison, nats: float, level: float) -> bool:
    """Whether there is a chirp that explains more than so many nats.

    Where it passes the spectrum has more power, as if noise had been added there or filtered away elsewhere.

    Args:
        comparison: Recording and simulation.
        nats: Gain of another explanation of the spectrum.
        level: Largest p value of the chirp.
    """
    return _p_value(comparison) <= level and _strongest(comparison).nats > nats


def strongest_chirp(comparison: Comparison) -> tuple[float, Sweep]:
    """The best straight track, and its p value beyond what the simulation shows."""
    return _p_value(comparison), _strongest(comparison)


def _p_value(comparison: Comparison) -> float:
    p_value = _strongest(comparison).p_value
    # Lines that both sides have leave traces of any size: beside what the simulation shows nothing can be said.
    seen_in_both = p_value < CHANCE and _simulated(comparison).p_value < CHANCE
    return 1.0 if seen_in_both else p_value


@derived
def _strongest(comparison: Comparison) -> Sweep:
    """The best track in the recording."""
    return strongest_sweep(_weighed(decorrelated_record(comparison.observed), comparison))


@derived
def _simulated(comparison: Comparison) -> Sweep:
    """The best track in the simulation's first record."""
    return strongest_sweep(_weighed(decorrelated_record(comparison.reference), comparison))


def _weighed(white: Tensor, comparison: Comparison) -> Tensor:
    """Whitened samples `(sensor, time)` with less of bands in which the simulation's own lines wander."""
    n = white.shape[-1]
    share = comparison.steady_share(torch.arange(n // 2 + 1, dtype=torch.float64) / n)
    return white if bool((share == 1).all()) else torch.fft.irfft(torch.fft.rfft(white) * share.sqrt(), n=n)


@derived
def decorrelated_record(side: Records) -> Tensor:
    """Whitened record `(sensor, time)` of a steady level, without the coherence of broad bands."""
    # Standard deviations, and samples beyond: pulses and spikes have all frequencies, also those of a line that moves.
    far, many = 4.5, 8
    white = left_out(side).white[0]
    white = white / local_level(white).sqrt()
    off = white.abs() > far
    if bool(off.any()):
        white = whitened_without(side, off)
        white = white / local_level(white).sqrt()
        white = torch.where(white.abs() > far, 0.0, white)
    n = white.shape[-1]
    transform = torch.fft.rfft(white)
    edges = [0, *(round(e * n / side.bands.n_samples) for e in side.bands.edges[1:-1]), transform.shape[-1]]
    transform = decorrelated(transform / math.sqrt(n), edges, side.dof)
    transform = torch.where(off.sum(-1, keepdim=True) > many, _level(transform, edges), transform)
    white = torch.fft.irfft(transform, n=n)
    white = white / white.square().mean(-1, keepdim=True).sqrt()
    # Beside lines the ends mirror what is next to them: counted twice, chance would be significant.
    end = n // ENDS
    white[:, :end], white[:, -end:] = 0.0, 0.0
    return white


def _level(transform: Tensor, edges: list[int]) -> Tensor:
    """A transform `(sensor, bin)` of the same level in all bands, where one was whitened with what was far off."""
    fewest, parts = 64, []  # bins, for a median that is known to a fifth
    for part in transform.split([b - a for a, b in itertools.pairwise(edges)], -1):
        if part.shape[-1] >= fewest:
            part = part / (part.abs().median(-1, keepdim=True).values.clamp(min=1e-300) / math.sqrt(math.log(2)))
        parts.append(part)
    return torch.cat(parts, -1)
