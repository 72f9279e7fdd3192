"""Twins of a recording in which nothing is missing: what witnesses say when recording and simulation agree.

A twin has a recording and a simulation of its own, both drawn from the noise that describes the simulation, as long as
those given and with the same auxiliary channels: whatever finite lengths and chance do, they do to twins as well.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.testimony import combined, testimony

FEWEST = 50


def twin(case: Case, generator: torch.Generator) -> Case:
    """A recording and a simulation that agree, drawn from what describes the simulation."""
    model = case.base.model()
    n_records, _, n = case.simulated.signal.shape
    recording = model.simulate(case.n_samples, generator=generator)
    simulation = model.simulate(n, batch=(n_records,), generator=generator)
    return Case.of(case.scene, recording, simulation).knowing(case.simulated.lines)


def twin_p_values(case: Case, n_twins: int, generator: torch.Generator) -> Tensor:
    """p values of all witnesses together among twins, `(twin,)`: uniform, as far as every witness is honest."""
    values = [combined(testimony(twin(case, generator))) for _ in range(n_twins)]
    return torch.tensor(values, dtype=torch.float64)
