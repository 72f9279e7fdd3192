"""A tone whose size or frequency goes up and down with a period: a rotor that hunts, a beat, a belt that slips."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Rival
from gyrofuse.mismatch.mechanisms.signals.harmonics import Harmonics, sidebands_of
from gyrofuse.mismatch.mechanisms.signals.tone import Harmonic, VibrationTone
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.stats.inclusion import included_sensors


@dataclass(frozen=True, eq=False)
class ModulatedTone(VibrationTone):
    """`x_i(t) = Re sum_k a_ik exp(2 pi j (f + k f_m) t)`: a tone, and lines evenly on either side of it.

    With an amplitude that follows a sine there is one line on either side; with a frequency that does, as many as it
    moves by, over `f_m` (Carson's rule). Each harmonic's `multiple` is its `k`.

    Attributes:
        modulation_hz: `f_m`.
    """

    modulation_hz: float = 1.0

    @classmethod
    def _with_family(cls, comparison: Comparison, tone: VibrationTone, series: Harmonics) -> ModulatedTone | None:
        rate = comparison.info.rate
        found = sidebands_of(comparison, tone.frequency_hz / rate)
        # What turns has lines evenly beside each other as well: multiples of a frequency say more.
        if found is None or len(found.orders) <= len(series.others):
            return None
        none, every = torch.zeros_like(tone.cosine), torch.ones(comparison.n_samples, dtype=torch.bool)
        lines = tuple(Harmonic(k, none, none) for k in sorted(found.orders))
        own = cls(tone.frequency_hz, tone.cosine, tone.sine, harmonics=lines, modulation_hz=found.spacing * rate)
        return own._fitted(comparison, every)._from_its_middle()

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        """None: one line in the place of a peak is a plain tone."""
        return None

    def _fitted(self, comparison: Comparison, keep: Tensor) -> ModulatedTone:
        fitted = super()._fitted(comparison, keep)
        assert isinstance(fitted, ModulatedTone)
        return fitted

    def _from_its_middle(self) -> ModulatedTone:
        """The same, counted from the line next to the mean frequency of its power."""
        power = squared_modulus(torch.complex(*self._parts())).sum(-1)
        orders = self._turns()[1]
        middle = round(float(orders @ power / power.sum()))
        at = {0: (self.cosine, self.sine)} | {one.multiple: (one.cosine, one.sine) for one in self.harmonics}
        own = at.pop(middle, (torch.zeros_like(self.cosine), torch.zeros_like(self.sine)))
        lines = tuple(Harmonic(k - middle, *parts) for k, parts in sorted(at.items()))
        frequency = self.frequency_hz + middle * self.modulation_hz
        return replace(self, frequency_hz=frequency, cosine=own[0], sine=own[1], harmonics=lines)

    def _has(self, squares: Tensor) -> Tensor:
        return included_sensors(squares.sum(0), 2 * len(squares)).which

    @staticmethod
    def _word(one: Harmonic) -> str:
        return f"sideband_{one.multiple:+d}"

    def _frequencies(self) -> dict[str, float]:
        return {"frequency": self.frequency_hz, "modulation": self.modulation_hz}

    def _at_frequencies(self, hz: list[float]) -> ModulatedTone:
        return replace(self, frequency_hz=hz[0], modulation_hz=hz[1])

    def _turns(self) -> Tensor:
        orders = torch.tensor([0.0, *(one.multiple for one in self.harmonics)], dtype=torch.float64)
        return torch.stack([torch.ones_like(orders), orders])

    def _besides(self, info: RecordingInfo) -> str:
        orders = [one.multiple for one in self.harmonics]
        reach = max(map(abs, orders)) * self.modulation_hz
        return (
            f"it goes up and down at {self.modulation_hz:.4g} Hz, in size or frequency: {len(orders)} lines stand "
            f"evenly beside it, within {reach:.3g} Hz"
        )

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        reach = (max(abs(one.multiple) for one in self.harmonics) + 1) * self.modulation_hz
        pictures.spectrum_near(ax, comparison, sensor, self.frequency_hz, reach / 12)

    def wander(self, comparison: Comparison, noise: Tensor, energy: float) -> float:
        """None beside what is periodic, where its own line may be faint."""
        return 0.0
