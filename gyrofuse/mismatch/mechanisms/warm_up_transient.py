"""A warm-up: a bias that decays after power-on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case, Scene
from gyrofuse.mismatch.mechanism import Finding
from gyrofuse.mismatch.slow_effect import (
    SlowEffect,
    estimate,
    log_factors,
    only,
    place,
    plausible,
    slow_finding,
    strong_scan,
)
from gyrofuse.mismatch.slow_families import warm_ups
from gyrofuse.mismatch.slow_scans import concerned

_PLACES = 200


@dataclass(frozen=True, eq=False)
class WarmUpTransient(SlowEffect):
    """`x_i(t) = size_i exp(-t / tau)` in every sensor `i`, `t` from the first sample.

    A curve at the beginning that no channel follows, the same in all sensors but for its size. A random walk goes
    anywhere at any time. Temperature that rises after power-on does the same: the channel decides, where there is one.

    Attributes:
        size: At the first sample, `(sensor,)`, unit of the signal.
        time_constant_s: `tau`, s.
    """

    name: ClassVar[str] = "warm_up_transient"
    time_constant_s: float

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        strong = strong_scan(case, cls.name, level)
        if strong is None:
            return None
        look, scan = strong.look, strong.scan
        low, high = plausible(look, scan)
        taus = torch.logspace(math.log10(low), math.log10(high), _PLACES, dtype=torch.float64)
        found = estimate(look, scan, warm_ups(case, taus))
        tau = place(found.place, case.scene.rate)
        effect = cls(only(found.size, concerned(scan)), log_factors(scan), tau.value)
        words = f"decays after the start with a time constant of {tau.value:.3g} s"
        return slow_finding(case, strong, effect, found, words, {"time_constant": tau}, time_s=0.0)

    def path(self, n_samples: int, scene: Scene) -> Tensor:
        return (-scene.seconds(n_samples) / self.time_constant_s).exp()
