"""Which real mixing of independent sensors the cross-spectra of a recording show.

Signals `x = M y` of independent `y` of any spectra have the log likelihood, but for a constant and with the powers at
their likeliest,

    L(M) = -sum_b d_b [sum_i log (M^-1 S_b M^-T)_ii + 2 log |det M|].

It is largest where `M^-1 S_b M^-T` is as diagonal as it can be in all bands together (Pham). What a sensor has of
another one is told from what that one has of it by their spectra alone: of alike ones only the sum is known.

References:
    Pham, Joint approximate diagonalization of positive definite Hermitian matrices, SIAM Journal on Matrix Analysis and
    Applications 22 (2001), 1136.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER

_PRIOR_SD = 0.3  # of an entry: more than cross-talk has, and less than lets two sensors change places


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


def mixing_of(spectra: Tensor, dof: Tensor, free: Tensor | None = None) -> Mixing:
    """The likeliest mixing.

    Args:
        spectra: Cross-spectra of a recording, `(band, sensor, sensor)`.
        dof: Complex ordinates of each, `(band,)`.
        free: Entries that are fitted; by default those of pairs that gain more than their numbers cost.
    """
    rounds, settled, p = 60, 1e-7, spectra.shape[-1]
    matrix = torch.zeros(p, p, dtype=torch.float64)
    chosen = ~torch.eye(p, dtype=torch.bool) if free is None else free
    for turn in range(rounds):
        wanted, information = _normal_equations(spectra, dof, matrix)
        if free is None and turn < rounds // 2:  # then they stay
            chosen = _worth(wanted, information)
        new = _solved(wanted, information, chosen)[0]
        step, matrix = float((new - matrix).abs().max()), new
        if step < settled:
            break
    sd = _solved(*_normal_equations(spectra, dof, matrix), chosen)[1]
    return Mixing(matrix, chosen, sd, _log_likelihood(spectra, dof, matrix) - _log_likelihood(spectra, dof, 0 * matrix))


def _unmixed(spectra: Tensor, matrix: Tensor) -> Tensor:
    inverse = torch.linalg.inv(torch.eye(len(matrix), dtype=matrix.dtype) + matrix).to(spectra.dtype)
    return inverse @ spectra @ inverse.mT


def _log_likelihood(spectra: Tensor, dof: Tensor, matrix: Tensor) -> float:
    own = _unmixed(spectra, matrix).diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300)
    volume = torch.linalg.slogdet(torch.eye(len(matrix), dtype=matrix.dtype) + matrix).logabsdet
    return -float((dof * (own.log().sum(-1) + 2 * volume)).sum())


def _normal_equations(spectra: Tensor, dof: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Of each entry together with its mirror image: the slopes at none, and the information.

    Slopes `(sensor, sensor)`; information `(sensor, sensor, 2)`: of an entry itself, and with its mirror image.
    """
    left = _unmixed(spectra, matrix)
    own = left.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300)  # (band, sensor)
    weight = 2 * dof[:, None, None]  # of real parts: half of the variance of complex ones
    ratio = own[:, None, :] / own[:, :, None]  # what a part of the column's adds, over the row's
    itself = (weight * ratio).sum(0)
    mirrored = weight.sum(0).expand_as(itself)
    slope = (weight * left.real / own[:, :, None]).sum(0)
    return slope + itself * matrix + mirrored * matrix.mT, torch.stack([itself, mirrored], -1)


def _solved(wanted: Tensor, information: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
    """Entries and their standard deviations, each beside its mirror image where that is free as well."""
    own, with_other = information[..., 0] + 1 / _PRIOR_SD**2, information[..., 1] * (free & free.mT)
    determinant = own * own.mT - with_other.square()
    entry = (own.mT * wanted - with_other * wanted.mT) / determinant
    return torch.where(free, entry, 0.0), torch.where(free, (own.mT / determinant).sqrt(), 0.0)


def _worth(wanted: Tensor, information: Tensor) -> Tensor:
    """Pairs whose entries gain more than they cost, `(sensor, sensor)`; both, since either may stand for the other."""
    p = len(wanted)
    every = ~torch.eye(p, dtype=torch.bool)
    entry, _ = _solved(wanted, information, every)
    gain = (entry * wanted + (entry * wanted).mT) / 2
    cost = 2 * NATS_PER_NUMBER + torch.tensor(p * (p - 1) / 2).log()  # which pair is searched
    return every & (gain > cost)
