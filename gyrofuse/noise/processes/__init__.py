"""Noise processes of rate sensors: one class, one equation; they compose with `+` into a model.

Haar wavelet variances `nu` are those of level `j`, filter length `tau = 2**j`; frequencies `f` are in cycles
per sample. The formulas are those of Voirol et al., Accounting for Vibration Noise in Stochastic Measurement
Errors, appendix C, where a process names no other source.

A new process is one file with a subclass of `Process` and one line in `PROCESSES`: text, dictionaries, fits, ranking,
state spaces, datasheets and exports find it there.
"""

from __future__ import annotations

from typing import Any

from gyrofuse.noise.model import Model, SpectralLine
from gyrofuse.noise.processes.ar1 import AR1
from gyrofuse.noise.processes.base import Process, States, WhiteAndWalk
from gyrofuse.noise.processes.drift import Drift
from gyrofuse.noise.processes.flicker_noise import FlickerNoise
from gyrofuse.noise.processes.haar_kernel import haar_kernel
from gyrofuse.noise.processes.matern32 import Matern32
from gyrofuse.noise.processes.quantization_noise import QuantizationNoise
from gyrofuse.noise.processes.random_walk import RandomWalk
from gyrofuse.noise.processes.sinusoid import Sinusoid
from gyrofuse.noise.processes.white_noise import WhiteNoise

__all__ = [
    "AR1",
    "PROCESSES",
    "Drift",
    "FlickerNoise",
    "Matern32",
    "Model",
    "Process",
    "QuantizationNoise",
    "RandomWalk",
    "Sinusoid",
    "SpectralLine",
    "States",
    "WhiteAndWalk",
    "WhiteNoise",
    "haar_kernel",
]

# All processes, in the order in which a sum of them is written. Constructors differ, hence no common type.
PROCESSES: tuple[type[Any], ...] = (
    WhiteNoise,
    QuantizationNoise,
    FlickerNoise,
    AR1,
    Matern32,
    RandomWalk,
    Drift,
    Sinusoid,
)
