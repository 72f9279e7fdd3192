"""Isolated outliers that only the simulation has."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.exchanged import exchanged
from gyrofuse.mismatch.detectors.variance.outliers import fewer_outliers_p_value
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.regimes.spikes import Spikes
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class SimulatedSpikes(Mechanism):
    """`x_t = y_t - a_t`: the simulation's outliers are replaced by what the samples beside them predict, and noise.

    Which samples are outliers is drawn by their probabilities: what is left has the law of noise without any.

    Attributes:
        added: The outliers.
    """

    name: ClassVar[str] = Spikes.name
    likelihood: ClassVar[str] = Spikes.likelihood
    separated_by: ClassVar[str] = Spikes.separated_by
    added: Spikes

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p_value = fewer_outliers_p_value(comparison)
        if p_value > level:
            return None
        found = Spikes.detect_and_fit(exchanged(comparison), 1.0)
        if found is None or not isinstance(found.effect, Spikes) or not found.identified:
            return None
        effect = cls(found.effect)
        if not effect.leaves_spectra_alike(comparison, found.sensors):
            return None
        sentence = f"only the simulation has {found.sentence}"
        return replace(found, effect=effect, sentence=sentence, p_value=p_value, time_s=None)

    def leaves_spectra_alike(self, comparison: Comparison, sensors: tuple[int, ...]) -> bool:
        """Whether the sensors' spectra are those of the recording, or most of how they differ is these outliers'.

        Noise with heavy tails that has passed a filter is nearer to a normal one: it lacks no outliers.
        """
        most = 0.5
        repaired = self.repair(comparison, comparison.generator())
        (before, expected), (after, _) = (_spectral_distance(c, sensors) for c in (comparison, repaired))
        return before < 2 * expected or after - expected < most * (before - expected)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        records = signal.reshape(-1, *signal.shape[-2:])
        return torch.stack([self.added.replaced(record, info, generator) for record in records]).view_as(signal)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        """Of noise without outliers over noise that has those of the simulation."""
        return -self.added.held_out_scores(comparison, fold)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        """Its numbers are those of the simulation, of which nothing is held out."""
        return self

    def plot(self, comparison: Comparison, ax: Axes, *, sensor: int, fitted: bool) -> None:
        self.added.plot(comparison, ax, sensor=sensor, fitted=fitted)


def _spectral_distance(comparison: Comparison, sensors: tuple[int, ...]) -> tuple[float, float]:
    """Squared distance of logarithms of powers over their variance, summed over sensors and bands, and its mean."""
    observed, reference = comparison.observed, comparison.reference
    d, s = observed.power_dof[list(sensors)], reference.power_dof[list(sensors)]
    known = (d > 2) & (s > 2)
    apart = (observed.log_power - reference.log_power)[list(sensors)].square() / (1 / d + 1 / s)
    return float(apart[known].sum()), float(known.sum())
