"""p values of many tests together, and of averaged likelihood ratios (e-values)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_LOOSE = 0.05  # of the bound on the probability of a mean ratio
_BY_CHANCE, _SURELY = 0.05, 1e-3  # p values of what a simulation shows
_TAIL = 0.25  # share of the twins behind the fitted tail
SHARES = (0.2, 0.5, 0.9)  # of the sensors that have an effect


def sidak(p: float, places: float) -> float:
    """p value of the smallest of so many independent ones, each uniform: `1 - (1 - p)^places`, to rounding."""
    return -math.expm1(places * math.log1p(-min(p, 1.0))) if p < 1 else 1.0


def sidak_level(p: float, places: float) -> float:
    """What the smallest of so many p values is where it has `p` when corrected for their number."""
    return -math.expm1(math.log1p(-min(p, 1 - 1e-16)) / places)


def p_value_from_e_value(log_ratio: float) -> float:
    """p value of a mean likelihood ratio, from its logarithm.

    It exceeds `x` with probability `1/x` at most (Ville, 1939); by drawn records `1/30x` or less. To `1/20x` is held.
    """
    return math.exp(min(math.log(_LOOSE) - log_ratio, 0.0))


def e_values_by_share(log_ratios: Tensor) -> Tensor:
    """Logarithms of `prod (1 - e + e E)` for shares `e`, `(share, ...)`, of ratios `log E` `(sensor, ...)`."""
    e = torch.tensor(SHARES, dtype=log_ratios.dtype).view(-1, *[1] * log_ratios.ndim)
    return torch.logaddexp(log_ratios + e.log(), torch.log1p(-e)).sum(1)


def e_value_of_some(log_ratios: Tensor) -> Tensor:
    """Logarithm of the mean of `prod (1 - e + e E)` over shares `e`.

    Any of the sensors may have what each has a likelihood ratio of its own for; these have to be independent.
    """
    return log_ratios[0] if len(log_ratios) == 1 else e_values_by_share(log_ratios).logsumexp(0) - math.log(len(SHARES))


def p_value_beyond_reference(own: float, other: float) -> float:
    """p value of what the simulation shows too, there with the p value `other`.

    What it may have by chance the recording has to surpass: `own / other` is below `x` with a probability below `x`.
    Beside what it surely has, there is nothing to be told.
    """
    if other > _BY_CHANCE:
        return own
    return min(own / other, 1.0) if other > _SURELY else 1.0


def monte_carlo_p_value(p_value: float, among: Tensor) -> float:
    """p value from its rank among those of twins `(twin,)`, in which nothing is missing.

    Beyond the smallest quarter of them the tail is fitted instead of counted: `-log p` has an exponential tail, with
    rate one where witnesses are honest. The next one lies beyond all but the `k` highest with `(k + 1) / (n + 1)`, and
    there beyond `x` with `(1 + x / sum)^-k`, both exactly, the sum that of the `k` excesses.
    """
    scores, own = -among.clamp(min=1e-300).log(), -math.log(max(p_value, 1e-300))
    threshold = float(scores.topk(round(_TAIL * len(scores)) + 1).values[-1])
    excess = scores[scores > threshold] - threshold
    if own <= threshold or not len(excess):
        return float(((scores >= own).sum() + 1) / (len(scores) + 1))
    beyond = (1 + (own - threshold) / float(excess.sum())) ** -len(excess)
    return (len(excess) + 1) / (len(scores) + 1) * beyond
