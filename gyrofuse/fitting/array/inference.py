"""Inference for the matrices of a moment fit of arrays: intervals that respect their range, and the J test."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.fitting.array.moments import array_moment_covariance, pairs, unvech, vech, weights_of
from gyrofuse.fitting.array.search import jacobian
from gyrofuse.fitting.moments.inference import quadratic, sandwich
from gyrofuse.fitting.moments.records import SampleDesign
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.wavelets.intervals import normal_quantile

# Time constants of an AR1 in the record below which its parameters count as unidentified: an AR1 with a time constant
# of a seventh of the record is estimated anywhere from a thirtieth of it to a random walk, and the delta method fails.
RELIABLE_TIME_CONSTANTS = 50


class ArrayFit(NamedTuple):
    """Fit of arrays in units of their sensors.

    Attributes:
        theta: Matrices, `(item, process, sensor, sensor)`.
        shape: Nonlinear parameters `x`, `(item, shaped)`.
        converged: Whether the search came to rest, `(item,)`.
        covariance: Covariance of the entries of `theta` and the `x` that were fitted, `(item, unknown, unknown)`; NaN
            for entries that no moment determines.
        objective: `r' Omega r`, `(item,)`.
        dof: Degrees of freedom of the J statistic, `(item,)`.
        dispersion: Variance of the J statistic over that of a chi-square, `(item,)`.
        rank: Rank of each matrix, `(item, process)`.
    """

    theta: Tensor
    shape: Tensor
    converged: Tensor
    covariance: Tensor
    objective: Tensor
    dof: Tensor
    dispersion: Tensor
    rank: Tensor


class Estimate(NamedTuple):
    """A value with its standard error and interval, all of one shape."""

    value: Tensor
    std_err: Tensor
    low: Tensor
    high: Tensor


def covariance_of_fit(
    gamma: Tensor,
    theta: Tensor,
    shape: Tensor,
    records: SampleDesign,
    structure: ModelStructure,
    *,
    rounding: float = 1e-5,
    negligible: float = 1e-8,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Sandwich covariance `(A' O A)^-1 A' O V O A (A' O A)^-1` with `A` the Jacobian, as if no matrix lacked rank.

    Args:
        gamma: Wavelet cross-covariance that was fitted, `(item, level, sensor, sensor)`.
        theta: Matrices, `(item, process, sensor, sensor)`.
        shape: Nonlinear parameters `x`, `(item, shaped)`.
        records: Length and levels of the records.
        structure: Structure of the model.
        rounding: Share of the largest eigenvalue of a matrix below which another one counts as zero.
        negligible: Share of a moment that the same eigenvalue adds to it, below which it counts as zero.

    Returns:
        Covariance, objective, degrees of freedom, dispersion and ranks as in `ArrayFit`.
    """
    n_items, n_sensors = len(gamma), gamma.shape[-1]
    present = vech(gamma).isfinite()
    covariance = array_moment_covariance(structure, theta, shape, records)
    weight = weights_of(covariance, present)
    tau = records.tau.to(gamma)
    columns = structure.columns(tau, shape)
    fitted = columns @ vech(theta)
    residual = torch.where(present, vech(gamma) - fitted, 0.0).flatten(1)
    # The entries of a pair are determined by at least as many levels as there are processes.
    entries = (present.sum(1) >= structure.n_linear)[:, None].expand(-1, structure.n_linear, -1).flatten(1)
    known = torch.cat([entries, entries.new_ones(n_items, len(structure.free_nonlinear))], -1)
    slopes = jacobian(tau, structure, theta, shape) * present.flatten(1)[..., None]
    flat = covariance.reshape(*weight.shape)
    spread, objective = sandwich(slopes, known, flat, weight), quadratic(residual, weight)
    spread = torch.where(known[:, :, None] & known[:, None, :], spread, torch.nan)
    eigenvalues = torch.linalg.eigvalsh(theta) * columns.amax(-2)[..., None]  # of moments of unit size
    lost = ((eigenvalues < rounding * eigenvalues[..., -1:]) | (eigenvalues < negligible)).sum(-1)
    dof = present.flatten(1).sum(-1) - known.sum(-1) + (lost * (lost + 1) // 2).sum(-1)
    own = [at for at, pair in enumerate(zip(*pairs(n_sensors), strict=True)) if pair[0] == pair[1]]
    variance = covariance.diagonal(dim1=1, dim2=3).diagonal(dim1=1, dim2=2)
    rarity = (variance / fitted.square() / 2)[..., own]  # of observations: one over their number, (item, level, sensor)
    return spread, objective, dof, _dispersion(rarity, present[..., own], dof), n_sensors - lost


def _dispersion(rarity: Tensor, present: Tensor, dof: Tensor) -> Tensor:
    """Variance of `r' V^-1 r` over twice its degrees of freedom, when levels hold few observations.

    Of a covariance `S` of `p` variables with `n` observations, `n tr((S - 1)^2) / 2` has mean `p (p + 1) / 2` and
    variance `p (p + 1) + p (2 p^2 + 5 p + 5) / n`.
    """
    p = present.sum(-1)  # (item, level)
    mean = torch.where(present, rarity, 0.0).sum(-1) / p.clamp(min=1)
    return 1 + (p * (2 * p.square() + 5 * p + 5) * mean).sum(-1) / (2 * dof.clamp(min=1))


def matrices(fit: ArrayFit, identified: Tensor, confidence_level: float) -> tuple[Estimate, Estimate]:
    """Entries of the matrices, and correlations, each `(item, process, sensor, sensor)`.

    Intervals are symmetric in the logarithm of variances, in `atanh` of correlations, and in covariances as they are. A
    variance that hardly differs from zero gets an upper limit only, as do those of a matrix that is not identified,
    whose covariances and correlations get none: the bound on its eigenvalues leaves nothing that is symmetric, and a
    time constant estimated too short makes all variances too large.

    Args:
        fit: Fit of the arrays.
        identified: Whether each matrix is identified, `(item, process)`, see `identified_matrices`.
        confidence_level: Probability that an interval holds the true value.

    Returns:
        Entries and correlations.
    """
    n_processes, n_sensors = fit.theta.shape[1], fit.theta.shape[-1]
    a, b = pairs(n_sensors)
    n_pairs = len(a)
    n_linear = n_processes * n_pairs
    whole = fit.covariance[:, :n_linear, :n_linear].unflatten(1, (n_processes, -1)).unflatten(3, (n_processes, -1))
    spread = whole.diagonal(dim1=1, dim2=3).movedim(-1, 1)  # (item, process, pair, pair)
    sd = spread.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    value = torch.where(sd.isnan(), torch.nan, vech(fit.theta))
    z, one_sided = normal_quantile((1 + confidence_level) / 2), normal_quantile(confidence_level)
    low, high = value - z * sd, value + z * sd
    own = (a == b).nonzero()[:, 0]
    variance, ratio = value[..., own], sd[..., own] / value[..., own]
    resolved = ratio < 2  # beyond, the logarithm of a variance has no useful interval
    identified = identified[..., None]  # (item, process, 1)
    low, high = (torch.where(identified, limit, torch.nan) for limit in (low, high))
    two_sided = resolved & identified
    low[..., own] = torch.where(two_sided, variance * torch.exp(-z * ratio), 0 * variance)
    reach = torch.where(two_sided, z, one_sided) * ratio
    high[..., own] = variance * torch.where(resolved, torch.exp(reach), 1 + reach)
    entries = Estimate(*(unvech(part) for part in (value, sd, low, high)))

    # d rho = d theta_ab / s - rho (d theta_aa / theta_aa + d theta_bb / theta_bb) / 2
    first, second = own[a], own[b]
    scale = (value[..., first] * value[..., second]).sqrt()
    rho = (value / scale).clamp(-1, 1)
    place = torch.arange(n_pairs)
    slopes = torch.zeros_like(spread)
    slopes[..., place, place] = 1 / scale
    slopes[..., place, first] -= rho / (2 * value[..., first])
    slopes[..., place, second] -= rho / (2 * value[..., second])
    filled = spread.nan_to_num(nan=0.0)
    rho_sd = (slopes.nan_to_num(nan=0.0) @ filled * slopes.nan_to_num(nan=0.0)).sum(-1).clamp(min=0).sqrt()
    rho_sd = torch.where(rho.isnan(), torch.nan, rho_sd)
    # At a correlation of one, estimated without error, the scale of atanh ends.
    end = 1e-12
    width = z * rho_sd / (1 - rho.square()).clamp(min=end)
    middle = rho.clamp(-1 + end, 1 - end).atanh()
    low, high = (torch.where(identified, (middle + sign * width).tanh(), torch.nan) for sign in (-1, 1))
    # The correlation of a sensor with itself is one.
    itself = (a == b).to(rho.device)
    certain = [torch.where(itself, one, part) for one, part in ((0.0, rho_sd), (1.0, low), (1.0, high))]
    return entries, Estimate(*(unvech(part) for part in (rho, *certain)))


def covariance_of_numbers(fit: ArrayFit, squared: Tensor, std_err: Tensor, structure: ModelStructure) -> Tensor:
    """Covariance of entries of the matrices and of `phi` or `beta`, process by process, `(item, number, number)`.

    Args:
        fit: Fit of the arrays.
        squared: Units of the entries, `(item, 1, pair)`.
        std_err: Standard errors of `phi` and `beta`, `(item, parameter)`, also of those that were not fitted.
        structure: Structure of the model.
    """
    n_items, n_pairs = len(squared), squared.shape[-1]
    n_linear = structure.n_linear * n_pairs
    moved = [structure.nonlinear.index(k) for k in structure.free_nonlinear]
    among = fit.covariance.diagonal(dim1=-2, dim2=-1)[:, n_linear:].clamp(min=0).sqrt()
    # d phi / d x from the two standard errors; 0 / 0 where there is none.
    slope = (std_err[:, moved] / among).nan_to_num(nan=0.0)
    units = torch.cat([squared.expand(-1, structure.n_linear, -1).flatten(1), slope], -1)
    whole = torch.diag_embed(torch.cat([torch.zeros(n_items, n_linear).to(std_err), std_err.square()], -1))
    place = torch.tensor([*range(n_linear), *(n_linear + i for i in moved)], device=std_err.device)
    whole[:, place[:, None], place] = fit.covariance * (units[:, :, None] * units[:, None, :])
    order: list[int] = []
    for k in range(structure.n_linear):
        order += range(k * n_pairs, (k + 1) * n_pairs)
        order += [n_linear + structure.nonlinear.index(k)] if k in structure.nonlinear else []
    return whole[:, order][:, :, order]


def is_long(phi: Tensor, n_samples: int) -> Tensor:
    """Whether a record of `n_samples` holds too few time constants of an AR1 of this `phi`, of the shape of `phi`."""
    return phi > math.exp(-RELIABLE_TIME_CONSTANTS / n_samples)


def identified_matrices(fit: ArrayFit, structure: ModelStructure, n_samples: int) -> Tensor:
    """Whether a matrix has full rank and its process no long time constant, `(item, process)`."""
    identified = fit.rank == fit.theta.shape[-1]
    for k, x in zip(structure.nonlinear, fit.shape.unbind(-1), strict=True):
        if structure.processes[k].has_memory():
            identified[:, k] &= ~is_long(structure.processes[k].from_unconstrained(x), n_samples)
    return identified


def shared(
    fit: ArrayFit, identified: Tensor, held_sd: Tensor, structure: ModelStructure, confidence_level: float
) -> Estimate:
    """Parameters `(item, parameter)` of all sensors, `phi` of AR1s and `beta` of tones, in the order of the model.

    Intervals are symmetric in `atanh phi` and `logit(beta / pi)`. No AR1 has one where the matrix of any of them is not
    identified, as an error in one is compensated by the others.

    Args:
        fit: Fit of the arrays.
        identified: Whether each matrix is identified, `(item, process)`.
        held_sd: Standard errors of frequencies that the moments did not fit, `(item, sinusoid)`.
        structure: Structure of the model.
        confidence_level: Probability that an interval holds the true value.
    """
    z = normal_quantile((1 + confidence_level) / 2)
    n_moving = len(structure.free_nonlinear)
    moving = fit.covariance.diagonal(dim1=-2, dim2=-1)[:, fit.covariance.shape[-1] - n_moving :].clamp(min=0).sqrt()
    moved, held = iter(moving.unbind(-1)), iter(held_sd.unbind(-1))
    memories = [k for k, process in enumerate(structure.processes) if process.has_memory()]
    vague = ~identified[:, memories].all(-1)
    found = []
    for k, x in zip(structure.nonlinear, fit.shape.unbind(-1), strict=True):
        process = structure.processes[k]
        slope = process.unconstrained_slope(x)
        width = next(moved) if k in structure.free_nonlinear else next(held) / slope
        low, high = (process.from_unconstrained(x + sign * z * width) for sign in (-1, 1))
        if process.has_memory():
            low, high = (torch.where(vague, torch.nan, limit) for limit in (low, high))
        found.append(Estimate(process.from_unconstrained(x), slope * width, low, high))
    if not found:
        return Estimate(*(fit.shape,) * 4)
    return Estimate(*(torch.stack(column, -1) for column in zip(*found, strict=True)))
