"""Settings for mechanisms to act in, and recordings that conceal one: what their draws and contract tests share."""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.mechanisms.signals.clock import ClockSkew
from gyrofuse.mismatch.mechanisms.signals.sensor_delay import SensorDelay
from gyrofuse.mismatch.mechanisms.simulated.course import SimulatedCourse
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum

RATE = 100.0  # Hz
N_SAMPLES = 8192  # of the cases that a mechanism is looked for in
RECORDS = 4  # of a simulation
NOISE = gf.WhiteNoise(1.0) + gf.AR1(0.98, 0.004) + gf.RandomWalk(1e-6)
TONE, TONE_SIZE = 0.13, 1.0  # cycles per sample, and amplitude, of a tone that recording and simulation share


class Drawn(NamedTuple):
    """An instance of a mechanism.

    Attributes:
        effect: It.
        truth: What limits have to cover, by the names of a finding's parameters.
        channels: Auxiliary channels that it follows.
        tones: That recording and simulation have to have, cycles per sample.
        moved: Whether one motion has to move all sensors of both.
        simulated: What the simulation has, and what the mechanism acts on.
    """

    effect: Mechanism
    truth: dict[str, float]
    channels: Mapping[str, Tensor] = {}
    tones: tuple[float, ...] = ()
    moved: bool = False
    simulated: Mechanism | None = None


@dataclass(frozen=True)
class Setting:
    """Where a mechanism is to act.

    Attributes:
        clean: Recording without it, `(sensor, time)`.
        concerned: Sensors that have it.
        size: Of the effect, over one that is plainly seen: 100 to 300 nats in two sensors and `N_SAMPLES`.
        generator: Of its numbers.
    """

    clean: Tensor
    concerned: tuple[int, ...]
    size: float
    generator: torch.Generator = field(repr=False)

    @property
    def n_sensors(self) -> int:
        return self.clean.shape[-2]

    @property
    def n_samples(self) -> int:
        return self.clean.shape[-1]

    def even(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=self.generator, dtype=torch.float64))

    def chance(self) -> bool:
        return self.even(0, 1) < 0.5

    def sign(self) -> float:
        return 1.0 if self.chance() else -1.0

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, dtype=torch.float64)

    def sizes(self, low: float, high: float, elsewhere: float = 0.0) -> Tensor:
        """One number for each sensor concerned, `(sensor,)`."""
        drawn = [self.even(low, high) if i in self.concerned else elsewhere for i in range(self.n_sensors)]
        return torch.tensor(drawn, dtype=torch.float64)

    def signed(self, low: float, high: float) -> Tensor:
        """Likewise, of either sign."""
        return self.sizes(low, high) * torch.tensor([self.sign() for _ in range(self.n_sensors)], dtype=torch.float64)

    def of_each(self, name: str, values: Tensor) -> dict[str, float]:
        """Numbers `(sensor,)` of the sensors concerned by the names of parameters."""
        return {f"{name}[{i}]": float(values[i]) for i in self.concerned}


DRAWS: dict[type[Mechanism], Callable[[Setting], Drawn]] = {}


def draws(kind: type[Mechanism]) -> Callable[[Callable[[Setting], Drawn]], Callable[[Setting], Drawn]]:
    """Mark the function that draws instances of a mechanism."""

    def marked(function: Callable[[Setting], Drawn]) -> Callable[[Setting], Drawn]:
        DRAWS[kind] = function
        return function

    return marked


def draw_of(kind: type[Mechanism]) -> Callable[[Setting], Drawn]:
    """The function that draws instances of a mechanism."""
    if kind not in DRAWS:
        raise LookupError(
            f"expected a draw of {kind.__name__}, which is in the catalogue, got none; add a function marked with "
            f"@draws({kind.__name__}) to tests/mechanism_draws.py"
        )
    return DRAWS[kind]


def generator(*seed: object) -> torch.Generator:
    """Of numbers that belong to a text and a count."""
    return torch.Generator().manual_seed(zlib.crc32(repr(seed).encode()))


def info(n_sensors: int, channels: Mapping[str, Tensor] | None = None) -> RecordingInfo:
    return RecordingInfo(RATE, "deg/s", tuple(map(str, range(1, n_sensors + 1))), dict(channels or {}))


def array(n_sensors: int) -> gf.ArrayModel:
    """Noise of the simulation."""
    return gf.ArrayModel.from_sensors([NOISE] * n_sensors)


@functools.cache
def noise_spectrum(n_sensors: int, n_samples: int) -> NoiseSpectrum:
    """The same as a sum of the spectra that mechanisms refer to."""
    drawn = array(n_sensors).simulate(n_samples, batch=(16,), generator=generator("base"))
    return Comparison.of(info(n_sensors), drawn[0], drawn).base


def drawn_in(
    kind: type[Mechanism],
    *seed: object,
    n_sensors: int = 2,
    concerned: Sequence[int] | None = None,
    size: float = 1.0,
    n_samples: int = N_SAMPLES,
) -> tuple[Drawn, Setting]:
    """An instance of a mechanism, and where it is to act.

    Args:
        kind: The mechanism.
        seed: Of all numbers.
        n_sensors: Of the array.
        concerned: Sensors that have it; all by default.
        size: Over one that is plainly seen.
        n_samples: Of the record.
    """
    rng = generator(kind.__name__, *seed)
    clean = array(n_sensors).simulate(n_samples, generator=rng)
    which = tuple(range(n_sensors)) if concerned is None else tuple(concerned)
    setting = Setting(clean, which, size, rng)
    return draw_of(kind)(setting), setting


def tone(n_sensors: int, n_samples: int, turn: float, f: float = TONE) -> Tensor:
    """What recording and simulation share, `(sensor, time)`."""
    angle = 2 * math.pi * f * torch.arange(n_samples, dtype=torch.float64) + turn
    return TONE_SIZE * angle.cos().expand(n_sensors, -1)


def motion(n_samples: int, rng: torch.Generator) -> Tensor:
    """What moves all sensors, faster and slower, `(time,)`."""
    return gf.AR1(0.8, 2.0).simulate(n_samples, generator=rng)


def concealed(kind: type[Mechanism], *seed: object, n_sensors: int = 2) -> tuple[gf.Recording, gf.Recording, Drawn]:
    """A recording with a mechanism that the simulation does not have, plainly seen in all sensors, or in one clock."""
    apart = kind in (ClockSkew, SensorDelay)  # from the others
    concerned, n_sensors = ((0,), max(n_sensors, 3)) if apart else (None, n_sensors)
    drawn, setting = drawn_in(kind, *seed, n_sensors=n_sensors, concerned=concerned)
    rng = setting.generator
    n_simulated = N_SAMPLES if issubclass(kind, SimulatedCourse) else RECORDS * N_SAMPLES  # one record has a course
    simulation = array(n_sensors).simulate(n_simulated, generator=rng)
    recording = setting.clean
    for f in drawn.tones:
        recording = recording + tone(n_sensors, N_SAMPLES, setting.even(0, 6), f)
        simulation = simulation + tone(n_sensors, n_simulated, setting.even(0, 6), f)
    if drawn.moved:
        recording = recording + motion(N_SAMPLES, rng)
        simulation = simulation + motion(n_simulated, rng)
    where = info(n_sensors, drawn.channels)
    if drawn.simulated is not None:
        recording, simulation = (drawn.simulated.apply(side, where, rng) for side in (recording, simulation))
    recording = drawn.effect.apply(recording, where, rng)
    return (
        gf.Recording(recording, RATE, unit="deg/s", channels=drawn.channels),
        gf.Recording(simulation, RATE, unit="deg/s"),
        drawn,
    )


def compared(recording: gf.Recording, simulation: gf.Recording | gf.ArrayModel, *seed: object) -> Comparison:
    return prepared(recording, simulation, None, generator("case", *seed))
