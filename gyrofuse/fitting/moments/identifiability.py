"""Which parameters of a fitted model a record of that length cannot tell apart, and how to say so."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from gyrofuse.fitting.moments.inference import WEAKLY_DETERMINED, Estimates
from gyrofuse.fitting.spectral.tones import FEWEST_CYCLES, Tones
from gyrofuse.fitting.structure import Composition
from gyrofuse.noise.processes import Model
from gyrofuse.wavelets.equivalent_dof import normal_quantile

# A tone of fewer cycles is a trend, an AR1 of which the record holds fewer time constants a random walk.
FEWEST_TIME_CONSTANTS = 2.0
_BY_CHANCE = 0.05  # p value above which a line may be noise
_BEYOND_DOUBT = 5.0  # standard deviations between two measurements of one amplitude
_ONE_FOR_THE_OTHER = 0.95  # correlation beyond which two parameters are known in combination only


def uncertain(made_of: Composition, estimates: Estimates, n_samples: int, confidence_level: float) -> Tensor:
    """Unknowns whose limits want a profile, `(item, unknown)`: `p` of the processes first, then `x`.

    Variances at zero, what is weakly determined, and processes that others of the model could take the place of.
    """
    needed = ~estimates.determined[:, made_of.places]
    kinds = [type(process) for process in made_of.processes]
    for k, alike in _alike(made_of, estimates, n_samples).items():
        limits = made_of.processes[k].short_limit, made_of.processes[k].long_limit
        for kind, where in zip(limits, alike, strict=True):
            others = [other for other in range(len(kinds)) if kinds[other] is kind]
            needed[:, [k, _shape_at(made_of, k), *others]] |= where[:, None]
    for (k, other), where in _twins(made_of, estimates, confidence_level).items():
        needed[:, [k, other, _shape_at(made_of, k), _shape_at(made_of, other)]] |= where[:, None]
    for k in made_of.shaped:  # the shape of what is not there may be anything
        needed[:, _shape_at(made_of, k)] &= ~_absent(made_of, estimates, k)
    return needed


def told_apart(made_of: Composition, estimates: Estimates, confidence_level: float) -> Tensor:
    """Whether all AR1s differ from each other by more than chance, `(item,)`."""
    apart = torch.ones_like(estimates.params[:, 0], dtype=torch.bool)
    for where in _twins(made_of, estimates, confidence_level).values():
        apart &= ~where
    return apart


def remarks(
    made_of: Composition, estimates: Estimates, n_samples: int, confidence_level: float, tones: Tones | None = None
) -> list[tuple[str, ...]]:
    """What cannot be told apart at this length, in words, for each item.

    Args:
        made_of: Structure of the model.
        estimates: With their final intervals.
        n_samples: Length T of the records.
        confidence_level: Of these.
        tones: Behind the sinusoids, in their order; None where the moments found these.
    """
    params = Model(list(made_of.processes)).param_names
    names = [params[place].split(".")[0] for place in made_of.places[: made_of.n_linear]]
    found: list[tuple[Tensor, str]] = []
    for k, (white, walk) in _alike(made_of, estimates, n_samples).items():
        limits = made_of.processes[k].short_limit, made_of.processes[k].long_limit
        short, long = (limit.with_article("a") if limit else "a trend" for limit in limits)
        found += [
            (white & walk, f"{names[k]}: its memory is unknown at this length"),
            (white & ~walk, f"{names[k]}: indistinguishable from {short} at this length"),
            (walk & ~white, f"{names[k]}: indistinguishable from {long} at this length"),
        ]
    for (k, other), where in _twins(made_of, estimates, confidence_level).items():
        found.append((where, f"{names[k]} and {names[other]}: indistinguishable from one process at this length"))
    for k, process in enumerate(made_of.processes):
        if process.has_line:
            beta = estimates.params[:, made_of.places[_shape_at(made_of, k)]]
            few = (beta * n_samples < 2 * math.pi * FEWEST_CYCLES) & ~_absent(made_of, estimates, k)
            found.append((few, f"{names[k]}: fewer than {FEWEST_CYCLES:g} cycles in the record"))
    found += [
        (where, f"{params[one]} and {params[other]}: known in combination only")
        for (one, other), where in _combined(made_of, estimates).items()
    ]
    said: list[list[str]] = [[] for _ in estimates.params]
    for where, text in found:
        for item in where.nonzero()[:, 0].tolist():
            said[item].append(text)
    if tones is not None:
        sinusoids = [name for k, name in enumerate(names) if made_of.processes[k].has_line]
        for item, tone in (tones.p_value >= _BY_CHANCE).nonzero().tolist():
            p_value = tones.p_value[item, tone].item()
            said[item].append(f"{sinusoids[tone]}: not told from the noise (p = {p_value:.1g})")
        for item, tone in _standing_in(made_of, estimates, tones).nonzero().tolist():
            held = tones.amplitude[item, tone].item()
            said[item].append(
                f"{sinusoids[tone]}: the spectrum holds an amplitude of {held:.2g} at this frequency, the rest stands "
                "in for what the model lacks; refine the fit"
            )
    return [tuple(texts) for texts in said]


def _alike(made_of: Composition, estimates: Estimates, n_samples: int) -> dict[int, tuple[Tensor, Tensor]]:
    """For each process with a memory whether its interval of `phi` reaches no memory, and one as long as the record."""
    found: dict[int, tuple[Tensor, Tensor]] = {}
    for k, process in enumerate(made_of.processes):
        if process.has_memory():
            place, there = made_of.places[_shape_at(made_of, k)], ~_absent(made_of, estimates, k)
            low, high = estimates.low[:, place], estimates.high[:, place]
            found[k] = (
                there & (low <= process.memoryless) & (high >= process.memoryless),
                there & (high >= math.exp(-FEWEST_TIME_CONSTANTS / n_samples)),
            )
    return found


def _twins(made_of: Composition, estimates: Estimates, confidence_level: float) -> dict[tuple[int, int], Tensor]:
    """Pairs of processes of one class with a memory that differ by less than chance, in `x`."""
    found: dict[tuple[int, int], Tensor] = {}
    which = [k for k, process in enumerate(made_of.processes) if process.has_memory()]
    z = normal_quantile((1 + confidence_level) / 2)
    for k, other in itertools.combinations(which, 2):
        kind = type(made_of.processes[k])
        if type(made_of.processes[other]) is not kind:
            continue
        places = [made_of.places[_shape_at(made_of, at)] for at in (k, other)]
        phi = estimates.params[:, places]
        x = kind.to_unconstrained(phi)
        slope = 1 / kind.unconstrained_slope(x)
        slope = torch.stack([slope[:, 0], -slope[:, 1]], -1)
        own = estimates.covariance[:, places][:, :, places]
        variance = (own * slope[:, :, None] * slope[:, None, :]).sum((-2, -1))
        apart = (x[:, 0] - x[:, 1]).square()
        both = ~_absent(made_of, estimates, k) & ~_absent(made_of, estimates, other)
        found[k, other] = both & ~(apart > z**2 * variance)  # also where the variance is unknown
    return found


def _combined(made_of: Composition, estimates: Estimates) -> dict[tuple[int, int], Tensor]:
    """Pairs of variances, both weakly determined, of which one rises as the other falls."""
    found: dict[tuple[int, int], Tensor] = {}
    spread = estimates.covariance.diagonal(dim1=-2, dim2=-1)
    for k, other in itertools.combinations(range(made_of.n_linear), 2):
        one, two = made_of.places[k], made_of.places[other]
        size = spread[:, [one, two]].prod(-1)
        weak = (spread[:, [one, two]] > (WEAKLY_DETERMINED * estimates.params[:, [one, two]]).square()).all(-1)
        found[one, two] = (
            weak & (size > 0) & (estimates.covariance[:, one, two].square() > _ONE_FOR_THE_OTHER**2 * size)
        )
    return found


def _standing_in(made_of: Composition, estimates: Estimates, tones: Tones) -> Tensor:
    """Sinusoids that the moments find beyond doubt larger than the spectrum does, `(item, sinusoid)`."""
    places = [made_of.places[k] for k, process in enumerate(made_of.processes) if process.has_line]
    spread = estimates.covariance.diagonal(dim1=-2, dim2=-1)[:, places] + tones.amplitude_sd.square()
    return estimates.params[:, places] - tones.amplitude > _BEYOND_DOUBT * spread.sqrt()


def _shape_at(made_of: Composition, k: int) -> int:
    """The unknown `x` of a process."""
    return made_of.n_linear + made_of.shaped.index(k)


def _absent(made_of: Composition, estimates: Estimates, k: int) -> Tensor:
    return estimates.params[:, made_of.places[k]] == 0
