"""A mean likelihood ratio over Lorentzian humps that each sensor has of its own.

Powers `P` of bins whose mean is a level are weighed with a hump's shape less its mean, `c = sum (L - mean L) P`,
over the level that the same bins show: nearly a Beta variable with the skewness of its weights, and `u` its normal
score. A hump moves `u` by `a`; where `e` is the share of sensors that have it,

    prod_i (1 - e + e exp(a u_i - a^2 / 2))

has expectation one where nothing stands out, and so has its mean over positions, widths, sizes and shares.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from scipy import signal
from torch import Tensor

from gyrofuse.mismatch.detectors.spectra.modulated_ordinates import inflation
from gyrofuse.mismatch.detectors.spectra.shared_peak_scan import LOWEST, SMOOTH, Stretches
from gyrofuse.mismatch.stats.multiplicity import e_value_of_some


def scanned_own_peaks(power: Tensor, ordinates: float, levels: Tensor, width: float) -> Iterator[Stretches]:
    """Humps of half widths from four bins, a root of two apart, every half of a half width.

    Args:
        power: Of bins `(sensor, bin)`, of sensors that share nothing.
        ordinates: Number of independent ordinates in a bin.
        levels: Correlations of ordinates of noise whose level varies, `(sensor, distance)`.
        width: Of a bin, in bins of the record, of which those distances are.
    """
    n_bins, half = power.shape[-1], 4.0
    while half <= n_bins / 12:
        cell = max(int(half / 4), 1)
        cells = power[:, : n_bins // cell * cell].unflatten(-1, (-1, cell)).mean(-1)
        shape = _shape(cells.shape[-1], half / cell)
        independent = cell * ordinates / inflation(levels, shape - shape.mean(), cell * width)[:, None]
        score, whole = _scores(cells, shape, independent, -(-LOWEST // cell))
        centre = torch.arange(cells.shape[-1]) * cell + cell // 2
        which = (whole & (centre > 8 * half)).nonzero()[:, 0][:: max(round(half / 2 / cell), 1)]
        if len(which):
            whole_width = round(2 * half)
            yield Stretches(centre[which] - whole_width // 2, whole_width, _log_ratios(score[:, which]))
        half *= math.sqrt(2)


def _shape(n_cells: int, half: float) -> Tensor:
    """A hump of so many cells' half width, with what is around it: 16 half widths on either side.

    Fewer where the noise is not level so far, five at least: there half of a hump is taken for the level.
    """
    wide = n_cells / SMOOTH / half
    reach = round(min(max(wide, 5.0), 16.0) * half)
    return 1 / (1 + (torch.arange(-reach, reach + 1, dtype=torch.float64) / half).square())


def _scores(cells: Tensor, shape: Tensor, ordinates: Tensor, lowest: int) -> tuple[Tensor, Tensor]:
    """Normal scores of a hump centred on each cell `(sensor, cell)`, and whether four fifths of it lie in the spectrum.

    Args:
        cells: Their mean powers, `(sensor, cell)`.
        shape: Of the hump, cell by cell.
        ordinates: Number of independent ordinates in a cell, `(sensor, 1)`.
        lowest: Cells that are left out.
    """
    kernels = torch.stack([torch.ones_like(shape), shape, shape.square()])[:, None]
    used = torch.ones_like(cells[:1])
    used[:, :lowest] = 0
    count, first, second = _around(used, kernels)[:, 0]
    total, along = _around(cells * used, kernels[:2])
    count = count.round().clamp(min=1.0)  # whole, but for the rounding of transforms
    variance = (second - first.square() / count).clamp(min=1e-9) / ordinates
    standard = (along * count / total.clamp(min=1e-300) - first) / variance.sqrt()
    away = shape - shape.mean()
    skewness = float(away.pow(3).sum() / away.square().sum().pow(1.5)) * math.sqrt(len(shape))
    inside = (1 - skewness / math.hypot(skewness, 2.0)) / 2
    return _normal_of_share(standard, inside, len(shape) * ordinates), count > 0.8 * len(shape)


def _around(rows: Tensor, kernels: Tensor) -> Tensor:
    """Rows `(row, cell)` weighed with kernels `(kernel, 1, cell)` about each cell, `(kernel, row, cell)`."""
    every = rows.expand(len(kernels), -1, -1)
    return torch.from_numpy(signal.oaconvolve(every.numpy(), kernels.numpy(), mode="same", axes=-1))


def _normal_of_share(standard: Tensor, inside: float, n: Tensor) -> Tensor:
    """Normal score (Paulson) of a standardised Beta variable of mean `inside` and `n` ordinates."""
    share = (inside + standard * (inside * (1 - inside) / (n + 1)).sqrt()).clamp(1e-9, 1 - 1e-9)
    root = (share / inside * (1 - inside) / (1 - share)).pow(1 / 3)
    a, b = 1 / (9 * n * inside), 1 / (9 * n * (1 - inside))
    return ((1 - b) * root - (1 - a)) / (b * root.square() + a).sqrt()


def _log_ratios(score: Tensor) -> Tensor:
    """Log likelihood ratios `(position,)` of normal scores `(sensor, position)`, averaged over sizes and sensors."""
    sizes = (2.0, 3.0, 4.5, 6.5)  # standard deviations
    ratios = torch.stack([e_value_of_some(a * score - a**2 / 2) for a in sizes])
    return ratios.logsumexp(0) - math.log(len(sizes))
