"""Classification of faults that the parity test has isolated: the kind of fault from the shape of the residual.

The difference of the sensor from the optimal fusion of the others, `e = x_i - sum_k a_k x_k`, is put through an
orthogonal Haar transform, whose coefficients have the known variances `a' Gamma_j a` of a nominal array. Each shape
that a fault may have from some instant on - a step (bias), a ramp (drift), an inverted sign - is fitted, and the most
likely shape is compared with noise of larger variances.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

# Kinds of fault: stuck-at, bias, drift, noise increase, sign inversion, noise decrease.
KINDS = ("frozen", "biased", "drifting", "noisier", "sign-flipped", "quieter")
STUCK, BIAS, DRIFT, NOISE_INCREASE, SIGN_INVERSION, NOISE_DECREASE = range(len(KINDS))
_SHAPES = (BIAS, DRIFT, SIGN_INVERSION)

# Number of instants of a grid at which a shape may begin; a second grid of as many refines the best of them, to a
# thousandth of the span.
_ONSETS = 32


def kinds_of(
    chunk: Tensor,
    window: int,
    isolated: Tensor,
    level: Tensor,
    gamma: Tensor,
    matrix: Tensor,
    silent: Tensor,
) -> tuple[Tensor, Tensor]:
    """Kind and size of the fault of every isolated sensor.

    Args:
        chunk: `(..., sensor, time)`, with the samples that precede its first window.
        window: Samples of a window; the windows are at the end of the chunk.
        isolated: `(..., window, sensor)`, bool, the faulty sensors.
        level: `(..., window, sensor)`, from 0, at which the fault shows most.
        gamma: `(..., level, sensor, sensor)` of a nominal array.
        matrix: `(..., window, level, sensor, sensor)`, the `N` of the parity test.
        silent: `(..., window, sensor)`, whether the sensor itself varies too little.

    Returns:
        Kind, an index of `KINDS`, and size, `(..., window, sensor)`: the step of a bias (signal), the slope of a drift
        (signal per sample), the factor of a noise increase on the residual's standard deviation; NaN for other kinds.
        -1 and NaN where no sensor is isolated.
    """
    kind = torch.full_like(level, -1)
    size = torch.full_like(matrix[..., 0, 0, :1].expand(level.shape), torch.nan).clone()
    n_windows, n_levels = isolated.shape[-2], gamma.shape[-3]
    at = tuple(isolated.nonzero().T)
    signals, gammas = chunk.reshape(-1, *chunk.shape[-2:]), gamma.reshape(-1, *gamma.shape[-3:])
    item, healthy = (
        torch.arange(len(flat), device=chunk.device).view(*batch, 1, 1).expand(isolated.shape)[isolated]
        for flat, batch in ((signals, chunk.shape[:-2]), (gammas, gamma.shape[:-3]))
    )
    end = chunk.shape[-1] - (n_windows - 1 - at[-2]) * window
    # Twice as long as the level at which it shows, and as the window, so that the time before the fault is included.
    reach = (level[at] + 2).clamp(min=window.bit_length()).clamp(max=n_levels + 1)
    matrix = matrix.expand(*isolated.shape[:-1], *matrix.shape[-3:])
    rows = matrix[at[:-1] + (level[at], at[-1])]  # noqa: RUF005  # (fault, sensor)
    contrasts = rows / rows.gather(-1, at[-1][:, None])
    for levels in reach.unique().tolist():
        of_length = (reach == levels).nonzero().flatten()
        # 2**18 numbers (2 MiB) at a time.
        for some in of_length.split(max(262_144 // (len(_SHAPES) * _ONSETS * 2**levels), 1)):
            sensor = at[-1][some]
            times = end[some, None] - 2**levels + torch.arange(2**levels, device=chunk.device)
            values = signals[item[some, None], :, times].mT  # (fault, sensor, time)
            own = values.gather(1, sensor[:, None, None].expand(-1, 1, values.shape[-1])).squeeze(1)
            contrast = contrasts[some]
            others = contrast.scatter(-1, sensor[:, None], 0.0)
            variance, variance_of_others = (
                torch.einsum("ni,njik,nk->nj", c, gammas[healthy[some], :levels], c) for c in (contrast, others)
            )
            difference = torch.einsum("np,npt->nt", contrast, torch.where(contrast[..., None] != 0, values, 0.0))
            kinds, sizes = _shapes(difference, own, variance, variance_of_others, window)
            kept = own[:, -min(window, own.shape[-1]) :]
            # A stuck sensor repeats one value for a tenth of the window or more; noise alone does not.
            stuck = _longest_repeat(kept) >= 0.1 * window
            here = tuple(column[some] for column in at)
            kind[here] = torch.where(silent[here], torch.where(stuck, STUCK, NOISE_DECREASE), kinds)
            size[here] = torch.where(silent[here], torch.nan, sizes)
    return kind, size


class _Span(NamedTuple):
    """A span of samples that ends with the window.

    Attributes:
        observed: Coefficients of `e`, `(fault, coefficient)`.
        precision: One over the variances of the coefficients in a nominal array, 0 where they are missing.
        inverted: Precision of the evidence for an inverted sign from the rate.
        own: The sensor itself, `(fault, time)`.
        mean: Mean of the sensor in the last window, `(fault, 1)`.
    """

    observed: Tensor
    precision: Tensor
    inverted: Tensor
    own: Tensor
    mean: Tensor


def _shapes(
    difference: Tensor, own: Tensor, variance: Tensor, variance_of_others: Tensor, window: int
) -> tuple[Tensor, Tensor]:
    """Kind and size by the shape of `e` over a span of samples, a power of 2.

    Args:
        difference: `e`, `(fault, time)`.
        own: The sensor itself, `(fault, time)`.
        variance: `(fault, level)`, variance of the coefficients of `e` in a nominal array.
        variance_of_others: `(fault, level)`, variance of the fusion of the others, with which `e` compares the sensor.
        window: Samples of the last window.
    """
    length = own.shape[-1]
    observed, levels = _orthogonal(difference)
    if levels[-1] == variance.shape[-1]:  # one level beyond what is known: at most what a random walk has there
        variance, variance_of_others = (torch.cat([v, 2 * v[:, -1:]], -1) for v in (variance, variance_of_others))
    precision = torch.where(observed.isfinite(), 1 / variance[:, levels], 0.0)
    observed = observed.nan_to_num(0.0)
    share = _share_of_rate(_orthogonal(own - difference)[0], precision, variance, variance_of_others, levels)
    mean = own[:, -window:].nanmean(-1, keepdim=True).nan_to_num(0.0)
    span = _Span(observed, precision, precision * share, own, mean)

    time = torch.arange(length, device=own.device, dtype=own.dtype)
    stride = max(length // _ONSETS, 1)
    onset = time[::stride].expand(len(own), len(_SHAPES), -1)
    gain, _ = _fit(span, onset)
    near = onset.gather(-1, gain.argmax(-1, keepdim=True))
    closer = torch.arange(-_ONSETS // 2, _ONSETS // 2, device=near.device) * max(2 * stride // _ONSETS, 1)
    gain, size = _fit(span, (near + closer).clamp(0, length - 1))
    gain, best = gain.max(-1)  # (fault, shape)
    size = size.gather(-1, best[..., None])[..., 0]
    gain, shape = gain.max(-1)
    kind, size = torch.tensor(_SHAPES, device=shape.device)[shape], size.gather(-1, shape[:, None])[:, 0]

    # Noise that began within the span may show in its second half only.
    late = torch.cat([time[: length >> level] >= length >> (level + 1) for level in range(1, int(levels.max()) + 2)])
    noise = torch.maximum(
        _noise_evidence(observed, precision, variance, levels),
        _noise_evidence(observed, precision * late, variance, levels),
    )
    # Penalties for fitted parameters: the instant of a shape, the variance and the colour of noise.
    explained = gain / 2 - torch.log1p(gain.clamp(min=0)) > noise - torch.log1p(noise) / 2 - 1
    louder = ((observed.square() * precision).sum(-1) / (precision > 0).sum(-1)).sqrt()
    return torch.where(explained, kind, NOISE_INCREASE), torch.where(explained, size, louder)


def _fit(span: _Span, onset: Tensor) -> tuple[Tensor, Tensor]:
    """Reduction of chi-square by each of `_SHAPES` at each onset, and the size of the shape.

    Args:
        span: The observations.
        onset: `(fault, shape, onset)`.

    Returns:
        Both `(fault, shape, onset)`.
    """
    observed, precision, inverted = (value[:, None] for value in span[:3])
    time = torch.arange(span.own.shape[-1], device=onset.device, dtype=onset.dtype)
    since = time - onset[..., None]  # (fault, shape, onset, time)
    begun = since >= 0
    forms = _orthogonal(torch.stack([begun[:, 0].to(since), since[:, 1].clamp(min=0)], 1))[0]
    along = (forms * (precision * observed)[:, None]).sum(-1)
    energy = (forms.square() * precision[:, None]).sum(-1)
    free = torch.where(energy > 0, along.square() / energy, 0.0)
    # An inverted sign has no free size: undoing it subtracts twice the sensor, that is its mean and its rate.
    mean = _orthogonal(torch.where(begun[:, 2], span.mean[:, None], 0.0))[0]
    felt = _orthogonal(torch.where(begun[:, 2], (span.own - span.mean)[:, None], 0.0))[0].nan_to_num(0.0)
    back = precision * mean * (observed - mean) + inverted * felt * (observed - felt - 2 * mean)
    # A free size is penalised, or an inverted sign at rest would always be taken for a bias.
    gain = torch.cat([free - torch.log1p(free), 4 * back.sum(-1)[:, None]], 1)
    return gain, torch.cat([along / energy, torch.full_like(along[:, :1], torch.nan)], 1)


def _share_of_rate(
    others: Tensor, precision: Tensor, variance: Tensor, variance_of_others: Tensor, levels: Tensor
) -> Tensor:
    """Weight of each coefficient as evidence for an inverted sign, `(fault, coefficient)`: 1 in motion, 0 at rest.

    With a rate of variance S, and noise of variances v and w, the log likelihoods of a sensor `x` and of `-x` differ
    by `2 x y S / (S (v + w) + v w)`: at rest noise has no sign.
    """
    known = (precision > 0).to(variance)
    zeros = torch.zeros_like(variance)
    count = zeros.index_add(-1, levels, known).clamp(min=1)
    power = zeros.index_add(-1, levels, others.nan_to_num(0.0).square() * known) / count
    # Power within two standard errors of the noise is no rate.
    rate = (power - variance_of_others * (1 + 2 * (2 / count).sqrt())).clamp(min=0)
    own = (variance - variance_of_others).clamp(min=0)
    weight = rate / (rate + own * variance_of_others / variance)
    return weight.nan_to_num(0.0)[:, levels]  # where the sensor adds no noise of its own, and there is no rate


def _orthogonal(values: Tensor) -> tuple[Tensor, Tensor]:
    """Haar coefficients of non-overlapping windows `(..., coefficient)`, and the level of each from 0."""
    coefficients, levels = [], []
    for level in range(round(math.log2(values.shape[-1]))):
        first, second = values.unflatten(-1, (-1, 2)).unbind(-1)
        coefficients.append((second - first) / 2)
        levels.append(torch.full((first.shape[-1],), level, device=values.device))
        values = (first + second) / 2
    return torch.cat(coefficients, -1), torch.cat(levels)


def _longest_repeat(values: Tensor) -> Tensor:
    """Length of the longest run of samples that equal the sample before, `(...)` of `(..., time)`."""
    same = values.diff(dim=-1) == 0
    count = same.cumsum(-1)
    return (count - torch.where(same, 0, count).cummax(-1).values).amax(-1)


def _noise_evidence(coefficients: Tensor, precision: Tensor, variance: Tensor, levels: Tensor) -> Tensor:
    """Largest log likelihood ratio of added noise: white, random walk, of the same colour, or of one level.

    Variance `1 + s g_j` times what it should be turns the log likelihood by
    `sum_j n_j/2 [r_j s g_j / (1 + s g_j) - ln(1 + s g_j)]`, where `r_j` is the mean of `n_j` squares at level j.
    """
    zeros = torch.zeros_like(variance)
    energy = zeros.index_add(-1, levels, coefficients.square() * precision)
    count = zeros.index_add(-1, levels, (precision > 0).to(variance))  # (fault, level)
    tau = torch.exp2(torch.arange(variance.shape[-1], device=variance.device, dtype=variance.dtype))
    # A single level counts as noise from 8 coefficients on; fewer fit any shape.
    alone = torch.diag_embed((count >= 8).to(variance))
    colours = torch.stack([1 / tau / variance, tau / variance, torch.ones_like(variance)], 1)
    colours = torch.cat([colours / colours.amax(-1, keepdim=True), alone], 1)  # (fault, colour, level)
    sizes = torch.logspace(-2, 8, 81, device=variance.device, dtype=variance.dtype)[:, None, None, None]
    added = sizes * colours  # (size, fault, colour, level)
    ratio = energy.unsqueeze(-2) * added / (1 + added) - count.unsqueeze(-2) * torch.log1p(added)
    return ratio.sum(-1).amax((0, 2)) / 2
