"""Effects of the catalogue that a simulation has itself.

A repaired simulation names them: they act on its noise as they did when they were found. Samples name nothing. Where
their values lie on a lattice they were rounded, and are again after all that is built into them. What follows a channel
of the recording, or happens at one of its moments, is looked for in the recording and asked of the simulation: where
both have it, it is taken off both, so that no more than their difference is found.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, cast

import torch
from scipy import special
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.confirm import held_out_gain
from gyrofuse.mismatch.folds import N_FOLDS
from gyrofuse.mismatch.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms import STAGES
from gyrofuse.mismatch.mechanisms.quantization import Quantization
from gyrofuse.mismatch.repaired import RepairedModel
from gyrofuse.mismatch.slow_effect import SlowEffect

_MOST = 6  # effects that a simulation is believed to have


def with_own_effects(
    case: Case, simulation: object, level: float, generator: torch.Generator
) -> tuple[Case, tuple[Mechanism, ...]]:
    """The case as far as the simulation's own effects explain it, and these.

    What happened once counts where this recording has it.

    Args:
        case: Recording and simulation; of a repaired simulation, its noise.
        simulation: As it was given.
        level: Largest p value of an effect that is looked for in samples.
        generator: Of what is built into the simulation.
    """
    own: list[Mechanism] = []
    if isinstance(simulation, RepairedModel):
        # In the order in which they act; what the converter does a case does again by itself.
        for effect in sorted(simulation.effects, key=lambda effect: effect.taken_off):
            if not effect.happened_once or held_out_gain(case, effect).as_found > 0:
                case = effect.anew(case, generator)
                own.append(effect)
        return case, tuple(own)
    rounding = Quantization.of_simulation(case)
    if rounding is not None:
        case = rounding.undone(case, generator)
        own.append(rounding)
    if case.simulated.signal.shape[-1] == case.n_samples:
        for stage in STAGES:
            kinds = [kind for kind in stage if kind.proportional_to]
            while kinds and len(own) < _MOST and (shared := _shared(case, kinds, level)):
                case = _without(case, shared)
                own.append(shared)
    return case, tuple(own)


def _shared(case: Case, kinds: Iterable[type[Mechanism]], level: float) -> Mechanism | None:
    """The strongest effect of the recording, of those kinds, if the simulation has it; None where it has not."""
    found = _strongest(case, kinds, level)
    if found is None:
        return None
    records = case.simulated.signal
    simulated = case.with_recording(_summed(records))
    alone = _resized(found.effect, simulated)
    if not _has(simulated, alone, level):
        return None
    both = case.with_recording(_summed(torch.cat([case.recorded.signal, records])))
    same = _scaled(_resized(found.effect, both), 1 / math.sqrt(len(records) + 1))
    # Numbers of both together, where they agree: those of the simulation alone have its noise.
    again = _strongest(_without(case, same), kinds, level)
    if again is None or (again.mechanism, again.channel) != (found.mechanism, found.channel):
        return same
    return _scaled(alone, 1 / math.sqrt(len(records)))


def _has(simulated: Case, effect: Mechanism, level: float) -> bool:
    """Whether a simulation has an effect whose numbers were fitted to it: chance alone gives each half a nat."""
    gain = held_out_gain(simulated, effect)
    numbers = int(_sizes(effect).count_nonzero())
    return gain.confirms(level) and float(special.chdtrc(numbers, 2 * gain.as_found)) < level


def _strongest(case: Case, kinds: Iterable[type[Mechanism]], level: float) -> Finding | None:
    found = [f for f in (kind.nominate(case, level) for kind in kinds) if f is not None]
    return max(found, key=lambda f: f.gain, default=None)


def _summed(records: Tensor) -> Tensor:
    """Records `(record, sensor, time)` as one whose noise is as strong as theirs: what they share stands out."""
    return records.sum(0) / math.sqrt(len(records))


def _resized(effect: Mechanism, case: Case) -> Mechanism:
    """With the numbers that a case's recording has."""
    sizes = [_sizes(effect.refitted(case, fold)) for fold in range(N_FOLDS)]
    return _with_size(effect, torch.stack(sizes).mean(0))


def _scaled(effect: Mechanism, factor: float) -> Mechanism:
    return _with_size(effect, factor * _sizes(effect))


def _sizes(effect: Mechanism) -> Tensor:
    """All numbers that it is proportional to; slow effects may have several paths."""
    return effect.sizes if isinstance(effect, SlowEffect) else cast(Tensor, getattr(effect, effect.proportional_to))


def _with_size(effect: Mechanism, size: Tensor) -> Mechanism:
    if isinstance(effect, SlowEffect):
        return effect.with_sizes(size)
    return cast(Mechanism, replace(cast(Any, effect), **{effect.proportional_to: size}))


def _without(case: Case, effect: Mechanism) -> Case:
    """With an effect taken off both sides."""
    return case.with_recording(effect.removed(case.recording, case.scene)).built_in(
        lambda signal: effect.removed(signal, case.scene)
    )
