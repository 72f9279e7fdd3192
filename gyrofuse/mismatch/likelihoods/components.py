"""Spectral shapes that compete: what each makes of the spectra of a simulation, with its numbers as plain tensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.filter_forms import filter_power, strength_of
from gyrofuse.mismatch.likelihoods.reference_spectrum import Ground
from gyrofuse.noise.processes import AR1

_T = TypeVar("_T", bound="Term")


@dataclass(frozen=True, eq=False)
class Term:
    """One shape with its numbers.

    Attributes:
        local: Numbers of each sensor, `(number, sensor)`, and which of them are free.
        shared: Numbers that sensors share, `(number,)`.
    """

    name: ClassVar[str]
    prior_scale: ClassVar[tuple[float, ...]] = ()  # of local numbers around zero, heavy tails: `spectral.prior_cost`
    # Standard deviations of local and shared numbers before any data, which evidence counts: of logarithms, where a
    # local number is a size. A factor of 4.5, or of 7, either way.
    local_sd: ClassVar[float] = 1.5
    shared_sd: ClassVar[float] = 2.0
    lower: ClassVar[float] = -math.inf
    upper: ClassVar[float] = math.inf
    acts: ClassVar[str] = "add"  # or "scale" the noise, or "filter" everything

    local: Tensor
    free: Tensor
    shared: Tensor

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        """Factors on spectra, or densities added, `(..., sensor, place)`, of numbers with leading dimensions."""
        raise NotImplementedError

    def prior(self) -> Tensor | None:
        """Scales of local numbers around zero, `(number, sensor)` or `(number, 1)`, of heavy tails; None without."""
        return torch.tensor(self.prior_scale, dtype=torch.float64)[:, None] if self.prior_scale else None

    def reach(self) -> Tensor:
        """How far shared numbers may go at once."""
        return torch.full_like(self.shared, 0.7)

    def local_reach(self) -> Tensor:
        """How far local numbers may go at once."""
        return torch.full_like(self.local, math.inf)

    def unit(self) -> Tensor:
        """Local numbers per unit in which `local_sd` is told: of a size, itself."""
        return self.local.abs() if self.acts == "add" else torch.ones_like(self.local)

    def only(self: _T, free: Tensor) -> _T:
        """With those local numbers free `(number, sensor)`, the others 0."""
        return replace(self, free=free, local=torch.where(free, self.local, 0.0))

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
    # A level that changes by much more than this is rare, but not by how much.
    prior_scale: ClassVar[tuple[float, ...]] = (1.5, 1.5, 1.5, 1.5)
    lower: ClassVar[float] = -30.0  # nothing is left, in double precision
    upper: ClassVar[float] = 30.0

    new: Tensor | None = None

    @classmethod
    def start(cls, ground: Ground) -> Shift:
        white, coloured, walk = ground.matters
        free = torch.stack([white, coloured, coloured, walk])
        local, shared = torch.zeros(4, free.shape[-1], dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
        return cls(local, free, shared, ground.parts.lacks[1])

    def only(self, free: Tensor) -> Shift:
        if self.new is not None:
            free = torch.stack([free[0], free[1], free[2] | (free[1] & self.new), free[3]])
        return super().only(free)

    @classmethod
    def starts(cls, ground: Ground) -> list[Shift]:
        """All numbers free, and those of single parts, each with many values, `local` is `(start, 4, sensor)`."""
        every = cls.start(ground)
        found = []
        for rows, values in zip((torch.ones(4, dtype=torch.bool), *_SINGLE), _VALUES, strict=True):
            one = every.only(every.free & rows[:, None])
            if bool(one.free.any()):
                found.append(replace(one, local=torch.tensor(values, dtype=torch.float64)[:, :, None] * one.free))
        return found

    @property
    def parts(self) -> Tensor:
        """Which rows of numbers are free in some sensor, `(number,)`."""
        return self.free.any(-1)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        return ground.parts.shifted(local) / ground.density


# White noise, the level of the AR1s, level and corner, the walk.
_SINGLE = torch.tensor([[1, 0, 0, 0], [0, 1, 0, 0], [0, 1, 1, 0], [0, 0, 0, 1]], dtype=torch.bool)
_LEVELS = (0.0, -9.0, -4.0, -1.5, -0.5, 0.5, 1.5, 3.0, 5.0, 8.0)  # log factors of a power to start from
_CORNERS = (-3.0, -1.5, 0.0, 1.5, 3.0, 4.5)  # of a corner: AR1s far from what they were, where no slope leads to
_MOVED = tuple((0.0, level, corner, 0.0) for level in (0.0, 2.0, 4.0, 6.0) for corner in _CORNERS)
# Of the AR1s' plateau gone, filters and white noise that falls are told apart by the evidence, not by where it starts.
_VALUES: tuple[tuple[tuple[float, ...], ...], ...] = (
    ((0.0, 0.0, 0.0, 0.0), *_MOVED, *((x, 0.0, 0.0, 0.0) for x in _LEVELS), *((x, x, 0.0, x) for x in _LEVELS)),
    tuple((x, 0.0, 0.0, 0.0) for x in _LEVELS),
    tuple((0.0, x, 0.0, 0.0) for x in _LEVELS),
    ((0.0, 0.0, 0.0, 0.0), *_MOVED),
    tuple((0.0, 0.0, 0.0, x) for x in _LEVELS),
)


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
        free = torch.ones(1, len(ground.mean), dtype=torch.bool)
        return cls(local, free, torch.zeros(0, dtype=torch.float64), kind)

    def local_reach(self) -> Tensor:
        return torch.full_like(self.local, 0.7)  # a factor of two

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        power = filter_power(self.kind, strength_of(self.kind, local[..., 0, :]), ground.places)
        return torch.where(self.free[0, :, None], power, 1.0)


@dataclass(frozen=True, eq=False)
class Flicker(Term):
    """`a / f` added: the local number is `a`."""

    name: ClassVar[str] = "flicker"
    lower: ClassVar[float] = 0.0

    @classmethod
    def start(cls, ground: Ground) -> Flicker:
        unit = (ground.density * ground.places).amin(-1)
        return cls(0.1 * unit[None], torch.ones(1, len(unit), dtype=torch.bool), torch.zeros(0, dtype=torch.float64))

    @classmethod
    def starts(cls, ground: Ground) -> Flicker:
        """Levels to start from, `local` is `(start, 1, sensor)`."""
        start = cls.start(ground)
        return replace(start, local=torch.logspace(-1, 6, 15, dtype=torch.float64)[:, None, None] * start.local)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        return local[..., 0, :, None] / ground.places


@dataclass(frozen=True, eq=False)
class PowerLaw(Term):
    """`b (f0/f)^slope` added: the local number is `b`, shared is the slope. What flicker noise is set against."""

    name: ClassVar[str] = "power_law"
    lower: ClassVar[float] = 0.0

    @classmethod
    def like(cls, flicker: Flicker, ground: Ground) -> PowerLaw:
        """To start from flicker noise."""
        return cls(flicker.local / cls._middle(ground), flicker.free, torch.ones(1, dtype=torch.float64))

    @staticmethod
    def _middle(ground: Ground) -> float:
        """`f0`: where level and slope have little to do with each other."""
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
        shared = torch.tensor([math.log(centre), math.log(width)], dtype=torch.float64)
        return cls(variance[None], torch.ones(1, len(variance), dtype=torch.bool), shared)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        centre, width = shared[..., 0, None].exp(), shared[..., 1, None].exp()
        return local[..., 0, :, None] * oscillation(ground.places, centre, width)[..., None, :]

    def reach(self) -> Tensor:
        return _bump_reach(self.shared)

    def within(self) -> Peak:
        return replace(self, local=self.local.clamp(min=0.0), shared=_bump_within(self.shared, self.narrowest))


_MOST = 0.95  # of a sensor's noise that a fit starts with in a common source: where correlations still have a slope


@dataclass(frozen=True, eq=False)
class Common(Term):
    """Noise of one source in every sensor: local are the real and imaginary parts of the gains, or real ones alone.

    Shared is the logarithm of the corner, cycles per sample, for an AR1.

    Attributes:
        kind: White, AR1 or walk.
        inside: Whether it is a part of what each sensor has, whose power stays, instead of coming on top.
        whole: Gains at which that part is all that a sensor has, `(sensor,)`. Two sensors alone tell but the product of
            their gains; with these as scales of a prior they have like parts.
    """

    name: ClassVar[str] = "common_mode"

    kind: str = "white"
    inside: bool = False
    whole: Tensor | None = None

    def prior(self) -> Tensor | None:
        return None if self.whole is None else self.whole[None]

    def told(self, sd: Tensor) -> Tensor:
        """Standard deviations that each sensor's gain is, `(sensor,)`, by those of its parts `(number, sensor)`."""
        return (self.local.square().sum(0).sqrt() / sd.square().nanmean(0).sqrt()).nan_to_num(nan=0.0)

    def acting(self, matrix: Tensor) -> Tensor:
        """What comes on top of a matrix `(..., sensor, sensor)` of a source."""
        return matrix - torch.diag_embed(matrix.diagonal(dim1=-2, dim2=-1)) if self.inside else matrix

    def variants(self, ground: Ground, seen: Tensor) -> list[Common]:
        """The same in phase or not, on top or inside.

        Inside with gains of a part that is less than the whole, and in the sensors `(sensor,)` that were seen to have
        it: what chance gives the others would tell how two that are alone share the product of their gains.
        """
        aligned = self.free.clone()
        aligned[1] = False
        forms = [
            replace(self, free=aligned, local=self.local * aligned),
            replace(self, free=torch.ones_like(self.free)),
        ]
        whole = (ground.density / self.shape(ground, self.shared)).amin(-1).sqrt()
        size = (self.local.square().sum(0).sqrt() / whole).clamp(min=_MOST)
        parts = (replace(form, inside=True, whole=whole, local=form.local * _MOST / size) for form in forms)
        return [*forms, *(part.only(part.free & seen) for part in parts)]

    def shape(self, ground: Ground, shared: Tensor) -> Tensor:
        """Density of the source, `(..., place)`."""
        return common_density(self.kind, ground.places, shared.exp())

    def within(self) -> Common:
        return replace(self, shared=self.shared.clamp(max=math.log(0.45))) if self.kind == "ar1" else self

    @property
    def turned(self) -> bool:
        """Whether sensors have phases of their own, beside signs."""
        return bool(self.free[1].any())

    @classmethod
    def starts(cls, ground: Ground, excess: Tensor, worth: Tensor, kind: str, shared: Tensor) -> tuple[Common, Common]:
        """In phase but for signs, and with any phases."""
        free = torch.tensor([[True], [False]]).expand(2, excess.shape[-1])
        aligned = cls.start(ground, excess.real.to(excess.dtype), worth, kind, shared)
        # Vectors of real matrices are real but for a factor.
        g = torch.complex(*aligned.local)
        g = (g * g[g.abs().argmax()].conj().sgn()).real
        local = torch.stack([g, torch.zeros_like(g)])
        return replace(aligned, local=local, free=free), cls.start(ground, excess, worth, kind, shared)

    @classmethod
    def start(cls, ground: Ground, excess: Tensor, worth: Tensor, kind: str, shared: Tensor) -> Common:
        """Gains from the strongest direction of an excess `(band, sensor, sensor)` over the noise's densities."""
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

    def reach(self) -> Tensor:
        return _bump_reach(self.shared)

    def within(self) -> CommonBump:
        return replace(self, shared=_bump_within(self.shared, self.narrowest))


def _bump_reach(shared: Tensor) -> Tensor:
    """A centre goes no further at once than half its width."""
    return torch.stack([(shared[1] - shared[0]).exp() / 2, torch.tensor(0.7, dtype=torch.float64)])


def _bump_within(shared: Tensor, narrowest: float) -> Tensor:
    centre = shared[0].clamp(max=math.log(0.49))
    # Broader ones would not be seen to fall on both sides.
    widest = torch.minimum(centre - math.log(2), (0.5 - centre.exp()).log() - math.log(2))
    return torch.stack([centre, torch.minimum(torch.maximum(shared[1], centre + math.log(narrowest)), widest)])


def common_density(kind: str, f: Tensor, shared: Tensor) -> Tensor:
    """Density of a source: white, AR1s and oscillations of variance one, walks of increments of variance one.

    `shared` are the corner of an AR1, or centre and half width of an oscillation, cycles per sample.
    """
    if kind == "white":
        return torch.ones_like(f)
    if kind == "walk":
        return 1 / (4 * torch.sin(math.pi * f.clamp(min=1e-12)).square())
    if kind == "oscillation":
        return oscillation(f, shared[0], shared[1])
    phi = torch.exp(-2 * math.pi * shared[0])
    return AR1._spectrum(f, phi, 1 - phi.square())
