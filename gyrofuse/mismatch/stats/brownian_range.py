"""Range of a CUSUM: Kuiper's law, and what it is where the scale is an estimate."""

from __future__ import annotations

import math

from gyrofuse.mismatch.stats.long_run_variance import chi_square_nodes

_NEGLIGIBLE = 0.6  # range below which the series has not converged, and p is 1 to 1e-3


def kuiper_p_value(reach: float) -> float:
    """Of a Brownian bridge's range, `2 sum (4 j^2 x^2 - 1) exp(-2 j^2 x^2)` (Kuiper, 1960)."""
    if reach < _NEGLIGIBLE:
        return 1.0
    terms = [(4 * (j * reach) ** 2 - 1) * math.exp(-2 * (j * reach) ** 2) for j in range(1, 40)]
    return min(max(2 * sum(terms), 0.0), 1.0)


def studentised_range_p_value(reach: float, dof: float) -> float:
    """The same over an sd whose square is chi-square of so many degrees of freedom: the mean over that law."""
    factors, weights = chi_square_nodes(dof)
    return sum(
        w * kuiper_p_value(reach * math.sqrt(f)) for f, w in zip(factors.tolist(), weights.tolist(), strict=True)
    )
