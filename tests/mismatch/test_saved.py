"""A repaired simulation as plain numbers and back."""

from __future__ import annotations

import copy
import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass, replace
from typing import Annotated, Any, ClassVar

import pytest
import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.mechanisms.catalogue import CATALOGUE
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.mechanisms.regimes.channel_noise import ChannelNoise
from gyrofuse.mismatch.mechanisms.regimes.gradual_change import GradualChange
from gyrofuse.mismatch.mechanisms.regimes.heavy_tails import HeavyTailedNoise
from gyrofuse.mismatch.mechanisms.regimes.periodic_noise import PeriodicNoise
from gyrofuse.mismatch.mechanisms.regimes.random_level import RandomLevelNoise
from gyrofuse.mismatch.mechanisms.regimes.scale_mixture import ScaleMixture
from gyrofuse.mismatch.mechanisms.regimes.spikes import Spikes
from gyrofuse.mismatch.mechanisms.regimes.telegraph import RandomTelegraph
from gyrofuse.mismatch.mechanisms.regimes.variance_change import VarianceChange
from gyrofuse.mismatch.mechanisms.remainders.coherence import CoherenceRemainder
from gyrofuse.mismatch.mechanisms.remainders.slow import SlowRemainder
from gyrofuse.mismatch.mechanisms.remainders.spectrum import Remainder
from gyrofuse.mismatch.mechanisms.signals.channel_coupling import ChannelCoupling
from gyrofuse.mismatch.mechanisms.signals.channel_transfer import ChannelTransfer
from gyrofuse.mismatch.mechanisms.signals.clock import ClockSkew
from gyrofuse.mismatch.mechanisms.signals.g_sensitivity import GSensitivity
from gyrofuse.mismatch.mechanisms.signals.motion import Motion
from gyrofuse.mismatch.mechanisms.signals.quadratic_coupling import QuadraticCoupling
from gyrofuse.mismatch.mechanisms.signals.scale_factor import ScaleFactor
from gyrofuse.mismatch.mechanisms.signals.sensor_delay import SensorDelay
from gyrofuse.mismatch.mechanisms.signals.time_scale import TimeScale
from gyrofuse.mismatch.mechanisms.signals.tone import Harmonic, VibrationTone
from gyrofuse.mismatch.mechanisms.signals.tone_amplitude import ToneSize
from gyrofuse.mismatch.mechanisms.simulated.course import SimulatedRamp, SimulatedStep, SimulatedWarmUp
from gyrofuse.mismatch.mechanisms.simulated.noise import (
    MovedResonance,
    SimulatedCommonMode,
    SimulatedResonance,
    SimulatedWanderingTone,
)
from gyrofuse.mismatch.mechanisms.simulated.spikes import SimulatedSpikes
from gyrofuse.mismatch.mechanisms.slow.bias_oscillation import BiasOscillation
from gyrofuse.mismatch.mechanisms.slow.drifting_scale import DriftingScale
from gyrofuse.mismatch.mechanisms.slow.late_warm_up import LateWarmUp
from gyrofuse.mismatch.mechanisms.slow.ramp import Ramp
from gyrofuse.mismatch.mechanisms.slow.step import Step
from gyrofuse.mismatch.mechanisms.slow.temperature import TemperatureDrift
from gyrofuse.mismatch.mechanisms.slow.warm_up import Decay, WarmUpTransient
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode
from gyrofuse.mismatch.mechanisms.spectra.bumps.resonance import Resonance
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_harmonics import WanderingHarmonics
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_tone import DriftingTone
from gyrofuse.mismatch.mechanisms.spectra.common_source import CommonMode
from gyrofuse.mismatch.mechanisms.spectra.cross_talk import CrossTalk
from gyrofuse.mismatch.mechanisms.spectra.high_pass import HighPassFilter
from gyrofuse.mismatch.mechanisms.spectra.low_pass import LowPassFilter
from gyrofuse.mismatch.mechanisms.spectra.moved_low_pass import MovedLowPassFilter
from gyrofuse.mismatch.mechanisms.spectra.notch import NotchFilter
from gyrofuse.mismatch.mechanisms.spectra.parameter_change import ParameterShift
from gyrofuse.mismatch.mechanisms.spectra.slopes.flicker import FlickerNoise
from gyrofuse.mismatch.mechanisms.spectra.slopes.power_law import PowerLawNoise
from gyrofuse.mismatch.mechanisms.transients.channel_line import ChannelLine
from gyrofuse.mismatch.mechanisms.transients.channel_tone import ChannelTone
from gyrofuse.mismatch.mechanisms.transients.chirp import Chirp
from gyrofuse.mismatch.mechanisms.transients.modulated_tone import ModulatedTone
from gyrofuse.mismatch.mechanisms.transients.pulses import Pulses
from gyrofuse.mismatch.mechanisms.transients.ring_down import RingDown
from gyrofuse.mismatch.mechanisms.transients.tone_in_spells import ToneInSpells
from gyrofuse.mismatch.mechanisms.values.clipping import Clipping
from gyrofuse.mismatch.mechanisms.values.held_values import HeldValues
from gyrofuse.mismatch.mechanisms.values.interleaved_gain import InterleavedGain
from gyrofuse.mismatch.mechanisms.values.interleaving import Interleaving
from gyrofuse.mismatch.mechanisms.values.interpolated_samples import InterpolatedSamples
from gyrofuse.mismatch.mechanisms.values.median_filter import MedianFilter
from gyrofuse.mismatch.mechanisms.values.nonlinearity import Nonlinearity
from gyrofuse.mismatch.mechanisms.values.rounding.angle_quantization import AngleCounts, AngleQuantization
from gyrofuse.mismatch.mechanisms.values.rounding.dead_band import DeadBand
from gyrofuse.mismatch.mechanisms.values.rounding.missing_codes import MissingCodes
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.mechanisms.values.sensor_gain import SensorGain
from gyrofuse.mismatch.mechanisms.values.sensor_order import SensorOrder
from gyrofuse.mismatch.mechanisms.values.stuck_samples import StuckSamples
from gyrofuse.mismatch.mechanisms.values.unit_scale import UnitScale
from gyrofuse.mismatch.repair import serialise as saved
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.repair.serialise import repaired_from_dict
from gyrofuse.mismatch.signals.comparison import RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum

NOISE = gf.ArrayModel.from_sensors([gf.WhiteNoise(1.0) + gf.AR1(0.9, 0.1), gf.WhiteNoise(2.0) + gf.AR1(0.8, 0.2)])
SCENE = RecordingInfo(50.0, "deg/s", ("a", "b"))


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def complex_numbers(*values: complex) -> Tensor:
    return torch.tensor(values, dtype=torch.complex128)


BASE = NoiseSpectrum(4096, torch.rand(2, 13, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
MODE = Mode(0.11, 0.01, complex_numbers(0.3 + 0.1j, 0.2), True)
# One of every class in the catalogue, with numbers that JSON has to round and none that are alike.
EVERY = (
    UnitScale(math.degrees(1)),
    SensorGain(numbers(-1 / 3, 1.0)),
    Quantization(numbers(0.3, 0.0), numbers(0.01, 0.0), numbers(0.2, 0.0), numbers(1 / 3, 0.1)),
    Quantization(numbers(0.3, 0.0), numbers(0.01, 0.0), numbers(0.0, 0.0), numbers(1 / 3, 0.1), (0.0, 1 / 3)),
    Quantization(numbers(0.3, 0.1), numbers(0.0, 0.0), numbers(0.0, 0.0), numbers(1 / 3, 0.1), (), (True, False)),
    Clipping(numbers(-0.7, -math.inf), numbers(math.inf, 1 / 3), numbers(0.1, 0.2)),
    Nonlinearity(
        numbers(0.1, 0.2),
        numbers(1 / 30, 0.0),
        torch.tensor([[-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]], dtype=torch.float64),
        torch.tensor([[2 / 3, 1.0, 1.5], [1.0, 1.0, 1.0]], dtype=torch.float64),
    ),
    StuckSamples(numbers(0.2, 0.1), numbers(0.01, 0.0), True),
    MedianFilter(numbers(5.0, 1.0), numbers(0.3, 0.0), numbers(0.01, 0.0)),
    MissingCodes(numbers(1 / 3, 0.0), numbers(0.01, 0.0), ((0, 0, -1), ())),
    InterpolatedSamples(numbers(0.02, 0.0), numbers(7.3, 1.0), numbers(0.01, 0.0), True),
    HeldValues(numbers(2.5, 1.0), numbers(0.3, 0.0), numbers(0.01, 0.0)),
    StuckSamples(numbers(0.2, 0.0), numbers(0.01, 0.0), False, (7.3, 1.0), (1 / 3, 0.0)),
    StuckSamples(numbers(0.2, 0.0), numbers(0.01, 0.0), False, (), (1 / 3, 0.0)),  # of single samples
    PeriodicNoise(
        1 / 3, torch.tensor([0.0, 1 / 3, 1.0, 0.5], dtype=torch.float64), numbers(1.0, 0.9), numbers(4 / 3, 1.0), 0.7
    ),
    RandomLevelNoise((4, 0), numbers(0.8, 1.0), numbers(4 / 3, 1.0), numbers(0.3, 0.0), numbers(0.7, 1.0), True, 0.7),
    HeavyTailedNoise(numbers(4 / 3 + 1, 0.0), numbers(0.0, 1 / 3)),
    ScaleMixture(numbers(0.2, 0.0), numbers(3.0, 1.0)),
    Spikes(numbers(0.05, 0.0), numbers(7 / 3, 0.0), numbers(0.3, 0.0), True),
    SimulatedSpikes(Spikes(numbers(0.05, 0.0), numbers(7 / 3, 0.0), numbers(0.3, 0.0), False)),
    ClockSkew((1,), 1e-5 / 3, ((200, 2), (300, 1)), 0.07, complex_numbers(0.3j), complex_numbers(0.1)),
    GSensitivity("acceleration", torch.tensor([[0.1, 0.2, 1 / 3], [0.0, 0.0, 0.0]], dtype=torch.float64)),
    QuadraticCoupling("acceleration", torch.tensor([[1 / 3], [0.1]], dtype=torch.float64), "axis 2"),
    DriftingScale((7.3, 1 / 3), "temperature", 0, 25.1, numbers(0.01 / 3, 0.0)),
    ScaleFactor("rate", torch.tensor([[1e-3], [0.0]], dtype=torch.float64)),
    ChannelTransfer(("rate",), torch.tensor([[[1e-3, 0.2, 1 / 3]], [[0.0, 0.0, 0.0]]], dtype=torch.float64)),
    RingDown(
        numbers(1.5, 1 / 3),
        numbers(7.3, 9.1),
        numbers(0.2, 1 / 3),
        torch.tensor([[1 / 3, 0.0], [0.1, 0.2]], dtype=torch.float64),
        torch.tensor([[0.1, 0.0], [1 / 7, 0.2]], dtype=torch.float64),
        4.0,
    ),
    Pulses(
        numbers(1.5, 1 / 3),
        numbers(0.3, 0.2),
        numbers(1.0, 1 / 3),
        torch.tensor([[1 / 3, 0.0], [0.1, 0.2]], dtype=torch.float64),
        4.0,
    ),
    Interleaving(numbers(1 / 3, 0.0)),
    ChannelNoise("motor", 0, "size", numbers(0.1, 1 / 3), 1.0, numbers(1.1, 1.0), numbers(7 / 3, 1.0), 1.5),
    ChannelCoupling("motor", torch.tensor([[1 / 3], [0.0]], dtype=torch.float64)),
    BiasOscillation(numbers(1 / 3, 0.0), torch.zeros(2, 4, dtype=torch.float64), numbers(0.2, 0.0), 20 / 3),
    ChannelTone(
        (
            ChannelLine(
                "motor",
                0,
                True,
                4 / 3,
                10 / 3,
                0.1,
                1 / 30,
                1 / 7,
                True,
                2,
                torch.tensor([[1 / 3, 0.0], [0.1, 0.2]], dtype=torch.float64),
                torch.tensor([[0.1, 0.0], [1 / 7, 0.2]], dtype=torch.float64),
            ),
        )
    ),
    Chirp(
        numbers(0.5, 20 / 3),
        numbers(4.5, 9.0),
        torch.tensor([[1 / 3, 0.0], [0.1, 0.2]], dtype=torch.float64),
        torch.tensor([[0.1, 0.0], [1 / 7, 0.2]], dtype=torch.float64),
    ),
    ToneInSpells(
        numbers(0.5, 20 / 3),
        numbers(4.5, 9.0),
        numbers(7.3, 7.35),
        torch.tensor([[1 / 3, 0.0], [0.1, 0.2]], dtype=torch.float64),
        torch.tensor([[0.1, 0.0], [1 / 7, 0.2]], dtype=torch.float64),
        10.0,
    ),
    InterleavedGain(numbers(1.0, 1.0), numbers(4 / 3, 1.0), numbers(0.1, 0.2)),
    ModulatedTone(
        12.5,
        numbers(1 / 3, 0.0),
        numbers(0.0, 0.1),
        harmonics=(Harmonic(-1, numbers(0.1, 0.2), numbers(0.0, 1 / 3)),),
        modulation_hz=2 / 3,
    ),
    VibrationTone(7.3, numbers(0.3, 0.0), numbers(0.1, 0.2)),
    VibrationTone(
        12.5,
        numbers(1 / 3, 0.0),
        numbers(0.0, 0.1),
        2,
        (Harmonic(1, numbers(0.1, 0.2), numbers(0.0, 1 / 3)), Harmonic(5, numbers(0.0, 0.2), numbers(0.3, 0.1))),
    ),
    TimeScale(
        1.04 / 3 + 0.7,
        (7.3, 20 / 3),
        torch.tensor([[0.3j, 0.1], [0.2, 0.0]], dtype=torch.complex128),
        numbers(0.1, 0.2),
        torch.tensor([[0.1, 1 / 3], [0.0, 0.0]], dtype=torch.float64),
    ),
    SensorDelay(numbers(0.0, 1 / 3)),
    ToneSize(7.3, numbers(0.3, 1 / 3)),
    RandomTelegraph(numbers(0.3, 0.0), numbers(1 / 3, 1.0), numbers(0.2, 1.0)),
    RandomTelegraph(numbers(0.3, 0.1), numbers(1 / 3, 1 / 7), numbers(1 / 7, 1 / 3), (1, -1)),
    TemperatureDrift(
        numbers(1 / 3, 0.0), torch.zeros(2, 4, dtype=torch.float64), 0.7, "temperature", 0, (numbers(0.1, 0.0),)
    ),
    TemperatureDrift(
        numbers(1 / 3, 0.0), torch.zeros(2, 4, dtype=torch.float64), 0.7, "temperature", 0, (), (numbers(0.1, 0.2),)
    ),
    LateWarmUp(numbers(1 / 3, 0.0), torch.zeros(2, 4, dtype=torch.float64), 1.7, 2.3),
    LateWarmUp(numbers(1 / 3, 0.0), torch.zeros(2, 4, dtype=torch.float64), 1.7, 2.3, decays=True),
    WarmUpTransient(
        numbers(1 / 3, 0.0), torch.zeros(2, 4, dtype=torch.float64), 2.3, (Decay(numbers(0.2, 0.0), 20 / 3),)
    ),
    Step(numbers(0.0, 1 / 3), torch.zeros(2, 4, dtype=torch.float64), 3.3),
    SimulatedStep(Step(numbers(0.0, 1 / 3), torch.zeros(2, 4, dtype=torch.float64), 3.3)),
    SimulatedRamp(Ramp(numbers(0.0, 1 / 3), torch.zeros(2, 4, dtype=torch.float64), 3.3)),
    SimulatedWarmUp(WarmUpTransient(numbers(0.0, 1 / 3), torch.zeros(2, 4, dtype=torch.float64), 3.3)),
    Ramp(numbers(0.0, 1 / 3), torch.zeros(2, 4, dtype=torch.float64), 3.3),
    Motion(
        numbers(1.5, 4.0),
        numbers(2.0, 5.0),
        torch.tensor([[[0.5, 0.0], [0.2, 1 / 3]], [[0.1, 0.0], [0.0, 0.1]]], dtype=torch.float64),
        torch.tensor([[[9.0, 1.0], [1.0, 1 / 3]], [[2.0, 0.0], [0.0, 3.0]]], dtype=torch.float64),
        numbers(0.1, 0.3),
    ),
    VarianceChange(((1.5, 3.25), (6.0, 7.0)), numbers(2.0, 1.0), 1 / 3, (20.0,)),
    GradualChange(numbers(0.0, 1 / 3, 9.0), numbers(0.0, 0.7, 1.0), numbers(0.9, 1.0), numbers(1 / 3, 1.0), 0.1),
    ParameterShift(BASE, torch.tensor([[0.1, 0.0], [1 / 3, 0.0], [0.0, 0.0], [0.2, 0.1]], dtype=torch.float64)),
    LowPassFilter("pole", numbers(0.7, 0.0)),
    LowPassFilter("bilinear2", numbers(0.7, 0.0), undone=True),
    MovedLowPassFilter("bilinear2", numbers(0.7, 0.0), "bilinear3", 1 / 3),
    HighPassFilter(numbers(0.03, 0.0), 40.0, "bilinear2"),
    NotchFilter(0.11, 1 / 3, numbers(0.7, 0.0)),
    NotchFilter(0.21, 0.6, numbers(0.0, 5.0), "bilinear4"),
    Resonance(MODE),
    SensorOrder((1, 0)),
    DriftingTone(MODE, True, 0.9),
    WanderingHarmonics(MODE, True, 0.9, 2, (1, 3), (replace(MODE, centre=0.055), replace(MODE, centre=0.165))),
    FlickerNoise(numbers(1 / 3, 0.0)),
    PowerLawNoise(numbers(1 / 3, 0.0), 4 / 3, 0.01 / 3),
    AngleQuantization(numbers(1 / 3, 0.0)),
    AngleCounts(Quantization(numbers(1.3, 0.0), numbers(0.0, 0.0), numbers(0.0, 0.0), numbers(1 / 3, 0.1))),
    CrossTalk(torch.tensor([[0.0, 1 / 3], [0.05, 0.0]], dtype=torch.float64)),
    CommonMode("ar1", 0.03, complex_numbers(0.1, 0.2j), BASE, True),
    SimulatedResonance(Resonance(MODE), BASE),
    MovedResonance(Resonance(MODE), BASE, Resonance(replace(MODE, centre=0.3))),
    SimulatedWanderingTone(DriftingTone(MODE, True, 0.9), BASE),
    SimulatedCommonMode(CommonMode("white", 0.0, complex_numbers(0.1, 0.2j), BASE, False), BASE),
    DeadBand(numbers(0.0, 0.1), numbers(0.2, 0.0), numbers(0.01, 1 / 3)),
    SlowRemainder(
        numbers(0.0, 1 / 3),
        torch.zeros(2, 4, dtype=torch.float64),
        torch.tensor([[0.1, 1 / 3], [0.0, 0.2]], dtype=torch.float64),
        1000,
    ),
    Remainder(numbers(0.01, 0.1, 0.4), torch.tensor([[0.1, 1 / 3, 0.0], [0.0, 0.2, 0.3]], dtype=torch.float64)),
    CoherenceRemainder(
        numbers(0.01, 0.4),
        torch.tensor([[0.1, 1 / 3], [0.7, 0.2]], dtype=torch.float64),
        torch.eye(2, dtype=torch.complex128).expand(2, -1, -1),
        torch.stack([complex_numbers(1, 0.1j, -0.1j, 1), complex_numbers(1, 1 / 3, 1 / 3, 1)]).unflatten(-1, (2, 2)),
    ),
)


@dataclass(frozen=True, eq=False)
class Odd(Mechanism):
    name: ClassVar[str] = "odd"
    base: NoiseSpectrum
    limits: Annotated[Tensor, Dims(("sensor",), infinite=True)]
    spans: tuple[tuple[float, float], ...]
    channel: str
    together: bool

    @property
    def follows(self) -> tuple[str, ...]:
        return (self.channel,)


CHANNELS = {"acceleration": 3, "rate": 1, "temperature": 1, "motor": 1}  # rows
ODD: tuple[Any, ...] = (None, True, "x", "nan", "inf", -1, 0, 1e308, -1e308, 10**400, [], {}, [[]], ["a"], [1] * 50)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths to all entries of plain numbers, of long lists to the first two."""
    if path:
        yield path
    entries = value.items() if isinstance(value, dict) else enumerate(value[:2]) if isinstance(value, list) else ()
    for key, entry in entries:
        yield from places(entry, (*path, key))


def model(*effects: Mechanism) -> RepairedModel:
    return RepairedModel(NOISE, SCENE, effects)


def test_simulates_the_same_after_json():
    first = model(VibrationTone(7.3, numbers(0.3, 0.0), numbers(0.1, 0.2)))
    again = repaired_from_dict(json.loads(json.dumps(first.to_dict(), allow_nan=False)))
    drawn = [m.simulate(500, generator=torch.Generator().manual_seed(1)) for m in (first, again)]
    torch.testing.assert_close(*drawn, rtol=0, atol=0)
    assert (again.info.rate, again.info.unit, again.info.sensors) == (50.0, "deg/s", ("a", "b"))
    assert str(again) == f"{again.noise} + vibration_tone"


def test_what_an_effect_has_of_late_may_be_absent():
    """Files of earlier releases know one path of a slow effect."""
    drift = TemperatureDrift(numbers(0.3, 0.0), torch.zeros(2, 4, dtype=torch.float64), 0.7, "temperature", 0)
    description = model(drift).to_dict()
    del description["effects"][0]["numbers"]["curvature"]
    (back,) = repaired_from_dict(description).effects
    assert isinstance(back, TemperatureDrift)
    assert back.curvature == ()


def descendants(kind: type) -> set[type]:
    return {kind}.union(*(descendants(below) for below in kind.__subclasses__()))


def test_the_catalogue_lists_every_mechanism():
    """Those whose `fit_without` is not abstract; and there is an instance of each to be tested."""
    whole = {
        kind
        for kind in descendants(Mechanism)
        if kind.__module__.startswith("gyrofuse.") and is_dataclass(kind) and hasattr(kind, "name")
    }
    assert set(CATALOGUE) == whole
    assert len(CATALOGUE) == len(whole)
    assert {type(effect) for effect in EVERY} == whole


@pytest.mark.parametrize("effect", EVERY, ids=lambda effect: type(effect).__name__)
def test_simulates_the_same_bits_after_json(effect: Mechanism):
    first = model(effect)
    again = repaired_from_dict(json.loads(json.dumps(first.to_dict(), allow_nan=False)))
    g = torch.Generator().manual_seed(2)
    channels = {name: torch.randn(rows, 500, generator=g, dtype=torch.float64) for name, rows in CHANNELS.items()}
    drawn = [
        m.simulate(500, batch=(2,), channels=channels, generator=torch.Generator().manual_seed(1))
        for m in (first, again)
    ]
    assert torch.equal(*drawn)
    plain = model().simulate(500, batch=(2,), generator=torch.Generator().manual_seed(1))
    assert not torch.equal(drawn[0], plain)
    assert again.to_dict() == first.to_dict()


@pytest.mark.parametrize("effect", EVERY, ids=lambda effect: type(effect).__name__)
def test_refuses_numbers_that_are_none_of_a_mechanism(effect: Mechanism):
    """Whatever becomes of any one entry: it is refused in words that name it, or simulates finite samples."""
    description = json.loads(json.dumps(model(effect).to_dict(), allow_nan=False))
    for where in places(description["effects"][0]["numbers"]):
        for odd in ODD:
            changed = copy.deepcopy(description)
            owner: Any = changed["effects"][0]["numbers"]
            for key in where[:-1]:
                owner = owner[key]
            owner[where[-1]] = odd
            try:
                again = repaired_from_dict(changed)
            except ValueError as error:
                said = str(error)
                assert re.match(r"`description`: expected in effects\.0\S* ", said), (where, odd, said)
            else:
                assert effect.follows or again.simulate(300).isfinite().all()


@pytest.mark.parametrize(
    ("effect", "change", "says"),
    [
        (Spikes, {"rate": [0.1]}, "effects.0.numbers.rate a list of 2 along the axis sensor, got one of 1"),
        (Spikes, {"rate": [0.1, "x"]}, "effects.0.numbers.rate a finite number, got 'x'"),
        (Spikes, {"together": 1}, "effects.0.numbers.together true or false, got 1"),
        (Step, {"onset_s": "../../x"}, "effects.0.numbers.onset_s a finite number, got '../../x'"),
        (Step, {"onset_s": "nan"}, "effects.0.numbers.onset_s a finite number, got 'nan'"),
        (ClockSkew, {"sensors": [7]}, "effects.0 an effect that can be simulated, got IndexError"),
        (Resonance, {"mode": [1]}, r"effects.0.numbers.mode the numbers of a Mode by their names, got \[1\]"),
        (VibrationTone, {"frequency_hz": -1e308}, "effects.0.numbers.frequency_hz a number below 1e154"),
        (RandomTelegraph, {"up": [1e-300, 1.0]}, "expected dwells of more than 0.01 samples"),
        (LowPassFilter, {"kind": "sieve"}, "effects.0 an effect that can be simulated, got KeyError: 'sieve'"),
    ],
)
def test_says_which_number_is_wrong(effect: type[Mechanism], change: dict[str, object], says: str):
    description = model(next(e for e in EVERY if type(e) is effect)).to_dict()
    description["effects"][0]["numbers"] |= change
    with pytest.raises(ValueError, match=says):
        repaired_from_dict(description)


def test_every_kind_of_number_comes_back(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(saved, "CATALOGUE", (Odd,))
    base = NoiseSpectrum(4096, numbers(1.0, 2.0)[:, None])
    effect = Odd(base, numbers(-math.inf, 2.0), ((0.0, 1.5),), "temperature", True)
    first = model(effect)
    again = repaired_from_dict(json.loads(json.dumps(first.to_dict(), allow_nan=False)))
    (found,) = again.effects
    assert isinstance(found, Odd)
    assert (found.base.n_samples, found.spans, found.channel, found.together) == (
        4096,
        effect.spans,
        "temperature",
        True,
    )
    for got, expected in ((found.base.coefficients, base.coefficients), (found.limits, effect.limits)):
        torch.testing.assert_close(got, expected, rtol=0, atol=0)
    with pytest.raises(ValueError, match="`channels`: expected temperature, which the simulation follows, got none"):
        again.check(50.0, "deg/s")


def test_check_refuses_another_rate_or_unit():
    model().check(50.0, "unknown")
    with pytest.raises(ValueError, match="`rate`: expected that of the repaired simulation, 50 Hz, got 25 Hz"):
        model().check(25.0, "deg/s")
    with pytest.raises(ValueError, match="`unit`: expected that of the repaired simulation, 'deg/s', got 'rad/s'"):
        model().check(50.0, "rad/s")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"effects": [{"mechanism": "x", "kind": "Gremlin", "numbers": {}}]},
            "effects.0 a mechanism among .*'Gremlin'",
        ),
        ({"effects": [{"mechanism": "x"}]}, "expected in effects.0 a mechanism among .*, got None"),
        ({"effects": [1]}, "expected in effects.0 an effect, got 1"),
        ({"effects": {}}, "expected in effects a list, got {}"),
        ({"rate": None}, "expected in rate a finite number, got None"),
        ({"rate": -1}, "`rate`: expected a finite number > 0, got -1"),
        ({"unit": [1]}, r"expected in unit a text, got \[1\]"),
        ({"sensors": ["a"]}, "expected the names of 2 sensors, as many as the noise is of, got 1"),
        ({"noise_samples": -1}, "`noise_samples`: expected a whole number >= 0, got -1"),
        ({"noise_samples": 0.5}, "`noise_samples`: expected a whole number >= 0, got 0.5"),
        ({"noise": gf.WhiteNoise(1.0).to_dict()}, "expected the noise of an array, got that of a sensor"),
    ],
)
def test_refuses_what_is_no_repaired_simulation(change: dict[str, object], says: str):
    with pytest.raises(ValueError, match=says):
        repaired_from_dict({**model().to_dict(), **change})
