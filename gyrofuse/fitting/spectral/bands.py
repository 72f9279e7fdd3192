"""Variances of the cosine ordinates of a record, in bands: what noise processes give there, and what was measured."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import torch
from torch import Tensor

from gyrofuse._base.transforms import tone_in_cosines
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.dct_bands import SINGLE, DCTBands
from gyrofuse.noise.processes import Process

_TONE_HALF_WIDTH = 32  # ordinates on either side of a sinusoid over which it takes degrees of freedom


class BandSpectrum:
    """The processes of a model that have a continuous spectrum.

    Attributes:
        which: Their places among the processes.
        processes: They themselves, without values.
        moving: Places in `which` of those with a nonlinear parameter.
        at_x: Places of these among the shaped processes.
    """

    def __init__(self, structure: ModelStructure) -> None:
        self.which = [k for k, p in enumerate(structure.processes) if p.gaussian]
        self.processes: list[Process] = [structure.processes[k] for k in self.which]
        self.moving = [i for i, p in enumerate(self.processes) if p.shape_name is not None]
        self.at_x = [structure.nonlinear.index(self.which[i]) for i in self.moving]

    def columns(self, bins: Bins, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Variances `u` `(item, band, process)` for `p = 1`, and their first and second derivatives `(item, band, x)`.

        Args:
            bins: Bands.
            x: Unconstrained nonlinear parameters, `(item, x)`.
        """
        size = len(x), len(bins.count)
        found = [process.unit_band_variance(bins, own) for process, own in self._with_shapes(x)]
        values = torch.stack([one.value.expand(size) for one in found], -1)
        slopes = [one.slope for one in found if one.slope is not None]
        if not slopes:
            empty = x.new_empty(*size, 0)
            return values, empty, empty
        curvatures = [one.curvature for one in found if one.curvature is not None]
        return values, torch.stack(slopes, -1), torch.stack(curvatures, -1)

    def variances(self, bins: Bins, p: Tensor, x: Tensor) -> Tensor:
        """Variance of the ordinates, `(item, band)`."""
        return (self.columns(bins, x)[0] @ p[..., None])[..., 0]

    def density(self, f: Tensor, p: Tensor, x: Tensor) -> Tensor:
        """Spectral density `(item, frequency)`, cycles per sample."""
        total = p.new_zeros(len(p), len(f))
        pairs = zip(self._with_shapes(x[..., None]), p[..., None].unbind(-2), strict=True)
        for (process, own), size in pairs:
            total += process._spectrum(f, **process.from_scale_and_shape(size, own))
        return total

    def _with_shapes(self, x: Tensor) -> Iterable[tuple[Process, Tensor | None]]:
        at = iter(x.unbind(1))
        return ((process, None if process.shape_name is None else next(at)) for process in self.processes)


class Bins(DCTBands):
    """Bands of the cosine ordinates of records, and what records and sinusoids have in them."""

    def energy(self, ordinates: Iterable[Tensor]) -> Tensor:
        """Sums of squared ordinates, given for some items `(item, k)` at a time, `(item, band)`."""
        single = min(SINGLE, self.n_samples - 1)
        parts = []
        for values in ordinates:
            power = values.square()
            bands = [power[:, a:b].sum(-1, keepdim=True) for a, b in itertools.pairwise(self.edges[single:])]
            parts.append(torch.cat([power[:, 1 : single + 1], *bands], -1))
        return torch.cat(parts)

    def taken_by(self, betas: Tensor, phases: Tensor) -> Tensor:
        """Degrees of freedom that amplitude, phase and frequency of sinusoids take from each band, `(item, band)`.

        Args:
            betas: Angular frequencies `(item, tone)`, rad per sample.
            phases: Phases `(item, tone)`, rad, of sines at `t = 1, 2, ..`.
        """
        n = self.n_samples
        edges = torch.tensor(self.edges, device=betas.device)
        total = self.count.new_zeros(len(betas), len(self.count))
        reach = torch.arange(-_TONE_HALF_WIDTH, _TONE_HALF_WIDTH + 1, device=betas.device)
        for beta, phase in zip(betas.unbind(-1), phases.unbind(-1), strict=True):
            k = (beta * n / math.pi).round()[:, None] + reach  # (item, ordinate)
            inside = (k >= 1) & (k <= n - 1)
            even, odd, slopes = tone_in_cosines(beta[:, None], k, n)
            turn = (phase + beta * (n + 1) / 2)[:, None]  # in the middle of the record
            moved = turn.sin() * slopes[0] + turn.cos() * slopes[1]
            columns = torch.stack([even, odd, moved / n], -1) * inside[..., None]
            leverage = torch.linalg.qr(columns)[0].square().sum(-1)
            place = torch.bucketize(k.clamp(1, n - 1).long(), edges, right=True) - 1
            total.scatter_add_(-1, place, leverage * inside)
        return total
