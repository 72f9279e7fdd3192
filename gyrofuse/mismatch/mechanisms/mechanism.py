"""What every mechanism of the catalogue is: an equation with numbers, how it is found, and what it does to signals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.axes import clean_name, new_axes_below_each_other
from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse._base.results import cleaned, readable
from gyrofuse.mismatch.mechanisms.finding_parts import Alternative, Parameter
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import sd_of_sum, spectral_gains

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Rival(NamedTuple):
    """A mechanism fitted in the place of a finding of another one.

    Attributes:
        effect: Mechanism with its numbers.
        score: Log likelihood ratio in sample less what its numbers cost, nats; compared among rivals of one likelihood.
    """

    effect: Mechanism
    score: float


class Mechanism:
    """Physics that a simulator left out: an equation whose numbers are known.

    A subclass is a frozen dataclass of numbers. `detect_and_fit` finds it in a comparison, the rest says what it does.
    The class attributes declare all that the search, the report and the repaired simulation need to know of it: none of
    them knows a mechanism by name.

    Attributes:
        name: Name of the physics; classes that are the same physics in another form share it.
        likelihood: Family of its held-out score: scores of one family are log likelihood ratios of the same data.
        rivals: Names of mechanisms that may look like it, each of which is fitted in the place of a finding.
        named_together: Names that are told apart by the same test, and so are detected together.
        replaced_by: Names that may take the place of a finding which loses to a rival, whatever that rival is.
        separated_by: Data that would tell it from its rivals.
        stage: Position in the chain from sensor to numbers: 0 is analogue; clipping, rounding and repeats come after.
        additive: Whether its repair takes it off the recording, instead of applying it to the simulation.
        known_path: Whether it adds a path that is known up to its amplitudes.
        happened_once: Whether it belongs to a time of this recording, and is not expected in another one.
        of_samples: Whether it is taken off the simulation's samples, so that their noise is estimated without it.
        changes_noise: Whether it changes levels or spectra of noise, so that wrong numbers lead a simulation away.
        sets_sizes: Whether it says how large lines of the simulation are in the end, whatever filters do to them.
        of_spectra: Whether it is found in spectra alone.
        broad: Whether its spectral width is that of noise, on which a spectral line may stand.
        identified: Whether it is physics with a name, and not what is left of a difference.
        refit_after_others: Whether it is fitted anew to what the others leave wherever blocks are held out.
        level_after_repairs: Factor of the significance level once another finding was repaired.
        rescales: Whether it puts the simulation's numbers into another unit.
        time_words: Words for the time of a finding in a report.
        remark: Sentence in the report where a repaired simulation has it without a finding.
    """

    name: ClassVar[str]
    likelihood: ClassVar[str] = "spectra"
    rivals: ClassVar[tuple[str, ...]] = ()
    named_together: ClassVar[tuple[str, ...]] = ()
    replaced_by: ClassVar[tuple[str, ...]] = ()
    separated_by: ClassVar[str] = "a longer recording"
    stage: ClassVar[int] = 0
    additive: ClassVar[bool] = False
    known_path: ClassVar[bool] = False
    happened_once: ClassVar[bool] = False
    of_samples: ClassVar[bool] = False
    changes_noise: ClassVar[bool] = False
    sets_sizes: ClassVar[bool] = False
    of_spectra: ClassVar[bool] = False
    broad: ClassVar[bool] = False
    identified: ClassVar[bool] = True
    refit_after_others: ClassVar[bool] = False
    level_after_repairs: ClassVar[float] = 1.0
    rescales: ClassVar[bool] = False
    time_words: ClassVar[str] = "sets in at"
    remark: ClassVar[str] = ""
    simulated = RenamedAttribute("apply")
    removed = RenamedAttribute("remove")

    @property
    def order(self) -> tuple[int, bool]:
        """Position in which it acts on a simulation; what is additive comes on top of all that is noise."""
        return self.stage, self.additive

    @property
    def only_numbers(self) -> bool:
        """Whether the simulation has its physics, with other numbers."""
        return False

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        """The strongest instance that the recording shows at a p value below `level`, if any.

        Args:
            comparison: Recording and simulation, as far as explained.
            level: Largest p value, corrected for all frequencies, times and sensors that were searched.
        """
        raise NotImplementedError

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        """The mechanism fitted as if it were the cause of a finding of another one; None where it cannot be.

        Args:
            finding: Finding of a mechanism that names this one among its `rivals`.
            comparison: Recording and simulation with all findings explained but that one.
        """
        found = cls.detect_and_fit(comparison, 1.0)
        return None if found is None else Rival(found.effect, found.gain)

    @classmethod
    def in_reference(cls, comparison: Comparison) -> Mechanism | None:
        """The mechanism as the simulation's own samples show it; by default it is not looked for."""

    def undo_in_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The comparison with the simulation as it may have been before a mechanism that `in_reference` found."""
        raise NotImplementedError

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        """Clean signals `(..., sensor, time)` of a simulation with the mechanism."""
        raise NotImplementedError

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        """A recording `(..., sensor, time)` without what can be taken off it; by default as it is."""
        return signal

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The comparison with the mechanism taken off the recording or, as by default, applied to the simulation."""
        return self.apply_to_reference(comparison, generator)

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The comparison with the mechanism in the simulation, whether or not it could be taken off the recording."""
        return comparison.apply(partial(self.apply, info=comparison.info, generator=generator), self.stage)

    def with_company(self, comparison: Comparison) -> tuple[Mechanism, tuple[Mechanism, ...]]:
        """The mechanism by itself, and what it was found beside; by default nothing."""
        return self, ()

    def beneath(self, later: Sequence[Mechanism], before: Comparison) -> Mechanism:
        """The mechanism as it is judged where `later` ones, which act after it, are applied to `before` already."""
        return self

    def apply_elsewhere(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """That of another recording with a simulation that has it; what has another phase there is applied to it."""
        return self.repair(comparison, generator)

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        """Cross-spectral densities `(frequency, sensor, sensor)` at `f` cycles per sample with the mechanism.

        What `remove` takes off does not count; by default nothing changes.
        """
        return matrices

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        """Log likelihood ratio of each block that a fold holds out, `(block,)`, nats, with the numbers as they are.

        By default that of the spectra of what is left; what is no matter of spectra has a likelihood of its own.
        """
        return spectral_gains(comparison, self.remove(comparison.recording, comparison.info), self.spectra, fold)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        """The same mechanism with its numbers estimated without the blocks that a fold holds out.

        Args:
            comparison: Recording and simulation in which the mechanism was found.
            fold: Number of the fold.
        """
        raise NotImplementedError

    def as_compared(self, comparison: Comparison) -> Mechanism:
        """The mechanism as it is set against its rivals; by default the same."""
        return self

    def score_difference_sd(self, own: Tensor, other: Mechanism, theirs: Tensor, comparison: Comparison) -> float:
        """Standard deviation of the difference between its held-out score and that of another mechanism, nats.

        Args:
            own: Its scores of the blocks, `(block,)`.
            other: The other mechanism.
            theirs: Scores of the other, `(block,)`.
            comparison: Recording and simulation in which both were fitted.
        """
        return sd_of_sum(own - theirs)

    def explained_by_others(
        self, comparison: Comparison, finding: Finding, beside: Sequence[Finding]
    ) -> tuple[str, ...]:
        """Names of mechanisms that explain as much as a finding without having been fitted; none by default.

        Args:
            comparison: Recording and simulation with all findings explained but this one.
            finding: Finding whose effect this is.
            beside: All other findings.
        """
        return ()

    def plot(self, comparison: Comparison, ax: Axes, *, sensor: int, fitted: bool) -> None:
        """Draw the evidence in one sensor, as a person would look for it.

        Args:
            comparison: Recording and simulation, with all other findings repaired.
            ax: Axes to draw into.
            sensor: Position of the sensor.
            fitted: Whether to draw what was fitted as well.
        """
        raise NotImplementedError

    def is_seen(self, comparison: Comparison) -> bool:
        """Whether it is seen in a comparison with all other findings repaired; by default it was, and is not asked."""
        return True

    def found(
        self, sentence: str, p_value: float, sensors: tuple[int, ...], parameters: dict[str, Parameter], **more: Any
    ) -> Finding:
        """A finding of it under its own name, with further entries by theirs."""
        return Finding(self.name, self, sentence, p_value, sensors, parameters, **more)

    @property
    def follows(self) -> tuple[str, ...]:
        """Auxiliary channels that it follows; none by default."""
        return ()

    def line_width(self, parameters: Mapping[str, Parameter], comparison: Comparison) -> float | None:
        """Half width of a spectral line, Hz; None of what is none."""
        return None

    @property
    def amplitudes(self) -> Tensor:
        """Amplitudes of a known path, `(sensor, ...)`."""
        raise NotImplementedError

    def with_amplitudes(self, amplitudes: Tensor) -> Mechanism:
        """The same path with other amplitudes."""
        raise NotImplementedError

    def in_unit(self, factor: float) -> Mechanism:
        """The same mechanism of numbers that are a factor larger."""
        return self

    def left_of(self, own: Sequence[Mechanism]) -> tuple[Mechanism, ...]:
        """What is left of effects that the simulation has itself, where it has this one too; by default all."""
        return tuple(own)


class Context(NamedTuple):
    """Recording and simulation as they came, and the effects of the other findings, in order."""

    start: Comparison
    others: tuple[Mechanism, ...]


@dataclass(frozen=True, eq=False)
class Finding:
    """One difference between recording and simulation, with its name.

    Attributes:
        mechanism: Name of the physics.
        effect: Mechanism with its numbers.
        alternatives: Names of mechanisms that the data cannot tell apart from it.
        sensors: Positions of the sensors concerned, from 0.
        levels: Wavelet levels concerned, from 1.
        frequency_hz: Of a line or band.
        time_s: Onset, s after the first sample.
        channel: Auxiliary channel that it follows.
        parameters: By name, with limits and units.
        p_value: For having looked at every place where it could have been.
        held_out_gain: Log score on data not used for it, nats; None until confirmed.
        gain_without: The same where all other findings are in: what is lost if it alone is left out.
        instead: Its best rival on the same blocks; None where it has none in the catalogue.
        sentence: The same in plain English.
        hides: Positions of sensors in which nothing else can be seen beside it.
        context: Recording and simulation as they came with the other findings, for its picture; None before the end.
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
    context: Context | None = field(default=None, repr=False)

    @property
    def identified(self) -> bool:
        """Whether it has one name: else its alternatives explain it equally well, and its sentence says so."""
        return self.mechanism == self.effect.name

    @property
    def clearest_sensor(self) -> int:
        """Position of the sensor whose own numbers are largest over the width of their intervals."""

        def clarity(sensor: int) -> float:
            own = [entry for name, entry in self.parameters.items() if name.endswith(f"[{sensor}]")]
            return max((abs(entry.value) / max(entry.high - entry.low, 1e-300) for entry in own), default=0.0)

        return max(self.sensors, key=clarity)

    def plot(self, axes: Sequence[Axes] | None = None) -> list[Axes]:
        """Draw the evidence in the sensor where it is clearest, before the repair and after it.

        All other findings are repaired in both pictures.

        Args:
            axes: Two axes to draw into; new ones below each other by default.

        Returns:
            The two axes.

        Raises:
            ValueError: The finding is not part of a report, or there are not two axes.
        """
        if self.context is None:
            raise ValueError("`finding`: expected one of a report's findings, got one without recording; use those")
        if axes is None:
            axes = new_axes_below_each_other(2)
        if len(axes) != 2:
            raise ValueError(f"`axes`: expected two, before and after the repair, got {len(axes)}")
        # What a converter does shows on the numbers as they came alone: whatever is taken off them hides it.
        generator = torch.Generator().manual_seed(0)
        before = repaired(self.context.start, () if self.effect.stage else self.context.others, generator)
        after = self.effect.repair(before, generator)
        sensor = self.clearest_sensor
        name = clean_name(before.info.sensors[sensor])
        for ax, comparison, when in zip(axes, (before, after), ("before", "after"), strict=True):
            self.effect.plot(comparison, ax, sensor=sensor, fitted=when == "before")
            title = f"{readable(self.mechanism)}, sensor {name}, {when} the repair"
            ax.set_title(title, loc="left", fontsize=9, parse_math=False)
        low, high = zip(*(ax.get_ylim() for ax in axes), strict=True)
        for ax in axes:  # so that what is gone shows at a glance
            ax.set_ylim(min(low), max(high))
        return list(axes)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The comparison with the effect repaired, and noise in the place of sensors that it hides all else of."""
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


def repaired(comparison: Comparison, parts: Iterable[Mechanism | Finding], generator: torch.Generator) -> Comparison:
    """The comparison with mechanisms or findings repaired, one after the other, by random numbers of a generator."""
    for part in parts:
        comparison = part.repair(comparison, generator)
    return comparison
