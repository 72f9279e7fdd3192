"""Tests of powers (F), of lines and of coherences (whitened differences of coherence matrices), band by band."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.detectors.lines.line_signs import line_signs
from gyrofuse.mismatch.detectors.lines.line_sizes import LineSizes, line_sizes
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.slow.slow_power import slow_power
from gyrofuse.mismatch.detectors.variance.level_spread import level_variance
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.multiplicity import sidak


def spectrum_test(comparison: Comparison) -> TestResult:
    """Ratio of powers in each band and sensor, or of all that is slow together."""
    found, slow = _of_bands(comparison), slow_power(comparison)
    if slow is None:
        return found
    f, sensor = slow.frequency * comparison.info.rate, comparison.info.sensors[slow.sensor]
    together = TestResult(
        "spectrum",
        slow.p_value,
        f"power below {f:.3g} Hz is {slow.ratio:.3g} times the simulation's in sensor {sensor}",
        sensors=(slow.sensor,),
        levels=(level_of(slow.frequency),),
        frequency_hz=f,
    )
    return min((replace(e, p_value=sidak(e.p_value, 2)) for e in (found, together)), key=lambda e: e.p_value)


def _of_bands(comparison: Comparison) -> TestResult:
    """Of each band, F distributed with both records' degrees of freedom.

    Those of a fitted model are fewer by what its numbers may be off.
    """
    tails = power_tails(comparison)
    count = int(tails.isfinite().sum())
    if not count:
        return TestResult("spectrum", 1.0, "the simulation is too short to compare spectra with")
    sensor, band = divmod(int(tails.nan_to_num(nan=1.0).argmin()), tails.shape[1])
    p = float(tails[sensor, band])
    which = (tails < 0.05 / count).nonzero()
    ratio = float(comparison.observed.power[sensor, band] / comparison.reference.power[sensor, band])
    f = float(comparison.bands.frequency[band]) * comparison.info.rate
    return TestResult(
        "spectrum",
        sidak(p, count),
        f"power near {f:.3g} Hz is {ratio:.3g} times the simulation's in sensor {comparison.info.sensors[sensor]}",
        sensors=tuple(sorted({int(i) for i in which[:, 0]})) or (sensor,),
        levels=tuple(sorted({level_of(float(comparison.bands.frequency[b])) for b in which[:, 1].tolist() or [band]})),
        frequency_hz=f,
    )


def line_test(comparison: Comparison) -> TestResult:
    """The strongest spectral line that the simulation does not have, or one that it has in another size."""
    line = comparison.line
    f = line.frequency * comparison.info.rate
    names = ", ".join(comparison.info.sensors[i] for i in line.sensors)
    found = TestResult(
        "line",
        line.p_value,
        f"a line at {f:.6g} Hz in sensors {names}",
        sensors=line.sensors,
        levels=(level_of(line.frequency),),
        frequency_hz=f,
    )
    sizes = line_sizes(comparison)
    if sizes is None:
        return found
    every = (found, _other_size(comparison, sizes), *_other_sign(comparison))
    return min((replace(e, p_value=sidak(e.p_value, len(every))) for e in every), key=lambda e: e.p_value)


def _other_sign(comparison: Comparison) -> tuple[TestResult, ...]:
    """Sensors in which all lines of the simulation have the opposite phase, if any."""
    signs = line_signs(comparison)
    if signs is None or bool((signs.sign > 0).all()):
        return ()
    turned = tuple((signs.sign < 0).nonzero()[:, 0].tolist())
    words = f"the simulation's lines have the opposite phase in {comparison.info.named(turned)}"
    return (TestResult("line", signs.p_value, words, sensors=turned, levels=(1,)),)


def _other_size(comparison: Comparison, sizes: LineSizes) -> TestResult:
    """The simulation's line whose amplitude in the recording is the most surprising."""
    sensor, at = sizes.worst
    ratio = float(sizes.observed[sensor, at] / sizes.reference[sensor, at].clamp(min=1e-300))
    line = comparison.reference.lines[at]
    f, tails = line * comparison.info.rate, sizes.tails
    which = (tails[:, at] < 0.05 / tails.numel()).nonzero()[:, 0].tolist() or [sensor]
    return TestResult(
        "line",
        sizes.p_value,
        f"the line at {f:.6g} Hz has {ratio:.3g} times the simulation's amplitude in {comparison.info.named([sensor])}",
        sensors=tuple(which),
        levels=(level_of(line),),
        frequency_hz=f,
    )


def coherence_test(comparison: Comparison) -> TestResult:
    """Difference of complex coherences in each band, summed over the pairs of sensors.

    Of 80 ordinates and more the sum is Gamma distributed but for a slightly heavier tail, here that of F.
    """
    fewest = 80
    d, reference = (
        side.coherence_dof * comparison.steady_shares for side in (comparison.observed, comparison.reference)
    )
    if comparison.n_sensors < 2:
        return TestResult("coherence", 1.0, "a single sensor has no pairs")
    known = (d >= fewest) & (reference >= fewest)
    if not bool(known.any()):
        return TestResult("coherence", 1.0, "the recording is too short to compare coherences")
    one, other = comparison.observed.coherence, comparison.reference.coherence
    upper = torch.triu_indices(comparison.n_sensors, comparison.n_sensors, 1)
    # Whitened by what both have in common, entries vary alike and apart, whatever noise the sensors share.
    white = whitened_difference(one[known], other[known], d[known], reference[known])
    difference = torch.zeros(len(d), upper.shape[1], dtype=d.dtype)  # (band, pair)
    difference[known] = white.abs().square()[:, upper[0], upper[1]]
    q = difference.sum(-1) / (1 / d + 1 / reference.clamp(min=1e-9))
    n_pairs = difference.shape[-1]
    tails = stats.f.sf((q / n_pairs).numpy(), 2 * n_pairs, 10 * d.minimum(reference).clamp(min=1.0).numpy())
    tails = torch.from_numpy(tails).masked_fill(~known, 1.0)
    band = int(tails.argmin())
    pair = int(difference[band].argmax())
    i, j = (comparison.info.sensors[int(k[pair])] for k in upper)
    largest = float(one[band].abs()[upper[0], upper[1]][pair])
    f = float(comparison.bands.frequency[band]) * comparison.info.rate
    return TestResult(
        "coherence",
        sidak(float(tails[band]), int(known.sum())),
        f"sensors {i} and {j} have a coherence of {largest:.2f} near {f:.3g} Hz",
        sensors=tuple(range(comparison.n_sensors)),
        levels=(level_of(float(comparison.bands.frequency[band])),),
        frequency_hz=f,
    )


def whitened_difference(one: Tensor, other: Tensor, d: Tensor, s: Tensor) -> Tensor:
    """Difference of coherences `(band, sensor, sensor)` of `d` and `s` ordinates, in units of their mean."""
    both = (d[:, None, None] * one + s[:, None, None] * other) / (d + s)[:, None, None]
    root = torch.linalg.cholesky(both)
    left = torch.linalg.solve_triangular(root, one - other, upper=False)
    return torch.linalg.solve_triangular(root, left.mH, upper=False)


def power_tails(comparison: Comparison) -> Tensor:
    """Two-sided p values of the ratio of powers `(sensor, band)`; NaN where the simulation says nothing.

    The numbers of a fitted model may tell hardly the order of magnitude of a power, less than 20 ordinates would: its
    logarithm is then normal, while that of few ordinates is skew.
    """
    ratio = comparison.observed.power / comparison.reference.power
    d, s = (
        dof * comparison.steady_shares
        for dof in (comparison.bands.dof * comparison.observed.evenness, comparison.reference.power_dof)
    )
    own = level_variance(comparison) - comparison.reference.level_variance  # that of the simulation is in its own
    d = d / (1 + d * own[:, None])
    law = stats.f(2 * d.numpy(), 2 * s.clamp(min=1e-9).numpy())
    tails = 2 * torch.from_numpy(law.sf(ratio.numpy())).minimum(torch.from_numpy(law.cdf(ratio.numpy())))
    varies = torch.special.polygamma(1, d.clamp(min=1e-9)) + 1 / s.clamp(min=1e-9)
    away = comparison.observed.log_power - comparison.reference.power.log()
    normal = 2 * torch.special.ndtr(-away.abs() / varies.sqrt())
    vague = (s < 20) & (s < comparison.reference.dof / 2)
    tails = torch.where(vague, normal.maximum(tails), tails)
    return tails.clamp(max=1.0).masked_fill(s <= 0, math.nan)


def excess_p_value(comparison: Comparison, low: float, high: float) -> float:
    """p value, for all bands and sensors, of more power in a band that lies between two frequencies or reaches there.

    Args:
        comparison: Recording and simulation.
        low, high: Cycles per sample.
    """
    tails, edges = power_tails(comparison), comparison.bands.edges
    near = [
        b
        for b in range(tails.shape[1])
        if edges[b] < high * comparison.n_samples and edges[b + 1] > low * comparison.n_samples
    ]
    more = (comparison.observed.power > comparison.reference.power) & tails.isfinite()
    there = tails.where(more, 1.0)[:, near]
    return sidak(float(there.min()), int(tails.isfinite().sum())) if there.numel() else 1.0


def level_of(frequency: float) -> int:
    """Wavelet level whose octave `(2^-j-1, 2^-j)` holds a frequency in cycles per sample, from 1."""
    return max(math.floor(-math.log2(frequency)), 1)
