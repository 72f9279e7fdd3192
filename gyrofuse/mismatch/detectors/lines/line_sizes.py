"""Amplitudes of the simulation's lines, in it and in the recording."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.known_lines import amplitudes, line_wander
from gyrofuse.mismatch.stats.multiplicity import sidak


class LineSizes(NamedTuple):
    """Amplitudes of every line that the simulation has, `(sensor, line)`, unit of the signals.

    Attributes:
        observed: In the recording.
        reference: In the simulation, the mean over its records.
        sd: Standard deviation of what was recorded, for the noise around.
        simulated_sd: Of what was simulated, as well as its records agree.
        present: Standard deviations by which amplitudes in the simulation are larger than those of noise, on average.
    """

    observed: Tensor
    reference: Tensor
    sd: Tensor
    simulated_sd: Tensor
    present: Tensor

    @property
    def z(self) -> Tensor:
        """Differences in standard deviations, `(sensor, line)`."""
        return (self.observed - self.reference) / torch.hypot(self.sd, self.simulated_sd)

    @property
    def tails(self) -> Tensor:
        """p values of each, `(sensor, line)`."""
        return torch.special.erfc(self.z.abs() / math.sqrt(2))

    @property
    def worst(self) -> tuple[int, int]:
        """Sensor and line whose size is the most surprising."""
        sensor, line = divmod(int(self.z.abs().argmax()), self.z.shape[1])
        return sensor, line

    @property
    def p_value(self) -> float:
        """p value of that one, corrected for all."""
        return sidak(float(self.tails[self.worst]), self.tails.numel())


@derived
def line_sizes(comparison: Comparison) -> LineSizes | None:
    """Both sides' lines; None where the simulation has none.

    An amplitude scatters by `sqrt(2 S / n)` where the line stands out, and by less where it does not. The variance of
    the simulation's is that of its records, and not below that of the record from which it was estimated.
    """
    lines = comparison.reference.lines
    if not lines:
        return None
    own, others = (
        amplitudes(side.signal, lines) for side in (comparison.observed, comparison.reference)
    )  # (record, sensor, line)
    density = comparison.base.spectrum(torch.tensor(lines, dtype=torch.float64))  # (sensor, line)
    ours, theirs = (2 * density / side.signal.shape[-1] for side in (comparison.observed, comparison.reference))
    if len(others) > 1:
        theirs = theirs.maximum(others.var(0))
    wander = line_wander(comparison.reference.signal, lines, density)
    ours = ours + wander * (comparison.reference.signal.shape[-1] / comparison.n_samples)
    theirs = theirs.maximum(wander)
    fitted = comparison.reference.uncertainty
    effective_samples = comparison.reference.effective_samples if fitted is None else fitted.n_samples
    known = (theirs / len(others)).maximum(2 * density / effective_samples)
    # Of noise alone the parts are normal, and the amplitude of each record has Rayleigh's law.
    noise = (2 * density / comparison.reference.signal.shape[-1]).sqrt()
    mean, sd = math.sqrt(math.pi / 2), math.sqrt(2 - math.pi / 2)
    present = (others.mean(0) / noise - mean) * math.sqrt(len(others)) / sd
    return LineSizes(own[0], others.mean(0), ours.sqrt(), known.sqrt(), present)
