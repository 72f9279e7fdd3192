"""Amplitudes of the simulation's lines, in it and in the recording."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.known_lines import amplitudes
from gyrofuse.mismatch.stats.multiplicity import sidak


class LineSizes(NamedTuple):
    """Amplitudes of every line that the simulation has, `(sensor, line)`, unit of the signals.

    Attributes:
        observed: In the recording.
        reference: In the simulation, the mean over its records.
        sd: Standard deviation of what was recorded, for the noise around.
        simulated_sd: Of what was simulated, as well as its records agree.
        present: Standard deviations by which amplitudes in the simulation are larger than those of noise, on average.
        wander: Variance of an amplitude in the simulation by how its line wanders.
    """

    observed: Tensor
    reference: Tensor
    sd: Tensor
    simulated_sd: Tensor
    present: Tensor
    wander: Tensor

    @property
    def wanders(self) -> Tensor:
        """Whether a line has another phase at other times, in the sensor where it is largest, `(line,)`."""
        most = 0.1  # standard deviations of an amplitude by that, over it
        size, at = self.reference.max(0)
        return self.wander.gather(0, at[None])[0] > (most * size).square()

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
    wander = _wander(comparison)
    ours = ours + wander * (comparison.reference.signal.shape[-1] / comparison.n_samples)
    theirs = theirs.maximum(wander)
    fitted = comparison.reference.uncertainty
    effective_samples = comparison.reference.effective_samples if fitted is None else fitted.n_samples
    known = (theirs / len(others)).maximum(2 * density / effective_samples)
    # Of noise alone the parts are normal, and the amplitude of each record has Rayleigh's law.
    noise = (2 * density / comparison.reference.signal.shape[-1]).sqrt()
    mean, sd = math.sqrt(math.pi / 2), math.sqrt(2 - math.pi / 2)
    present = (others.mean(0) / noise - mean) * math.sqrt(len(others)) / sd
    return LineSizes(own[0], others.mean(0), ours.sqrt(), known.sqrt(), present, wander)


def _wander(comparison: Comparison) -> Tensor:
    """Variance of the amplitude of a record's lines in the simulation by how they wander, `(sensor, line)`.

    What the scatter over parts of a record is beyond that of noise; 0 where it is not.
    """
    side, parts, rare = comparison.reference, 16, 1e-3
    frequency, length = torch.tensor(side.lines, dtype=torch.float64), side.signal.shape[-1] // parts
    taper = torch.hann_window(length, periodic=False, dtype=torch.float64)
    turn = torch.polar(
        torch.ones(len(frequency), parts * length, dtype=torch.float64),
        -2 * math.pi * frequency[:, None] * torch.arange(parts * length, dtype=torch.float64),
    ).unflatten(-1, (parts, length))
    segments = side.signal[..., : parts * length].unflatten(-1, (parts, length))
    segments = (segments - segments.mean(-1, keepdim=True)) * taper
    z = torch.einsum("rskt,lkt->rslk", segments.to(turn.dtype), turn) * (2 / taper.sum())
    apart = z - z.mean(-1, keepdim=True)
    scatter = apart.abs().square().mean((0, -1)) * (parts / (parts - 1))
    longer = 3  # parts over which a phase goes on
    follows = sum((apart[..., k:] * apart[..., :-k].conj()).real.mean(0).sum(-1) for k in range(1, longer + 1))
    scatter = scatter + (2 / parts * torch.as_tensor(follows)).clamp(min=0)
    noise = 4 * taper.square().sum() / taper.sum().square() * comparison.base.spectrum(frequency)
    dof = 2 * len(side.signal) * (parts - 1)
    return torch.where(scatter > noise * float(stats.chi2.isf(rare, dof)) / dof, scatter - noise, 0.0) / parts
