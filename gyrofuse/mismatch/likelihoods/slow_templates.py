"""Templates of slow effects: block means of a step, a warm-up, or a lagging temperature of size one.

Mechanisms declare theirs as subclasses of `SlowTemplates`; scans know them by that alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.declared import declared
from gyrofuse.mismatch.likelihoods.slow_noise import ordinates, slow_ordinates
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, RecordingInfo
from gyrofuse.mismatch.signals.filters import late

# A grid of templates is as fine as keeps neighbours correlated by 0.9 or more, where the noise is white.
_TIME_CONSTANTS = 24
_LAGS = 16


@dataclass(frozen=True, eq=False)
class Family:
    """Templates of one mechanism on a grid of its nonlinear numbers.

    Attributes:
        name: Name of the mechanism.
        points: Nonlinear numbers of each template, samples: an onset, one or two time constants, or a lag,
            `(template, number)`.
        designs: Ordinates of the block means of each template for sizes of one, `(template, column, ordinate)`.
        words: What the bias does, with the first nonlinear number in seconds.
        channel: Name of the temperature that it follows, and `row` of that.
        design_at: Designs at other points; None where only those of the grid exist.
        jumps: Whether templates are jumps at once: several of them, in any order, are another path than one.
        timed: Whether the first nonlinear number is a time after the first sample.
        decays: Whether what begins then goes back to where it was.
        form: Of a drift with a temperature.
        becomes: Name of the mechanism that its shortest templates are: no look-alike of that.
    """

    name: str
    points: Tensor
    designs: Tensor
    words: str
    channel: str | None = None
    row: int = 0
    design_at: Callable[[Tensor], Tensor] | None = None
    jumps: bool = False
    timed: bool = False
    decays: bool = False
    form: ThermalForm | None = None
    becomes: str = ""

    def at(self, points: Tensor) -> Family:
        """The same mechanism at other points `(template, number)`."""
        assert self.design_at is not None
        return replace(self, points=points, designs=self.design_at(points))


class SlowTemplates:
    """What a mechanism declares to be scanned for."""

    @classmethod
    def families(cls, comparison: Comparison) -> Iterable[Family]:
        """Its templates in a comparison; none by default."""
        return ()


def declared_families(comparison: Comparison) -> tuple[Family, ...]:
    """Templates of all mechanisms that declare any."""
    return tuple(family for kind in declared(SlowTemplates) for family in kind.families(comparison))


def steps(comparison: Comparison) -> Family:
    """Steps at the edges of blocks and in their middles."""
    at, block = edges(), comparison.block

    def design_at(points: Tensor) -> Tensor:
        # A step within a block is what lies between those at its two edges.
        place = (points[:, 0] / block - 1).clamp(0, len(at) - 1)
        before = place.floor().long().clamp(max=len(at) - 2)
        return torch.lerp(at[before], at[before + 1], (place - before)[:, None])[:, None]

    onsets = block * torch.arange(1.0, N_BLOCKS - 0.5, 0.5, dtype=torch.float64)[:, None]
    words = "the bias steps near {:.4g} s"
    return Family("step", onsets, design_at(onsets), words, design_at=design_at, jumps=True, timed=True)


def warm_ups(comparison: Comparison, number: int) -> Family:
    """Sums of one or two decays `exp(-t / tau)`, time constants from half a block to the record, the slower one last.

    Two time constants are two steps of the grid apart at least: closer ones are one, with sizes that cancel each other.
    """
    grid = _log_grid(comparison.block / 2, comparison.n_samples, _TIME_CONSTANTS)
    points = grid[:, None] if number == 1 else grid[torch.triu_indices(len(grid), len(grid), 2)].mT
    block = comparison.block

    def design_at(time_constants: Tensor) -> Tensor:
        tau = time_constants[..., None]
        # The mean of a decay over a block is a geometric sum.
        mean = torch.expm1(-block / tau) / torch.expm1(-1 / tau) / block
        return ordinates(mean * (-torch.arange(N_BLOCKS) * block / tau).exp())

    words = "the bias decays after the start, over some {:.3g} s"
    return Family("warm_up_transient", points, design_at(points), words, design_at=design_at)


def temperatures(comparison: Comparison) -> list[Family]:
    """Each row of each temperature in every form of a drift, with lags up to a quarter of the record."""
    grid = _log_grid(comparison.block / 2, comparison.n_samples / 4, _LAGS - 1)
    lags = torch.cat([torch.zeros_like(grid[:1]), grid])[:, None]
    families = []
    for channel, row in temperature_rows(comparison):
        words = f"the bias follows {channel}".replace("{", "{{").replace("}", "}}")
        for most, changes in ((3, False), (2, True)):
            designs_of = partial(_temperature_designs, comparison.info, channel, row, comparison.n_samples)
            points = lags[1:] if changes else lags
            whole = designs_of(ThermalForm(most, changes), points)  # of which those of fewer powers are a part
            for powers in range(1, most + 1):
                form = ThermalForm(powers, changes)
                designs = torch.cat([whole[:, :powers], whole[:, most:]], 1)
                families.append(
                    Family(
                        "temperature_drift", points, designs, words, channel, row, partial(designs_of, form), form=form
                    )
                )
    return families


class ThermalForm(NamedTuple):
    """What a bias has of a temperature.

    Attributes:
        powers: Powers of the temperature, from the first one on.
        changes: Whether it has a share of the temperature's rate of change as well, which is what a lag of its own in
            every sensor looks like.
    """

    powers: int
    changes: bool

    def paths(self, temperature: Tensor, lagging: Tensor, lag: float) -> Tensor:
        """Paths for sizes of one, `(path, time)`.

        Args:
            temperature: Temperature, `(time,)`.
            lagging: The same with a lag.
            lag: The lag, samples or seconds, by which the rate of change is counted.
        """
        at_work = temperature if self.changes else lagging
        path = at_work - at_work[0]
        change = [(temperature - lagging) / lag] if self.changes else []
        return torch.stack([*(path**k for k in range(1, self.powers + 1)), *change])


def temperature_rows(comparison: Comparison) -> list[tuple[str, int]]:
    """Names and rows of the channels that are temperatures, whole, and not constant."""
    return [
        (name, row)
        for name, values in comparison.info.channels.items()
        if name.lower().startswith("temperature")
        for row, channel in enumerate(values.reshape(-1, values.shape[-1]))
        if bool(channel.isfinite().all()) and bool(channel.amax() > channel.amin())
    ]


def _temperature_designs(
    info: RecordingInfo, channel: str, row: int, n_samples: int, form: ThermalForm, lags: Tensor
) -> Tensor:
    """Ordinates of what a drift has of a temperature with lags `(template, 1)`, samples."""
    temperature = lagged(info, channel, row, 0.0, n_samples)
    return torch.stack(
        [
            slow_ordinates(
                form.paths(temperature, lagged(info, channel, row, lag, n_samples, moving=form.changes), lag)
            )
            for lag in lags[:, 0].tolist()
        ]
    )


def lagged(info: RecordingInfo, channel: str, row: int, lag: float, n_samples: int, *, moving: bool = False) -> Tensor:
    """Temperature of what follows a channel with a lag in samples, `tau dy/dt = x - y`, `(time,)`.

    From equilibrium; or, `moving`, from a temperature that had changed at its first rate for long: a rate of change has
    no start of its own. That rate is the slope of the channel over the first lag.
    """
    x = info.channel_rows(channel)[row]
    if len(x) < n_samples:
        raise ValueError(
            f"`channels`: expected {channel!r} at {n_samples} samples or more, got {len(x)}; "
            "give it for the whole record"
        )
    if not moving or lag <= 0:
        return late(x[:n_samples], lag)
    t = torch.arange(n_samples, dtype=torch.float64)
    first = min(max(round(lag), 2), n_samples)
    from_middle = t[:first] - t[:first].mean()
    slope = (x[:first] @ from_middle) / (from_middle @ from_middle)
    return late(x[:n_samples] - slope * t, lag) + slope * (t - 1 / math.expm1(1 / lag))


def edges() -> Tensor:
    """Steps at every edge of blocks, `(edge, ordinate)`."""
    block = torch.arange(N_BLOCKS)
    return ordinates((block >= block[1:, None]).to(torch.float64))


def _log_grid(low: float, high: float, number: int) -> Tensor:
    return torch.logspace(math.log10(low), math.log10(high), number, dtype=torch.float64)
