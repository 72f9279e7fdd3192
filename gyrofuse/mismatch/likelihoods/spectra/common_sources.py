"""Spectral components that sensors share: noise of one source, with a gain in every sensor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.components import Term, oscillation, peak_step, peak_within
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground
from gyrofuse.noise.processes import AR1


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

    def t_values(self, sd: Tensor) -> Tensor:
        """Gains over their standard deviations, `(sensor,)`, from those of their parts `sd`."""
        return (self.variance.sqrt() / sd.square().nanmean(0).sqrt()).nan_to_num(nan=0.0)

    def rises_below(self, sd: Tensor) -> bool:
        # A source that one sensor alone surely has: with a second one, correlations would show it too.
        return self.kind == "ar1" and float(self.t_values(sd).topk(2).values[-1]) < 5

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
        return common_density(self.kind, ground.nodes, shared.exp())

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
            replace(self, free=self.free.any(0).expand_as(self.free)),
        ]
        whole = (ground.density / self.shape(ground, self.shared)).amin(-1).sqrt()
        size = (self.variance.sqrt() / whole).clamp(min=most)
        parts = (replace(form, inside=True, whole=whole, local=form.local * most / size) for form in forms)
        every = [*forms, *(part.only(part.free & seen) for part in parts)]
        return [form for form in every if (form.turned, form.inside) != (self.turned, self.inside)]

    @classmethod
    def starts(
        cls, ground: Ground, excess: Tensor, information: Tensor, kind: str, shared: Tensor
    ) -> tuple[Common, Common]:
        """In phase but for signs, and with any phases; arguments as of `start`."""
        free = torch.tensor([[True], [False]]).expand(2, excess.shape[-1])
        aligned = cls.start(ground, excess.real.to(excess.dtype), information, kind, shared)
        # Vectors of real matrices are real but for a factor.
        g = aligned.gain
        g = (g * g[g.abs().argmax()].conj().sgn()).real
        local = torch.stack([g, torch.zeros_like(g)])
        return replace(aligned, local=local, free=free), cls.start(ground, excess, information, kind, shared)

    @classmethod
    def start(cls, ground: Ground, excess: Tensor, information: Tensor, kind: str, shared: Tensor) -> Common:
        """Gains from the strongest direction of an excess.

        Args:
            ground: Noise of the reference.
            excess: Cross-spectra beyond a model, over the noise's densities, `(band, sensor, sensor)`.
            information: Information of a band, `(band,)`.
            kind: Kind of source.
            shared: Its shared numbers.
        """
        p = excess.shape[-1]
        nothing = cls(torch.zeros(2, p, dtype=torch.float64), torch.ones(2, p, dtype=torch.bool), shared, kind)
        level = ground.whole.mT.sqrt()
        c = ground.bands.mean_of(nothing.shape(ground, shared))  # (band,)
        size = c[:, None, None] / (level[:, :, None] * level[:, None, :])
        weight = (information[:, None, None] * size).to(excess.dtype)
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
        return torch.full_like(self.local, math.inf), peak_step(self.shared)

    def within(self) -> CommonBump:
        return replace(self, shared=peak_within(self.shared, self.narrowest))

    def variants(self, ground: Ground, seen: Tensor) -> list[Common]:
        return []


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
