"""Twins of a recording in which nothing is missing: what witnesses say when recording and simulation agree.

A twin has a recording and a simulation of its own, both drawn from the noise that describes the simulation, as long as
those given and with the same auxiliary channels: whatever finite lengths and chance do, they do to twins as well.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.testimony import combined, testimony

FEWEST = 50
_TAIL = 0.25  # share of the twins behind the fitted tail


def twin(case: Case, generator: torch.Generator) -> Case:
    """A recording and a simulation that agree, drawn from what describes the simulation."""
    model = case.base.model()
    n_records, _, n = case.simulated.signal.shape
    recording = model.simulate(case.n_samples, generator=generator)
    return Case.of(case.scene, recording, model.simulate(n, batch=(n_records,), generator=generator))


def twin_p_values(case: Case, n_twins: int, generator: torch.Generator) -> Tensor:
    """p values of all witnesses together among twins, `(twin,)`: uniform, as far as every witness is honest."""
    values = [combined(testimony(twin(case, generator))) for _ in range(n_twins)]
    return torch.tensor(values, dtype=torch.float64)


def calibrated(p_value: float, among: Tensor) -> float:
    """p value of agreement from its rank among those of twins `(twin,)`.

    Beyond the smallest quarter of them the tail is fitted instead of counted: `-log p` has an exponential tail, with
    rate one where witnesses are honest. The maximum of its likelihood is the inverse mean excess.
    """
    scores, own = -among.clamp(min=1e-300).log(), -math.log(max(p_value, 1e-300))
    threshold = float(scores.quantile(1 - _TAIL))
    if own <= threshold:
        return float(((scores >= own).sum() + 1) / (len(scores) + 1))
    excess = scores[scores > threshold] - threshold
    return _TAIL * math.exp(-(own - threshold) / float(excess.mean()))
