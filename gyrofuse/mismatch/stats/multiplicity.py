"""p values of many tests together, and of averaged likelihood ratios (e-values).

References:
    Sidak, Rectangular confidence regions for the means of multivariate normal distributions, JASA 62 (1967), 626.
    Ville, Etude critique de la notion de collectif, 1939: a nonnegative variable of mean one exceeds `x` with
    probability `1/x` at most.
    Vovk and Wang, E-values: calibration, combination and applications, Ann. Statist. 49 (2021), 1736.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import CERTAIN, CHANCE

SHARES = (0.2, 0.5, 0.9)  # of the sensors that have an effect, beforehand: few, half of them, nearly all


def sidak(p: float, n_tests: float) -> float:
    """p value `1 - (1 - p)^n` of the smallest of so many independent p values, exact to rounding."""
    return -math.expm1(n_tests * math.log1p(-min(p, 1.0))) if p < 1 else 1.0


def sidak_level(p: float, n_tests: float) -> float:
    """Smallest of so many p values that has the p value `p` once corrected: the inverse of `sidak`."""
    return -math.expm1(math.log1p(-min(p, 1 - 1e-16)) / n_tests)


def log_mean(log_values: Tensor) -> float:
    """Logarithm of the mean of values of any shape, from their logarithms."""
    return float(log_values.flatten().logsumexp(0)) - math.log(log_values.numel())


def p_value_from_e_value(log_ratio: float) -> float:
    """p value of a mean likelihood ratio.

    Ville's bound is `1/x`. Drawn nulls exceed `x` in `1/30x` (levels of noise, 4500 records of 1 to 6 sensors) to
    `1/70x` (outliers, by importance sampling) of all records: `1/20x` is used.

    Args:
        log_ratio: Logarithm of the mean likelihood ratio, nats.
    """
    return math.exp(min(-math.log(20.0) - log_ratio, 0.0))


def e_value_of(p_value: float) -> float:
    """Logarithm of the mean likelihood ratio behind a p value of `p_value_from_e_value`, nats."""
    return -math.log(20.0 * max(p_value, 1e-300))


def e_values_by_share(log_ratios: Tensor) -> Tensor:
    """Logarithms of `prod_i (1 - e + e E_i)` for each share `e`, `(share, ...)`, of `log E` `(sensor, ...)`."""
    e = torch.tensor(SHARES, dtype=log_ratios.dtype).view(-1, *[1] * log_ratios.ndim)
    return torch.logaddexp(log_ratios + e.log(), torch.log1p(-e)).sum(1)


def e_value_of_some(log_ratios: Tensor) -> Tensor:
    """Logarithm of the e-value that some of the sensors have an effect, `(...)`: the mean over the shares.

    Args:
        log_ratios: Logarithms of independent e-values of each sensor, `(sensor, ...)`.
    """
    return log_ratios[0] if len(log_ratios) == 1 else e_values_by_share(log_ratios).logsumexp(0) - math.log(len(SHARES))


def p_value_beyond_reference(own: float, other: float) -> float:
    """p value of an effect of the recording beyond that which the simulation shows itself.

    Args:
        own: p value of the effect in the recording.
        other: p value of the same effect in the simulation. By chance it is uniform, and `own / other` is below `x`
            with a probability below `x`; beside a certain effect of the simulation nothing can be said.
    """
    if other > CHANCE:
        return own
    return min(own / other, 1.0) if other > CERTAIN else 1.0


def monte_carlo_p_value(p_value: float, among: Tensor) -> float:
    """p value from its rank among those of null replicates, with a fitted tail beyond the smallest quarter of them.

    `-log p` has an exponential tail, of rate one where tests are honest. A further replicate lies beyond the threshold
    with `(k + 1) / (n + 1)`, and there beyond `x` with `(1 + x / sum)^-k`, both exactly; `sum` is that of the `k`
    excesses over the threshold.

    Args:
        p_value: Smallest p value of the recording.
        among: Those of the replicates, `(replicate,)`.
    """
    scores, own = -among.clamp(min=1e-300).log(), -math.log(max(p_value, 1e-300))
    threshold = float(scores.topk(round(len(scores) / 4) + 1).values[-1])
    excess = scores[scores > threshold] - threshold
    if own <= threshold or not len(excess):
        return float(((scores >= own).sum() + 1) / (len(scores) + 1))
    return (len(excess) + 1) / (len(scores) + 1) * _further(own - threshold, float(excess.sum()), len(excess))


def p_value_beyond_largest(own: Tensor, among: Tensor, times_as_many: float = 1.0) -> float:
    """p value of the largest log ratios of many cells, by the largest ones of another record's.

    Their tail is exponential, of rate one where they are as independent as was thought, and of a lower one where the
    noise of both records is heavy-tailed or wanders: half of the ones given, forty at most, tell. Fewer than ten count
    as ten, the others of rate one. Of one to four of the largest together those that are least likely count.

    Args:
        own: Log ratios of cells, `(cell,)`, the largest first, nats.
        among: The largest ones of the other record, one of each stretch of cells that belong together, `(cell,)`.
        times_as_many: Cells of the record over those of the other one.
    """
    k, few, most = min(len(among) // 2, 40), 10, 4
    if k == 0:
        return math.exp(-max(float(own[0]), 0.0)) if len(own) else 1.0
    largest = among.topk(k + 1).values
    total = max(float((largest[:k] - largest[k]).sum()), float(k)) + max(few - k, 0)
    beyond = (own[:most] - largest[k]).clamp(min=0).cumsum(0).tolist()
    # As many cells as tuples of so many may be those.
    p_values = [(times_as_many * k) ** j * _further(b, total, max(k, few)) for j, b in enumerate(beyond, 1)]
    return sidak(min([1.0, *p_values]), max(len(p_values), 1))


def _further(beyond: float, total: float, n: int) -> float:
    """Probability that further exponential values are beyond some of that sum, where so many have that total."""
    return (1 + beyond / total) ** -n
