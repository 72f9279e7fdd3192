"""What a moment fit says of its parameters: covariance, intervals that respect their range, and the J test."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._composition import Composition
from gyrofuse.moment_covariance import moment_covariance
from gyrofuse.processes import AR1, Drift, Sinusoid

# Beyond this spread of its logarithm a variance is known to hardly its order of magnitude.
WEAKLY_DETERMINED = 0.5


@dataclass(frozen=True, eq=False)
class Fit:
    """Where a search ended.

    Attributes:
        variance: Wavelet variances `(item, level)` that were fitted.
        linear: `p`, `(item, process)`.
        shape: `x`, `(item, shaped)`.
        held_sd: Spread of the frequencies `beta` that were held, `(item, sinusoid)`.
        tau: `(level,)`.
        converged: `(item,)`.
        omega: Weights `(level,)` or `(level, level)`, or `"optimal"` or `"diagonal"`.
    """

    variance: Tensor
    linear: Tensor
    shape: Tensor
    held_sd: Tensor
    tau: Tensor
    converged: Tensor
    omega: str | Tensor


@dataclass(frozen=True, eq=False)
class Inference:
    """Uncertainty of fitted parameters.

    Attributes:
        params: `(item, parameter)`.
        covariance: `(item, parameter, parameter)`; zero rows for variances at zero.
        low: `(item, parameter)`.
        high: `(item, parameter)`; of a variance at zero a one-sided limit.
        fitted: Wavelet variances of the fitted model, `(item, level)`.
        objective: `r' Omega r`, `(item,)`.
        j_statistic: `r' V^-1 r`, `(item,)`.
        degrees: Of freedom of the J statistic, `(item,)`.
        determined: `(item, parameter)`, whether the data say more than its order of magnitude.
    """

    params: Tensor
    covariance: Tensor
    low: Tensor
    high: Tensor
    fitted: Tensor
    objective: Tensor
    j_statistic: Tensor
    degrees: Tensor
    determined: Tensor


def infer(fit: Fit, made_of: Composition, n_samples: int, confidence_level: float) -> Inference:
    """Sandwich covariance `(A' O A)^-1 A' O V O A (A' O A)^-1`, `A = d nu / d theta` ([V] theorem 2), and intervals.

    Intervals are symmetric in the logarithm of variances and amplitudes and in `atanh phi`. A variance estimated as
    zero lies on the edge of its range: it gets the upper limit only, and an AR1 without variance any `phi`.

    Args:
        fit: Where the search ended.
        made_of: Structure of the model.
        n_samples: Length T of the records.
        confidence_level: Probability that an interval holds the true value.

    Returns:
        Parameters with their uncertainty.
    """
    values, slope = made_of.columns(fit.tau, fit.shape), made_of.slopes(fit.tau, fit.shape)
    fitted = (values @ fit.linear[..., None])[..., 0]
    covariance = moment_covariance(made_of.model(fit.linear, fit.shape), n_samples, len(fit.tau))
    residual = fit.variance - fitted
    root, failed = torch.linalg.cholesky_ex(covariance)
    whitened = torch.linalg.solve_triangular(root, residual[..., None], upper=False)[..., 0]
    j_statistic = torch.where(failed > 0, torch.nan, whitened.square().sum(-1))

    # Jacobian by p, and by x of the unknown shapes: (item, level, unknown)
    moving = [made_of.shaped.index(k) for k in made_of.curved]
    by_shape = (slope * fit.linear[:, None, made_of.shaped])[..., moving]
    jacobian = torch.cat([values, by_shape], -1)
    present = fit.linear > 0  # (item, process)
    active = torch.cat([present, present[:, made_of.curved]], -1)
    own, objective = _sandwich(jacobian, active, covariance, residual, fit.omega)
    # With the variances at zero let off it, how far they might be.
    edge, _ = _sandwich(
        jacobian, torch.cat([torch.ones_like(present), present[:, made_of.curved]], -1), covariance, residual, fit.omega
    )
    n_free = active.sum(-1)
    degrees = (len(fit.tau) - n_free).to(j_statistic)

    z = _normal_quantile((1 + confidence_level) / 2)
    z_one_sided = _normal_quantile(confidence_level)
    params = made_of.params(fit.linear, fit.shape)
    low, high, scale = torch.empty_like(params), torch.empty_like(params), torch.zeros_like(params)
    determined = torch.ones_like(params, dtype=torch.bool)
    unknown = [-1] * params.shape[-1]  # which column of the Jacobian a parameter has
    column, at_curved, at_shaped, at_held = 0, made_of.n_linear, 0, 0
    spread = own.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    limit = edge.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    held_at: list[tuple[int, int]] = []
    for k, process in enumerate(made_of.processes):
        p, sd = fit.linear[:, k], spread[:, k]
        rooted = isinstance(process, (Sinusoid, Drift))
        if isinstance(process, AR1):
            x, sd_x = fit.shape[:, at_shaped], spread[:, at_curved]
            there = present[:, k]
            low[:, column] = torch.where(there, (x - z * sd_x).tanh(), -1.0)
            high[:, column] = torch.where(there, (x + z * sd_x).tanh(), 1.0)
            scale[:, column] = 1 - x.tanh().square()
            determined[:, column] = there & (sd_x < WEAKLY_DETERMINED)
            unknown[column] = at_curved
            column, at_curved, at_shaped = column + 1, at_curved + 1, at_shaped + 1
        ratio = torch.where(p > 0, sd / p, torch.inf)
        first = torch.where(p > 0, p * torch.exp(-z * ratio), 0.0)
        last = torch.where(p > 0, p * torch.exp(z * ratio), z_one_sided * limit[:, k])
        low[:, column], high[:, column] = (first.sqrt(), last.sqrt()) if rooted else (first, last)
        # a = sqrt(p)
        scale[:, column] = torch.where(p > 0, 0.5 / p.clamp(min=1e-300).sqrt(), 0.0) if rooted else 1.0
        determined[:, column] = ratio < WEAKLY_DETERMINED
        unknown[column] = k
        column += 1
        if isinstance(process, Sinusoid):
            x = fit.shape[:, at_shaped]
            at_shaped += 1
            if made_of.held:
                beta, sd_b = params[:, column], fit.held_sd[:, at_held]
                held_at.append((column, at_held))
                at_held += 1
                low[:, column] = (beta - z * sd_b).nan_to_num(nan=0.0).clamp(min=0)
                high[:, column] = (beta + z * sd_b).nan_to_num(nan=torch.pi).clamp(max=torch.pi)
                determined[:, column] = sd_b < WEAKLY_DETERMINED * beta
            else:
                sd_x = spread[:, at_curved]
                low[:, column] = torch.pi * (x - z * sd_x).sigmoid()
                high[:, column] = torch.pi * (x + z * sd_x).sigmoid()
                scale[:, column] = torch.pi * x.sigmoid() * (1 - x.sigmoid())
                determined[:, column] = sd_x < WEAKLY_DETERMINED
                unknown[column] = at_curved
                at_curved += 1
            column += 1
    known = [c for c, u in enumerate(unknown) if u >= 0]
    full = torch.zeros(*params.shape, params.shape[-1], dtype=params.dtype, device=params.device)
    index = torch.tensor([unknown[c] for c in known], device=params.device)
    block = own[:, index[:, None], index] * scale[:, known, None] * scale[:, None, known]
    place = torch.tensor(known, device=params.device)
    full[:, place[:, None], place] = block
    for c, tone in held_at:
        full[:, c, c] = fit.held_sd[:, tone].square()
    return Inference(params, full, low, high, fitted, objective, j_statistic, degrees, determined)


def _sandwich(
    jacobian: Tensor, active: Tensor, covariance: Tensor, residual: Tensor, omega: str | Tensor
) -> tuple[Tensor, Tensor]:
    """Covariance `(item, unknown, unknown)` of the unknowns, zero where not active, and `r' Omega r`."""
    columns = jacobian * active[:, None].to(jacobian)
    size = columns.square().sum(-2).sqrt()
    size = torch.where(size > 0, size, 1.0)
    columns = columns / size[:, None]
    if isinstance(omega, Tensor):
        weight = torch.diag(omega.to(covariance)) if omega.ndim == 1 else omega.to(covariance)
    elif omega == "diagonal":
        weight = torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1).reciprocal())
    else:
        weight = torch.linalg.inv_ex(covariance)[0]
    objective = ((weight @ residual[..., None])[..., 0] * residual).sum(-1)
    weighted = weight @ columns
    bread = columns.mT @ weighted
    scale = bread.diagonal(dim1=-2, dim2=-1).clamp(min=torch.finfo(bread.dtype).tiny).sqrt()
    off = (~active).to(bread)
    scaled = bread / scale[:, :, None] / scale[:, None, :] + torch.diag_embed(off)
    inverse = torch.linalg.inv_ex(scaled)[0] / scale[:, :, None] / scale[:, None, :]
    spread = inverse @ (weighted.mT @ covariance @ weighted) @ inverse
    keep = active[:, :, None] & active[:, None, :]
    return torch.where(keep, spread / size[:, :, None] / size[:, None, :], 0.0), objective


def _normal_quantile(probability: float) -> float:
    return float(torch.special.ndtri(torch.tensor(probability, dtype=torch.float64)))
