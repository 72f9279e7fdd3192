"""Candidates for the composition of a noise, their simplifications, and their neighbours."""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.parsing import parse_model
from gyrofuse.noise.processes import AR1, PROCESSES, Drift, Model, Process, QuantizationNoise, RandomWalk, WhiteNoise

Kinds = list[type[Process]]
Key = frozenset[tuple[type[Process], int]]

# Factor `c` of the penalty of Hannan and Quinn, above 1 for a consistent choice. At 1.5 a superfluous process is chosen
# in less than 1 % of records of 10^4 to 10^7 samples, where the penalty `ln T` of BIC misses many of the weak ones.
_HANNAN_QUINN = 1.5
# Standard error of the logarithm of a variance, or of `x`, above which it is unknown: a factor of e^4 either way.
_UNKNOWN = 2.0


def key_of(kinds: Iterable[type[Process]]) -> Key:
    """Numbers of the processes of each kind, without an order."""
    return frozenset(Counter(kinds).items())


def structure_of(kinds: Iterable[type[Process]], held: bool) -> ModelStructure:
    """Structure of a model with these processes, in the usual order."""
    ordered: list[Any] = sorted(kinds, key=PROCESSES.index)  # of classes with constructors of their own
    return ModelStructure(tuple(kind() for kind in ordered), held)


def kinds_of(structure: ModelStructure) -> Kinds:
    """Types of its processes."""
    return [type(p) for p in structure.processes]


def name_of(kinds: Iterable[type[Process]]) -> str:
    """Name of a structure, such as `WN + 2*AR1 + RW`."""
    return structure_of(kinds, True).name


def n_unknown(kinds: Kinds, held: bool) -> int:
    """Unknowns of the moments, with frequencies of sinusoids known from elsewhere or not."""
    return len(kinds) + sum(kind.shape_name is not None and not (held and kind.has_line) for kind in kinds)


def n_parameters(structure: ModelStructure) -> int:
    """Unknowns of a structure; of a sinusoid amplitude and frequency."""
    return structure.n_linear + len(structure.nonlinear)


def penalty(structure: ModelStructure, n_samples: int) -> float:
    """Penalty of its parameters in `-2 ln L`: `2 c ln ln T` each, and `ln T` for a slope, known to `T^(-3/2)`."""
    drifts = sum(process.deterministic for process in structure.processes)
    each = 2 * _HANNAN_QUINN * math.log(math.log(n_samples))
    return (n_parameters(structure) - drifts) * each + drifts * math.log(n_samples)


def all_noises(most: int, most_ar1s: int = 3) -> list[Kinds]:
    """Sums of WN, QN, AR1s, RW and DR with at least one noise.

    Args:
        most: Largest number of parameters.
        most_ar1s: Largest number of AR1s: more are not identified in records of feasible length.
    """
    found = []
    for n, *others in itertools.product(range(most_ar1s + 1), *((False, True),) * 4):
        kinds = [
            kind
            for kind, there in zip((WhiteNoise, QuantizationNoise, RandomWalk, Drift), others, strict=True)
            if there
        ]
        kinds += [AR1] * n
        if set(kinds) - {Drift} and len(kinds) + n <= most:
            found.append(kinds)
    return found


def read_candidates(candidates: Sequence[Model | str]) -> list[Kinds]:
    """Kinds of the processes of each candidate.

    Raises:
        TypeError: Not a sequence of models or formulas.
        ValueError: None, one with values, or the same twice.
    """
    if isinstance(candidates, (str, Model)) or not isinstance(candidates, Sequence):
        raise TypeError(
            f"`candidates`: expected a sequence of models or formulas such as ['WN', 'WN + AR1'], got "
            f"{type(candidates).__name__}; put it in a list"
        )
    found: dict[Key, Kinds] = {}
    for candidate in candidates:
        model = parse_model(candidate) if isinstance(candidate, str) else candidate
        if not isinstance(model, Model):
            raise TypeError(
                f"`candidates`: expected models or formulas such as 'WN + AR1', got {type(model).__name__}; "
                "write WhiteNoise() + AR1()"
            )
        given = [name for name, value in model._named() if value is not None]
        if given:
            raise ValueError(
                f"`candidates`: expected parameters to be estimated, got values of {', '.join(given)}; "
                "write the process without values"
            )
        kinds = [type(p) for p in model.processes]
        if not any(kind.gaussian for kind in kinds):
            raise ValueError(f"`candidates`: expected a noise in each, got {name_of(kinds)}; add WN")
        if key_of(kinds) in found:
            raise ValueError(f"`candidates`: expected each composition once, got {name_of(kinds)} twice; leave one out")
        found[key_of(kinds)] = kinds
    if not found:
        raise ValueError("`candidates`: expected at least one, got none; leave it out for all that make sense")
    return list(found.values())


def with_ancestors(wanted: Iterable[Kinds]) -> list[Kinds]:
    """All wanted and those with any of their processes left out, from small to large.

    Along a part of them alone a search may get stuck: from WN, an AR1 that is weak beside it is missed, while from the
    AR1 alone, WN is found.
    """
    found: dict[Key, Kinds] = {}
    for kinds in wanted:
        numbers = Counter(kinds)
        for fewer in itertools.product(*(range(n + 1) for n in numbers.values())):
            part = [kind for kind, n in zip(numbers, fewer, strict=True) for _ in range(n)]
            if any(kind.gaussian for kind in part):
                found.setdefault(key_of(part), part)
    return sorted(found.values(), key=len)


def children(kinds: Kinds, among: Iterable[Key]) -> list[Kinds]:
    """Structures with one process more."""
    known = set(among)
    return [more for kind in PROCESSES if key_of(more := [*kinds, kind]) in known]


def parents(kinds: Kinds) -> list[Key]:
    """Structures with one process less."""
    smaller = []
    for kind in dict.fromkeys(kinds):
        rest = list(kinds)
        rest.remove(kind)
        smaller.append(key_of(rest))
    return smaller


def next_to(kinds: Kinds, among: Iterable[Key]) -> list[tuple[Kinds, int | None]]:
    """Structures like one, the smaller ones first, and which of its processes each lacks; None where it lacks none.

    Those with a process less or more, and those with one or two processes of one parameter in the place of an AR1,
    which has two: it is white noise or a random walk at the ends of its range, and much like white and quantisation
    noise where it alternates weakly.
    """
    known = set(among)
    found: list[tuple[Kinds, int | None]] = []
    for k, kind in enumerate(kinds):
        rest = kinds[:k] + kinds[k + 1 :]
        lacking = [one for one in kind.stand_ins if one not in rest]
        in_its_place = [(), *itertools.combinations(lacking, 1), *itertools.combinations(lacking, 2)]
        found += [([*rest, *some], k) for some in in_its_place]
    found += [(child, None) for child in children(kinds, known)]
    return sorted((pair for pair in found if key_of(pair[0]) in known), key=lambda pair: len(pair[0]))


def simplified(
    structure: ModelStructure, params: Tensor, covariance: Tensor, n_samples: int
) -> list[tuple[Kinds, str] | None]:
    """For every item, the composition with fewer parameters that the fit amounts to, and why; None where there is none.

    Args:
        structure: Structure of the model.
        params: Parameters, `(item, parameter)`.
        covariance: Their covariance, `(item, parameter, parameter)`.
        n_samples: Length T of the record.
    """
    sd = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    alike = 0.05  # difference of two `atanh phi` below which time constants differ by less than a tenth
    flags: list[tuple[int, type[Process] | None, str, Tensor]] = []
    earlier: defaultdict[type[Process], list[tuple[int, Tensor, Tensor]]] = defaultdict(list)
    numbers: Counter[type[Process]] = Counter()
    for k, process in enumerate(structure.processes):
        kind = type(process)
        numbers[kind] += 1
        word = f"{process.symbol} {numbers[kind]}" if process.repeatable else process.symbol
        linear, size = structure.places[k], params[:, structure.places[k]]
        ratio = sd[:, linear] / size
        flags.append((k, None, f"{word} has no {'slope' if process.deterministic else 'variance'}", size <= 0))
        if process.has_memory():
            shape = structure.places[structure.n_linear + structure.nonlinear.index(k)]
            phi, x = params[:, shape], kind.to_unconstrained(params[:, shape])
            x_sd = sd[:, shape] / kind.unconstrained_slope(x)
            if kind.long_limit is not None:
                long = phi > torch.tensor(-2.0 / n_samples).exp()
                flags.append((k, kind.long_limit, f"{word} is {kind.long_limit.with_article('a')}", long))
            if kind.short_limit is not None:
                gap = x - kind.to_unconstrained(x.new_tensor(kind.memoryless))
                short = (gap.abs() < 2 * x_sd) & (x_sd < _UNKNOWN / 4)
                flags.append((k, kind.short_limit, f"{word} is {kind.short_limit.with_article('a')}", short))
            for other, other_x, other_sd in earlier[kind]:
                gap = torch.maximum(2 * torch.hypot(x_sd, other_sd), torch.full_like(x, alike))
                known = (x_sd < _UNKNOWN) & (other_sd < _UNKNOWN)
                same = ((x - other_x).abs() < gap) & known | ((x - other_x).abs() < alike)
                flags.append((k, None, f"{word} is {process.symbol} {other}", same))
            earlier[kind].append((numbers[kind], x, x_sd))
        flags.append((k, None, f"{word} is not identified", ~(ratio < _UNKNOWN)))
    table = torch.stack([flag for *_, flag in flags], -1).tolist()
    found: list[tuple[Kinds, str] | None] = []
    for row in table:
        becomes: dict[int, type[Process] | None] = {}
        reasons = []
        for (k, limit, word, _), there in zip(flags, row, strict=True):
            if there and k not in becomes:
                becomes[k] = limit
                reasons.append(word)
        found.append((_replaced(structure, becomes), ", ".join(reasons)) if becomes else None)
    return found


def _replaced(structure: ModelStructure, becomes: dict[int, type[Process] | None]) -> Kinds:
    kept: Kinds = []
    for k, process in enumerate(structure.processes):
        kind = becomes[k] if k in becomes else type(process)
        if kind is not None and (kind.repeatable or kind not in kept):
            kept.append(kind)
    return kept
