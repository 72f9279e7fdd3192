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

from gyrofuse.mismatch.mechanisms.catalogue import STAGES
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.signals.slow_effect import SlowEffect
from gyrofuse.mismatch.mechanisms.values.quantization import Quantization
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.selection.held_out import held_out_gain
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.folds import N_FOLDS

_MOST = 6  # effects that a simulation is believed to have


def with_own_effects(
    comparison: Comparison, simulation: object, level: float, generator: torch.Generator
) -> tuple[Comparison, tuple[Mechanism, ...]]:
    """The case as far as the simulation's own effects explain it, and these.

    What happened once counts where this recording has it.

    Args:
        comparison: Recording and simulation; of a repaired simulation, its noise.
        simulation: As it was given.
        level: Largest p value of an effect that is looked for in samples.
        generator: Of what is built into the simulation.
    """
    own: list[Mechanism] = []
    if isinstance(simulation, RepairedModel):
        # In the order in which they act; what the converter does a case does again by itself.
        for effect in sorted(simulation.effects, key=lambda effect: effect.taken_off):
            if not effect.happened_once or held_out_gain(comparison, effect).as_found > 0:
                comparison = effect.apply_elsewhere(comparison, generator)
                own.append(effect)
        return comparison, tuple(own)
    rounding = Quantization.of_simulation(comparison)
    if rounding is not None:
        comparison = rounding.undone(comparison, generator)
        own.append(rounding)
    if comparison.reference.signal.shape[-1] == comparison.n_samples:
        for stage in STAGES:
            kinds = [kind for kind in stage if kind.proportional_to]
            while kinds and len(own) < _MOST and (shared := _shared(comparison, kinds, level)):
                comparison = _without(comparison, shared)
                own.append(shared)
    return comparison, tuple(own)


def _shared(comparison: Comparison, kinds: Iterable[type[Mechanism]], level: float) -> Mechanism | None:
    """The strongest effect of the recording, of those kinds, if the simulation has it; None where it has not."""
    found = _strongest(comparison, kinds, level)
    if found is None:
        return None
    records = comparison.reference.signal
    reference = comparison.with_recording(_summed(records))
    alone = _resized(found.effect, reference)
    if not _has(reference, alone, level):
        return None
    both = comparison.with_recording(_summed(torch.cat([comparison.observed.signal, records])))
    same = _scaled(_resized(found.effect, both), 1 / math.sqrt(len(records) + 1))
    # Numbers of both together, where they agree: those of the simulation alone have its noise.
    again = _strongest(_without(comparison, same), kinds, level)
    if again is None or (again.mechanism, again.channel) != (found.mechanism, found.channel):
        return same
    return _scaled(alone, 1 / math.sqrt(len(records)))


def _has(reference: Comparison, effect: Mechanism, level: float) -> bool:
    """Whether a simulation has an effect whose numbers were fitted to it: chance alone gives each half a nat."""
    gain = held_out_gain(reference, effect)
    numbers = int(_sizes(effect).count_nonzero())
    return gain.confirms(level) and float(special.chdtrc(numbers, 2 * gain.as_found)) < level


def _strongest(comparison: Comparison, kinds: Iterable[type[Mechanism]], level: float) -> Finding | None:
    found = [f for f in (kind.detect_and_fit(comparison, level) for kind in kinds) if f is not None]
    return max(found, key=lambda f: f.gain, default=None)


def _summed(records: Tensor) -> Tensor:
    """Records `(record, sensor, time)` as one whose noise is as strong as theirs: what they share stands out."""
    return records.sum(0) / math.sqrt(len(records))


def _resized(effect: Mechanism, comparison: Comparison) -> Mechanism:
    """With the numbers that a case's recording has."""
    sizes = [_sizes(effect.fit_without(comparison, fold)) for fold in range(N_FOLDS)]
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


def _without(comparison: Comparison, effect: Mechanism) -> Comparison:
    """With an effect taken off both sides."""
    return comparison.with_recording(effect.remove(comparison.recording, comparison.info)).apply(
        lambda signal: effect.remove(signal, comparison.info)
    )
