"""What errors of a fitted model's numbers do to scores of spectra, and whether they are larger than they may be.

Normal scores `u` of the ratios of powers (`shape_bands`) have the covariance `V = V0 + E E'` with `E = sqrt(w) J R`
(`spectral_uncertainty`) and `V0` that of neighbouring bands and of what sensors share. Shapes of a difference are
weighed with `(1 + E E')^-1`; or with what is left outside the tangent space of the parameters, which no numbers of
theirs can imitate.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.likelihoods.band_powers import Narrow, narrow
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.stats.multiplicity import sidak

# Of the largest singular value of tangents of unit length, below which a direction is none: rounding leaves 1e-15, and
# processes that are alike over the whole spectrum cannot be told apart whatever their numbers.
_NO_DIRECTION = 1e-8


class Errors(NamedTuple):
    """Errors of estimation in scores.

    Attributes:
        moved: `E`, scores by independent errors of unit variance, `(sensor, band, error)`.
        tangents: Orthonormal directions in which parameters move each sensor's scores, `(sensor, band, direction)`;
            zero beyond their number.
    """

    moved: Tensor
    tangents: Tensor

    def beside(self, shapes: Tensor) -> Tensor:
        """Shapes `(shape, sensor, band)` weighed with `(1 + E E')^-1`, by Woodbury's identity."""
        inner = torch.eye(self.moved.shape[-1], dtype=shapes.dtype) + self.moved.mT @ self.moved
        along = torch.einsum("hsb,sbe->she", shapes, self.moved)
        return shapes - torch.einsum("sbe,she->hsb", self.moved, torch.linalg.solve(inner, along.mT).mT)

    def outside(self, shapes: Tensor) -> Tensor:
        """Shapes `(shape, sensor, band)` without their parts in the tangent space."""
        along = torch.einsum("hsb,sbd->hsd", shapes, self.tangents)
        return shapes - torch.einsum("sbd,hsd->hsb", self.tangents, along)

    def covariance(self, templates: Tensor) -> Tensor:
        """What errors add to that of scores along templates `(shape, sensor, band)`, `(shape, sensor, sensor)`."""
        along = torch.einsum("hsb,sbe->hse", templates, self.moved)
        return along @ along.mT


@derived
def estimation_errors(comparison: Comparison) -> Errors | None:
    """Of the simulation's model; None where its numbers are known."""
    uncertainty = comparison.reference.uncertainty
    if uncertainty is None:
        return None
    data = narrow(comparison)
    rows = data.worth.sqrt()[:, None] * uncertainty.rows(data.frequency)  # (sensor, band, parameter)
    size = rows.norm(dim=1, keepdim=True)
    directions, strength, _ = torch.linalg.svd(rows / size.clamp(min=1e-300), full_matrices=False)
    there = strength > _NO_DIRECTION * strength[:, :1]
    most = int(there.sum(-1).max())
    return Errors(rows @ uncertainty.root, (directions * there[:, None])[..., :most])


@derived
def parameters_p_value(comparison: Comparison) -> float:
    """p value of the parameters that would suit the recording, for how far they are from the simulation's.

    Chi-square of the scores in the tangent space, all sensors together or one alone.
    """
    data, errors = narrow(comparison), estimation_errors(comparison)
    if errors is None:
        return 1.0
    seen = torch.einsum("sbd,sb->sd", errors.tangents, data.scores)
    covariance = _covariance(data, errors)
    there = errors.tangents.any(1)  # (sensor, direction)
    alone = [_tail(seen[i][own], covariance[i, :, i][own][:, own]) for i, own in enumerate(there)]
    if len(alone) == 1:
        return alone[0]
    every = there.flatten()
    together = _tail(seen.flatten()[every], covariance.flatten(0, 1).flatten(1)[every][:, every])
    return sidak(min(together, sidak(min(alone), len(alone))), 2)


def _covariance(data: Narrow, errors: Errors) -> Tensor:
    """Of the scores along the tangents of all sensors, `(sensor, direction, sensor, direction)`."""
    q = errors.tangents
    apart = data.coherence.clone()
    apart.diagonal(dim1=-2, dim2=-1).fill_(1.0)
    covariance = torch.einsum("ibd,bij,jbe->idje", q, apart, q)
    beside = torch.einsum("ibd,b,ibe->ide", q[:, :-1], data.together, q[:, 1:])
    along = torch.einsum("ibd,ibe->ide", q, errors.moved)
    covariance = covariance + torch.einsum("idr,jer->idje", along, along)
    for i, own in enumerate(beside + beside.mT):
        covariance[i, :, i] += own
    return covariance


def _tail(seen: Tensor, covariance: Tensor) -> float:
    """Upper tail of the chi-square of normal numbers."""
    if not len(seen):
        return 1.0
    return float(stats.chi2.sf(float(seen @ torch.linalg.solve(covariance, seen)), len(seen)))
