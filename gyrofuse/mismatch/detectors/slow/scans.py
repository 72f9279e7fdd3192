"""Scans of block means for slow effects: the most surprising template of each family.

Statistic: the best of a family of templates (onsets, time constants, lags of a temperature), by generalised least
squares with the noise refitted beside it. Null law: the maximum of a chi-square process along the whitened templates,
from the length of the curve that they draw on the sphere, and never more than that of as many separate tests; and
where the slow noise is known from few ordinates of the simulation, the tail of an F law in the place of an exponential
one.

References: Davies, Hypothesis testing when a nuisance parameter is present only under the alternative, Biometrika 74
(1987), 33.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.likelihoods.slow_noise import Fit, SlowNoise, best_fit, own_ordinates, simulated_slow_noise
from gyrofuse.mismatch.likelihoods.slow_templates import Family, declared_families, edges
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.stats.curve_maximum import curve_length, most_extreme, surprise
from gyrofuse.mismatch.stats.gls import least_squares
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.multiplicity import sidak

_LOW = 48  # ordinates in which sensors are compared: noise in common is slow
_SEEN = 0.02  # probability that a sensor seems to have a template, of those that are included to begin with
_FAR_ABOVE = 10.0  # variance over the simulation's, from which the noise is another one
_REFINED = 0.01  # p value below which the best template is sought between those of the grid
PLAUSIBLE = 6.0  # nats below the most likely template: 3.5 standard deviations of its numbers
MOST_STEPS = 12  # one by one: what takes more is another path


@dataclass(frozen=True, eq=False)
class Scan:
    """The best template of a family.

    Attributes:
        family: Templates, and `best`, the position of the best one.
        fit: Noise and sizes with it.
        z: Sizes in standard deviations, `(sensor, column)`, each column beside those before it; `held` with the noise
            held at the fit's, and `z` with what the likelihood ratio leaves where the noise may be stronger instead.
        gain: Log likelihood ratio of all sensors, nats, less the cost of the search.
        p_value: Corrected for the search.
        relation: Correlation of the sensors' noise beside it, `(sensor, sensor)`.
        lengths: Length of the curve of templates on the sphere, `(sensor,)`; infinite where only their number counts.
        searched: Templates of the grid.
    """

    family: Family
    best: int
    fit: Fit
    held: Tensor
    z: Tensor
    gain: float
    p_value: float
    relation: Tensor
    lengths: Tensor
    searched: int

    @property
    def point(self) -> list[float]:
        """Nonlinear numbers of the best template, samples."""
        return [float(number) for number in self.family.points[self.best]]

    @property
    def design(self) -> Tensor:
        """Columns of the best template, `(column, ordinate)`."""
        return self.family.designs[self.best]

    @cached_property
    def sensors(self) -> tuple[int, ...]:
        """Sensors that have the effect, given that any has."""
        return included_sensors(self.held.square().sum(-1), self.held.shape[-1], _SEEN).positions

    def gain_beside(self, relation: Tensor) -> float:
        """Its gain where the noise of the sensors has another correlation."""
        return float(surprise(self.z, self.lengths, relation, self.searched)[0])


class SeveralSteps(NamedTuple):
    """Steps in place of any other effect.

    Attributes:
        gain: Log likelihood ratio of all, nats, less what their onsets and sizes gain by chance.
        first: The ordinates without all but the most significant step.
    """

    gain: float
    first: SlowAnalysis


@dataclass(frozen=True, eq=False)
class SlowAnalysis:
    """Ordinates of a comparison's recording, and what may explain them.

    Attributes:
        noise: Slow noise around that of the simulation.
        y: Ordinates `(sensor, ordinate)`.
        null: Fit without an effect.
        families: Templates.
    """

    noise: SlowNoise
    y: Tensor
    null: Fit
    families: tuple[Family, ...]

    @cached_property
    def scans(self) -> tuple[Scan, ...]:
        """The best scan of each mechanism, p values corrected for its families.

        What a path of another form leaves is correlated among sensors: weighed by that, the worst form would gain most.
        All gains are therefore those beside the correlation that the most likely effect leaves.
        """
        scans = [self._scan(family) for family in self.families]
        relation = max(scans, key=lambda scan: float(scan.fit.value.sum())).relation
        scans = [replace(scan, gain=scan.gain_beside(relation), relation=relation) for scan in scans]
        best = []
        for name in dict.fromkeys(s.family.name for s in scans):
            own = [s for s in scans if s.family.name == name]
            first = max(own, key=lambda s: s.gain)
            best.append(replace(first, p_value=sidak(min(s.p_value for s in own), len(own))))
        return tuple(best)

    def scan(self, name: str) -> Scan | None:
        """The scan of one mechanism; None where there is nothing to scan."""
        return next((s for s in self.scans if s.family.name == name), None)

    @cached_property
    def wandering(self) -> float:
        """Nats that slow noise of any strength gains in place of an effect, less one for each sensor."""
        spread = self.noise.spread.clone()
        spread[1:] = 5.0  # sd of log factors of which nothing is known
        free = best_fit(replace(self.noise, spread=spread), self.y, start=self.null.log_factors)
        return free.log_likelihood(self.y) - self.null.log_likelihood(self.y) - len(self.y)

    @cached_property
    def several_steps(self) -> SeveralSteps | None:
        """Steps that together leave nothing but noise; None where there is one at most.

        Nor where they go on and on: a path that wanders, or bends, may be cut into ever more of them.
        """
        n_sensors, n_edges = self.of_steps[0].shape
        cost = math.log(n_edges) + n_sensors
        at, sizes, gains = steps_one_by_one(*self.of_steps, 2 * cost, MOST_STEPS)
        if not gains or len(gains) == MOST_STEPS:
            return None
        # A step within a block seems to be two at both ends of it.
        others = [k for k, edge in enumerate(at) if abs(edge - at[0]) > 1]
        if not others:
            return None
        paths = edges()
        fit = best_fit(self.noise, self.y, paths[at], self.null.log_factors)
        gain = fit.log_likelihood(self.y, paths[at]) - self.null.log_likelihood(self.y) - cost * len(at)
        alone = self.y - sizes[:, others] @ paths[torch.tensor(at)[others]]
        families = tuple(family for family in self.families if family.jumps)
        return SeveralSteps(gain, replace(self, y=alone, null=best_fit(self.noise, alone), families=families))

    @cached_property
    def of_steps(self) -> tuple[Tensor, Tensor]:
        """Products with steps at the edges of blocks, weighted by the simulation's noise.

        Those of the data `(sensor, edge)`, and of the steps with each other `(sensor, edge, edge)`.
        """
        weight, jumps = 1 / self.noise.own, edges()
        return (weight * self.y) @ jumps.mT, (weight[:, None] * jumps) @ jumps.mT

    def _scan(self, family: Family) -> Scan:
        """The best template with the noise refitted beside it, and again with the noise that it leaves."""
        steady = torch.ones(len(self.y), dtype=torch.float64)
        if family.jumps:  # to and fro between two levels they are another mechanism
            steady -= torch.tensor([jumps_to_and_fro(*pair) for pair in zip(*self.of_steps, strict=True)]).to(steady)
        scan: Scan | None = None
        fit, relation = self.null, related(self.y, self.null.variance, self.noise.own)
        lengths = torch.full_like(steady, math.inf)
        for _ in range(2):
            z = least_squares(self.y, fit.variance, family.designs).z  # (template, sensor, column)
            if family.designs.shape[1] == 1:
                paths = family.designs[:, 0]
                lengths = curve_length(fit.variance, paths, (1 / fit.variance) @ paths.square().mT)
            at = int(most_extreme(z.movedim(0, 1) * steady[:, None, None], lengths, relation))
            fit = best_fit(self.noise, self.y, family.designs[at], self.null.log_factors)
            again = self._judged(family, at, fit, lengths, steady, len(family.points))
            relation = again.relation
            scan = again if scan is None or again.p_value < scan.p_value else scan
        assert scan is not None
        if scan.p_value < _REFINED and family.design_at is not None:
            family, at, fit = self._refined(scan)
            scan = self._judged(family, at, fit, scan.lengths, steady, scan.searched)
        return scan

    def _judged(self, family: Family, at: int, fit: Fit, lengths: Tensor, steady: Tensor, searched: int) -> Scan:
        """A template with the noise that it leaves, the best of so many `searched` along a curve."""
        design = family.designs[at]
        left = self.y - fit.size @ design
        relation = related(left, fit.variance, self.noise.own)
        held = least_squares(self.y, fit.variance, design).z * steady[:, None]
        # Without the effect the noise that fits best may be stronger, which leaves less of the effect.
        ratio = 2 * float((fit.value - self.null.value).sum().clamp(min=0))
        share = min(ratio / max(float(held.square().sum()), 1e-300), 1.0)
        z = held * math.sqrt(share) / _excess(left, fit.variance).sqrt()[:, None]
        gain, p_value = (float(number) for number in surprise(z, lengths, relation, searched))
        p_value = studentised(p_value, self._dof(design, fit))
        return Scan(family, at, fit, held, z, gain, p_value, relation, lengths, searched)

    def _dof(self, design: Tensor, fit: Fit) -> float:
        """Complex ordinates from which the variance of a template's size is known (Satterthwaite).

        What is faster than a block is known exactly; neighbouring bands of the slow noise are correlated, and half of
        their ordinates count.
        """
        slow = 1 - self.noise.parts[:, 0] * fit.log_factors[:, :1].exp() / fit.variance  # share of the variance
        weight = design[0].square() / fit.variance
        return self.noise.dof / 2 / float((weight * slow).sum() / weight.sum()) ** 2

    def _refined(self, scan: Scan) -> tuple[Family, int, Fit]:
        """The best template between those of the grid, in a family as fine as the data determine its numbers.

        Of a strong effect the best template of a grid leaves more than the noise, and the stronger the noise seems the
        less it determines the numbers: the grid closes in on the plausible templates with the noise refitted each time.
        """
        family, at, fit = scan.family, scan.best, scan.fit
        for _ in range(12):  # each at least halves the grid
            gains = log_likelihood_ratios(self.y, fit.variance, family.designs, scan.sensors)
            likely, at = gains > gains.max() - 2 * PLAUSIBLE, int(gains.argmax())
            fit = best_fit(self.noise, self.y, family.designs[at], fit.log_factors)
            if int(likely.sum()) >= 24:  # of 96: a quarter of a standard deviation apart
                break
            family = _between(family, likely)
        return family, at, fit


@derived
def slow_analysis(comparison: Comparison) -> SlowAnalysis:
    """The slow ordinates of a comparison, with all that mechanisms declare as what may explain them."""
    noise, y = simulated_slow_noise(comparison), own_ordinates(comparison, comparison.observed)[0]
    return SlowAnalysis(noise, y, best_fit(noise, y), declared_families(comparison))


def slow_test(comparison: Comparison) -> TestResult:
    """A step, a warm-up, or a temperature that the recording follows."""
    return _most_significant(comparison, slow_analysis(comparison).scans)


def steady_course_test(comparison: Comparison) -> TestResult:
    """One of them of which a single size says all: no swing to and fro, which noise makes by itself now and then."""
    scans = slow_analysis(comparison).scans
    return _most_significant(comparison, [scan for scan in scans if scan.family.designs.shape[1] == 1])


def _most_significant(comparison: Comparison, scans: Sequence[Scan]) -> TestResult:
    scan = min(scans, key=lambda s: s.p_value)
    largest = max(scan.sensors, key=lambda i: float(scan.z[i].norm()))
    seconds = scan.point[0] / comparison.info.rate
    words = scan.family.words.format(seconds)
    return TestResult(
        "slow",
        sidak(scan.p_value, len(scans)),
        f"{words}, most clearly in sensor {comparison.info.sensors[largest]}",
        sensors=scan.sensors,
        time_s=seconds if scan.family.timed else None,
        channel=scan.family.channel,
    )


def log_likelihood_ratios(y: Tensor, variance: Tensor, designs: Tensor, sensors: Sequence[int]) -> Tensor:
    """Log likelihood ratio of each template in some sensors, nats, with the noise held, `(template,)`."""
    which = list(sensors)
    return least_squares(y[which], variance[which], designs).z.square().sum((-1, -2)) / 2


def steps_one_by_one(score: Tensor, gram: Tensor, least: float, most: int) -> tuple[list[int], Tensor, list[float]]:
    """Steps by forward selection: each where it gains most in all sensors together beside those before.

    Args:
        score: Weighted products of the data with steps at the edges of blocks, `(sensor, edge)`.
        gram: Those of the steps with each other, `(sensor, edge, edge)`.
        least: Twice the nats that a step gains.
        most: Number of steps at most.

    Returns:
        Edges, sizes `(sensor, step)`, and twice the nats that each gained when it was found.
    """
    at: list[int] = []
    gains: list[float] = []
    while True:
        within = gram[:, at][:, :, at]
        sizes = torch.linalg.solve(within, score[:, at, None])[..., 0]
        left = score - (gram[:, :, at] @ sizes[..., None])[..., 0]
        shared = (gram[:, :, at] * torch.linalg.solve(within, gram[:, at]).mT).sum(-1)
        information = gram.diagonal(dim1=-2, dim2=-1) - shared
        information[:, at] = math.inf
        squares = (left.square() / information).sum(0)
        if float(squares.max()) < least or len(at) == most:
            return at, sizes, gains
        at.append(int(squares.argmax()))
        gains.append(float(squares.max()))


def jumps_to_and_fro(score: Tensor, gram: Tensor) -> bool:
    """Whether four or more jumps of a sensor lead between two levels, by its products `(edge,)`, `(edge, edge)`."""
    at, sizes, _ = steps_one_by_one(score[None], gram[None], 5.0**2, 10)
    if len(at) < 4:
        return False
    jumps = sizes[0]
    levels = torch.cat([torch.zeros_like(jumps[:1]), jumps[torch.tensor(at).argsort()].cumsum(0)])
    return bool(levels.amax() - levels.amin() < 1.6 * jumps.abs().median())  # a staircase of two jumps: 2


def related(left: Tensor, variance: Tensor, own: Tensor) -> Tensor:
    """Correlation of the sensors' slow noise `(sensor, sensor)`, shrunk towards none by as much as is chance.

    Noise far above the simulation's `own` variance is another one, which sensors may share almost wholly: how little of
    it they do not share falls off in its own way, so that no ordinate shows it.

    References: Ledoit and Wolf, A well-conditioned estimator for large-dimensional covariance matrices, Journal of
    Multivariate Analysis 88 (2004), 365.
    """
    low = (left / variance.sqrt())[:, :_LOW]
    c = low @ low.mT
    size = c.diagonal().sqrt()
    c = c / size[:, None] / size
    eye = torch.eye(len(c), dtype=c.dtype)
    squares = c[eye == 0].square()
    share = min(float((1 - squares).square().sum() / _LOW / squares.sum().clamp(min=1e-300)), 1.0)
    c = (1 - share) * c + share * eye
    above = float((variance / own)[:, :_LOW].log().mean().exp())
    if above <= _FAR_ABOVE:
        return c
    values, vectors = torch.linalg.eigh(c)
    return (vectors * values.clamp(min=1 - _FAR_ABOVE / above)) @ vectors.mT


def studentised(p_value: float, dof: float) -> float:
    """p value with noise known from so many complex ordinates: the tail of F with 2 and 2 dof in place of `exp(-x)`."""
    return (1 - math.log(max(p_value, 1e-300)) / dof) ** -dof if math.isfinite(dof) else p_value


def _between(family: Family, likely: Tensor, number: int = 96) -> Family:
    """A grid of so many templates between the neighbours of those that are likely, `(template,)`."""
    spans = []
    for numbers in family.points.mT:
        every = numbers.unique()
        at = torch.searchsorted(every, numbers[likely].contiguous())
        spans.append((float(every[max(int(at.min()) - 1, 0)]), float(every[min(int(at.max()) + 1, len(every) - 1)])))
    per_number = round(number ** (1 / len(spans)))
    grids = [torch.linspace(low, high, per_number, dtype=torch.float64) for low, high in spans]
    points = torch.cartesian_prod(*grids).view(-1, len(spans))
    if len(spans) == 2 and not family.timed:  # closer time constants are one, with sizes that cancel each other
        points = points[points[:, 1] > 1.5 * points[:, 0]]
    return family.at(points)


def _excess(left: Tensor, variance: Tensor) -> Tensor:
    """Mean square of steps at all edges in what is left, over what the noise lets expect, 1 at least, `(sensor,)`."""
    mean = least_squares(left, variance, edges()[:, None]).z.square().mean((0, 2))
    return ((mean + mean.mean()) / 2).clamp(min=1)
