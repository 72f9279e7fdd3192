"""How far a recording and a simulation are apart, without asking why."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.detectors.tests import TESTS
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.repair.inputs import Simulation, modelled, prepared
from gyrofuse.mismatch.repair.reference_effects import with_own_effects
from gyrofuse.mismatch.selection.discrepancy import mean_discrepancy
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.multiplicity import sidak_level

_FALSE_ALARM = 0.01  # as in a diagnosis, of an effect that both are said to have


def discrepancy(
    recording: Recording | Tensor,
    simulation: Simulation,
    *,
    rate: float | None = None,
    generator: torch.Generator | None = None,
) -> float:
    """Squared differences of wavelet cross-covariances over their variance, mean over levels and pairs of sensors.

    One is chance alone. It is `held_out.before` of a diagnosis with the usual false alarm, at a fraction of its cost:
    to judge simulations by recordings that they were not made from.

    Args:
        recording: As for `diagnose`.
        simulation: As for `diagnose`.
        rate: Hz, for recordings given as tensors; 1 by default.
        generator: Of a model's samples. By default one with a fixed seed.

    Raises:
        TypeError: Neither samples nor a model.
        ValueError: Recording and simulation do not fit each other, are too short, or constant.
    """
    if generator is None:
        generator = torch.Generator().manual_seed(0)
    simulation = modelled(simulation, recording)
    given = prepared(recording, simulation, rate, generator)
    return mean_discrepancy(compared(given, simulation, generator))


def compared(
    given: Comparison,
    simulation: object,
    generator: torch.Generator,
    drawn_with: Sequence[Mechanism] | None = None,
) -> Comparison:
    """A case as a discrepancy sees it: without what the simulation itself has of channels and moments.

    Args:
        given: Recording and simulation as they came.
        simulation: As it was given.
        generator: Of what is built into the simulation.
        drawn_with: Effects that samples are known to have; by default they are looked for.
    """
    start, _ = with_own_effects(given, simulation, sidak_level(_FALSE_ALARM, len(TESTS)), generator, drawn_with)
    return start
