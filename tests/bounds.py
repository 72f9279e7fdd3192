"""Bounds on numbers of successes, which a claim that is true breaks once in a thousand studies."""

from __future__ import annotations

from scipy import stats

REFUSED = 1e-3  # chance that a true claim is refused


def at_most(n: int, p: float) -> int:
    """Most successes of n that a probability of p at most may give."""
    return int(stats.binom.ppf(1 - REFUSED, n, p))


def at_least(n: int, p: float) -> int:
    """Fewest successes of n that a probability of p at least may give."""
    return int(stats.binom.ppf(REFUSED, n, p))
