"""The catalogue: mechanisms in the order in which they are looked for.

Specific facts come first and spectra of any origin last: a rounded, spiky recording has a white excess too. Within a
stage the best one is taken first, and the stage is gone through again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

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
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone
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
from gyrofuse.mismatch.mechanisms.slow.warm_up import WarmUpTransient
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


def _stage_of(kind: type[Mechanism]) -> int:
    return next(k for k, stage in enumerate(STAGES) if kind in stage)


STAGES: tuple[tuple[type[Mechanism], ...], ...] = (
    (SensorOrder,),  # whatever else is looked for sensor by sensor
    (Nonlinearity, InterleavedGain),  # which change levels as well
    (UnitScale, SensorGain),
    # Facts on the numbers themselves.
    (AngleCounts,),  # whose values lie on a grid as rounded ones do
    (MedianFilter, Quantization, MissingCodes, Clipping, HeldValues, StuckSamples, InterpolatedSamples),
    (Spikes, SimulatedSpikes, ScaleMixture, HeavyTailedNoise),
    (ClockSkew, TimeScale),
    (GSensitivity, QuadraticCoupling, ScaleFactor, DriftingScale, ChannelCoupling, ChannelTransfer),
    (Motion,),  # whose smooth course looks like any of these
    (ChannelTone,),  # a cause that is logged
    (Chirp,),  # which passes any frequency
    (RingDown, Pulses),  # whose strongest are lines too
    (WanderingHarmonics,),  # each of whose lines alone looks like several tones, or like noise that changes
    (VibrationTone, ModulatedTone, ToneInSpells, ToneSize, Interleaving),
    (RandomTelegraph,),
    # Where noise is louder, what is slow is known less well.
    (ChannelNoise, PeriodicNoise, GradualChange, RandomLevelNoise),
    (TemperatureDrift, WarmUpTransient, LateWarmUp, Ramp, Step, BiasOscillation),
    (SimulatedWarmUp, SimulatedRamp, SimulatedStep),
    (VarianceChange,),  # to which large jumps look alike
    (SensorDelay,),  # to which sources and modes in common would be a makeshift
    (MovedResonance, SimulatedResonance, SimulatedWanderingTone, SimulatedCommonMode),  # plain in the simulation
    (
        ParameterShift,
        LowPassFilter,
        MovedLowPassFilter,
        HighPassFilter,
        NotchFilter,
        Resonance,
        DriftingTone,
        FlickerNoise,
        PowerLawNoise,
        AngleQuantization,
        CommonMode,
        CrossTalk,
    ),
)

# Stages that are searched once more after something was found in another: a course of the bias hides jumps between two
# levels, and noise that the simulation lacks hides courses of the bias.
AGAIN: dict[int, int] = {
    _stage_of(TemperatureDrift): _stage_of(RandomTelegraph),
    _stage_of(ParameterShift): _stage_of(TemperatureDrift),
}

# What is left of slow courses and of spectra once nothing with a name is found any more.
UNNAMED: tuple[type[SlowRemainder] | type[Remainder] | type[CoherenceRemainder], ...] = (
    SlowRemainder,
    Remainder,
    CoherenceRemainder,
)

# Every mechanism that a repaired simulation may have; a dead band is looked for where no quantisation grid is found.
CATALOGUE: tuple[type[Mechanism], ...] = (*itertools.chain(*STAGES), DeadBand, *UNNAMED)


def named(names: Iterable[str]) -> list[type[Mechanism]]:
    """Mechanisms of the stages that have one of these names, in their order; several forms may share a name."""
    wanted = frozenset(names)
    return [kind for kind in itertools.chain(*STAGES) if kind.name in wanted]
