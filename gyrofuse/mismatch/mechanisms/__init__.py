"""The catalogue: mechanisms in the order in which they are looked for.

Specific facts come first and spectra of any origin last: a rounded, spiky recording has a white excess too. Within a
stage the best one is taken first, and the stage is gone through again.
"""

from __future__ import annotations

import itertools

from gyrofuse.mismatch.mechanism import Mechanism
from gyrofuse.mismatch.mechanisms.clipping import Clipping
from gyrofuse.mismatch.mechanisms.clock_skew import ClockSkew
from gyrofuse.mismatch.mechanisms.common_mode import CommonMode
from gyrofuse.mismatch.mechanisms.dead_band import DeadBand
from gyrofuse.mismatch.mechanisms.drifting_tone import DriftingTone
from gyrofuse.mismatch.mechanisms.flicker import FlickerNoise
from gyrofuse.mismatch.mechanisms.g_sensitivity import GSensitivity
from gyrofuse.mismatch.mechanisms.gradual_change import GradualChange
from gyrofuse.mismatch.mechanisms.low_pass import LowPassFilter
from gyrofuse.mismatch.mechanisms.parameter_shift import ParameterShift
from gyrofuse.mismatch.mechanisms.quadratic_coupling import QuadraticCoupling
from gyrofuse.mismatch.mechanisms.quantization import Quantization
from gyrofuse.mismatch.mechanisms.random_telegraph import RandomTelegraph
from gyrofuse.mismatch.mechanisms.resonance import Resonance
from gyrofuse.mismatch.mechanisms.scale_factor import ScaleFactor
from gyrofuse.mismatch.mechanisms.spikes import Spikes
from gyrofuse.mismatch.mechanisms.step import Step
from gyrofuse.mismatch.mechanisms.stuck_samples import StuckSamples
from gyrofuse.mismatch.mechanisms.temperature_drift import TemperatureDrift
from gyrofuse.mismatch.mechanisms.tone_size import ToneSize
from gyrofuse.mismatch.mechanisms.unit_scale import UnitScale
from gyrofuse.mismatch.mechanisms.variance_change import VarianceChange
from gyrofuse.mismatch.mechanisms.vibration_tone import VibrationTone
from gyrofuse.mismatch.mechanisms.warm_up_transient import WarmUpTransient
from gyrofuse.mismatch.remainder import Remainder
from gyrofuse.mismatch.slow_remainder import SlowRemainder

STAGES: tuple[tuple[type[Mechanism], ...], ...] = (
    (UnitScale,),
    (Quantization, Clipping, StuckSamples),  # facts on the numbers themselves
    (Spikes,),
    (ClockSkew,),
    (GSensitivity, QuadraticCoupling, ScaleFactor),
    (VibrationTone, ToneSize),
    (RandomTelegraph,),
    (GradualChange,),  # where noise is louder, what is slow is known less well
    (TemperatureDrift, WarmUpTransient, Step),
    (VarianceChange,),  # to which large jumps look alike
    (ParameterShift, LowPassFilter, Resonance, DriftingTone, FlickerNoise, CommonMode),
)

# Every mechanism that a repaired simulation may have: a dead band is looked for where no lattice is found, the
# remainders once nothing with a name is left.
CATALOGUE: tuple[type[Mechanism], ...] = (*itertools.chain(*STAGES), DeadBand, Remainder, SlowRemainder)
