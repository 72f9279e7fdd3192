"""Arrays whose simulation lacks a spectral shape."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.likelihoods.spectra.components import (
    oscillation,
)
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import filter_response, filter_strength
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode
from gyrofuse.mismatch.mechanisms.spectra.bumps.resonance import Resonance
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_tone import DriftingTone
from gyrofuse.mismatch.mechanisms.spectra.common_source import CommonMode
from gyrofuse.mismatch.mechanisms.spectra.low_pass import LowPassFilter
from gyrofuse.mismatch.mechanisms.spectra.parameter_change import ParameterShift
from gyrofuse.mismatch.mechanisms.spectra.slopes.flicker import FlickerNoise
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.filters import filtered, noise
from gyrofuse.noise.array_model import ArrayModel

N, P, RATE = 16384, 6, 100.0


WHITE = 1e-4
BUMP = Mode(0.12, 0.01, torch.ones(6, dtype=torch.complex128), False)
SIGNS = torch.tensor([1.0, 1.0, -1.0, 0.5, 1.0, 1.0], dtype=torch.float64)
CATALOGUE = (ParameterShift, LowPassFilter, Resonance, DriftingTone, FlickerNoise, CommonMode)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def comparison(recording: Tensor, simulation: Tensor) -> Comparison:
    return Comparison.of(
        RecordingInfo(RATE, "deg/s", tuple(map(str, range(recording.shape[-2])))), recording, simulation
    )


def array(white: float = WHITE, phi: float = 0.99) -> ArrayModel:
    sensor = [gf.WhiteNoise(white * (1 + i / 20)) + gf.AR1(phi, 2e-7) + gf.RandomWalk(1e-9) for i in range(P)]
    return ArrayModel.from_sensors(sensor)


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def drawn(seed: int, change: Callable[[Tensor, torch.Generator], Tensor] | None = None, n: int = N) -> Comparison:
    g = generator(seed)
    recording, simulation = array().simulate(n, generator=g), array().simulate(n, batch=(4,), generator=g)
    return comparison(recording if change is None else change(recording, g), simulation)


def nominated(given: Comparison, level: float = 1e-3) -> Finding | None:
    found = [f for f in (m.detect_and_fit(given, level) for m in CATALOGUE) if f is not None]
    return max(found, key=lambda f: f.gain, default=None)


def oscillating(g: torch.Generator, centre: float, width: float, rows: int, n: int = N) -> Tensor:
    return noise(n, lambda f: oscillation(f, tensor(centre)[0], tensor(width)[0]), rows, g)


def wandering(g: torch.Generator, n: int = N) -> Tensor:
    speed = noise(n, lambda f: 1 / (1e-8 + f.square()), 1, g)[0]
    return torch.cos(2 * math.pi * (0.1 + 0.002 * speed / speed.std()).cumsum(0))


CHANGES: dict[str, tuple[str, Callable[[Tensor, torch.Generator], Tensor], dict[str, float]]] = {
    "levels": ("parameter_shift", lambda x, g: 1.1 * x, {"white_factor[2]": 1.1**2}),
    "filter": (
        "low_pass",
        lambda x, g: filtered(
            x, lambda f: filter_response("bilinear2", filter_strength("bilinear2", tensor(*(P * [0.3]))), f)
        ),
        {"corner[1]": 30.0},
    ),
    "own modes": (
        "resonance",
        lambda x, g: x + 0.004 * oscillating(g, 0.1, 0.01, P),
        {"frequency": 10.0, "width": 2.0, "rms[3]": 0.004},
    ),
    "one mode": (
        "resonance",
        lambda x, g: x + 0.004 * oscillating(g, 0.1, 0.002, 1) * SIGNS[:, None],
        {"frequency": 10.0, "width": 0.4, "rms[3]": 0.002},
    ),
    "tone": ("drifting_tone", lambda x, g: x + 0.004 * wandering(g) * SIGNS[:, None], {"amplitude[0]": 0.004}),
    "flicker": ("flicker", lambda x, g: x + 1e-3 * noise(N, torch.reciprocal, P, g), {"level[4]": 2**0.5 * 1e-3}),
    "white in common": (
        "common_mode",
        lambda x, g: x + 0.004 * torch.randn(1, N, generator=g, dtype=torch.float64) * SIGNS[:, None],
        {"gain[0]": 0.004, "gain[3]": 0.002},
    ),
    "a walk in common": (
        "common_mode",
        lambda x, g: x + 3e-4 * torch.randn(1, N, generator=g, dtype=torch.float64).cumsum(-1) * SIGNS[:, None],
        {"gain[0]": 3e-4, "gain[3]": 1.5e-4},
    ),
}
