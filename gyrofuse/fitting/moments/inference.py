"""Inference for the parameters of a moment fit: covariance, intervals that respect their range, and the J test."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from gyrofuse.fitting.j_test import CLEARLY_REJECTED
from gyrofuse.fitting.moments.records import SampleDesign
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.processes import Sinusoid
from gyrofuse.wavelets.intervals import chi_square_tail, normal_quantile

# Standard error of the logarithm of a variance above which it is known to hardly its order of magnitude: its 95 %
# interval then spans a factor of e^2 = 7.
WEAKLY_DETERMINED = 0.5


@dataclass(frozen=True, eq=False)
class Fit:
    """Fit of the moments.

    Attributes:
        variance: Wavelet variances `(item, level)` that were fitted.
        linear: Linear parameters `p`, `(item, process)`.
        shape: Nonlinear parameters `x`, `(item, shaped)`.
        held_sd: Standard errors of the frequencies `beta` that were not fitted, `(item, sinusoid)`.
        converged: Whether a minimum was reached, `(item,)`.
        omega: Weights `(level,)` or `(level, level)`, or `"optimal"` or `"diagonal"`.
        records: Lengths and levels of the records.
    """

    variance: Tensor
    linear: Tensor
    shape: Tensor
    held_sd: Tensor
    converged: Tensor
    omega: str | Tensor
    records: SampleDesign

    @property
    def tau(self) -> Tensor:
        """Filter lengths `(level,)`."""
        return self.records.tau.to(self.variance.device)


@dataclass(frozen=True, eq=False)
class Estimates:
    """Parameters of the model with their uncertainty.

    Attributes:
        params: Parameters, `(item, parameter)`.
        covariance: Their covariance, `(item, parameter, parameter)`; zero rows for variances at zero.
        low: Lower limits, `(item, parameter)`.
        high: Upper limits, `(item, parameter)`; one-sided for a variance at zero.
        determined: Whether more than the order of magnitude is known, `(item, parameter)`.
    """

    params: Tensor
    covariance: Tensor
    low: Tensor
    high: Tensor
    determined: Tensor


@dataclass(frozen=True, eq=False)
class Inference:
    """Result of a moment fit, item by item.

    Attributes:
        estimates: Parameters with their uncertainty.
        fitted: Wavelet variances of the fitted model, `(item, level)`.
        objective: `r' Omega r`, `(item,)`.
        j_statistic: `r' V^-1 r`, `(item,)`.
        dof: Degrees of freedom of the J statistic, its mean, `(item,)`.
        dispersion: Variance of the J statistic over that of a chi-square of this mean, `(item,)`.
        converged: `(item,)`.
    """

    estimates: Estimates
    fitted: Tensor
    objective: Tensor
    j_statistic: Tensor
    dof: Tensor
    dispersion: Tensor
    converged: Tensor

    @property
    def p_value(self) -> Tensor:
        """P value of the J test, by a scaled chi-square, `(item,)`; NaN without degrees of freedom."""
        return chi_square_tail(self.j_statistic / self.dispersion, self.dof / self.dispersion)

    @property
    def clearly_rejected(self) -> Tensor:
        """Whether the J test clearly rejects the model, `(item,)`."""
        return self.p_value < CLEARLY_REJECTED


def either(condition: Tensor, one: Any, other: Any) -> Any:
    """The first for items that meet a condition `(item,)`, the second for others; tensors or dataclasses of them."""
    if isinstance(one, Tensor):
        return torch.where(condition.view(-1, *(1,) * (one.ndim - 1)), one, other)
    pairs = ((getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    return type(one)(*(either(condition, *pair) for pair in pairs))


def infer(fit: Fit, structure: ModelStructure, confidence_level: float) -> Inference:
    """Sandwich covariance `(A' O A)^-1 A' O V O A (A' O A)^-1`, `A = d nu / d theta` ([V] theorem 2), and the J test.

    Args:
        fit: Fit of the moments.
        structure: Structure of the model.
        confidence_level: Probability that an interval holds the true value.
    """
    own = _residual_of(fit, structure)
    # Jacobian by p, and by x of the unknown shapes: (item, level, unknown)
    moving = [structure.nonlinear.index(k) for k in structure.free_nonlinear]
    jacobian = torch.cat([own.values, own.slopes[..., moving]], -1)
    present = fit.linear > 0  # (item, process)
    active = torch.cat([present, present[:, structure.free_nonlinear]], -1)
    covariance = sandwich(jacobian, active, own.covariance, own.weight)
    # Standard errors of variances at zero, if they could be negative.
    free = torch.cat([torch.ones_like(present), present[:, structure.free_nonlinear]], -1)
    edge = sandwich(jacobian, free, own.covariance, own.weight)
    estimates = estimated(
        structure,
        fit.linear,
        fit.shape,
        _in_logs(covariance, fit, structure),
        edge.diagonal(dim1=-2, dim2=-1)[:, : structure.n_linear].clamp(min=0).sqrt(),
        confidence_level,
    )
    dof = (len(fit.tau) - active.sum(-1)).to(own.j_statistic)
    return Inference(estimates, own.fitted, own.objective, own.j_statistic, dof, torch.ones_like(dof), fit.converged)


def infer_efficient(
    fit: Fit, structure: ModelStructure, covariance: Tensor, edge_sd: Tensor, confidence_level: float
) -> Inference:
    """Inference at efficient estimates, which are no minimum of the moments' objective.

    An efficient estimate of covariance `S` is uncorrelated with what it leaves (Hausman):
    `Var r = V - A S A'`, so that `r' V^-1 r` is a sum of squares of normal variables with the eigenvalues of
    `1 - L^-1 A S A' L^-T`, `V = L L'`, as weights: 0 to 1, where a minimum has zeros and ones alone.

    Args:
        fit: Moments, and the estimates in the place of the minimum.
        structure: Structure of the model.
        covariance: `S`, of `ln p` of all processes and `x` of all shaped ones, `(item, unknown, unknown)`; what is not
            known of it takes nothing from the residuals, so that the test refuses too seldom.
        edge_sd: As in `estimated`.
        confidence_level: Probability that an interval holds the true value.

    References:
        J. A. Hausman, Econometrica 46, 1978.
    """
    own = _residual_of(fit, structure)
    jacobian = torch.cat([own.values * fit.linear[:, None], own.slopes], -1)
    moved = torch.linalg.solve_triangular(own.root, jacobian, upper=False)
    part = moved @ covariance.nan_to_num(nan=0.0, posinf=0.0) @ moved.mT
    taken = torch.linalg.eigvalsh(torch.where(own.j_statistic.isfinite()[:, None, None], part, 0.0)).clamp(0, 1)
    dof = (1 - taken).sum(-1)
    dispersion = (1 - taken).square().sum(-1) / dof
    estimates = estimated(structure, fit.linear, fit.shape, covariance, edge_sd, confidence_level)
    return Inference(estimates, own.fitted, own.objective, own.j_statistic, dof, dispersion, fit.converged)


@dataclass(frozen=True, eq=False)
class _MomentResidual:
    """Measured moments, a model, and their difference.

    Attributes:
        fitted: `nu(theta)`, `(item, level)`.
        covariance: `V`, `(item, level, level)`.
        root: Its Cholesky factor.
        weight: `Omega`, or one for each item.
        objective: `r' Omega r`, `(item,)`.
        j_statistic: `r' V^-1 r`, `(item,)`.
        values: Derivatives `(item, level, process)` by `p`.
        slopes: The same by `x` of all shaped processes.
    """

    fitted: Tensor
    covariance: Tensor
    root: Tensor
    weight: Tensor
    objective: Tensor
    j_statistic: Tensor
    values: Tensor
    slopes: Tensor


def _residual_of(fit: Fit, structure: ModelStructure) -> _MomentResidual:
    values, slopes = structure.columns(fit.tau, fit.shape), structure.slopes(fit.tau, fit.shape)
    fitted = (values @ fit.linear[..., None])[..., 0]
    covariance = fit.records.covariance(structure.model(fit.linear, fit.shape))
    residual = fit.variance - fitted
    root, failed = torch.linalg.cholesky_ex(covariance)
    whitened = torch.linalg.solve_triangular(root, residual[..., None], upper=False)[..., 0]
    j_statistic = torch.where(failed > 0, torch.nan, whitened.square().sum(-1))
    weight = _weight(fit.omega, covariance)
    objective = quadratic(residual, weight)
    slopes = slopes * fit.linear[:, None, structure.nonlinear]
    return _MomentResidual(fitted, covariance, root, weight, objective, j_statistic, values, slopes)


def quadratic(residual: Tensor, weight: Tensor) -> Tensor:
    return ((weight @ residual[..., None])[..., 0] * residual).sum(-1)


def _weight(omega: str | Tensor, covariance: Tensor) -> Tensor:
    if isinstance(omega, Tensor):
        return torch.diag(omega.to(covariance)) if omega.ndim == 1 else omega.to(covariance)
    if omega == "diagonal":
        return torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1).reciprocal())
    return torch.linalg.inv_ex(covariance)[0]


def _in_logs(own: Tensor, fit: Fit, structure: ModelStructure) -> Tensor:
    """Covariance `(item, unknown, unknown)` of `ln p` of all processes and `x` of all shaped ones, held ones too."""
    n_linear, nonlinear = structure.n_linear, structure.nonlinear
    scale = torch.where(fit.linear > 0, fit.linear.clamp(min=1e-300).reciprocal(), 0.0)
    scale = torch.cat([scale, torch.ones_like(own[:, n_linear:, 0])], -1)
    place = [*range(n_linear), *(n_linear + nonlinear.index(k) for k in structure.free_nonlinear)]
    size = n_linear + len(nonlinear)
    covariance = own.new_zeros(len(own), size, size)
    index = torch.tensor(place, device=own.device)
    covariance[:, index[:, None], index] = own * scale[:, :, None] * scale[:, None, :]
    held = [n_linear + at for at, k in enumerate(nonlinear) if k not in structure.free_nonlinear]
    if held:
        slope = Sinusoid.unconstrained_slope(fit.shape[:, [at - n_linear for at in held]])
        covariance[:, held, held] = (fit.held_sd / slope).square()
    return covariance


def estimated(
    structure: ModelStructure,
    linear: Tensor,
    shape: Tensor,
    covariance: Tensor,
    edge_sd: Tensor,
    confidence_level: float,
) -> Estimates:
    """Parameters with intervals that respect their ranges.

    Intervals are symmetric in the logarithm of variances and amplitudes, in `atanh phi` and in `logit(beta / pi)`. A
    variance estimated as zero lies on the edge of its range: it gets an upper limit only, and an AR1 without variance
    any `phi`.

    Args:
        structure: Structure of the model.
        linear: `p`, `(item, process)`.
        shape: `x`, `(item, shaped)`.
        covariance: Covariance of `ln p` of all processes and `x` of all shaped ones, `(item, unknown, unknown)`.
        edge_sd: Standard error of `p` itself, as if a `p` at zero could be negative, `(item, process)`.
        confidence_level: Probability that an interval holds the true value.
    """
    z, one_sided = normal_quantile((1 + confidence_level) / 2), normal_quantile(confidence_level)
    sd = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    found: list[tuple[int, Tensor, Tensor, Tensor, Tensor]] = []  # unknown, low, high, slope, determined
    at_shaped = structure.n_linear
    for k, process in enumerate(structure.processes):
        p, ratio = linear[:, k], sd[:, k]
        present = p > 0
        low = torch.where(present, p * torch.exp(-z * ratio), 0.0)
        high = torch.where(present, p * torch.exp(z * ratio), one_sided * edge_sd[:, k])
        size = (k, low, high, p, present & (ratio < WEAKLY_DETERMINED))
        if process.squared:  # p is the square of the parameter
            size = (k, low.sqrt(), high.sqrt(), p.sqrt() / 2, size[-1])
        if process.shape_name is not None:
            x, width = shape[:, at_shaped - structure.n_linear], sd[:, at_shaped]
            # Without variance, or fewer than a few cycles of a tone, it may be anything.
            width = torch.where(present & width.isfinite(), width, torch.inf)
            known = width < WEAKLY_DETERMINED
            low, high = (process.from_unconstrained(x + sign * z * width) for sign in (-1, 1))
            form = (at_shaped, low, high, process.unconstrained_slope(x), known)
            found += [form, size] if next(iter(process.parameters)) == process.shape_name else [size, form]
            at_shaped += 1
        else:
            found.append(size)
    lows, highs, slopes, determined = (torch.stack(column, -1) for column in list(zip(*found, strict=True))[1:])
    index = torch.tensor([unknown for unknown, *_ in found], device=covariance.device)
    of_params = covariance[:, index[:, None], index] * slopes[:, :, None] * slopes[:, None, :]
    return Estimates(structure.params(linear, shape), of_params, lows, highs, determined)


def sandwich(jacobian: Tensor, active: Tensor, covariance: Tensor, weight: Tensor) -> Tensor:
    """Covariance of the unknowns, `(item, unknown, unknown)`, zero where not active.

    Args:
        jacobian: Derivatives of the moments with respect to the unknowns, `(item, level, unknown)`.
        active: Unknowns that are estimated, `(item, unknown)`, bool.
        covariance: Covariance of the moments, `(item, level, level)`.
        weight: Weight matrix of the fit, `(item, level, level)` or `(level, level)`.
    """
    columns = jacobian * active[:, None].to(jacobian)
    size = columns.square().sum(-2).sqrt()
    size = torch.where(size > 0, size, 1.0)
    columns = columns / size[:, None]
    weighted = weight @ columns
    bread = columns.mT @ weighted
    scale = bread.diagonal(dim1=-2, dim2=-1).clamp(min=torch.finfo(bread.dtype).tiny).sqrt()
    off = (~active).to(bread)
    scaled = bread / scale[:, :, None] / scale[:, None, :] + torch.diag_embed(off)
    inverse = torch.linalg.inv_ex(scaled)[0] / scale[:, :, None] / scale[:, None, :]
    of_scaled = inverse @ (weighted.mT @ covariance @ weighted) @ inverse
    keep = active[:, :, None] & active[:, None, :]
    return torch.where(keep, of_scaled / size[:, :, None] / size[:, None, :], 0.0)
