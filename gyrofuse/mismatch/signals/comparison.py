"""A recording and a simulation side by side, as far as the diagnosis has come.

What was found either is taken off the recording (a tone, a temperature's share) or is built into the simulation (a
filter, rounding): after each finding the two are compared afresh, sample against sample, so that their finite lengths
act on both alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import torch
from torch import Tensor

from gyrofuse.mismatch.signals.known_lines import wandering, without_lines
from gyrofuse.mismatch.signals.lines import FoundLine, simulated_lines, strongest_line, whitened
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from gyrofuse.mismatch.signals.psd import Bands, bands
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.signals.variance_course import VarianceCourse

N_BLOCKS = 256


@dataclass(frozen=True, eq=False)
class RecordingInfo:
    """What is known about a recording beside its samples.

    Attributes:
        rate: Hz.
        unit: Of the signals.
        sensors: Names.
        channels: Auxiliary channels `(row, time)` by name.
    """

    rate: float
    unit: str
    sensors: tuple[str, ...]
    channels: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def measure(self) -> str:
        """Unit of numbers for readers, by its name where that is known."""
        return "units" if self.unit == "unknown" else self.unit

    def named(self, which: Sequence[int], every: str | None = None) -> str:
        """Sensors by their names, for a sentence; all of several by the words `every`, where given."""
        if every is not None and len(which) == len(self.sensors) > 1:
            return every
        return ("sensor " if len(which) == 1 else "sensors ") + ", ".join(self.sensors[i] for i in which)

    def channel_rows(self, name: str) -> Tensor:
        """An auxiliary channel as its rows, `(row, time)`: one of a single row may be given as `(time,)`."""
        values = self.channels[name].to(torch.float64)
        return values.reshape(-1, values.shape[-1])

    def seconds(self, n_samples: int) -> Tensor:
        """Times of the samples, s."""
        return torch.arange(n_samples, dtype=torch.float64) / self.rate


@dataclass(frozen=True, eq=False)
class Comparison:
    """State of a diagnosis.

    Attributes:
        info: Rate, unit, names, auxiliary channels.
        as_came: The recording, one record: the values that its converter gave.
        observed: The same without what was taken off it.
        reference: The simulation, with what was built into it: records as long as the recording, or a single shorter
            one.
        analog: The simulation's samples `(record, sensor, time)` before the converter; where they came rounded, as
            they may have been.
        converter: What it does to them, with the place of each in the chain.
        rounding: Variance that rounding adds at the end of both sides, after all that is analogue, `(sensor,)`; None
            without.
        bent: Factors `(sensor, frequency)` by which powers were changed of what was built in though its form is another
            one, or by which its own scatter: what is left where it acts is a matter of it.
        modes: Centre and half width of narrow noise that was built in, cycles per sample: it is no line, however like
            one it looks.
        filters: Names of filters that were built in, and factors `(sensor, frequency)` by which they changed powers.
        straightened: Sensors whose bent scale was taken back: what is left of a curve's form shows in their values.
        passed_over: Names of shapes of spectra that were tried and do not hold: others come before them.
        seed: Seed of the random numbers that tests draw: that of the caller's generator.
    """

    info: RecordingInfo
    as_came: Records
    observed: Records
    reference: Records
    analog: Tensor
    converter: tuple[tuple[int, Callable[[Tensor], Tensor]], ...] = ()
    rounding: Tensor | None = None
    bent: tuple[Callable[[Tensor], Tensor], ...] = ()
    modes: tuple[tuple[float, float], ...] = ()
    filters: tuple[tuple[str, Callable[[Tensor], Tensor]], ...] = ()
    straightened: tuple[int, ...] = ()
    passed_over: tuple[str, ...] = ()
    seed: int = 0

    @classmethod
    def of(cls, info: RecordingInfo, recording: Tensor, simulation: Tensor) -> Comparison:
        """A case of a recording `(sensor, time)` and a simulation `(record, sensor, time)`."""
        both = bands(recording.shape[-1])
        came = Records(recording[None], both)
        return cls(info, came, came, Records(simulation, both), simulation)

    @property
    def recording(self) -> Tensor:
        """`(sensor, time)`, without what was taken off it."""
        return self.observed.signal[0]

    @property
    def taken_off(self) -> Tensor:
        """What was taken off the recording, `(sensor, time)`."""
        return self.as_came.signal[0] - self.recording

    @property
    def bands(self) -> Bands:
        """Bands of frequency of the recording."""
        return self.observed.bands

    @property
    def n_sensors(self) -> int:
        return self.recording.shape[-2]

    @property
    def n_samples(self) -> int:
        return self.recording.shape[-1]

    @property
    def base(self) -> NoiseSpectrum:
        """The simulation's noise as a sum of simple spectra."""
        return self.reference.base

    @cached_property
    def line(self) -> FoundLine:
        """The strongest line of the recording that the simulation does not have."""
        return strongest_line(self.observed, self.reference, self.steady_share)

    @cached_property
    def white(self) -> Tensor:
        """The recording in units of the simulation's noise, without its means, `(sensor, time)`."""
        return whitened(self.recording, self.base)

    @cached_property
    def lineless(self) -> Tensor:
        """The whitened recording without the spectral lines of the simulation, and of a steady level.

        Where a part of the record has nearly all power, neighbouring bins hold the same noise: by chance they bulge.
        """
        lines = simulated_lines(self.reference)
        if not lines and not self.observed.loud:
            return self.white
        return whitened(self.observed.steadied(without_lines(self.observed.signal, lines))[0], self.base)

    @cached_property
    def lineless_reference(self) -> Tensor:
        """The same of the simulation's records, `(record, sensor, time)`."""
        bare = without_lines(self.reference.signal, simulated_lines(self.reference))
        return whitened(self.reference.steadied(bare), self.base)

    @cached_property
    def steady_shares(self) -> Tensor:
        """Share of each band's ordinates that its power is known from where the simulation's comes and goes, `(band,)`.

        On either side: what only the recording has is no matter of chance.
        """
        return self.reference.steady_shares(self.bands)

    def wandering(self, lines: tuple[float, ...]) -> tuple[float, ...]:
        """Those of the simulation's lines, cycles per sample, that have another phase at other times."""
        return wandering(self.reference.signal, lines, self.base.spectrum(torch.tensor(lines, dtype=torch.float64)))

    @cached_property
    def _restless(self) -> tuple[float, ...]:
        return self.wandering(simulated_lines(self.reference))

    def steady_share(self, f: Tensor) -> Tensor:
        """The same at frequencies, cycles per sample; 0 next to a line of the simulation that wanders."""
        share = self.steady_shares[torch.bucketize(f, self.bands.ends[1]).clamp(max=len(self.steady_shares) - 1)]
        reach = 16 / min(self.n_samples, self.reference.signal.shape[-1])
        for line in self._restless:
            share = torch.where((f - line).abs() < reach, 0.0, share)
        return share

    def generator(self) -> torch.Generator:
        """A source of the random numbers of a test, the same for every test of the comparison."""
        return torch.Generator().manual_seed(self.seed)

    @property
    def block(self) -> int:
        """Samples of one of the 256 blocks for what is slow."""
        return self.n_samples // N_BLOCKS

    @property
    def shortest_transient(self) -> float:
        """Time constant from which means over blocks show how a bias settles or decays, samples."""
        return 2.0 * self.block

    def knowing(self, lines: tuple[float, ...]) -> Comparison:
        """Where the simulation has lines at these frequencies, cycles per sample: its noise is what is beside them."""
        if not lines:
            return self
        observed, reference = (replace(side, lines=lines) for side in (self.observed, self.reference))
        return replace(self, observed=observed, reference=reference)

    def subtract(self, taken: Tensor) -> Comparison:
        """With a signal `(sensor, time)` taken off the recording."""
        return replace(self, observed=replace(self.observed, signal=(self.recording - taken)[None]))

    def with_recording(self, recording: Tensor) -> Comparison:
        """With another recording `(sensor, time)`: one that was cleaned."""
        return replace(self, observed=replace(self.observed, signal=recording[None]))

    def in_unit(self, factor: float) -> Comparison:
        """With the simulation's numbers times a factor, after its converter."""
        converter = tuple((place, partial(_in_unit, act, factor)) for place, act in self.converter)
        reference = replace(self.reference, signal=factor * self.reference.signal)
        return replace(self, reference=reference, analog=factor * self.analog, converter=converter, rounding=None)

    def with_stand_ins(self, sensors: Sequence[int], generator: torch.Generator) -> Comparison:
        """With white noise in the place of sensors in which nothing else can be seen, of one law on both sides.

        Nothing differs there any more, while the others keep their positions and are searched on. The converter leaves
        the noise as it is.
        """
        hidden = torch.zeros(self.n_sensors, 1, dtype=torch.bool)
        hidden[list(sensors)] = True
        sd = self.recording.diff().std(-1, keepdim=True) / math.sqrt(2)
        observed, analog = (
            torch.where(hidden, sd * torch.randn(old.shape, generator=generator, dtype=torch.float64), old)
            for old in (self.observed.signal, self.analog)
        )
        reference = torch.where(hidden, analog, self.reference.signal)
        converter = tuple((place, partial(_but_for, act, hidden)) for place, act in self.converter)
        came = torch.where(hidden, observed, self.as_came.signal)
        return replace(
            self,
            as_came=replace(self.as_came, signal=came),
            observed=replace(self.observed, signal=observed),
            reference=replace(self.reference, signal=reference),
            analog=analog,
            converter=converter,
            rounding=None if self.rounding is None else torch.where(hidden[:, 0], 0.0, self.rounding),
        )

    def without_converter(self, place: int, sensors: Sequence[int]) -> Comparison:
        """Without what the simulation's converter does to some sensors at a place in the chain."""
        spared = torch.zeros(self.n_sensors, 1, dtype=torch.bool)
        spared[list(sensors)] = True
        converter = tuple((at, partial(_but_for, act, spared) if at == place else act) for at, act in self.converter)
        return replace(self, converter=converter).apply(lambda signal: signal)

    def apply(self, act: Callable[[Tensor], Tensor], place: int = 0) -> Comparison:
        """With something that acts on the simulation's samples, after what has a lower place in the chain.

        What the converter does (places above 0) is done again to what anything analogue has changed.
        """
        analog, converter = self.analog, self.converter
        if place:
            converter = tuple(sorted((*converter, (place, act)), key=lambda entry: entry[0]))
        else:
            analog = act(analog)
        signal = analog
        for _, converted in converter:
            signal = converted(signal)
        return replace(self, reference=replace(self.reference, signal=signal), analog=analog, converter=converter)

    def made_louder(self, known: VarianceCourse) -> Comparison:
        """With a course of the level built into the noise of the simulation, and known where noise is looked at."""
        lines = self.reference.lines
        built = self.apply(lambda signal: known.of_length(signal.shape[-1]).added(signal, lines))
        observed, reference = (
            replace(side, loud=(*side.loud, known.of_length(side.signal.shape[-1])))
            for side in (built.observed, built.reference)
        )
        return replace(built, observed=observed, reference=reference)


def _in_unit(act: Callable[[Tensor], Tensor], factor: float, signal: Tensor) -> Tensor:
    """What acts in one unit on signals that are in another."""
    return factor * act(signal / factor)


def _but_for(act: Callable[[Tensor], Tensor], hidden: Tensor, signal: Tensor) -> Tensor:
    """What acts on all sensors but those that are hidden, `(sensor, 1)`."""
    return torch.where(hidden, signal, act(signal))


def block_means(signal: Tensor) -> Tensor:
    """Means over 256 blocks of equal length, `(..., time)` -> `(..., block)`; what is left over is not used."""
    block = signal.shape[-1] // N_BLOCKS
    return signal[..., : block * N_BLOCKS].unflatten(-1, (N_BLOCKS, block)).mean(-1)
