"""What is left of the form of what was explained, and is no physics of its own."""

from __future__ import annotations

import torch

from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.psd import cross_spectra


def is_left_of_form(effect: Mechanism, start: Comparison, comparison: Comparison) -> bool:
    """Whether nearly all that a mechanism changes is a hundredth of what was explained in the same bands and sensors.

    Forms are those of a catalogue, and no real one is quite that: of what is ten thousand times the noise so much is
    left that it would have a name of its own.

    Args:
        effect: A mechanism that changes spectra.
        start: Recording and simulation as they came.
        comparison: The same as far as explained.
    """
    part, mostly = 0.01, 0.9  # of the power that was explained, and of what a mechanism says
    observed, reference = comparison.observed, comparison.reference
    noise = reference.power.clamp(min=1e-300)  # (sensor, band)
    explained = torch.zeros_like(noise)
    if observed is not comparison.as_came:
        taken = comparison.taken_off[None]
        taken = taken - taken.mean(-1, keepdim=True)
        explained = cross_spectra(taken, comparison.bands)[0].diagonal(dim1=-2, dim2=-1).real.mT.nan_to_num() / noise
    # What a filter takes away leaves a part of itself behind, and not of what it has taken.
    explained = torch.maximum(explained, (noise - start.reference.power).nan_to_num().clamp(min=0) / noise)
    before = reference.spectra
    changed = effect.spectra(before, comparison.bands.frequency).diagonal(dim1=-2, dim2=-1).real.mT / noise - 1
    weight = reference.dof * changed.square()
    small = changed.abs() < part * explained
    return float((weight * small).sum()) > mostly * float(weight.sum()) > 0
