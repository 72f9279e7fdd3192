"""A bias that depends on the way by which a temperature was reached: a loop, where a drift is a line.

A relay is up once the temperature has passed an upper threshold, down once it has passed a lower one, and stays as it
is between the two: the element of which Preisach (1935) composes hysteresis. Relays of a grid of thresholds are scanned
like other slow effects.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.slow.scans import Scan, slow_analysis
from gyrofuse.mismatch.likelihoods.slow_noise import ordinates
from gyrofuse.mismatch.likelihoods.slow_templates import Family, temperature_rows
from gyrofuse.mismatch.signals.comparison import Comparison, block_means
from gyrofuse.mismatch.signals.derived import derived


def hysteresis_test(comparison: Comparison) -> TestResult:
    """Relays that a temperature switches, at other values on its way up than on its way down."""
    scan = strongest_relay(comparison)
    if scan is None:
        return TestResult("hysteresis", 1.0, "there is no temperature that goes to and fro")
    largest = max(scan.sensors, key=lambda i: float(scan.z[i].abs()))
    return TestResult(
        "hysteresis",
        scan.p_value,
        f"the bias depends on the way by which {scan.family.channel} was reached, most clearly in sensor "
        f"{comparison.info.sensors[largest]}",
        sensors=scan.sensors,
        channel=scan.family.channel,
    )


@derived
def strongest_relay(comparison: Comparison) -> Scan | None:
    """The best relay, corrected for all channels and thresholds."""
    families = []
    for channel, row in temperature_rows(comparison):
        means = block_means(comparison.info.channel_rows(channel)[row, : comparison.n_samples])
        paths = relays(means)
        if len(paths) > 1:
            number = torch.arange(len(paths), dtype=torch.float64)[:, None]
            families.append(Family("hysteresis", number, ordinates(paths)[:, None], "", channel, row))
    return replace(slow_analysis(comparison), families=tuple(families)).scan("hysteresis") if families else None


def relays(temperature: Tensor, thresholds: int = 14) -> Tensor:
    """Different relays `(relay, time)`, -1 and 1, of a temperature; what switches once is a step, and left out.

    Args:
        temperature: Means over blocks, `(time,)`.
        thresholds: Quantiles of the temperature, each pair of which makes a relay.
    """
    levels = temperature.quantile(torch.linspace(0, 1, thresholds + 2, dtype=temperature.dtype)[1:-1])
    pairs = torch.combinations(levels)
    lower, upper = pairs[:, :1], pairs[:, 1:]
    switched = (temperature > upper).to(torch.int8) - (temperature < lower).to(torch.int8)  # 0 where it stays
    time = torch.arange(len(temperature))
    last = torch.where(switched != 0, time, -1).cummax(-1).values
    first = torch.where(temperature[0] > pairs.mean(-1, keepdim=True), 1, -1)
    state = torch.where(last >= 0, switched.gather(-1, last.clamp(min=0)).long(), first)
    state = state[(state.diff(dim=-1) != 0).sum(-1) >= 2]
    return torch.unique(state, dim=0).to(temperature.dtype)
