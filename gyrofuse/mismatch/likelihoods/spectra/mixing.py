"""Which real mixing of sensors the cross-spectra of a recording show, beside what a simulation's sensors share.

Signals `x = M y` of `y` of any powers and coherences `C_b` have the log likelihood, but for a constant and with the
powers at their likeliest,

    L(M) = -sum_b d_b [sum_i log (M^-1 S_b M^-T)_ii + 2 log |det M| + log |C_b| + tr C_b^-1 K_b],

with the coherences `K_b` of `M^-1 S_b M^-T`. It is largest where those are as near to `C_b` as they can be in all bands
together; of independent `y`, where the matrices are as diagonal as they can be (Pham). What a sensor has of another one
is told from what that one has of it by their spectra alone: of alike ones, and white ones above all, any rotation does
as well. Where `y` has the spectra of a simulation, powers tell more: of what coherences leave open the mixing is chosen
that the likelihood of the whole matrices prefers, `-sum_b d_b [log |M Y_b M^T| + tr (M Y_b M^T)^-1 S_b]`.

References:
    Pham, Joint approximate diagonalization of positive definite Hermitian matrices, SIAM Journal on Matrix Analysis and
    Applications 22 (2001), 1136.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER
from gyrofuse.mismatch.likelihoods.spectra.coherence import coherence_of


class Mixing(NamedTuple):
    """A mixing that was fitted.

    Attributes:
        matrix: `M - 1`, `(sensor, sensor)`: of the row's sensor what it has of the column's.
        free: Which entries were fitted, `(sensor, sensor)`.
        sd: Their standard deviations; zero where none was fitted.
        gain: Log likelihood ratio to none, nats.
    """

    matrix: Tensor
    free: Tensor
    sd: Tensor
    gain: float

    @property
    def worth(self) -> float:
        """The gain less what its numbers cost."""
        return self.gain - NATS_PER_NUMBER * int(self.free.sum())


class _Seen(NamedTuple):
    """What is known of it.

    Attributes:
        spectra: Cross-spectra of a recording, `(band, sensor, sensor)`.
        dof: Complex ordinates of each, `(band,)`.
        coherence: What a simulation's sensors share, `(band, sensor, sensor)`.
    """

    spectra: Tensor
    dof: Tensor
    coherence: Tensor

    def unmixed(self, matrix: Tensor) -> tuple[Tensor, Tensor]:
        """Powers `(band, sensor)` and coherences `(band, sensor, sensor)` without a mixing."""
        inverse = torch.linalg.inv(torch.eye(len(matrix), dtype=matrix.dtype) + matrix).to(self.spectra.dtype)
        left = inverse @ self.spectra @ inverse.mT
        power = left.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300)
        return power, coherence_of(left)

    def log_likelihood(self, matrix: Tensor) -> float:
        """`L`, but for what the coherences of the simulation alone make of it."""
        power, coherence = self.unmixed(matrix)
        volume = torch.linalg.slogdet(torch.eye(len(matrix), dtype=matrix.dtype) + matrix).logabsdet
        surprise = torch.linalg.solve(self.coherence, coherence).diagonal(dim1=-2, dim2=-1).real.sum(-1)
        return -float((self.dof * (power.log().sum(-1) + 2 * volume + surprise)).sum())

    def normal_equations(self, matrix: Tensor) -> tuple[Tensor, Tensor]:
        """Of each entry together with its mirror image.

        Returns:
            Right-hand sides `(sensor, sensor)`, and the information `(sensor, sensor, 2)`: of an entry itself, and with
            its mirror image.
        """
        power, coherence = self.unmixed(matrix)
        weight = 2 * self.dof[:, None, None]  # of real parts, which have half of the variance
        over = (power[:, None, :] / power[:, :, None]).sqrt()  # coherence that a part of the column's makes in the row
        itself = (weight * over.square()).sum(0)
        mirrored = weight.sum(0).expand_as(itself)
        slope = (weight * over * (coherence - self.coherence).real).sum(0)
        return slope + itself * matrix + mirrored * matrix.mT, torch.stack([itself, mirrored], -1)


def mixing_of(spectra: Tensor, dof: Tensor, coherence: Tensor, free: Tensor | None = None) -> Mixing:
    """The likeliest mixing.

    Entries are drawn towards none by their own scatter: where spectra are alike two sensors could change places.

    Args:
        spectra: Cross-spectra of a recording, `(band, sensor, sensor)`.
        dof: Complex ordinates of each, `(band,)`.
        coherence: What the simulation's sensors share, `(band, sensor, sensor)`.
        free: Entries that are fitted; by default those of pairs that gain more than their numbers cost.
    """
    seen, p, first_sd = _Seen(spectra, dof, coherence), spectra.shape[-1], 0.03
    matrix = torch.zeros(p, p, dtype=torch.float64)
    chosen = _worth(*seen.normal_equations(matrix), first_sd) if free is None else free
    if bool(chosen.any()):
        matrix = _settled(seen, matrix, chosen, first_sd)
        scatter = 2 * float(matrix[chosen].square().mean().sqrt())
        matrix = _settled(seen, matrix, chosen, max(scatter, 1e-6))
    else:
        scatter = first_sd
    sd = _solved(*seen.normal_equations(matrix), chosen, max(scatter, 1e-6))[1]
    return Mixing(matrix, chosen, sd, seen.log_likelihood(matrix) - seen.log_likelihood(torch.zeros_like(matrix)))


def of_known_powers(
    found: Mixing, spectra: Tensor, dof: Tensor, coherence: Tensor, unmixed: Tensor, *, fewer: bool = True
) -> Mixing:
    """The mixing that the powers of a simulation prefer among those that coherences leave open; else the same.

    Nor is it looked for where as many sensors share something as a source in common makes of them.

    Args:
        found: The one that coherences alone prefer.
        spectra: Cross-spectra of a recording, `(band, sensor, sensor)`.
        dof: Complex ordinates of each, `(band,)`.
        coherence: What the simulation's sensors share, `(band, sensor, sensor)`.
        unmixed: Cross-spectra of the simulation, `(band, sensor, sensor)`.
        fewer: Whether pairs that gain less than their numbers cost are left out.
    """
    most, by_chance = 60, 1.0  # entries, and standard deviations
    if not 0 < int(found.free.sum()) <= most:
        return found
    free, seen = found.free, _Seen(spectra, dof, coherence)
    matrix, sd, value = _scored(spectra, dof, unmixed, free)
    if not math.isfinite(value):  # a band in which a simulation has next to nothing
        return found
    while fewer and int(free.sum()) > 2:
        # Either of two may stand for the other: pairs have nothing where both together have nothing.
        size = torch.where(free, (matrix + matrix.mT).abs() / (sd.square() + sd.mT.square()).sqrt(), math.inf)
        gone = (size <= max(by_chance, float(size.min()))) & (size < size[free].max())
        without = _scored(spectra, dof, unmixed, free & ~gone) if bool(gone.any()) else None
        if without is None or value - without[2] > NATS_PER_NUMBER * int((free & gone).sum()):
            break
        free, (matrix, sd, value) = free & ~gone, without
    gain = seen.log_likelihood(matrix) - seen.log_likelihood(torch.zeros_like(matrix))
    known = Mixing(matrix, free, sd, gain)
    return known if known.worth > found.worth - NATS_PER_NUMBER * int(found.free.sum()) else found


def _scored(spectra: Tensor, dof: Tensor, unmixed: Tensor, free: Tensor) -> tuple[Tensor, Tensor, float]:
    """Entries of most likelihood with known powers, their standard deviations, and it, by Fisher's scoring.

    Rotations that change nothing are drawn to none: of alike spectra the mixing is symmetric then.
    """
    rounds, least, wide = 40, 1e-7, 0.3  # wide: standard deviation of the prior
    p, (rows, columns) = len(free), free.nonzero(as_tuple=True)
    eye, matrix = torch.eye(p, dtype=torch.float64), torch.zeros(p, p, dtype=torch.float64)

    def log_posterior(matrix: Tensor) -> float:
        mixed = (eye + matrix).to(unmixed.dtype)
        whole = mixed @ unmixed @ mixed.mT
        solved, failed = torch.linalg.solve_ex(whole, spectra)
        if bool(failed.any()):  # no mixing makes of independent signals fewer
            return -math.inf
        surprise = solved.diagonal(dim1=-2, dim2=-1).real.sum(-1)
        fit = (dof * (torch.linalg.slogdet(whole).logabsdet + surprise)).sum()
        return -float(fit + (matrix / wide).square().sum() / 2)

    value, sd = log_posterior(matrix), torch.zeros_like(matrix)
    for _ in range(rounds if math.isfinite(value) else 0):
        mixed = (eye + matrix).to(unmixed.dtype)
        half = unmixed @ mixed.mT  # Y M^T
        inverse = torch.linalg.inv(mixed @ half)
        slopes = torch.zeros(len(rows), len(dof), p, p, dtype=unmixed.dtype)  # of the whole matrices
        for k, (i, j) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True)):
            slopes[k, :, i] += half[:, j]
            slopes[k, :, :, i] += half[:, j].conj()
        turned = inverse @ slopes
        residual = inverse @ (spectra - mixed @ half)
        score = torch.einsum("b,kbij,bji->k", dof.to(turned.dtype), turned, residual).real - matrix[free] / wide**2
        information = torch.einsum("b,kbij,lbji->kl", dof.to(turned.dtype), turned, turned).real
        information += torch.eye(len(rows), dtype=information.dtype) / wide**2
        step = torch.linalg.solve(information, score)
        shorter = 1.0
        while True:
            new = matrix.clone()
            new[free] += shorter * step
            made = log_posterior(new)
            if made >= value or shorter < least:
                break
            shorter /= 2
        sd[free] = torch.linalg.inv(information).diagonal().sqrt()
        if not made >= value:
            break
        moved, matrix, value = float((new - matrix).abs().max()), new, made
        if moved < least:
            break
    return matrix, sd, value


def _settled(seen: _Seen, matrix: Tensor, free: Tensor, prior_sd: float) -> Tensor:
    """Where the normal equations no longer move it."""
    rounds, least = 30, 1e-7
    for _ in range(rounds):
        new, _ = _solved(*seen.normal_equations(matrix), free, prior_sd)
        step, matrix = float((new - matrix).abs().max()), new
        if step < least:
            break
    return matrix


def _solved(wanted: Tensor, information: Tensor, free: Tensor, prior_sd: float) -> tuple[Tensor, Tensor]:
    """Entries and their standard deviations, each beside its mirror image where that is free as well."""
    own, with_other = information[..., 0] + 1 / prior_sd**2, information[..., 1] * (free & free.mT)
    determinant = own * own.mT - with_other.square()
    entry = (own.mT * wanted - with_other * wanted.mT) / determinant
    return torch.where(free, entry, 0.0), torch.where(free, (own.mT / determinant).sqrt(), 0.0)


def _worth(wanted: Tensor, information: Tensor, prior_sd: float) -> Tensor:
    """Pairs whose entries gain more than they cost, `(sensor, sensor)`; both, since either may stand for the other."""
    p = len(wanted)
    every = ~torch.eye(p, dtype=torch.bool)
    entry, _ = _solved(wanted, information, every, prior_sd)
    gain = (entry * wanted + (entry * wanted).mT) / 2
    cost = 2 * NATS_PER_NUMBER + torch.tensor(p * (p - 1) / 2).log()  # which pair is searched
    return every & (gain > cost)
