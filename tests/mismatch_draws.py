"""Draws and nominations that tests of impulsive mechanisms share."""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse import AR1, RandomWalk, WhiteNoise
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.selection.held_out import score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import sd_of_sum

LEVEL = 5e-4
N, RATE = 16384, 100.0
SCENE = RecordingInfo(RATE, "deg/s", ("x", "y", "z"))
NOISE = WhiteNoise(1.0) + AR1(0.98, 0.004) + RandomWalk(1e-5)


def even(*shape: int, g: torch.Generator) -> Tensor:
    return torch.rand(shape, generator=g, dtype=torch.float64)


def normal(*shape: int, g: torch.Generator) -> Tensor:
    return torch.randn(shape, generator=g, dtype=torch.float64)


def nominated(comparison: Comparison, mechanism: type[Mechanism]) -> Finding:
    found = mechanism.detect_and_fit(comparison, LEVEL)
    assert found is not None
    return found


def drawn(seed: int, records: int = 4) -> tuple[Tensor, Tensor, torch.Generator]:
    g = torch.Generator().manual_seed(seed)
    recording = NOISE.simulate(N, batch=(3,), generator=g)
    return recording, NOISE.simulate(N, batch=(records, 3), generator=g), g


def settled(comparison: Comparison, found: Finding, g: torch.Generator) -> Comparison:
    """The case after the repair, in which the same is not found again; the repair gains on data held out."""
    gain = score_held_out(comparison, found.effect)
    assert gain.blocks.shape == (32,)
    assert gain.total > 1.7 * sd_of_sum(gain.blocks)
    after = found.effect.repair(comparison, g)
    assert type(found.effect).detect_and_fit(after, LEVEL) is None
    return after


def covers(found: Finding, name: str, truth: float) -> bool:
    parameter = found.parameters[name]
    return parameter.low - 1e-9 <= truth <= parameter.high + 1e-9
