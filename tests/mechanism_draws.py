"""Draws of every mechanism of the catalogue, with the recordings that they act on, for tests of what all have to do.

A new mechanism gets one function here, marked with `draws`: it gives an instance, and what its limits have to cover.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from scipy import special
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.likelihoods.laws.bend import Curve
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import filter_strength
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
from gyrofuse.mismatch.mechanisms.simulated.course import SimulatedCourse, SimulatedRamp, SimulatedStep, SimulatedWarmUp
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
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect
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
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from tests.mechanism_settings import RATE, TONE, TONE_SIZE, Drawn, Setting, draws, noise_spectrum


def acceleration(setting: Setting) -> Tensor:
    """Gravity, and a motion of half of it at all frequencies, `(3, time)`, g."""
    return 0.5 * setting.normal(3, setting.n_samples) + torch.tensor([[0.0], [0.0], [1.0]], dtype=torch.float64)


# Facts on the numbers themselves.


@draws(UnitScale)
def _(setting: Setting) -> Drawn:
    factor = (math.degrees(1), 1000.0, 3600.0)[int(setting.even(0, 3))] ** setting.sign()
    return Drawn(UnitScale(factor), {"factor": factor})


@draws(SensorOrder)
def _(setting: Setting) -> Drawn:
    place = list(range(setting.n_sensors))
    for i, j in zip(setting.concerned, (*setting.concerned[1:], setting.concerned[0]), strict=True):
        place[i] = j
    return Drawn(SensorOrder(tuple(place)), {}, simulated=SensorGain(torch.arange(1, len(place) + 1).to(torch.float64)))


@draws(SensorGain)
def _(setting: Setting) -> Drawn:
    factor = setting.signed(0.2, 0.4).mul(setting.size).exp()
    return Drawn(SensorGain(factor), setting.of_each("gain", factor), moved=True)


@draws(Quantization)
def _(setting: Setting) -> Drawn:
    step = setting.sizes(0.2, 0.6) * min(setting.size, 4.0)
    # A blurred lattice acts on values in their order, which is not how one is recorded: it is not looked for.
    blur = setting.sizes(0.1, 0.2) * float(setting.size > 1)
    effect = Quantization(step, setting.sizes(-0.5, 0.5) * step, blur, setting.clean.mean(-1))
    return Drawn(effect, setting.of_each("lsb", step))


@draws(AngleCounts)
def _(setting: Setting) -> Drawn:
    step = setting.sizes(0.8, 2.0) * min(setting.size, 2.0)
    grid = Quantization(step, torch.zeros_like(step), torch.zeros_like(step), setting.clean.mean(-1))
    return Drawn(AngleCounts(grid), setting.of_each("lsb", step))


@draws(DeadBand)
def _(setting: Setting) -> Drawn:
    half_width = setting.sizes(0.03, 0.1) * min(setting.size, 10.0)
    effect = DeadBand(setting.sizes(-0.1, 0.1), half_width, setting.clean.mean(-1))
    return Drawn(effect, setting.of_each("dead_band", half_width))


@draws(Clipping)
def _(setting: Setting) -> Drawn:
    low = setting.sizes(-3.0, -2.7, -math.inf)
    high = torch.full_like(low, math.inf) if setting.chance() else setting.sizes(2.7, 3.0, math.inf)
    truth = setting.of_each("low", low) | (setting.of_each("high", high) if bool(high.isfinite().any()) else {})
    return Drawn(Clipping(low, high, setting.clean.mean(-1)), truth)


def _shares(setting: Setting, low: float, high: float, most: float) -> tuple[Tensor, bool]:
    """Of samples that are none of their own, `(sensor,)`, and whether all sensors concerned lose them at once."""
    share, together = (setting.sizes(low, high) * setting.size).clamp(max=most), setting.chance()
    return (torch.where(share > 0, share.max(), 0.0) if together else share), together


@draws(Nonlinearity)
def _(setting: Setting) -> Drawn:
    """Of another gain on either side, or of a smaller one at both ends."""
    spread, size = setting.clean.std(-1), min(0.5 * setting.size, 2.0)
    bend = setting.signed(0.6, 0.9) * size if setting.chance() else setting.sizes(0.6, 0.9) * size
    ends = (-0.6 * bend).exp(), bend.exp()
    one = torch.ones_like(bend)
    slopes = torch.stack([ends[1] if bool((bend >= 0).all()) else ends[0], one, ends[1]], -1)
    knots = spread[:, None] * torch.tensor([-2.0, 0.0, 2.0], dtype=torch.float64)
    effect = Nonlinearity(setting.clean.mean(-1), torch.zeros_like(bend), knots, slopes)
    curves = [Curve(*own) for own in zip(knots.numpy(), slopes.numpy(), strict=True)]
    numbers = torch.stack(
        [torch.from_numpy(c.coefficients(0.0, float(sd))) for c, sd in zip(curves, spread, strict=True)]
    )
    numbers = torch.where(bend[:, None] != 0, numbers, 0.0)
    truth = {
        f"{name}[{i}]": float(numbers[i, k]) for i in setting.concerned for k, name in enumerate(("quadratic", "cubic"))
    }
    return Drawn(effect, truth)


@draws(StuckSamples)
def _(setting: Setting) -> Drawn:
    probability, together = _shares(setting, 0.001, 0.003, 0.9)
    return Drawn(
        StuckSamples(probability, torch.zeros_like(probability), together),
        setting.of_each("probability", probability),
    )


@draws(MedianFilter)
def _(setting: Setting) -> Drawn:
    window = torch.tensor([3.0, 5.0, 7.0, 9.0], dtype=torch.float64)[setting.sizes(0.0, 3.99).long()]
    window = torch.where(setting.sizes(1.0, 1.0) > 0, window, 1.0)
    effect = MedianFilter(window, torch.full_like(window, 0.4), torch.zeros_like(window))
    return Drawn(effect, setting.of_each("window", window))


@draws(MissingCodes)
def _(setting: Setting) -> Drawn:
    """Of a converter that the simulation has as well, which puts out all codes."""
    step = setting.sizes(0.05, 0.1)
    stuck, lost = (0, 0, 0, 0, -4, -4, -4, -4), (0, 0, 0, -1)
    shifts = tuple((stuck if setting.chance() else lost) if size > 0 else () for size in step.tolist())
    zero = torch.zeros_like(step)
    share = torch.tensor([0.5 if own == stuck else 0.25 for own in shifts], dtype=torch.float64)
    effect = MissingCodes(step, zero, shifts)
    return Drawn(effect, setting.of_each("missing_share", share), simulated=Quantization(step, zero, zero, zero))


@draws(InterpolatedSamples)
def _(setting: Setting) -> Drawn:
    probability, together = _shares(setting, 0.01, 0.03, 0.6)
    row = setting.sizes(4.0, 12.0, 1.0)
    row = torch.where(row > 1, row.max(), row) if together else row
    effect = InterpolatedSamples(probability, row, torch.zeros_like(row), together)
    return Drawn(effect, setting.of_each("probability", probability))


@draws(HeldValues)
def _(setting: Setting) -> Drawn:
    period, phase = setting.sizes(2.0, 5.0, 1.0), setting.sizes(0.0, 1.0)
    if setting.chance():
        period, phase = period.round(), phase.round()
    return Drawn(HeldValues(period, phase, torch.zeros_like(period)), setting.of_each("rate", RATE / period))


# The law of single samples, and what changes with time.


def _spikes(setting: Setting, low: float, high: float) -> Drawn:
    together = setting.chance() and len(setting.concerned) > 1
    rate = (setting.sizes(low, high) * setting.size).clamp(max=0.02)
    if together:
        rate = torch.where(rate > 0, rate.max(), 0.0)
    effect = Spikes(rate, setting.sizes(6.0, 9.0), setting.sizes(0.5, 1.0), together)
    per_hour = rate * RATE * 3600
    rates = {"rate": float(per_hour.max())} if together else {}
    return Drawn(effect, setting.of_each("amplitude", effect.amplitude) | rates | setting.of_each("rate", per_hour))


@draws(Spikes)
def _(setting: Setting) -> Drawn:
    return _spikes(setting, 0.001, 0.002)


@draws(ScaleMixture)
def _(setting: Setting) -> Drawn:
    share = setting.sizes(0.15, 0.35)
    ratio = 1.0 + setting.sizes(1.5, 2.5) * min(setting.size, 3.0)
    truth = setting.of_each("share", 100 * share) | setting.of_each("ratio", ratio)
    return Drawn(ScaleMixture(share, ratio), truth)


@draws(HeavyTailedNoise)
def _(setting: Setting) -> Drawn:
    """Of one law in all sensors concerned: the other is none that any of them has."""
    shape, none = setting.sizes(0.8, 2.0) * min(setting.size, 3.0), setting.sizes(0.0, 0.0)
    if setting.chance():
        return Drawn(HeavyTailedNoise(none, shape), setting.of_each("laplace_width", shape))
    freedom = torch.where(shape > 0, 2.5 + 4 / shape.clamp(min=0.1), 0.0)
    return Drawn(HeavyTailedNoise(freedom, none), setting.of_each("freedom", freedom))


@draws(VarianceChange)
def _(setting: Setting) -> Drawn:
    seconds = setting.n_samples / RATE
    start, length = setting.even(0.15, 0.35) * seconds, setting.even(0.3, 0.5) * seconds
    factor = setting.sizes(1.35, 1.6, 1.0) ** min(setting.size, 5.0)
    truth = {"start": start, "stop": start + length, **setting.of_each("factor", factor)}
    return Drawn(VarianceChange(((start, start + length),), factor, setting.even(0.5, 2.0)), truth)


@draws(GradualChange)
def _(setting: Setting) -> Drawn:
    seconds = setting.n_samples / RATE
    knots = torch.tensor([0.0, setting.even(0.1, 0.2), setting.even(0.8, 0.9), 1.0], dtype=torch.float64) * seconds
    share = torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64)
    factor = setting.sizes(1.7, 2.2, 1.0) ** min(setting.size, 3.0)
    effect = GradualChange(knots, share, torch.ones_like(factor), factor, setting.even(0.5, 2.0))
    return Drawn(effect, setting.of_each("factor", factor))


@draws(PeriodicNoise)
def _(setting: Setting) -> Drawn:
    cycles, factor = setting.even(8, 20), setting.sizes(1.5, 2.0, 1.0) ** min(setting.size, 4.0)
    f = cycles * RATE / setting.n_samples
    at = torch.arange(64, dtype=torch.float64) / 64
    profile = (1 + (2 * math.pi * (at - setting.even(0, 1))).cos()) / 2
    profile = (profile - profile.min()) / (profile.max() - profile.min())
    effect = PeriodicNoise(f, profile, torch.ones_like(factor), factor, setting.even(0.5, 2.0))
    return Drawn(effect, {"frequency": f, **setting.of_each("factor", factor)})


@draws(RandomLevelNoise)
def _(setting: Setting) -> Drawn:
    factor = setting.sizes(1.9, 2.5, 1.0) ** min(setting.size, 3.0)
    share, on_s = torch.full_like(factor, setting.even(0.2, 0.4)), torch.full_like(factor, setting.even(80, 160) / RATE)
    share = torch.where(factor != 1, share, 0.0)
    sources = tuple((factor != 1).long().tolist())
    effect = RandomLevelNoise(sources, torch.ones_like(factor), factor, share, on_s, False, setting.even(0.5, 2.0))
    return Drawn(effect, {**setting.of_each("factor", factor), **setting.of_each("time_on", on_s)})


@draws(ChannelNoise)
def _(setting: Setting) -> Drawn:
    held = 60  # samples
    command = setting.normal(1, setting.n_samples // held + 1).sigmoid().repeat_interleave(held, -1)
    command = command[:, : setting.n_samples]
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    factor = setting.sizes(1.7, 2.2, 1.0) ** min(2 * setting.size, 6.0)
    effect = ChannelNoise("motor", 0, "level", ends, 0.0, torch.ones_like(factor), factor, setting.even(0.5, 2.0))
    return Drawn(effect, {}, {"motor": command})


@draws(RandomTelegraph)
def _(setting: Setting) -> Drawn:
    half_step = setting.sizes(0.5, 0.7) * setting.size
    up, down = (setting.sizes(1.0, 3.0, 1.0) for _ in range(2))
    truth = [setting.of_each(*pair) for pair in (("half_step", half_step), ("dwell_up", up), ("dwell_down", down))]
    return Drawn(RandomTelegraph(half_step, up, down), truth[0] | truth[1] | truth[2])


# Known paths in noise.


@draws(ClockSkew)
def _(setting: Setting) -> Drawn:
    none = torch.zeros(len(setting.concerned), dtype=torch.complex128)
    if setting.chance():
        skew = setting.sign() * setting.even(1.5e-4, 4e-4) * setting.size
        effect = ClockSkew(setting.concerned, skew, (), TONE, none, none)
        return Drawn(effect, {"skew": 1e6 * skew}, tones=(TONE,))
    at, count = int(setting.even(0.3, 0.7) * setting.n_samples), 1 + int(setting.chance())
    effect = ClockSkew(setting.concerned, 0.0, ((at, count),), TONE, none, none)
    return Drawn(effect, {"lost": count, "time_of_loss_1": at / RATE}, tones=(TONE,))


@draws(TimeScale)
def _(setting: Setting) -> Drawn:
    ratio, lines = 1 + setting.sign() * setting.even(0.02, 0.1), (TONE, 0.31)
    none = torch.zeros(setting.n_sensors, len(lines), dtype=torch.complex128)
    f = torch.tensor([0.01, 0.1, 0.4], dtype=torch.float64)
    effect = TimeScale(ratio, tuple(RATE * f for f in lines), none, f, torch.zeros(setting.n_sensors, len(f)).to(f))
    return Drawn(effect, {"ratio": ratio, "rate": RATE / ratio}, tones=lines)


@draws(SensorDelay)
def _(setting: Setting) -> Drawn:
    late = setting.signed(0.5, 0.8) * setting.size
    return Drawn(SensorDelay(late), setting.of_each("delay", 1e3 / RATE * late), moved=True)


@draws(GSensitivity)
def _(setting: Setting) -> Drawn:
    coupling = (
        setting.sizes(0.25, 0.4)[:, None]
        * setting.size
        * torch.nn.functional.normalize(setting.normal(setting.n_sensors, 3), dim=-1)
    )
    truth = setting.of_each("gain", coupling.norm(dim=-1))
    return Drawn(GSensitivity("acceleration", coupling), truth, {"acceleration": acceleration(setting)})


@draws(QuadraticCoupling)
def _(setting: Setting) -> Drawn:
    kind = "length" if setting.chance() else "axis 2"
    gain = setting.signed(0.25, 0.4) * setting.size * (1 if kind == "length" else math.sqrt(3))
    effect = QuadraticCoupling("acceleration", gain[:, None], kind)
    return Drawn(effect, setting.of_each("gain", gain), {"acceleration": acceleration(setting)})


@draws(ScaleFactor)
def _(setting: Setting) -> Drawn:
    error = setting.signed(6e-3, 1e-2) * setting.size
    motion = gf.AR1(0.9, 400 * (1 - 0.9**2)).simulate(setting.n_samples, generator=setting.generator)
    return Drawn(
        ScaleFactor("rate", error[:, None]), setting.of_each("error", 1e6 * error), {"rate": motion.reshape(1, -1)}
    )


@draws(Interleaving)
def _(setting: Setting) -> Drawn:
    offset = setting.signed(0.15, 0.25) * setting.size
    return Drawn(Interleaving(offset), setting.of_each("offset", offset))


@draws(InterleavedGain)
def _(setting: Setting) -> Drawn:
    ratio = setting.sizes(0.15, 0.3).mul(min(setting.size, 4.0)).exp()
    effect = InterleavedGain(torch.ones_like(ratio), ratio, setting.clean.mean(-1))
    return Drawn(effect, setting.of_each("gain_ratio", torch.where(ratio != 1, ratio, 0.0)))


@draws(ChannelCoupling)
def _(setting: Setting) -> Drawn:
    gain = setting.signed(0.25, 0.4) * setting.size
    held = 40  # samples
    command = setting.normal(1, setting.n_samples // held + 1).repeat_interleave(held, -1)[:, : setting.n_samples]
    return Drawn(ChannelCoupling("motor", gain[:, None]), setting.of_each("gain", gain), {"motor": command})


@draws(RingDown)
def _(setting: Setting) -> Drawn:
    knocks, seconds = 6, setting.n_samples / RATE  # expected in the record, all of one mode
    frequency, decay = setting.even(0.1, 0.35) * RATE, setting.even(15.0, 40.0) / RATE
    size, phase = setting.sizes(3.0, 4.5) * setting.size, setting.even(0.0, 2 * math.pi)
    effect = RingDown(
        torch.zeros(1, dtype=torch.float64),
        torch.full((1,), frequency, dtype=torch.float64),
        torch.full((1,), decay, dtype=torch.float64),
        math.cos(phase) * size[None],
        math.sin(phase) * size[None],
        seconds / knocks,
    )
    truth = {"rate": 3600 * knocks / seconds, "frequency": frequency, "decay_time": decay}
    return Drawn(effect, truth | setting.of_each("amplitude", size))


@draws(Pulses)
def _(setting: Setting) -> Drawn:
    n, seconds = 4, setting.n_samples / RATE  # expected in the record, all alike
    width, size = setting.even(6.0, 20.0) / RATE, setting.signed(5.0, 7.0) * setting.size
    one = torch.ones(1, dtype=torch.float64)
    effect = Pulses(0 * one, width * one, one, size[None], seconds / n)
    return Drawn(effect, {"rate": 3600 * n / seconds, "width": width} | setting.of_each("amplitude", size))


@draws(Motion)
def _(setting: Setting) -> Drawn:
    seconds, p = setting.n_samples / RATE, len(setting.sizes(1.0, 1.0))
    start, length = setting.even(0.1, 0.6) * seconds, setting.even(0.06, 0.12) * seconds
    size = setting.sizes(1.5, 2.5) * setting.size
    one = torch.ones(1, dtype=torch.float64)
    root = torch.eye(p, dtype=torch.float64) + 0.7 * torch.ones(p, p, dtype=torch.float64).tril(-1)
    root = size[:, None] * root / root.norm(dim=-1, keepdim=True)
    effect = Motion(start * one, (start + length) * one, root[None], (10 * root @ root.mT)[None], 12.0 / RATE * one)
    return Drawn(effect, {"start": start, "stop": start + length} | setting.of_each("rms", size))


@draws(Chirp)
def _(setting: Setting) -> Drawn:
    start, stop, n_knots = setting.even(0.0, 0.2), setting.even(0.7, 1.0), 33
    time = torch.linspace(start, stop, n_knots, dtype=torch.float64) * setting.n_samples / RATE
    ends = [setting.even(0.06, 0.1) * RATE, setting.even(0.2, 0.4) * RATE]
    if setting.chance():
        ends.reverse()
    size, phase = setting.sizes(0.35, 0.5) * setting.size, setting.even(0.0, 2 * math.pi)
    effect = Chirp(
        time,
        torch.linspace(*ends, n_knots, dtype=torch.float64),
        math.cos(phase) * size.expand(n_knots, -1),
        math.sin(phase) * size.expand(n_knots, -1),
    )
    return Drawn(effect, {"start": float(time[0]), "stop": float(time[-1])} | setting.of_each("amplitude", size))


@draws(ChannelTone)
def _(setting: Setting) -> Drawn:
    n, held = setting.n_samples, 60  # samples
    command = setting.normal(1, n // held + 1).sigmoid().repeat_interleave(held, -1)[:, :n]
    offset, slope, middle = setting.even(0.05, 0.1) * RATE, setting.even(0.15, 0.3) * RATE, float(command.median())
    size, phase = setting.sizes(0.35, 0.5)[None] * setting.size, setting.even(0.0, 2 * math.pi)
    line = ChannelLine(
        "motor", 0, False, offset, slope, 0.0, 0.0, middle, False, 0, math.cos(phase) * size, math.sin(phase) * size
    )
    truth = {"frequency": line.middle_hz, "slope": slope} | setting.of_each("amplitude", size[0])
    return Drawn(ChannelTone((line,)), truth, {"motor": command})


@draws(ToneInSpells)
def _(setting: Setting) -> Drawn:
    seconds = setting.n_samples / RATE
    starts = torch.tensor([setting.even(0.05, 0.2), setting.even(0.5, 0.6)], dtype=torch.float64) * seconds
    frequency, phase = setting.even(0.1, 0.4) * RATE, setting.even(0.0, 2 * math.pi)
    size = (setting.sizes(0.4, 0.6) * setting.size).expand(2, -1)
    effect = ToneInSpells(
        starts,
        starts + setting.even(0.15, 0.25) * seconds,
        torch.full((2,), frequency, dtype=torch.float64),
        math.cos(phase) * size,
        math.sin(phase) * size,
        seconds,
    )
    return Drawn(effect, {"frequency": frequency} | setting.of_each("amplitude", size[0]))


@draws(VibrationTone)
def _(setting: Setting) -> Drawn:
    f, size = setting.even(5, 45), setting.sizes(0.2, 0.3) * setting.size
    turn = torch.tensor([setting.even(0, 6) for _ in size], dtype=torch.float64)
    effect = VibrationTone(f, size * turn.cos(), size * turn.sin())
    return Drawn(effect, {"frequency": f, **setting.of_each("amplitude", size)})


@draws(ModulatedTone)
def _(setting: Setting) -> Drawn:
    """Of a frequency that follows a sine: amplitudes are Bessel functions of its turn."""
    f, slow, turn = setting.even(10, 40), setting.even(0.3, 0.9), setting.even(1.5, 2.2)
    size = setting.sizes(0.5, 0.7) * setting.size
    phase = setting.even(0, 6)
    sizes = {k: size * float(special.jv(k, turn)) for k in range(-3, 4)}
    lines = {k: (a * math.cos(k * phase), -a * math.sin(k * phase)) for k, a in sizes.items()}
    own = lines.pop(0)
    effect = ModulatedTone(f, *own, harmonics=tuple(Harmonic(k, *a) for k, a in lines.items()), modulation_hz=slow)
    return Drawn(effect, {"frequency": f, "modulation": slow, **setting.of_each("amplitude", own[0].abs())})


@draws(ToneSize)
def _(setting: Setting) -> Drawn:
    change = setting.signed(0.25, 0.4)
    size = (TONE_SIZE + change) * (1 + change.abs() * (setting.size - 1)).abs()
    return Drawn(ToneSize(TONE * RATE, size), setting.of_each("amplitude", size), tones=(TONE,))


@draws(Step)
def _step(setting: Setting) -> Drawn:
    size, onset = setting.signed(2.5, 3.5) * setting.size, int(setting.even(0.3, 0.7) * setting.n_samples) / RATE
    return Drawn(Step(size, _none(setting), onset), {"onset": onset, **setting.of_each("size", size)})


@draws(Ramp)
def _ramp(setting: Setting) -> Drawn:
    onset = int(setting.even(0.2, 0.5) * setting.n_samples) / RATE
    slope = setting.signed(6.0, 8.0) * setting.size / (setting.n_samples / RATE - onset)
    return Drawn(Ramp(slope, _none(setting), onset), {"onset": onset, **setting.of_each("slope", slope)})


@draws(BiasOscillation)
def _(setting: Setting) -> Drawn:
    period = setting.n_samples / RATE / setting.even(2.5, 9.0)
    amplitude, angle = setting.sizes(1.8, 2.4) * setting.size, setting.even(0, 2 * math.pi)
    effect = BiasOscillation(amplitude * math.cos(angle), _none(setting), amplitude * math.sin(angle), period)
    return Drawn(effect, {"period": period, **setting.of_each("amplitude", amplitude)})


@draws(WarmUpTransient)
def _warm_up(setting: Setting) -> Drawn:
    size, tau = setting.signed(5.0, 7.0) * setting.size, setting.even(0.05, 0.2) * setting.n_samples / RATE
    slower = (Decay(setting.signed(5.0, 7.0), 3 * tau),) if setting.size > 1 else ()
    effect = WarmUpTransient(size, _none(setting), tau, slower)
    return Drawn(effect, {"time_constant": tau, **setting.of_each("size", size)})


@draws(LateWarmUp)
def _(setting: Setting) -> Drawn:
    seconds = setting.n_samples / RATE
    size, onset, tau = setting.signed(5.0, 7.0) * setting.size, setting.even(0.2, 0.6) * seconds, seconds / 16
    return Drawn(
        LateWarmUp(size, _none(setting), onset, tau, decays=setting.chance()),
        {"onset": onset, "time_constant": tau, **setting.of_each("size", size)},
    )


def _temperature(setting: Setting) -> Tensor:
    """That goes up and down, and on the whole up, `(time,)`, degC."""
    t = torch.arange(setting.n_samples, dtype=torch.float64) / setting.n_samples
    return 25 + 8 * (2 * math.pi * (setting.even(0.8, 1.6) * t + setting.even(0, 1))).sin() + 6 * t


@draws(DriftingScale)
def _(setting: Setting) -> Drawn:
    temperature = _temperature(setting)
    slope = setting.signed(0.015, 0.02) * min(setting.size, 2.0)
    effect = DriftingScale((TONE * RATE,), "temperature", 0, float(temperature.mean()), slope)
    truth = setting.of_each("slope", 100 * slope)
    return Drawn(effect, truth, {"temperature": temperature[None]}, tones=(TONE,))


@draws(TemperatureDrift)
def _(setting: Setting) -> Drawn:
    temperature = _temperature(setting)
    lag = 0.0 if setting.chance() else setting.even(0.02, 0.06) * setting.n_samples / RATE
    size = setting.signed(0.3, 0.4) * setting.size
    curvature = (setting.signed(0.01, 0.02),) if setting.size > 1 else ()
    effect = TemperatureDrift(size, _none(setting), lag, "temperature", 0, curvature)
    truth = {"lag": lag, **setting.of_each("coefficient", size)}
    return Drawn(effect, truth, {"temperature": temperature[None]})


def _none(setting: Setting) -> Tensor:
    """Of the slow noise beside an effect, nothing."""
    return torch.zeros(setting.n_sensors, 4, dtype=torch.float64)


# Spectra.


@draws(ParameterShift)
def _(setting: Setting) -> Drawn:
    log_factors = torch.zeros(4, setting.n_sensors, dtype=torch.float64)
    log_factors[0] = setting.signed(0.25, 0.35) * min(setting.size, 5.0)
    effect = ParameterShift(noise_spectrum(setting.n_sensors, setting.n_samples), log_factors)
    return Drawn(effect, setting.of_each("white_factor", log_factors[0].exp()))


@draws(LowPassFilter)
def _(setting: Setting) -> Drawn:
    kind = ("pole", "bilinear2", "bessel3")[int(setting.even(0, 3))]
    highest = {"pole": 40.0, "bilinear2": 46.0, "bessel3": 46.0}[kind]
    corner = setting.sizes(0.9 * highest, highest) / max(setting.size, 1.0)
    strength = torch.where(corner > 0, filter_strength(kind, corner.clamp(min=1) / RATE), 0.0)
    return Drawn(LowPassFilter(kind, strength), setting.of_each("corner", corner))


@draws(MovedLowPassFilter)
def _(setting: Setting) -> Drawn:
    """Of a simulation whose sensors all have its filter."""
    kind = ("bilinear", "bilinear2")[int(setting.even(0, 2))]
    own = setting.even(22.0, 28.0)
    corner = setting.sizes(1.25, 1.35).pow(min(setting.size, 2.0) * setting.sign()) * own
    every = filter_strength(kind, torch.full((setting.n_sensors,), own / RATE, dtype=torch.float64))
    strength = torch.where(setting.sizes(1.0, 1.0) > 0, filter_strength(kind, corner.clamp(min=1) / RATE), 0.0)
    effect = MovedLowPassFilter(kind, strength, kind, float(every[0]))
    truth = setting.of_each("corner", torch.where(strength > 0, corner, 0.0)) | {"simulated_corner": own}
    return Drawn(effect, truth, simulated=LowPassFilter(kind, every))


@draws(HighPassFilter)
def _(setting: Setting) -> Drawn:
    kind = ("bilinear", "bilinear2")[int(setting.even(0, 2))]
    corner = setting.sizes(0.03, 0.035) * min(setting.size, 4.0)
    return Drawn(HighPassFilter(corner, 40.0, kind), setting.of_each("corner", RATE * corner))


@draws(NotchFilter)
def _(setting: Setting) -> Drawn:
    centre, width = setting.even(0.1, 0.35), setting.even(0.3, 0.6)
    depth = (setting.sizes(0.2, 0.3) * setting.size).clamp(max=2.0)
    truth = {"centre": RATE * centre, "width": RATE * centre * width}
    effect = NotchFilter(centre, width, depth)
    return Drawn(effect, truth | setting.of_each("depth", 20 / math.log(10) * depth))


def _mode(setting: Setting, low: float, high: float, *, shared: bool) -> Mode:
    size = setting.sizes(low, high) * setting.size
    gain = size.to(torch.complex128)
    if shared:
        turn = torch.tensor([setting.even(0, 6) for _ in size], dtype=torch.float64)
        gain = torch.polar(size, turn)
    return Mode(setting.even(0.08, 0.4), setting.even(0.002, 0.004), gain, shared)


@draws(Resonance)
def _(setting: Setting) -> Drawn:
    mode = _mode(setting, 0.3, 0.4, shared=setting.chance())
    truth = {"frequency": mode.centre * RATE, "width": 2 * mode.width * RATE}
    return Drawn(Resonance(mode), truth | setting.of_each("rms", mode.gain.abs()))


@draws(DriftingTone)
def _(setting: Setting) -> Drawn:
    mode = _mode(setting, 0.3, 0.4, shared=True)
    truth = {"frequency": mode.centre * RATE, **setting.of_each("amplitude", math.sqrt(2) * mode.gain.abs())}
    return Drawn(DriftingTone(mode, setting.chance()), truth)


@draws(WanderingHarmonics)
def _(setting: Setting) -> Drawn:
    mode = _mode(setting, 0.35, 0.4, shared=True)
    mode = replace(mode, centre=setting.even(0.06, 0.14), width=setting.even(4, 6) / setting.n_samples)
    second, third = (replace(mode, centre=k * mode.centre, width=k * mode.width, gain=0.6 * mode.gain) for k in (2, 3))
    effect = WanderingHarmonics(mode, True, multiples=(2, 3), others=(second, third))
    return Drawn(effect, {"frequency": mode.centre * RATE})


@draws(AngleQuantization)
def _(setting: Setting) -> Drawn:
    variance = setting.sizes(0.08, 0.15) * setting.size
    angle = {name: math.sqrt(value) / RATE for name, value in setting.of_each("angle", variance).items()}
    return Drawn(AngleQuantization(variance), angle)


@draws(FlickerNoise)
def _(setting: Setting) -> Drawn:
    rms = setting.sizes(0.15, 0.2) * setting.size
    return Drawn(FlickerNoise(rms.square() / 2), setting.of_each("level", rms))


@draws(PowerLawNoise)
def _(setting: Setting) -> Drawn:
    density, slope = setting.sizes(1.1, 1.5) * setting.size, 0.6
    return Drawn(PowerLawNoise(density.square(), slope, 0.01), {"slope": slope})


@draws(CommonMode)
def _(setting: Setting) -> Drawn:
    kind = ("white", "ar1", "walk")[int(setting.even(0, 3))]
    size = {"white": (0.5, 0.6), "ar1": (0.4, 0.5), "walk": (0.03, 0.04)}[kind]
    gain = setting.signed(*size).to(torch.complex128) * setting.size
    corner = setting.even(0.02, 0.05) if kind == "ar1" else 0.0
    inside = kind == "white" and setting.chance()  # of no other noise there is enough
    effect = CommonMode(kind, corner, gain, noise_spectrum(setting.n_sensors, setting.n_samples), inside)
    truth = setting.of_each("gain", gain.abs()) | ({"corner": corner * RATE} if corner else {})
    return Drawn(effect, truth)


# What only the simulation has.


def _own(setting: Setting) -> NoiseSpectrum:
    return noise_spectrum(setting.n_sensors, setting.n_samples)


@draws(SimulatedSpikes)
def _(setting: Setting) -> Drawn:
    drawn = _spikes(setting, 0.005, 0.01)  # each that is missing says a nat
    assert isinstance(drawn.effect, Spikes)
    return Drawn(SimulatedSpikes(drawn.effect), drawn.truth, simulated=drawn.effect)


@draws(SimulatedStep)
def _(setting: Setting) -> Drawn:
    return _of_simulation(SimulatedStep, _step(setting))


@draws(SimulatedRamp)
def _(setting: Setting) -> Drawn:
    return _of_simulation(SimulatedRamp, _ramp(setting))


@draws(SimulatedWarmUp)
def _(setting: Setting) -> Drawn:
    return _of_simulation(SimulatedWarmUp, _warm_up(setting))


def _of_simulation(kind: type[SimulatedCourse], drawn: Drawn) -> Drawn:
    assert isinstance(drawn.effect, SlowEffect)
    return drawn._replace(effect=kind(drawn.effect), simulated=drawn.effect)


@draws(SimulatedResonance)
def _(setting: Setting) -> Drawn:
    mode = _mode(setting, 0.5, 0.6, shared=setting.chance())
    truth = {"frequency": mode.centre * RATE, **setting.of_each("rms", mode.gain.abs())}
    return Drawn(SimulatedResonance(Resonance(mode), _own(setting)), truth, simulated=Resonance(mode))


@draws(MovedResonance)
def _(setting: Setting) -> Drawn:
    old = _mode(setting, 0.5, 0.6, shared=False)
    new = Resonance(replace(old, centre=(1.15 if old.centre < 0.24 else 0.87) * old.centre))
    truth = {"frequency": new.mode.centre * RATE, **setting.of_each("rms", new.mode.gain.abs())}
    return Drawn(MovedResonance(Resonance(old), _own(setting), new), truth, simulated=Resonance(old))


@draws(SimulatedWanderingTone)
def _(setting: Setting) -> Drawn:
    tone = DriftingTone(_mode(setting, 0.5, 0.6, shared=True), True)
    return Drawn(SimulatedWanderingTone(tone, _own(setting)), {"frequency": tone.mode.centre * RATE}, simulated=tone)


@draws(SimulatedCommonMode)
def _(setting: Setting) -> Drawn:
    gain = setting.signed(0.6, 0.7).to(torch.complex128) * setting.size
    source = CommonMode("white", 0.0, gain, _own(setting), False)
    return Drawn(SimulatedCommonMode(source, _own(setting)), setting.of_each("gain", gain.abs()), simulated=source)


@draws(CrossTalk)
def _(setting: Setting) -> Drawn:
    p = setting.n_sensors
    part = setting.sign() * setting.sizes(0.09, 0.12) * setting.size  # of opposite signs they would share nothing
    mixing = torch.zeros(p, p, dtype=torch.float64)
    for i in setting.concerned:
        mixing[i, (i + 1) % p] = part[i]  # of the next one, whose noise is like its own
    truth = {f"part_of_{(i + 1) % p + 1}[{i}]": float(part[i]) for i in setting.concerned}
    return Drawn(CrossTalk(mixing), truth)


@draws(ChannelTransfer)
def _(setting: Setting) -> Drawn:
    # Late and early in turns: of this one gain and one delay of all sensors, which have a name, explain nothing.
    gain, late = setting.signed(0.015, 0.02) * setting.size, setting.sizes(2, 4)
    late[1::2] *= -1
    lags = torch.arange(-8, 9, dtype=torch.float64)
    apart = lags - late[:, None]
    delayed = torch.sinc(apart) * (math.pi * apart / 12).cos().square() * (apart.abs() < 6)
    motion = gf.AR1(0.9, 400 * (1 - 0.9**2)).simulate(setting.n_samples, generator=setting.generator)
    effect = ChannelTransfer(("rate",), (gain[:, None] * delayed)[:, None])
    truth = setting.of_each("gain", gain) | setting.of_each("delay", 1e3 / RATE * late)
    return Drawn(effect, truth, {"rate": motion[None]})


# What stands for no physics.


@draws(Remainder)
def _(setting: Setting) -> Drawn:
    f = torch.logspace(math.log10(2 / setting.n_samples), math.log10(0.45), 12, dtype=torch.float64)
    log_gain = 0.2 * min(setting.size, 5.0) * setting.normal(setting.n_sensors, len(f))
    concerned = torch.tensor([i in setting.concerned for i in range(setting.n_sensors)])
    return Drawn(Remainder(f, torch.where(concerned[:, None], log_gain, 0.0)), {})


@draws(SlowRemainder)
def _(setting: Setting) -> Drawn:
    further = torch.stack([setting.signed(0.5, 1.0) * setting.size for _ in range(3)], -1)
    return Drawn(SlowRemainder(setting.signed(0.5, 1.0), _none(setting), further, setting.n_samples), {})


@draws(CoherenceRemainder)
def _(setting: Setting) -> Drawn:
    f = torch.logspace(math.log10(2 / setting.n_samples), math.log10(0.45), 12, dtype=torch.float64)
    eye = torch.eye(setting.n_sensors, dtype=torch.complex128).expand(len(f), -1, -1)
    shared = torch.tensor([i in setting.concerned for i in range(setting.n_sensors)]).to(torch.complex128)
    shared = shared * torch.polar(
        torch.ones_like(shared.real), 0.3 * torch.arange(setting.n_sensors, dtype=torch.float64)
    )
    share = 0.1 * min(setting.size, 5.0)
    both = share * shared[:, None] * shared.conj()
    after = eye + both - torch.diag_embed(both.diagonal())
    level = noise_spectrum(setting.n_sensors, setting.n_samples).spectrum(f).sqrt()
    return Drawn(CoherenceRemainder(f, level, eye.clone(), after), {})
