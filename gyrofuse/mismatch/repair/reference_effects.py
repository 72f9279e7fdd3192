"""Effects of the catalogue that a simulation has itself.

A repaired simulation names them: they act on its noise as they did when they were found. Samples name nothing. Where
their values lie on a lattice they were rounded, and are again after all that is built into them. What follows a channel
of the recording, or happens at one of its moments, is looked for in the recording and asked of the simulation: where
both have it, it is taken off both, so that no more than their difference is found. A noise model follows no channel.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from scipy import special
from torch import Tensor

from gyrofuse.mismatch.mechanisms.catalogue import CATALOGUE, STAGES
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.selection.held_out import score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.folds import N_FOLDS
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.model import Model

_MOST = 6  # effects that a simulation is believed to have


def with_own_effects(
    comparison: Comparison,
    simulation: object,
    level: float,
    generator: torch.Generator,
    drawn_with: Sequence[Mechanism] | None = None,
) -> tuple[Comparison, tuple[Mechanism, ...]]:
    """The case as far as the simulation's own effects explain it, and these.

    What happened once counts where this recording has it.

    Args:
        comparison: Recording and simulation; of a repaired simulation, its noise.
        simulation: As it was given.
        level: Largest p value of an effect that is looked for in samples.
        generator: Of what is built into the simulation.
        drawn_with: Effects that samples are known to have, in their unit; by default they are looked for.
    """
    own: list[Mechanism] = []
    if isinstance(simulation, RepairedModel):
        # In the order in which they act; what the converter does a case does again by itself.
        for effect in sorted(simulation.effects, key=lambda effect: effect.additive):
            if not effect.happened_once or score_held_out(comparison, effect).in_sample > 0:
                comparison = effect.apply_elsewhere(comparison, generator)
                own.append(effect)
        return comparison, tuple(own)
    for kind in CATALOGUE:
        found = kind.in_reference(comparison)
        if found is not None:
            comparison = found.undo_in_reference(comparison, generator)
            own.append(found)
    if drawn_with is not None:
        for effect in drawn_with:
            if effect.known_path:
                comparison = _without(comparison, effect)
                own.append(effect)
    elif comparison.reference.signal.shape[-1] == comparison.n_samples:
        follows = not isinstance(simulation, Model | ArrayModel)
        for stage in STAGES:
            kinds = [kind for kind in stage if kind.known_path]
            while kinds and len(own) < _MOST:
                seen = comparison if follows else replace(comparison, info=replace(comparison.info, channels={}))
                shared = _shared(seen, kinds, level)
                if shared is None:
                    break
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


def _has(simulated: Comparison, effect: Mechanism, level: float) -> bool:
    """Whether a simulation has an effect whose numbers were fitted to it: chance alone gives each half a nat."""
    score = score_held_out(simulated, effect)
    numbers = int(effect.amplitudes.count_nonzero())
    return score.confirms(level) and float(special.chdtrc(numbers, 2 * score.in_sample)) < level


def _strongest(comparison: Comparison, kinds: Iterable[type[Mechanism]], level: float) -> Finding | None:
    found = [f for f in (kind.detect_and_fit(comparison, level) for kind in kinds) if f is not None]
    return max(found, key=lambda f: f.gain, default=None)


def _summed(records: Tensor) -> Tensor:
    """Records `(record, sensor, time)` as one whose noise is as strong as theirs: what they share stands out."""
    return records.sum(0) / math.sqrt(len(records))


def _resized(effect: Mechanism, comparison: Comparison) -> Mechanism:
    """With the amplitudes that a comparison's recording has."""
    amplitudes = [effect.fit_without(comparison, fold).amplitudes for fold in range(N_FOLDS)]
    return effect.with_amplitudes(torch.stack(amplitudes).mean(0))


def _scaled(effect: Mechanism, factor: float) -> Mechanism:
    return effect.with_amplitudes(factor * effect.amplitudes)


def _without(comparison: Comparison, effect: Mechanism) -> Comparison:
    """With an effect taken off both sides."""
    return comparison.with_recording(effect.remove(comparison.recording, comparison.info)).apply(
        lambda signal: effect.remove(signal, comparison.info)
    )
