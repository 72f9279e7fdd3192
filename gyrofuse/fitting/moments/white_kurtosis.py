"""Heavy or light tails of white noise: what they add to the uncertainty of its variance.

White noise of independent samples with excess kurtosis `kappa` adds `kappa (s2 / tau_j) (s2 / tau_k) / M` to the
covariance of the wavelet variances, the outer product of `s2 d nu / d s2` with itself. Whatever the weights, a fit to
moments takes such an error for one of `s2` alone, and so does a spectral likelihood, to which the fourth cumulant adds
the same at every frequency. Hence

    Var ln s2 = Gaussian value + kappa / T

and neither the other parameters nor the J test change.

References:
    P. M. Robinson, Annals of Statistics 5, 1977, for the fourth cumulant in spectral estimates of linear processes.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse.fitting.moments.inference import WEAKLY_DETERMINED, Inference
from gyrofuse.fitting.spectral.tones import Tones
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.wavelets.intervals import normal_quantile


def white_excess_kurtosis(series: Tensor, tones: Tones | None, structure: ModelStructure, params: Tensor) -> Tensor:
    """Excess kurtosis of the samples of the white noise, `(item,)`, if that is what is not Gaussian.

    The differences of white noise have the fourth cumulant `2 kappa s2^2`, and the cumulants of independent processes
    add up: those of Gaussian ones are zero.

    Args:
        series: `(item, time)`, NaN = missing sample.
        tones: Spectral lines of the sinusoids, which are subtracted; None where there are none.
        structure: Structure of the model.
        params: Fitted parameters, `(item, parameter)`.

    Returns:
        -2 or more; 0 where the model has no white noise, or its variance is zero.
    """
    at = _white_at(structure)
    if at is None:
        return params.new_zeros(len(params))
    rest = series.to(torch.float64)
    if tones is not None:
        rest = rest - tones.waveform(series.shape[-1])
    steps = rest.diff(dim=-1)
    steps = steps - steps.nanmean(-1, keepdim=True)
    cumulant = steps.pow(4).nanmean(-1) - 3 * steps.square().nanmean(-1).square()
    variance = params[:, at]
    kappa = cumulant / (2 * variance.square())
    return torch.where(kappa.isfinite(), kappa, 0.0).clamp(min=-2.0)  # that of a fair coin: no variable has less


def with_excess_kurtosis(
    inference: Inference, kappa: Tensor, structure: ModelStructure, n_samples: int, confidence_level: float
) -> Inference:
    """An inference for Gaussian noise with `kappa / n_samples` added to the variance of `ln s2`.

    Limits move by as much as an independent error of `ln s2` widens them.

    Args:
        inference: Inference with final intervals.
        kappa: Excess kurtosis of the white noise, `(item,)`.
        structure: Structure of the model.
        n_samples: Length of the records, all together.
        confidence_level: Probability that an interval holds the true value.
    """
    at, estimates = _white_at(structure), inference.estimates
    if at is None:
        return inference
    z, more = normal_quantile((1 + confidence_level) / 2), kappa / n_samples
    own = estimates.params[:, at]
    present = own > 0
    covariance = estimates.covariance.clone()
    covariance[:, at, at] = torch.where(
        present, (covariance[:, at, at] + own.square() * more).clamp(min=0), covariance[:, at, at]
    )
    low, high, determined = estimates.low.clone(), estimates.high.clone(), estimates.determined.clone()
    for limit, sign in ((low, -1), (high, 1)):
        width = sign * (limit[:, at] / own).log()
        wider = (width.square() + z**2 * more).clamp(min=0).sqrt()
        limit[:, at] = torch.where(present, own * torch.exp(sign * wider), limit[:, at])
    known = (high[:, at] / low[:, at]).log() < 2 * z * WEAKLY_DETERMINED
    determined[:, at] &= known | ~present
    return replace(
        inference, estimates=replace(estimates, covariance=covariance, low=low, high=high, determined=determined)
    )


def _white_at(structure: ModelStructure) -> int | None:
    """Index of the variance of the white noise among the parameters."""
    for k, process in enumerate(structure.processes):
        if process.white:
            return structure.places[k]
    return None
