"""Which parameters of a fitted model a record of that length identifies, and how to say so."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from gyrofuse.fitting.moments.inference import WEAKLY_DETERMINED, Estimates
from gyrofuse.fitting.spectral.tones import FEWEST_CYCLES, Tones
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.processes import Model
from gyrofuse.wavelets.intervals import normal_quantile

# Time constants in the record below which an AR1 is called indistinguishable from a random walk: with two of them the
# autocorrelation over the record is still e^-2.
DISTINGUISHABLE_TIME_CONSTANTS = 2.0


def weakly_identified(
    structure: ModelStructure, estimates: Estimates, n_samples: int, confidence_level: float
) -> Tensor:
    """Unknowns that the record identifies weakly, `(item, unknown)`: `p` of the processes first, then `x`.

    Variances at zero, unknowns known to hardly their order of magnitude, and processes that others of the model could
    replace.

    Args:
        structure: Structure of the model.
        estimates: Estimates with symmetric intervals.
        n_samples: Length T of the records.
        confidence_level: Probability that an interval holds the true value.
    """
    needed = ~estimates.determined[:, structure.places]
    kinds = [type(process) for process in structure.processes]
    for k, reached in _near_equivalent(structure, estimates, n_samples).items():
        limits = structure.processes[k].short_limit, structure.processes[k].long_limit
        for kind, where in zip(limits, reached, strict=True):
            others = [other for other in range(len(kinds)) if kinds[other] is kind]
            needed[:, [k, _shape_at(structure, k), *others]] |= where[:, None]
    for (k, other), where in _exchangeable(structure, estimates, confidence_level).items():
        needed[:, [k, other, _shape_at(structure, k), _shape_at(structure, other)]] |= where[:, None]
    for k in structure.nonlinear:  # the shape of what is not there may be anything
        needed[:, _shape_at(structure, k)] &= ~_absent(structure, estimates, k)
    return needed


def ar1s_differ(structure: ModelStructure, estimates: Estimates, confidence_level: float) -> Tensor:
    """Whether all AR1s differ significantly from each other, `(item,)`.

    Args:
        structure: Structure of the model.
        estimates: Estimates with their covariance.
        confidence_level: Probability that an interval holds the true value.
    """
    apart = torch.ones_like(estimates.params[:, 0], dtype=torch.bool)
    for where in _exchangeable(structure, estimates, confidence_level).values():
        apart &= ~where
    return apart


def notes(
    structure: ModelStructure, estimates: Estimates, n_samples: int, confidence_level: float, tones: Tones | None = None
) -> list[tuple[str, ...]]:
    """Parameters that are not identified at this length, in words, for each item.

    Args:
        structure: Structure of the model.
        estimates: Estimates with their final intervals.
        n_samples: Length T of the records.
        confidence_level: Probability that an interval holds the true value.
        tones: Spectral lines of the sinusoids, in their order; None where the frequencies were fitted to the
            wavelet variances.
    """
    params = Model(list(structure.processes)).param_names
    names = [params[place].split(".")[0] for place in structure.places[: structure.n_linear]]
    found: list[tuple[Tensor, str]] = []
    for k, (white, walk) in _near_equivalent(structure, estimates, n_samples).items():
        limits = structure.processes[k].short_limit, structure.processes[k].long_limit
        short, long = (limit.with_article("a") if limit else "a trend" for limit in limits)
        found += [
            (white & walk, f"{names[k]}: its memory is unknown at this length"),
            (white & ~walk, f"{names[k]}: indistinguishable from {short} at this length"),
            (walk & ~white, f"{names[k]}: indistinguishable from {long} at this length"),
        ]
    for (k, other), where in _exchangeable(structure, estimates, confidence_level).items():
        found.append((where, f"{names[k]} and {names[other]}: indistinguishable from one process at this length"))
    for k, process in enumerate(structure.processes):
        if process.has_line:
            beta = estimates.params[:, structure.places[_shape_at(structure, k)]]
            few = (beta * n_samples < 2 * math.pi * FEWEST_CYCLES) & ~_absent(structure, estimates, k)
            found.append((few, f"{names[k]}: fewer than {FEWEST_CYCLES:g} cycles in the record"))
    found += [
        (where, f"{params[one]} and {params[other]}: known in combination only")
        for (one, other), where in _combined(structure, estimates).items()
    ]
    found_by_item: list[list[str]] = [[] for _ in estimates.params]
    for where, text in found:
        for item in where.nonzero()[:, 0].tolist():
            found_by_item[item].append(text)
    if tones is not None:
        sinusoids = [name for k, name in enumerate(names) if structure.processes[k].has_line]
        # At 0.05 a line that is nothing but noise stays without this note in one record of twenty.
        for item, tone in (tones.p_value >= 0.05).nonzero().tolist():
            p_value = tones.p_value[item, tone].item()
            found_by_item[item].append(f"{sinusoids[tone]}: not significant against the noise (p = {p_value:.1g})")
        for item, tone in _larger_than_in_spectrum(structure, estimates, tones).nonzero().tolist():
            held = tones.amplitude[item, tone].item()
            found_by_item[item].append(
                f"{sinusoids[tone]}: the spectrum holds an amplitude of {held:.2g} at this frequency, the rest stands "
                "in for what the model lacks; refine the fit"
            )
    return [tuple(texts) for texts in found_by_item]


def _near_equivalent(
    structure: ModelStructure, estimates: Estimates, n_samples: int
) -> dict[int, tuple[Tensor, Tensor]]:
    """For each process with a memory, whether its interval contains no memory, and one as long as the record."""
    found: dict[int, tuple[Tensor, Tensor]] = {}
    for k, process in enumerate(structure.processes):
        if process.has_memory():
            place, there = structure.places[_shape_at(structure, k)], ~_absent(structure, estimates, k)
            low, high = estimates.low[:, place], estimates.high[:, place]
            found[k] = (
                there & (low <= process.memoryless) & (high >= process.memoryless),
                there & (high >= math.exp(-DISTINGUISHABLE_TIME_CONSTANTS / n_samples)),
            )
    return found


def _exchangeable(
    structure: ModelStructure, estimates: Estimates, confidence_level: float
) -> dict[tuple[int, int], Tensor]:
    """Pairs of processes of one class with a memory that do not differ significantly, in `x`."""
    found: dict[tuple[int, int], Tensor] = {}
    which = [k for k, process in enumerate(structure.processes) if process.has_memory()]
    z = normal_quantile((1 + confidence_level) / 2)
    for k, other in itertools.combinations(which, 2):
        kind = type(structure.processes[k])
        if type(structure.processes[other]) is not kind:
            continue
        places = [structure.places[_shape_at(structure, at)] for at in (k, other)]
        phi = estimates.params[:, places]
        x = kind.to_unconstrained(phi)
        slope = 1 / kind.unconstrained_slope(x)
        slope = torch.stack([slope[:, 0], -slope[:, 1]], -1)
        own = estimates.covariance[:, places][:, :, places]
        variance = (own * slope[:, :, None] * slope[:, None, :]).sum((-2, -1))
        apart = (x[:, 0] - x[:, 1]).square()
        both = ~_absent(structure, estimates, k) & ~_absent(structure, estimates, other)
        found[k, other] = both & ~(apart > z**2 * variance)  # also where the variance is unknown
    return found


def _combined(
    structure: ModelStructure, estimates: Estimates, least_correlation: float = 0.95
) -> dict[tuple[int, int], Tensor]:
    """Pairs of weakly determined variances whose estimates are correlated beyond `least_correlation`, of either sign.

    At a correlation of 0.95 the best known combination of the two, each over its standard error, is known six times
    better than the worst known one, `sqrt(1.95 / 0.05)`.
    """
    found: dict[tuple[int, int], Tensor] = {}
    variances = estimates.covariance.diagonal(dim1=-2, dim2=-1)
    for k, other in itertools.combinations(range(structure.n_linear), 2):
        one, two = structure.places[k], structure.places[other]
        size = variances[:, [one, two]].prod(-1)
        weak = (variances[:, [one, two]] > (WEAKLY_DETERMINED * estimates.params[:, [one, two]]).square()).all(-1)
        found[one, two] = weak & (size > 0) & (estimates.covariance[:, one, two].square() > least_correlation**2 * size)
    return found


def _larger_than_in_spectrum(structure: ModelStructure, estimates: Estimates, tones: Tones) -> Tensor:
    """Sinusoids with an amplitude five standard errors larger than in the spectrum, `(item, sinusoid)`.

    The standard errors of a model that lacks a process are too small. Were they half of the true ones, five of them
    would be 2.5 true ones, which chance exceeds with a probability of 0.6 %.
    """
    places = [structure.places[k] for k, process in enumerate(structure.processes) if process.has_line]
    variance = estimates.covariance.diagonal(dim1=-2, dim2=-1)[:, places] + tones.amplitude_sd.square()
    return estimates.params[:, places] - tones.amplitude > 5.0 * variance.sqrt()


def _shape_at(structure: ModelStructure, k: int) -> int:
    """Index of the unknown `x` of a process."""
    return structure.n_linear + structure.nonlinear.index(k)


def _absent(structure: ModelStructure, estimates: Estimates, k: int) -> Tensor:
    return estimates.params[:, structure.places[k]] == 0
