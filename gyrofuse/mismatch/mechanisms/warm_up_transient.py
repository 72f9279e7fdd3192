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
    sizes,
    slow_levels,
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
        look, scan, alternatives = strong
        low, high = plausible(look, scan)
        taus = torch.logspace(math.log10(low), math.log10(high), _PLACES, dtype=torch.float64)
        found = estimate(look, scan, warm_ups(case, taus))
        which = concerned(scan)
        tau = place(found.place, case.scene.rate)
        effect = cls(only(found.size, which), log_factors(scan), tau.value)
        largest = max(which, key=lambda i: abs(float(found.size[i])))
        return Finding(
            cls.name,
            effect,
            f"the bias of {case.scene.named(which)} decays after the start with a time constant of "
            f"{tau.value:.3g} s, by up to {abs(float(found.size[largest])):.3g} {case.scene.unit} "
            f"(sensor {case.scene.sensors[largest]})",
            scan.p_value,
            which,
            {"time_constant": tau, **sizes("size", found, which, case.scene.unit)},
            levels=slow_levels(case.n_samples),
            alternatives=alternatives,
            time_s=0.0,
            gain=scan.gain,
        )

    def path(self, n_samples: int, scene: Scene) -> Tensor:
        return (-scene.seconds(n_samples) / self.time_constant_s).exp()
