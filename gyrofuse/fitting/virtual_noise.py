"""Noise of a virtual gyro, as a model that a filter can assume.

A virtual gyro is a known linear filter of its sensors, so that the noise of the sensors makes its own. One vector of
weights `c` leaves every process of an array with the variance `c' Theta c`, exactly. Bands have the response

    h(f) = sum_k c_k b_k(f),   S(f) = sum_p S_p(f) h(f)* Theta_p h(f),

`b_k` being the difference of two moving means. In states that would be a line of `2**K` samples. A sum of white noise,
AR1s and a random walk follows the spectrum `S` in a handful instead, to an accuracy that is stated; tones pass with
their exact amplitude. What the filter does until it has seen `2**K` samples is not in it.
"""

from __future__ import annotations

import functools
import math
import operator
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.nnls import nonnegative_least_squares
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.processes import AR1, Model, Process, QuantizationNoise, RandomWalk, Sinusoid, WhiteNoise

# Frequencies in an octave: enough to follow the ripples of a moving mean.
_NODES = 16


class VirtualNoise(NamedTuple):
    """Noise of a virtual gyro.

    Attributes:
        model: Noise model, signal units, one step per sample.
        deviation: Largest relative difference between the power of the model and the true power in any octave of
            frequency; 0 for one vector of weights, whose model is exact.
    """

    model: Model
    deviation: float


def virtual_noise(weights: Tensor, array: ArrayModel) -> VirtualNoise:
    """Noise of a virtual gyro from that of its sensors.

    Args:
        weights: `(sensor,)`, one vector for all scales, or `(band, sensor)` of a multi-scale virtual gyro.
        array: Noise of the sensors, as simulated or fitted (`fit_array_gmwm(...).model`); without drift.

    Returns:
        The model, such as `state_space` and `UnitErrors` take it, and its accuracy.

    Raises:
        ValueError: Weights of another number of sensors, or an array with a process that has no spectrum or is left
            without any noise.

    Example:
        >>> bands = fit_multiscale(recording)
        >>> noise = virtual_noise(bands.weights, fit_array_gmwm(recording, "WN + AR1 + RW").model)
        >>> assumed = UnitErrors(noise.model.scaled(math.radians(1)), accelerometer, rate)
    """
    if weights.ndim not in (1, 2) or weights.shape[-1] != array.n_sensors:
        raise ValueError(
            f"`weights`: expected (sensor,) or (band, sensor) for the {array.n_sensors} sensors of `array`, "
            f"got shape {tuple(weights.shape)}"
        )
    if any(process.deterministic for process, _ in array.components):
        raise ValueError("`array`: expected noise, got a Drift, which has no spectrum; leave it out")
    bands = weights.detach().double().cpu().reshape(-1, array.n_sensors)
    tones = [part for part in array.components if part[0].has_line]
    noise = [part for part in array.components if not part[0].has_line]
    lines = [_tone(process, _square(matrix), bands) for process, matrix in tones]
    if len(bands) == 1:
        left = [(process, (bands[0] @ _square(matrix) @ bands[0]).item()) for process, matrix in noise]
        return VirtualNoise(_sum(_scaled(left) + lines), 0.0)
    own: list[Process] = [process for process, _ in noise if process.has_memory()]
    slowest = max([-1 / math.log(float(process.params[0])) for process in own if process.params[0] > 0], default=1.0)
    # Four octaves below the slowest band and the slowest AR1 only a random walk still changes.
    octaves = max(len(bands), math.ceil(math.log2(max(slowest, 1.0)))) + 4
    f = torch.exp2(-1 - (torch.arange(octaves * _NODES, dtype=torch.float64) + 0.5) / _NODES)
    through = response(bands, f)  # (sensor, frequency)
    spectrum = torch.zeros_like(f)
    for process, matrix in noise:
        power = torch.einsum("af,ab,bf->f", through.conj(), _square(matrix).to(through), through).real
        spectrum += process.spectrum(f) * power
    processes, deviation = _approximated(f, spectrum, octaves, own)
    return VirtualNoise(_sum(processes + lines), deviation)


def response(bands: Tensor, f: Tensor) -> Tensor:
    """Complex response `(sensor, frequency)` of weights `(band, sensor)` at frequencies in cycles per sample."""
    length = torch.exp2(torch.arange(len(bands), dtype=torch.float64))[:, None]
    phase = torch.pi * f
    means = torch.polar((phase * length).sin() / (phase.sin() * length), phase * (1 - length))  # of 2**k samples
    split = torch.cat([means[:-1] - means[1:], means[-1:]])  # (band, frequency)
    return bands.to(split).mT @ split


def _approximated(f: Tensor, spectrum: Tensor, octaves: int, own: list[Process]) -> tuple[list[Model], float]:
    """Processes whose spectra add up to one, by least squares of the relative difference, and how far they are off."""
    per_octave = 2  # AR1s in an octave of time constants: the spectrum of any one between them is followed
    times = torch.exp2(torch.arange(octaves * per_octave, dtype=torch.float64) / per_octave)
    units: list[Process] = [WhiteNoise(1.0), QuantizationNoise(1.0), RandomWalk(1.0)]
    units += [AR1(math.exp(-1 / time), 1.0) for time in times.tolist()] + own
    relative = torch.stack([unit.spectrum(f) for unit in units], -1) / spectrum[:, None]  # (frequency, process)
    size = relative.square().mean(0).sqrt()
    design = relative / size
    shares = nonnegative_least_squares(design.mT @ design, design.sum(0))
    # A millionth of the power at every frequency is a rounding of the other processes.
    shares = torch.where((design * shares).amax(0) > 1e-6, shares, 0.0)
    # A filter that integrates depends on the power in every octave.
    power = (design @ shares * spectrum).unflatten(0, (octaves, _NODES)) * f.unflatten(0, (octaves, _NODES))
    exact = (spectrum * f).unflatten(0, (octaves, _NODES)).sum(-1)
    off = (power.sum(-1) / exact - 1).abs().max().item()
    return _scaled(list(zip(units, (shares / size).tolist(), strict=True))), off


def _scaled(parts: list[tuple[Process, float]]) -> list[Model]:
    """Processes times a power; a model may hold one of some kinds only, whose powers add up."""
    repeated = [process.scaled(math.sqrt(power)) for process, power in parts if process.repeatable and power > 0]
    single: dict[str, Model] = {}
    for process, power in parts:
        if not process.repeatable and power > 0:
            before = single[process.key].params if process.key in single else 0.0
            single[process.key] = process.with_params(before + process.params * power)
    return [*single.values(), *repeated]


def _tone(process: Process, squared: Tensor, bands: Tensor) -> Model:
    amplitude, beta = process.params.unbind(-1)
    through = response(bands, beta.double().reshape(1) / (2 * torch.pi))[:, 0]
    power = (through.conj() @ squared.to(through) @ through).real.clamp(min=0)
    return Sinusoid(float(amplitude * power.sqrt()), float(beta))


def _square(matrix: Tensor) -> Tensor:
    """Covariance `(sensor, sensor)` of a component that may be given by gains."""
    matrix = matrix.double().cpu()
    return matrix[:, None] * matrix if matrix.ndim == 1 else matrix


def _sum(models: list[Model]) -> Model:
    if not models:
        raise ValueError("`array`: expected noise that the weights leave something of, got none")
    return functools.reduce(operator.add, models)
