"""Numbers of a slow effect with their uncertainty: posterior means over the plausible templates of a family."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.scans import PLAUSIBLE, Scan, SlowAnalysis, log_likelihood_ratios
from gyrofuse.mismatch.likelihoods.slow_noise import cell_differences
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.gls import least_squares
from gyrofuse.mismatch.stats.limits import Z


class Estimate(NamedTuple):
    """Numbers of an effect.

    Attributes:
        points: Median, 2.5 and 97.5 % quantiles of each nonlinear number, samples.
        size, sd: Means and standard deviations of the sizes, `(sensor, column)`.
    """

    points: tuple[tuple[float, float, float], ...]
    size: Tensor
    sd: Tensor


def estimate(analysis: SlowAnalysis, scan: Scan) -> Estimate:
    """Posterior of an effect's numbers, all templates of the scan's family alike beforehand, the noise held."""
    variance, designs = scan.fit.variance, scan.family.designs
    weight = torch.softmax(log_likelihood_ratios(analysis.y, variance, designs, scan.sensors), 0)
    fits = least_squares(analysis.y, variance, designs)  # (template, sensor, column)
    mean, square = (torch.tensordot(weight, values, 1) for values in (fits.size, fits.variance + fits.size.square()))
    points = tuple(quantiles(numbers, weight) for numbers in scan.family.points.mT)
    return Estimate(points, mean, (square - mean.square()).clamp(min=0).sqrt())


def log_factors(scan: Scan) -> Tensor:
    """Log factors of the slow noise beside an effect, `(sensor, part)`, that give it the significance of the scan.

    Without the effect the noise that fits best is stronger, which leaves less of the effect than noise held at the fit.
    """
    which = list(scan.sensors)
    held, left = scan.held[which].norm(), scan.z[which].norm()
    least = 1e-6 * held.clamp(min=1e-300)  # of what stronger noise explains as well there may be nothing left
    return scan.fit.log_factors + 2 * max(float((held / left.clamp(min=least)).log()), 0.0)


def quantiles(points: Tensor, weight: Tensor) -> tuple[float, float, float]:
    """Median, 2.5 and 97.5 % quantiles of points with weights that sum to one.

    No tail lies beyond the first and the last point: these are within the limits where they are as likely as limits of
    a normal law are.
    """
    points, order = points.sort()
    weight = weight[order]
    below = weight.cumsum(0) - weight / 2
    at = torch.searchsorted(below, torch.tensor([0.5, 0.025, 0.975], dtype=torch.float64)).clamp(max=len(points) - 1)
    middle, low, high = points[at].tolist()
    first, last = points[[0, -1]].tolist()
    likely = points[weight > math.exp(-(Z**2) / 2) * weight.max()]
    return middle, first if float(likely[0]) == first else low, last if float(likely[-1]) == last else high


def only(size: Tensor, which: Sequence[int]) -> Tensor:
    """Sizes `(sensor, ...)` of some sensors, 0 in the others."""
    kept = torch.zeros_like(size)
    kept[list(which)] = size[list(which)]
    return kept


def onset_samples(
    comparison: Comparison, analysis: SlowAnalysis, scan: Scan, size: Tensor
) -> tuple[float, float, float]:
    """Median of a step's onset with 95 % limits, samples, from ever finer cells around it.

    Args:
        comparison: Recording and simulation.
        analysis: Ordinates of the scan.
        scan: Scan of steps.
        size: Sizes of the step, `(sensor,)`, which are held.
    """
    most_cells, margin_cells = 256, 24  # searched at once, and left on either side of the likely ones
    which = list(scan.sensors)
    size = size[which, None]
    gains = log_likelihood_ratios(analysis.y, scan.fit.variance, scan.family.designs, which)
    near, onsets = (gains > gains.max() - PLAUSIBLE).nonzero()[:, 0], scan.family.points[:, 0]
    low, high = float(onsets[max(int(near[0]) - 1, 0)]), float(onsets[min(int(near[-1]) + 1, len(onsets) - 1)])
    margin, coarser = max(high - low, 4.0 * comparison.block), comparison.n_samples
    while True:
        first, end = max(int(low - margin), 0), min(int(high + margin), comparison.n_samples)
        cell = max(-(-(end - first) // most_cells), 1)
        n_cells = (end - first) // cell
        signal = comparison.recording[which, first : first + n_cells * cell]
        y = signal.unflatten(-1, (n_cells, cell)).mean(-1).diff()
        covariance = cell_differences(comparison.base, cell, n_cells)[which]
        inverse = torch.linalg.inv(covariance * scan.fit.log_factors[which, :1, None].exp())
        information = inverse.diagonal(dim1=-1, dim2=-2)
        gain = size * (inverse @ y[..., None])[..., 0] - size.square() * information / 2
        weight = torch.softmax(gain.sum(0), 0)
        onsets = first + cell * torch.arange(1, n_cells, dtype=torch.float64)
        mean = onsets @ weight
        sd = float(((onsets - mean).square() @ weight).sqrt())
        # A quarter of a standard deviation is fine enough; onsets far apart keep cells from getting finer.
        if cell == 1 or sd > 4 * cell or cell >= coarser:
            return quantiles(onsets, weight)
        coarser = cell
        at = (weight > 1e-4 * weight.max()).nonzero()[:, 0]
        low, high, margin = float(onsets[at[0]]), float(onsets[at[-1]]), margin_cells * cell
