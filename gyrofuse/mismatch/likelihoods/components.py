"""Spectral components that compete: what each makes of the spectra of a simulation, its numbers as plain tensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER
from gyrofuse.mismatch.likelihoods.filter_forms import FILTERS, filter_power, strength_of
from gyrofuse.mismatch.likelihoods.reference_spectrum import Ground
from gyrofuse.noise.processes import AR1

_T = TypeVar("_T", bound="Term")
_NO_SHARED = torch.zeros(0, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Term:
    """One component with its numbers.

    Attributes:
        local: Numbers of each sensor, `(number, sensor)`.
        free: Which of them are fitted, `(number, sensor)`.
        shared: Numbers that sensors share, `(number,)`.
    """

    name: ClassVar[str]  # of the mechanism
    acts: ClassVar[str] = "add"  # or "scale" the noise, "filter" everything
    coherent: ClassVar[bool] = False  # whether sensors share it
    lower: ClassVar[float] = -math.inf  # bounds of local numbers
    upper: ClassVar[float] = math.inf
    prior_scale: ClassVar[float | None] = None  # of local numbers around zero, heavy tails: `spectral.prior_cost`
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
    """

    name: ClassVar[str] = "parameter_shift"
    acts: ClassVar[str] = "scale"
    prior_scale: ClassVar[float | None] = 1.5  # a level that changes by much more is rare, but not by how much
    lower: ClassVar[float] = -30.0  # nothing is left, in double precision
    upper: ClassVar[float] = 30.0

    new: Tensor | None = None

    @classmethod
    def start(cls, ground: Ground) -> Shift:
        """All numbers free, none changed."""
        white, coloured, walk = ground.matters
        free = torch.stack([white, coloured, coloured, walk])
        return cls(torch.zeros(4, free.shape[-1], dtype=torch.float64), free, _NO_SHARED, ground.parts.lacks[1])

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

    @property
    def parts(self) -> Tensor:
        """Which rows of numbers are free in some sensor, `(number,)`."""
        return self.free.any(-1)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        return ground.parts.shifted(local) / ground.density

    def n_free(self, ground: Ground) -> int:
        return int(Shift.start(ground).free[self.parts].sum())

    def form_cost(self, n_sensors: int) -> float:
        white, ar1, corner, walk = self.parts
        n_parts = int(white) + int(ar1 | corner) + int(walk)
        return super().form_cost(n_sensors) + 2 * NATS_PER_NUMBER * (n_parts - 1)

    def everywhere(self, ground: Ground) -> Term:
        return replace(self, free=Shift.start(ground).free & self.parts[:, None])


@dataclass(frozen=True, eq=False)
class LowPass(Term):
    """A filter of each sensor: its local number is `log g(f_c)` of the form, see `filter_forms`.

    In it the information of a spectrum is about even, from corners far below half the rate to filters that hardly show.
    """

    name: ClassVar[str] = "low_pass"
    acts: ClassVar[str] = "filter"
    lower: ClassVar[float] = -8.0  # corner at the rate over 10^4
    upper: ClassVar[float] = math.log(1000)  # a tangent that is reached at 0.4997 of the rate: no band shows it

    kind: str = "pole"

    @classmethod
    def starts(cls, ground: Ground, kind: str) -> LowPass:
        """Corners to start from: all in one, `local` is `(start, 1, sensor)`."""
        numbers = torch.linspace(math.log(0.012), math.log(100), 37, dtype=torch.float64)
        local = numbers[:, None, None].expand(-1, 1, len(ground.mean)).clone()
        return cls(local, torch.ones(1, len(ground.mean), dtype=torch.bool), _NO_SHARED, kind)

    def step_limit(self) -> tuple[Tensor, Tensor]:
        return torch.full_like(self.local, 0.7), self.shared

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        power = filter_power(self.kind, strength_of(self.kind, local[..., 0, :]), ground.places)
        return torch.where(self.free[0, :, None], power, 1.0)

    def form_cost(self, n_sensors: int) -> float:
        return super().form_cost(n_sensors) + math.log(len(FILTERS))

    def everywhere(self, ground: Ground) -> Term:
        faint = 2.5  # number of a filter that changes the power at 0.45 of the rate by a third
        return replace(self, free=torch.ones_like(self.free), local=torch.where(self.free, self.local, faint))


@dataclass(frozen=True, eq=False)
class Flicker(Term):
    """`a / f` added: the local number is `a`."""

    name: ClassVar[str] = "flicker"
    lower: ClassVar[float] = 0.0

    @classmethod
    def start(cls, ground: Ground) -> Flicker:
        """A tenth of the noise where it is the largest share."""
        unit = (ground.density * ground.places).amin(-1)
        return cls(0.1 * unit[None], torch.ones(1, len(unit), dtype=torch.bool), _NO_SHARED)

    @classmethod
    def starts(cls, ground: Ground) -> Flicker:
        """Levels to start from, `local` is `(start, 1, sensor)`."""
        start = cls.start(ground)
        return replace(start, local=torch.logspace(-1, 6, 15, dtype=torch.float64)[:, None, None] * start.local)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        return local[..., 0, :, None] / ground.places


@dataclass(frozen=True, eq=False)
class PowerLaw(Term):
    """`b (f0/f)^slope` added: the local number is `b`, shared is the slope. What flicker noise is tested against."""

    name: ClassVar[str] = "power_law"
    lower: ClassVar[float] = 0.0

    @classmethod
    def like(cls, flicker: Flicker, ground: Ground) -> PowerLaw:
        """To start from flicker noise."""
        return cls(flicker.local / cls._middle(ground), flicker.free, torch.ones(1, dtype=torch.float64))

    @staticmethod
    def _middle(ground: Ground) -> float:
        """`f0`: where level and slope are hardly correlated."""
        return math.sqrt(float(ground.places[0]) * 0.5)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        falls = (self._middle(ground) / ground.places) ** shared[..., :1]
        return local[..., 0, :, None] * falls[..., None, :]

    def within(self) -> PowerLaw:
        return replace(self, local=self.local.clamp(min=0.0), shared=self.shared.clamp(0.2, 2.0))


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
        return local[..., 0, :, None] * oscillation(ground.places, centre, width)[..., None, :]

    def step_limit(self) -> tuple[Tensor, Tensor]:
        return torch.full_like(self.local, math.inf), _peak_step(self.shared)

    def within(self) -> Peak:
        return replace(self, local=self.local.clamp(min=0.0), shared=_peak_within(self.shared, self.narrowest))


@dataclass(frozen=True, eq=False)
class Common(Term):
    """Noise of one source in every sensor: local are the real and imaginary parts of the gains, or real ones alone.

    Shared is the logarithm of the corner, cycles per sample, for an AR1.

    Attributes:
        kind: White, AR1, walk or oscillation.
        inside: Whether it is a part of the noise that each sensor has, whose power stays, instead of coming on top.
        whole: Gains at which that part is all that a sensor has, `(sensor,)`. Of two sensors alone correlations show
            but the product of the gains; with these as scales of a prior they have like parts.
    """

    name: ClassVar[str] = "common_mode"
    coherent: ClassVar[bool] = True

    kind: str = "white"
    inside: bool = False
    whole: Tensor | None = None

    @property
    def gain(self) -> Tensor:
        """Complex gains, `(sensor,)`."""
        return torch.complex(*self.local)

    @property
    def variance(self) -> Tensor:
        """Variances, `(sensor,)`."""
        return self.local.square().sum(0)

    @property
    def turned(self) -> bool:
        """Whether sensors have phases of their own, beside signs."""
        return bool(self.free[1].any())

    def prior(self) -> Tensor | None:
        return None if self.whole is None else self.whole[None]

    def n_free(self, ground: Ground) -> int:
        p = self.local.shape[-1]
        return (2 * p - 1 if self.turned else p) + 2 * len(self.shared)

    def form_cost(self, n_sensors: int) -> float:
        # An AR1 that is too slow to show its corner is a walk: what is searched are eight corners.
        return math.log(8) if self.kind == "ar1" else 0.0

    def everywhere(self, ground: Ground) -> Term:
        return self

    def told(self, sd: Tensor) -> Tensor:
        """Standard deviations that each sensor's gain is from zero, `(sensor,)`, by those of its parts `sd`."""
        return (self.variance.sqrt() / sd.square().nanmean(0).sqrt()).nan_to_num(nan=0.0)

    def matrix(self) -> Tensor:
        """What it adds to the covariance of sensors, `(sensor, sensor)`, over the density of the source."""
        return self.acting(self.gain[:, None] * self.gain.conj())

    def acting(self, matrix: Tensor) -> Tensor:
        """What of a source's matrix `(..., sensor, sensor)` changes spectra."""
        return matrix - torch.diag_embed(matrix.diagonal(dim1=-2, dim2=-1)) if self.inside else matrix

    def derivatives(self) -> Tensor:
        """Derivatives of `matrix` with respect to local numbers, `(number, sensor, sensor)`."""
        row = torch.eye(len(self.gain), dtype=self.gain.dtype)[:, :, None] * self.gain.conj()  # e_i g^H
        return self.acting(torch.cat([row + row.mH, 1j * row + (1j * row).mH]))

    def shape(self, ground: Ground, shared: Tensor) -> Tensor:
        """Density of the source, `(..., node)`."""
        return common_density(self.kind, ground.places, shared.exp())

    def within(self) -> Common:
        return replace(self, shared=self.shared.clamp(max=math.log(0.45))) if self.kind == "ar1" else self

    def variants(self, ground: Ground, seen: Tensor) -> list[Common]:
        """The other forms of the same: in phase or not, on top or inside.

        A part inside starts with at most 0.95 of a sensor's noise, where correlations still have a slope.

        Args:
            ground: Noise of the reference.
            seen: Sensors that surely have it, `(sensor,)`, and alone get a part inside: the gains that chance gives to
                others would decide how two sensors share the product of theirs.
        """
        most = 0.95
        aligned = self.free.clone()
        aligned[1] = False
        forms = [
            replace(self, free=aligned, local=self.local * aligned),
            replace(self, free=torch.ones_like(self.free)),
        ]
        whole = (ground.density / self.shape(ground, self.shared)).amin(-1).sqrt()
        size = (self.variance.sqrt() / whole).clamp(min=most)
        parts = (replace(form, inside=True, whole=whole, local=form.local * most / size) for form in forms)
        every = [*forms, *(part.only(part.free & seen) for part in parts)]
        return [form for form in every if (form.turned, form.inside) != (self.turned, self.inside)]

    @classmethod
    def starts(cls, ground: Ground, excess: Tensor, worth: Tensor, kind: str, shared: Tensor) -> tuple[Common, Common]:
        """In phase but for signs, and with any phases; arguments as of `start`."""
        free = torch.tensor([[True], [False]]).expand(2, excess.shape[-1])
        aligned = cls.start(ground, excess.real.to(excess.dtype), worth, kind, shared)
        # Vectors of real matrices are real but for a factor.
        g = aligned.gain
        g = (g * g[g.abs().argmax()].conj().sgn()).real
        local = torch.stack([g, torch.zeros_like(g)])
        return replace(aligned, local=local, free=free), cls.start(ground, excess, worth, kind, shared)

    @classmethod
    def start(cls, ground: Ground, excess: Tensor, worth: Tensor, kind: str, shared: Tensor) -> Common:
        """Gains from the strongest direction of an excess.

        Args:
            ground: Noise of the reference.
            excess: Cross-spectra beyond a model, over the noise's densities, `(band, sensor, sensor)`.
            worth: Information of a band, `(band,)`.
            kind: Kind of source.
            shared: Its shared numbers.
        """
        p = excess.shape[-1]
        nothing = cls(torch.zeros(2, p, dtype=torch.float64), torch.ones(2, p, dtype=torch.bool), shared, kind)
        level = ground.mean.mT.sqrt()
        c = ground.bands.mean_of(nothing.shape(ground, shared))  # (band,)
        size = c[:, None, None] / (level[:, :, None] * level[:, None, :])
        weight = (worth[:, None, None] * size).to(excess.dtype)
        gram = (excess * weight).sum(0) / (weight.real * size).sum(0)
        values, vectors = torch.linalg.eigh((gram + gram.mH) / 2)
        g = vectors[:, -1] * values[-1].clamp(min=1e-300).sqrt()
        return replace(nothing, local=torch.stack([g.real, g.imag]))


@dataclass(frozen=True, eq=False)
class CommonBump(Common):
    """An oscillation of one source in every sensor: shared are the logarithms of centre and half width."""

    name: ClassVar[str] = "resonance"

    kind: str = "oscillation"
    narrowest: float = 0.02

    def step_limit(self) -> tuple[Tensor, Tensor]:
        return torch.full_like(self.local, math.inf), _peak_step(self.shared)

    def within(self) -> CommonBump:
        return replace(self, shared=_peak_within(self.shared, self.narrowest))

    def variants(self, ground: Ground, seen: Tensor) -> list[Common]:
        return []


def _peak_step(shared: Tensor) -> Tensor:
    """A centre goes no further at once than half its width."""
    return torch.stack([(shared[1] - shared[0]).exp() / 2, torch.tensor(0.7, dtype=torch.float64)])


def _peak_within(shared: Tensor, narrowest: float) -> Tensor:
    centre = shared[0].clamp(max=math.log(0.49))
    # Broader ones would not be seen to fall on both sides.
    widest = torch.minimum(centre - math.log(2), (0.5 - centre.exp()).log() - math.log(2))
    return torch.stack([centre, torch.minimum(torch.maximum(shared[1], centre + math.log(narrowest)), widest)])


def common_density(kind: str, f: Tensor, shared: Tensor | Sequence[Tensor]) -> Tensor:
    """Density of a source: white, AR1s and oscillations of variance one, walks of increments of variance one.

    Args:
        kind: "white", "walk", "ar1" or "oscillation".
        f: Cycles per sample.
        shared: Corner of an AR1, or centre and half width of an oscillation, cycles per sample.
    """
    if kind == "white":
        return torch.ones_like(f)
    if kind == "walk":
        return 1 / (4 * torch.sin(math.pi * f.clamp(min=1e-12)).square())
    if kind == "oscillation":
        return oscillation(f, shared[0], shared[1])
    phi = torch.exp(-2 * math.pi * shared[0])
    return AR1._spectrum(f, phi, 1 - phi.square())
