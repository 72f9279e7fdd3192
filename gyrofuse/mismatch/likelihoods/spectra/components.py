"""Spectral components that compete: what each makes of the spectra of a simulation, its numbers as plain tensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import FILTERS, filter_power, filter_response, strength_of
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground, Parts
from gyrofuse.mismatch.stats.limits import Z

_T = TypeVar("_T", bound="Term")
NO_SHARED = torch.zeros(0, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Term:
    """One component with its numbers.

    Attributes:
        local: Numbers of each sensor, `(number, sensor)`.
        free: Which of them are fitted, `(number, sensor)`.
        shared: Numbers that sensors share, `(number,)`.
    """

    name: ClassVar[str]  # of the mechanism
    acts: ClassVar[str] = "add"  # or "scale" the noise, "filter" everything, "undo" the simulation's filter of it
    coherent: ClassVar[bool] = False  # whether sensors share it
    turns: ClassVar[bool] = False  # whether it moves phases
    lower: ClassVar[float] = -math.inf  # bounds of local numbers
    upper: ClassVar[float] = math.inf
    prior_scale: ClassVar[float | None] = None  # of local numbers around zero, heavy tails: `spectral.prior_cost`
    apart: ClassVar[bool] = False  # whether single numbers of a sensor may be left out
    # Standard deviations of local and shared numbers before any data, which evidence counts: of logarithms, where a
    # local number is a size. A factor of 4.5, or of 7, either way.
    local_sd: ClassVar[float] = 1.5
    shared_sd: ClassVar[float] = 2.0

    local: Tensor
    free: Tensor
    shared: Tensor

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        """Factors on spectra, or densities added, `(..., sensor, node)`, of numbers with leading dimensions."""
        raise NotImplementedError

    def turn(self, f: Tensor) -> Tensor:
        """What it turns each sensor by at `f` cycles per sample, complex of size one, `(sensor, frequency)`."""
        raise NotImplementedError

    def prior(self) -> Tensor | None:
        """Scales of local numbers around zero, that broadcast with them, of heavy tails; None without."""
        return None if self.prior_scale is None else torch.tensor(self.prior_scale, dtype=torch.float64)

    def step_limit(self) -> tuple[Tensor, Tensor]:
        """Largest steps of local `(number, sensor)` and shared numbers in one round of a fit; a factor of two."""
        return torch.full_like(self.local, math.inf), torch.full_like(self.shared, 0.7)

    def unit(self) -> Tensor:
        """Local numbers per unit of `local_sd`: of a size, itself."""
        return self.local.abs() if self.acts == "add" else torch.ones_like(self.local)

    def n_free(self, ground: Ground) -> int:
        """Count of numbers that could have been fitted; a shared one, which was searched, counts twice."""
        return self.local.numel() + 2 * len(self.shared)

    def form_cost(self, n_sensors: int) -> float:
        """Nats for the choice of a form and of the sensors: a subset of that size among all of any size."""
        k = int(self.free.any(0).sum())
        subsets = math.lgamma(n_sensors + 1) - math.lgamma(k + 1) - math.lgamma(n_sensors - k + 1)
        return math.log(n_sensors) + subsets

    def rises_below(self, sd: Tensor) -> bool:
        """Whether a single sensor has more power below some frequency, as one that jumps between two levels has.

        Args:
            sd: Standard deviations of local numbers, all others held.
        """
        return False

    def louder(self, sd: Tensor) -> bool:
        """Whether a single sensor has plainly more of what its noise has at all frequencies.

        Args:
            sd: Standard deviations of local numbers.
        """
        return False

    def grid(self, ground: Ground) -> Term | None:
        """The same form at the numbers to start from, `local` is `(start, number, sensor)`; None without a grid."""
        return None

    def bent(self, ground: Ground) -> Term | None:
        """Noise that falls by any power of frequency, which this may have been chosen for; None where it is not."""
        return None

    def only(self: _T, free: Tensor) -> _T:
        """With those local numbers free `(number, sensor)`, the others 0."""
        return replace(self, free=free, local=torch.where(free, self.local, 0.0))

    def everywhere(self, ground: Ground) -> Term:
        """With numbers for every sensor again: a tenth of the largest, where they were not free."""
        least = self.local.amax(-1, keepdim=True) / 10
        return replace(self, free=torch.ones_like(self.free), local=torch.where(self.free, self.local, least))

    def within(self) -> Term:
        """With numbers that are allowed."""
        return replace(self, local=self.local.clamp(min=self.lower, max=self.upper))


@dataclass(frozen=True, eq=False)
class Shift(Term):
    """Other levels and corners: local numbers as in `Parts.shifted`.

    Attributes:
        new: Sensors that have no AR1, `(sensor,)`: the level of one comes with a corner.
        of: Noise whose parts they are, where a filter has changed it since; that of the ground by default.
    """

    name: ClassVar[str] = "parameter_shift"
    acts: ClassVar[str] = "scale"
    prior_scale: ClassVar[float | None] = 1.5  # a level that changes by much more is rare, but not by how much
    lower: ClassVar[float] = -30.0  # nothing is left, in double precision
    upper: ClassVar[float] = 30.0
    apart: ClassVar[bool] = True

    new: Tensor | None = None
    of: Parts | None = None

    @classmethod
    def start(cls, ground: Ground) -> Shift:
        """All numbers free, none changed."""
        white, coloured, walk = ground.matters
        free = torch.stack([white, coloured, coloured, walk])
        return cls(torch.zeros(4, free.shape[-1], dtype=torch.float64), free, NO_SHARED, ground.parts.lacks[1])

    def only(self, free: Tensor) -> Shift:
        if self.new is not None:
            free = torch.stack([free[0], free[1], free[2] | (free[1] & self.new), free[3]])
        return super().only(free)

    @classmethod
    def starts(cls, ground: Ground) -> list[Shift]:
        """Families of starts, `local` is `(start, 4, sensor)`: all numbers free, and those of single parts.

        Powers start from factors of `e^-9` to `e^8`. Of AR1s both level and corner do, up to `e^4.5` away: no slope
        leads to AR1s that lie far from what they were.
        """
        levels = torch.tensor([0.0, -9.0, -4.0, -1.5, -0.5, 0.5, 1.5, 3.0, 5.0, 8.0], dtype=torch.float64)
        corners = torch.tensor([-3.0, -1.5, 0.0, 1.5, 3.0, 4.5], dtype=torch.float64)
        white, level, corner, walk = torch.eye(4, dtype=torch.float64)
        moved = (torch.cartesian_prod(levels[[0, 6, 8, 9]], corners) @ torch.stack([level, corner])).contiguous()
        families = (
            (torch.ones(4), torch.cat([moved, *(levels[:, None] * row for row in (white, white + level + walk))])),
            (white, levels[:, None] * white),
            (level, levels[:, None] * level),
            (level + corner, moved),
            (walk, levels[:, None] * walk),
        )
        every, found = cls.start(ground), []
        for rows, values in families:
            one = every.only(every.free & (rows > 0)[:, None])
            if bool(one.free.any()):
                found.append(replace(one, local=values[:, :, None] * one.free))
        return found

    @classmethod
    def levels(cls, ground: Ground, log_ratio: Tensor, passed: Tensor) -> list[Shift]:
        """Single parts at a level, and white noise without the AR1 that stands for its filter.

        Args:
            ground: Noise of the simulation.
            log_ratio: Logarithm of the recording's power over it, `(sensor,)`.
            passed: Bands whose level that is, `(band,)`.
        """
        every = cls.start(ground)
        found = [every.only(every.free & row[:, None]) for row in torch.eye(4, dtype=torch.bool)[[0, 1, 3]]]
        found = [replace(one, local=log_ratio * one.free) for one in found if bool(one.free.any())]
        if bool((every.free[0] & every.free[1]).any()):
            grown = ground.parts.densities[0] + ground.parts.unseen_white[:, None]
            share = ground.bands.mean_of(grown) / ground.mean  # (sensor, band)
            white = log_ratio - share[:, passed].clamp(min=1e-9).log().mean(-1)
            none = torch.full_like(white, -9.0)
            local = torch.stack([white, none, torch.zeros_like(white), torch.zeros_like(white)])
            alone = every.only(every.free & torch.tensor([True, True, False, False])[:, None])
            found.append(replace(alone, local=local * alone.free))
        return found

    @property
    def parts(self) -> Tensor:
        """Which rows of numbers are free in some sensor, `(number,)`."""
        return self.free.any(-1)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        parts = ground.parts if self.of is None else self.of
        return parts.shifted(local) / parts.densities.sum(0)

    def n_free(self, ground: Ground) -> int:
        return int(Shift.start(ground).free[self.parts].sum())

    def rises_below(self, sd: Tensor) -> bool:
        return bool((self.local[1:] > 0).any())

    def louder(self, sd: Tensor) -> bool:
        return bool((self.local[0] > Z * sd[0]).any())

    def form_cost(self, n_sensors: int) -> float:
        white, ar1, corner, walk = self.parts
        n_parts = int(white) + int(ar1 | corner) + int(walk)
        return super().form_cost(n_sensors) + 2 * NATS_PER_NUMBER * (n_parts - 1)

    def everywhere(self, ground: Ground) -> Term:
        return replace(self, free=Shift.start(ground).free & self.parts[:, None])

    def bent(self, ground: Ground) -> PowerLaw:
        flicker, concerned = Flicker.start(ground), self.free.any(0, keepdim=True)
        return PowerLaw.like(replace(flicker, free=concerned, local=flicker.local * concerned), ground)


@dataclass(frozen=True, eq=False)
class LowPass(Term):
    """A filter of each sensor: its local number is `log g(f_c)` of the form, see `filter_forms`.

    In it the information of a spectrum is about even, from corners far below half the rate to filters that hardly show.
    """

    name: ClassVar[str] = "low_pass"
    acts: ClassVar[str] = "filter"
    turns: ClassVar[bool] = True
    lower: ClassVar[float] = -8.0  # corner at the rate over 10^4
    upper: ClassVar[float] = math.log(1000)  # a tangent that is reached at 0.4997 of the rate: no band shows it

    kind: str = "pole"

    @classmethod
    def starts(cls, ground: Ground, kind: str) -> LowPass:
        """Corners to start from: all in one, `local` is `(start, 1, 1)`."""
        numbers = torch.linspace(math.log(0.012), math.log(100), 37, dtype=torch.float64)
        return cls(numbers[:, None, None], torch.ones(1, len(ground.mean), dtype=torch.bool), NO_SHARED, kind)

    def grid(self, ground: Ground) -> LowPass:
        return type(self).starts(ground, self.kind)

    def step_limit(self) -> tuple[Tensor, Tensor]:
        return torch.full_like(self.local, 0.7), self.shared

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        power = filter_power(self.kind, strength_of(self.kind, local[..., 0, :]), ground.nodes)
        return torch.where(self.free[0, :, None], power, 1.0)

    def turn(self, f: Tensor) -> Tensor:
        response = filter_response(self.kind, strength_of(self.kind, self.local[0]), f)
        return torch.where(self.free[0, :, None], response.sgn(), 1.0)

    def form_cost(self, n_sensors: int) -> float:
        return super().form_cost(n_sensors) + math.log(len(FILTERS))

    def everywhere(self, ground: Ground) -> Term:
        faint = 2.5  # number of a filter that changes the power at 0.45 of the rate by a third
        return replace(self, free=torch.ones_like(self.free), local=torch.where(self.free, self.local, faint))


@dataclass(frozen=True, eq=False)
class SimulatedLowPass(LowPass):
    """The same filter where it is the simulation that has it."""

    acts: ClassVar[str] = "undo"

    def turn(self, f: Tensor) -> Tensor:
        return super().turn(f).conj()


@dataclass(frozen=True, eq=False)
class Flicker(Term):
    """`a / f` added: the local number is `a`."""

    name: ClassVar[str] = "flicker"
    lower: ClassVar[float] = 0.0

    @classmethod
    def start(cls, ground: Ground) -> Flicker:
        """A tenth of the noise where it is the largest share."""
        unit = (ground.density * ground.nodes).amin(-1)
        return cls(0.1 * unit[None], torch.ones(1, len(unit), dtype=torch.bool), NO_SHARED)

    @classmethod
    def starts(cls, ground: Ground) -> Flicker:
        """Levels to start from, `local` is `(start, 1, sensor)`."""
        start = cls.start(ground)
        return replace(start, local=torch.logspace(-1, 6, 15, dtype=torch.float64)[:, None, None] * start.local)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        return local[..., 0, :, None] / ground.nodes

    def rises_below(self, sd: Tensor) -> bool:
        return True

    def bent(self, ground: Ground) -> PowerLaw:
        return PowerLaw.like(self, ground)


@dataclass(frozen=True, eq=False)
class PowerLaw(Term):
    """`b (f0/f)^slope` added: the local number is `b`, shared is the slope. What flicker noise is tested against.

    Attributes:
        middle: `f0`: where level and slope are hardly correlated, cycles per sample.
    """

    name: ClassVar[str] = "power_law"
    lower: ClassVar[float] = 0.0
    middle: float

    @classmethod
    def like(cls, flicker: Flicker, ground: Ground) -> PowerLaw:
        """To start from flicker noise."""
        middle = math.sqrt(float(ground.nodes[0]) * 0.5)
        return cls(flicker.local / middle, flicker.free, torch.ones(1, dtype=torch.float64), middle)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        falls = (self.middle / ground.nodes) ** shared[..., :1]
        return local[..., 0, :, None] * falls[..., None, :]

    def within(self) -> PowerLaw:
        return replace(self, local=self.local.clamp(min=0.0), shared=self.shared.clamp(0.2, 2.0))

    def rises_below(self, sd: Tensor) -> bool:
        return True


def oscillation(f: Tensor, centre: Tensor, width: Tensor) -> Tensor:
    """Density of an AR2 of variance one with poles at `centre`, half as high `width` beside it, cycles per sample."""
    r, omega = torch.exp(-2 * math.pi * width), 2 * math.pi * centre
    z = torch.polar(torch.ones_like(f), -2 * math.pi * f)
    polynomial = 1 - 2 * r * torch.cos(omega) * z + r.square() * z.square()
    variance = (1 + r**2) / ((1 - r**2) * (1 + r**4 - 2 * r**2 * torch.cos(2 * omega)))
    return 1 / (variance * polynomial.abs().square())


@dataclass(frozen=True, eq=False)
class Peak(Term):
    """An AR2 added: local its variance, shared the logarithms of centre and half width, cycles per sample.

    Attributes:
        narrowest: Least half width that bands can show, over the centre.
    """

    name: ClassVar[str] = "resonance"
    lower: ClassVar[float] = 0.0

    narrowest: float = 0.02

    @classmethod
    def start(cls, centre: float, width: float, variance: Tensor) -> Peak:
        """A peak of variances `(sensor,)` in all sensors."""
        shared = torch.tensor([math.log(centre), math.log(width)], dtype=torch.float64)
        return cls(variance[None], torch.ones(1, len(variance), dtype=torch.bool), shared)

    @property
    def variance(self) -> Tensor:
        """Variances, `(sensor,)`."""
        return self.local[0]

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        centre, width = shared[..., 0, None].exp(), shared[..., 1, None].exp()
        return local[..., 0, :, None] * oscillation(ground.nodes, centre, width)[..., None, :]

    def step_limit(self) -> tuple[Tensor, Tensor]:
        return torch.full_like(self.local, math.inf), peak_step(self.shared)

    def rises_below(self, sd: Tensor) -> bool:
        centre, width = self.shared.exp().tolist()
        return bool(centre < 3 * width)

    def within(self) -> Peak:
        return replace(self, local=self.local.clamp(min=0.0), shared=peak_within(self.shared, self.narrowest))


def peak_step(shared: Tensor) -> Tensor:
    """A centre goes no further at once than half its width."""
    return torch.stack([(shared[1] - shared[0]).exp() / 2, torch.tensor(0.7, dtype=torch.float64)])


def peak_within(shared: Tensor, narrowest: float) -> Tensor:
    """Centre and half width that are allowed."""
    centre = shared[0].clamp(max=math.log(0.49))
    # Broader ones would not be seen to fall on both sides.
    widest = torch.minimum(centre - math.log(2), (0.5 - centre.exp()).log() - math.log(2))
    return torch.stack([centre, torch.minimum(torch.maximum(shared[1], centre + math.log(narrowest)), widest)])
