"""Test of channels: regression of an array on auxiliary channels, in the domain of cosine transforms.

`y_k = K a_k + noise` at every ordinate, `y` the sensors, `a` the rows of a channel, `K` real: the same gain at every
frequency, phase 0. The transform makes white noise and random walks independent from ordinate to ordinate, which the
Fourier transform of a stretch does not: there a slow channel and a wandering bias look alike at their ends. The noise
has the shape of the simulation's, and in each band the recording's own cross-spectral matrix on top of it, so that
sensors with noise in common count once. Lines that the simulation has as well are left out: there its own motion would
be compared with the channel's.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from scipy import special
from torch import Tensor

from gyrofuse._base.transforms import cosine_ordinates
from gyrofuse.mismatch.decisions import CERTAIN
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.filters import quadrature
from gyrofuse.mismatch.signals.known_lines import without_lines
from gyrofuse.mismatch.signals.lines import simulated_lines
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.multiplicity import sidak


@dataclass(frozen=True, eq=False)
class ChannelFit:
    """Gains of the sensors on the rows of a channel.

    Attributes:
        gains: `(sensor, row)`, signal per unit of the channel.
        covariance: Of the gains, `(sensor, row, sensor, row)`.
        statistic: Twice the log likelihood ratio, chi-square with a degree of freedom for each gain.
        quadrature: The same for gains a quarter of a cycle apart, which no instantaneous coupling has; NaN where they
            were not asked for.
        share: Largest share of one band in the statistic.
        squares: Of the gains of each sensor, chi-square with a degree of freedom for each row, `(sensor,)`.
        p_value: Of the array, for having asked it whole and sensor by sensor.
    """

    gains: Tensor
    covariance: Tensor
    statistic: float
    quadrature: float
    share: float
    squares: Tensor
    p_value: float

    @property
    def excess(self) -> float:
        """Of the statistic over what chance gives."""
        return self.statistic - self.gains.numel()


def regress(
    comparison: Comparison,
    rows: Tensor,
    signal: Tensor | None = None,
    which: Tensor | None = None,
    *,
    late_as_well: bool = True,
) -> ChannelFit | None:
    """Regress the recording, or `signal` `(sensor, time)`, on rows `(row, time)`; None where these do not move.

    Twice where there is something: what a strong effect adds to the recording's own spectra is no noise. By default of
    all sensors, or of those at the positions `which`; gains a quarter of a cycle late are not known without
    `late_as_well`.
    """
    which = torch.arange(comparison.n_sensors) if which is None else which
    rows = rows - rows.mean(-1, keepdim=True)
    size = rows.square().mean(-1).sqrt()
    if not bool((size > 1e-12).all()):
        return None
    lines = simulated_lines(comparison.reference)
    rows = without_lines(rows / size[:, None], lines)
    own = _lineless(comparison) if signal is None else without_lines(signal, lines)
    y = _lineless_ordinates(comparison) if signal is None else cosine_ordinates(own)
    late = cosine_ordinates(quadrature(rows)) if late_as_well else None
    ordinates = _Ordinates(y[which], cosine_ordinates(rows), late)
    fit = _fitted(comparison, ordinates, comparison.observed, which)
    if fit is not None and fit.p_value < CERTAIN:
        left = own.clone()
        left[which] -= fit.gains @ rows
        fit = _fitted(comparison, ordinates, replace(comparison.observed, signal=left[None]), which) or fit
    if fit is None:
        return None
    return replace(fit, gains=fit.gains / size, covariance=fit.covariance / size[:, None, None] / size)


class _Ordinates(NamedTuple):
    """Cosine transforms.

    Attributes:
        sensors: `(sensor, ordinate)`.
        rows: `(row, ordinate)`.
        late: Of the rows a quarter of a cycle apart, where those are asked for.
    """

    sensors: Tensor
    rows: Tensor
    late: Tensor | None


@derived
def _lineless(comparison: Comparison) -> Tensor:
    """The recording without lines that the simulation has as well, `(sensor, time)`."""
    return without_lines(comparison.recording, simulated_lines(comparison.reference))


@derived
def _lineless_ordinates(comparison: Comparison) -> Tensor:
    """Its cosine transform, `(sensor, ordinate)`."""
    return cosine_ordinates(_lineless(comparison))


@derived
def _weights(comparison: Comparison) -> Tensor:
    """Of cosine ordinates, by the simulation's noise, `(sensor, ordinate)`; none beside lines that it has as well."""
    n = comparison.n_samples
    k = torch.arange(n, dtype=torch.float64)
    weights = comparison.base.spectrum((k / (2 * n)).clamp(min=1 / (2 * n))).rsqrt()
    for f in simulated_lines(comparison.reference):
        weights[:, (k / 2 - f * n).abs() < 4] = 0.0  # bins of its main lobe
    return weights


def _fitted(comparison: Comparison, ordinates: _Ordinates, noise: Records, which: Tensor) -> ChannelFit | None:
    """Generalised least squares beside a noise of the cross-spectra of `noise`; None where rows are hardly apart."""
    y, a, late = ordinates
    n_sensors, n_rows, n = len(which), len(a), y.shape[-1]
    weights = _weights(comparison)[which]
    edges = [1, *(2 * edge for edge in comparison.bands.edges[1:-1]), n]
    moment, moment_late = (torch.zeros(n_sensors * n_rows, dtype=torch.float64) for _ in range(2))
    matrix = torch.zeros(n_sensors * n_rows, n_sensors * n_rows, dtype=torch.float64)
    parts, informed = [], []
    inverses = torch.linalg.inv(noise.over(comparison.base).real[:, which][:, :, which])
    for inverse, (first, end) in zip(inverses, itertools.pairwise(edges), strict=True):
        w = weights[:, first:end]
        white = (inverse @ (w * y[:, first:end])) * w  # (sensor, ordinate)
        design = (w[:, None] * a[:, first:end]).flatten(0, 1)  # (sensor * row, ordinate)
        informed.append(design.square().sum(-1).view(n_sensors, n_rows).sum(-1) * inverse.diagonal())
        matrix += design @ design.mT * inverse.repeat_interleave(n_rows, 0).repeat_interleave(n_rows, 1)
        parts.append((white @ a[:, first:end].mT).flatten())
        moment += parts[-1]
        if late is not None:
            moment_late += (white @ late[:, first:end].mT).flatten()
    if float(torch.linalg.cond(matrix)) > 1e12:
        return None
    covariance = torch.linalg.inv(matrix)
    gains = covariance @ moment
    statistic = float(gains @ matrix @ gains)
    contributions = torch.stack([own @ gains for own in parts])
    blocks = covariance.view(n_sensors, n_rows, n_sensors, n_rows)
    each = gains.view(n_sensors, n_rows)
    own_statistic = torch.stack([each[i] @ torch.linalg.solve(blocks[i, :, i], each[i]) for i in range(n_sensors)])
    scores = weights * (y - each @ a)
    left = [
        (inverse @ scores[:, first:end]).square() / inverse.diagonal()[:, None]
        for inverse, (first, end) in zip(inverses, itertools.pairwise(edges), strict=True)
    ]
    own = _tails(own_statistic, n_rows, torch.stack(informed), left)
    sure = torch.from_numpy(special.chdtri(n_rows, own.numpy()))  # what would be as rare if the noise were known
    pooled = float(
        special.chdtrc(n_sensors * n_rows, statistic * float(sure.sum() / own_statistic.sum().clamp(min=1e-300)))
    )
    p_value = sidak(min(2 * pooled, 2 * sidak(float(own.amin()), n_sensors)), 1)
    return ChannelFit(
        gains=each,
        covariance=blocks,
        statistic=statistic,
        quadrature=math.nan if late is None else float(moment_late @ covariance @ moment_late),
        share=float(contributions.amax() / contributions.sum()) if statistic > 0 else 1.0,
        squares=sure,
        p_value=min(p_value, 1.0),
    )


def _tails(statistic: Tensor, n_rows: int, informed: Tensor, left: list[Tensor]) -> Tensor:
    """p values `(sensor,)` of statistics with the noise that the fit leaves in the recording, band by band.

    The variance of a gain is the mean of the residual variances of its bands, weighted by their information (Huber and
    White); its degrees of freedom are those of the weighted mean (Satterthwaite), and the statistic's law is that of F.

    Args:
        statistic: Chi-square if the noise were known, `(sensor,)`.
        n_rows: Degrees of freedom of the statistic.
        informed: Information on the gains in each band, `(band, sensor)`.
        left: Squares of residuals in each band, of mean one, `(sensor, ordinate)`; 0 where nothing was used.
    """
    share = informed / informed.sum(0)
    count = torch.stack([(band > 0).sum(-1) for band in left])
    free = (count - n_rows * share).clamp(min=0.0)
    level = torch.stack([band.sum(-1) for band in left]) / free.clamp(min=0.5)
    noise = (share * level).sum(0)
    freedom = 1 / (share.square() / free.clamp(min=1e-9)).sum(0)
    scaled = statistic / noise.clamp(min=1e-300)
    tails = special.betainc(freedom.numpy() / 2, n_rows / 2, (freedom / (freedom + scaled)).numpy())
    return torch.from_numpy(tails).clamp(min=1e-300)


def channel_test(comparison: Comparison) -> TestResult:
    """Gains of the sensors on fast channels and on the products of their rows."""
    tried = []
    for name in [*accelerations(comparison), *rates(comparison), *auxiliary(comparison)]:
        rows = comparison.info.channel_rows(name)
        kinds = [("", rows)]
        if name in accelerations(comparison):
            kinds += [(" squared", made) for made in squared(rows).values()]
        for words, regressors in kinds:
            fit = regress(comparison, regressors)
            if fit is not None:
                tried.append((fit, name, words))
    if not tried:
        return TestResult("channel", 1.0, "there is no channel to compare with but temperatures, if any")
    fit, name, words = min(tried, key=lambda entry: entry[0].p_value)
    return TestResult(
        "channel",
        sidak(fit.p_value, len(tried)),
        f"sensors follow {name}{words}",
        sensors=included_sensors(fit.squares, fit.gains.shape[-1], chance=0.01).positions,
        channel=name,
    )


def accelerations(comparison: Comparison) -> list[str]:
    """Names of the channels of acceleration, whole ones."""
    return _channels(comparison, "accel")


def rates(comparison: Comparison) -> list[str]:
    """Names of the channels of a reference rate, whole ones."""
    return _channels(comparison, "rate")


def auxiliary(comparison: Comparison) -> list[str]:
    """Names of other channels than motion and temperature, whole ones that are more than a straight line in time."""
    return [
        name
        for name, values in comparison.info.channels.items()
        if not any(word in name.lower() for word in ("accel", "rate", "temperature"))
        and bool(torch.isfinite(values).all())
        and bool(_bends(values.reshape(-1, values.shape[-1]).to(torch.float64)).all())
    ]


def _bends(rows: Tensor) -> Tensor:
    """Whether rows `(row, time)` are neither constant nor a count of samples, `(row,)`."""
    time = torch.linspace(-1, 1, rows.shape[-1], dtype=rows.dtype)
    rows = rows - rows.mean(-1, keepdim=True)
    line = (rows @ time / time.square().sum())[:, None] * time
    return (rows - line).abs().amax(-1) > 1e-3 * rows.abs().amax(-1)


def squared(rows: Tensor) -> dict[str, Tensor]:
    """What may be made of the square of a vector of rows `(row, time)` without their means: by kind, `(any, time)`.

    All products, the squared length, and where there are several rows the square of each.
    """
    rows = rows - rows.mean(-1, keepdim=True)
    squares = rows.square()
    upper = torch.triu_indices(len(rows), len(rows))
    axes = {f"axis {k + 1}": square[None] for k, square in enumerate(squares)} if len(rows) > 1 else {}
    return {"each": rows[upper[0]] * rows[upper[1]], "length": squares.sum(0, keepdim=True), **axes}


def _channels(comparison: Comparison, word: str) -> list[str]:
    return [
        name
        for name, values in comparison.info.channels.items()
        if word in name.lower() and bool(torch.isfinite(values).all())
    ]
