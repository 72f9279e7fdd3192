"""Spectral lines of a model's sinusoids in records, found a second time where the first leaves doubt.

The first search takes the background from the periodogram itself, which bends to follow a line of few cycles and hides
it. The second one has the spectrum of noise processes fitted to the record: it can rise, but has no peaks.
"""

from __future__ import annotations

import math
from dataclasses import fields

import torch
from torch import Tensor

from gyrofuse.fitting.ranking.spectra import Spectra, detrended, reference_density
from gyrofuse.fitting.spectral.tones import Tones, find_tones
from gyrofuse.fitting.spectral.whittle import items_of
from gyrofuse.fitting.structure import ModelStructure

# Cycles in the record below which a spectral line is slow: the background taken from the periodogram bends to follow
# it.
_MANY_CYCLES = 30


def model_tones(series: Tensor, structure: ModelStructure) -> Tones | None:
    """Find the sinusoids of a model in the spectra of records `(item, time)`, from high to low frequency.

    Returns:
        `(item, sinusoid)`, float64; None where the model has no sinusoids.
    """
    n_tones = sum(p.has_line for p in structure.processes)
    if n_tones == 0:
        return None
    series = series.to(torch.float64)
    found = find_tones(series, n_tones)
    cycles = found.beta * series.shape[-1] / (2 * math.pi)
    doubtful = ((cycles < _MANY_CYCLES) | ~(found.p_value < 1e-4)).any(-1)
    if bool(doubtful.any()):
        ramp = any(p.deterministic for p in structure.processes)
        again = _second_search(detrended(series[doubtful]) if ramp else series[doubtful], items_of(found, doubtful))
        for field in fields(Tones):
            getattr(found, field.name)[doubtful] = getattr(again, field.name)
    order = found.beta.argsort(-1, descending=True)
    return Tones(*(value.gather(-1, order) for value in vars(found).values()))


def _second_search(series: Tensor, found: Tones) -> Tones:
    """The largest spectral lines over a noise spectrum fitted to the record without them, as many as were found.

    The largest slow line beside those found may have been missed. In the record to which noise is fitted it would raise
    the spectrum and hide itself, so that it is subtracted there too; it is kept if it then exceeds those found.
    """
    n_samples = series.shape[-1]
    density = reference_density(Spectra(series, found))
    rest = series - found.waveform(n_samples)
    missed = find_tones(rest, 1, density, highest=min(2 * math.pi * _MANY_CYCLES / n_samples, math.pi))
    pairs = zip(vars(found).values(), vars(missed).values(), strict=True)
    lines = Tones(*(torch.cat(pair, -1) for pair in pairs))
    return find_tones(series, found.beta.shape[-1], reference_density(Spectra(series, lines)))
