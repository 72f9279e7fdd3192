"""Both sides exchanged: what only the simulation has is looked for as if it were the recording."""

from __future__ import annotations

from dataclasses import replace

from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived


@derived
def exchanged(comparison: Comparison) -> Comparison:
    """The simulation in the place of the recording, cut to the length of its records, and the other way round."""
    simulation, recording = comparison.reference.steady, comparison.observed.steady
    n = simulation.shape[-1]
    count = recording.shape[-1] // n
    records = recording[0, :, : count * n].unflatten(-1, (count, n)).movedim(1, 0)
    info = replace(comparison.info, channels={})
    made = Comparison.of(info, simulation[0], records)
    varies = comparison.reference.level_variance
    sides = (replace(side, level_variance=varies) for side in (made.observed, made.reference))
    observed, reference = sides
    return replace(made, as_came=observed, observed=observed, reference=reference, seed=comparison.seed)
