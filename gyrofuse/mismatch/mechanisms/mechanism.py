"""What every mechanism of the catalogue is: an equation with numbers, and how a recording shows it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.results import cleaned
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import spectral_gains

_BETTER_SD = 2.0


class Parameter(NamedTuple):
    """A number with its limits at the confidence level of the diagnosis."""

    value: float
    low: float
    high: float
    unit: str


class Mechanism:
    """Physics that a simulator left out: an equation whose numbers are known.

    A subclass is a frozen dataclass of numbers. `detect_and_fit` finds it in a comparison; the rest says what it does,
    so that it composes with any noise model.
    """

    name: ClassVar[str]
    happened_once: ClassVar[bool] = False  # at a time of this recording, not in another one
    changes_noise: ClassVar[bool] = False  # levels or spectra of noise: a wrong one leads a simulation away
    proportional_to: ClassVar[str] = ""  # field, where it adds a known path to every record of the same time
    taken_off: ClassVar[bool] = False  # the recording by its repair, instead of built into the simulation
    place: ClassVar[int] = 0  # in the chain from sensor to numbers: clipped, rounded, repeated come after all else

    @property
    def order(self) -> tuple[int, bool]:
        """When it acts on a simulation: what is taken off was on top of all that the repairs make of its noise."""
        return self.place, self.taken_off

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        """The strongest instance that the recording shows at p below `level`, if any.

        Args:
            comparison: Recording and simulation, as far as explained.
            level: Largest p value, which allows for all the places that were looked at.
        """
        raise NotImplementedError

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        """What becomes of the clean signals `(..., sensor, time)` of a simulation."""
        raise NotImplementedError

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        """A recording `(..., sensor, time)` without what can be taken off it: all of it, by default none."""
        return signal

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The case with the mechanism taken off the recording or, as by default, built into the simulation."""
        return self.apply_to_reference(comparison, generator)

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The case with the mechanism in the simulation, whether or not it could be taken off the recording."""
        return comparison.apply(partial(self.apply, info=comparison.info, generator=generator), self.place)

    def apply_elsewhere(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The case of another recording, of which a simulation claims that it has the mechanism: as where it was found.

        What has another phase there goes into the simulation.
        """
        return self.repair(comparison, generator)

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        """What becomes of cross-spectral densities `(frequency, sensor, sensor)` at `f` cycles per sample.

        What `remove` takes off does not count; by default nothing happens.
        """
        return matrices

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        """Gain in log score of each block that a fold holds out, `(block,)`, nats, with the numbers as they are.

        By default that of the spectra of what is left; where a mechanism is no matter of spectra, its own likelihood.
        """
        return spectral_gains(comparison, self.remove(comparison.recording, comparison.info), self.spectra, fold)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        """The same mechanism with its numbers estimated anew, where it is known to be, without what a fold holds out.

        Args:
            comparison: As it was when the mechanism was found.
            fold: Which one.
        """
        raise NotImplementedError


class Alternative(NamedTuple):
    """The look-alike that does best in the place of a finding, all others in.

    Attributes:
        mechanism: Its name.
        gain: Its gain in log score on the blocks held out, nats.
        sd: Standard deviation of the difference between both gains, block by block.
    """

    mechanism: str
    gain: float
    sd: float

    def beats(self, gain: float) -> bool:
        """Whether it gains more than the finding does, by more than chance."""
        return self.gain > gain + _BETTER_SD * self.sd


@dataclass(frozen=True, eq=False)
class Finding:
    """One difference between recording and simulation, with its name.

    Attributes:
        mechanism: Name of the physics.
        effect: It, with its numbers.
        alternatives: Names that the data cannot tell apart from it.
        sensors: Positions of the sensors concerned, from 0.
        levels: Wavelet levels concerned, from 1.
        frequency_hz: Of a line or band.
        time_s: Onset, s after the first sample.
        channel: Auxiliary channel that it follows.
        parameters: By name, with limits and units.
        p_value: For having looked at every place where it could have been.
        held_out_gain: Log score on data not used for it, nats; None until confirmed.
        gain_without: The same where all other findings are in: what is lost if it alone is left out.
        instead: Its best look-alike on the same blocks; None where nothing in the catalogue looks like it.
        sentence: The same in plain English.
        hides: Positions of sensors in which it leaves nothing else to be told.
    """

    mechanism: str
    effect: Mechanism
    sentence: str
    p_value: float
    sensors: tuple[int, ...]
    parameters: dict[str, Parameter]
    levels: tuple[int, ...] = ()
    alternatives: tuple[str, ...] = ()
    frequency_hz: float | None = None
    time_s: float | None = None
    channel: str | None = None
    gain: float = 0.0
    held_out_gain: float | None = None
    gain_without: float | None = None
    instead: Alternative | None = None
    hides: tuple[int, ...] = ()

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The case with the effect explained, and noise in the place of sensors that it hides all else of."""
        comparison = self.effect.repair(comparison, generator)
        return comparison.with_stand_ins(self.hides, generator) if self.hides else comparison

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        return cleaned(
            {
                "mechanism": self.mechanism,
                "alternatives": list(self.alternatives),
                "sensors": list(self.sensors),
                "levels": list(self.levels),
                "frequency_hz": self.frequency_hz,
                "time_s": self.time_s,
                "channel": self.channel,
                "parameters": {name: entry._asdict() for name, entry in self.parameters.items()},
                "p_value": self.p_value,
                "held_out_gain": self.held_out_gain,
                "gain_without": self.gain_without,
                "instead": None if self.instead is None else self.instead._asdict(),
                "sentence": self.sentence,
            }
        )


def readable(name: str) -> str:
    """Name of a mechanism or witness for readers."""
    return name.replace("_", " ")
