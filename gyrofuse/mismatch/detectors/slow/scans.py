"""Scans of block means for slow effects: how surprising the best template is, and what it would be.

A scan takes the best of a family of templates (onsets, time constants, lags of a temperature). Its p value is that of
the maximum of a chi-square process along the whitened templates, from the length of the curve they draw on the sphere
(Davies, 1987), and never more than that of so many separate tests. Where it is small it is held against twins: block
means without an effect, beside simulations that tell of their noise no better than the one at hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.likelihoods.slow_noise import (
    Fit,
    SlowNoise,
    Told,
    best_fit,
    columns,
    normal_equations,
    scores,
    slow_ordinates,
    told,
    where,
)
from gyrofuse.mismatch.likelihoods.slow_templates import Family, double_warm_ups, edges, steps, temperatures, warm_ups
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.stats.curve_maximum import curve_length, most_extreme, surprise
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.multiplicity import monte_carlo_p_value, sidak

Array = NDArray[np.float64]

_LOW = 48  # ordinates in which sensors are compared
_SCANS = 2  # the second with the covariance that the first effect leaves
_FREE = 5.0  # sd of log factors that nothing is known of
_SEEN = 0.02  # chance that a sensor seems to have a template, of those that are taken for sure to begin with
_FAR_ABOVE = 10.0  # times the simulation's variance
_JUMP = 5.0  # standard deviations
_FEWEST_JUMPS, _MOST_JUMPS = 4, 10
_TWO_LEVELS = 1.6  # distance of the outermost levels, in jumps
MOST_STEPS = 12  # one by one: what takes more is another path
_TWINS = 256
_FINE = ("warm_up_transient", "temperature_drift")  # families that have places between any two
PLAUSIBLE = 6.0  # nats below the best place
_FINER, _CLOSER, _LIKELY = 8, 96, 12  # rounds, places of each, and how many likely ones are enough
_LEAST_APART = 0.4  # logarithms of two time constants: closer ones are one with sizes that cancel each other
# Where the likeliest place is sought: first and last step of its logarithm, nats that do not matter, and how often.
_SIDE, _SURELY_THERE, _SAME, _TRIES = 0.15, 1e-7, 1e-3, 300
_DOUBTED = 0.01  # p values below are held against twins


class Best(NamedTuple):
    """The best template of a family, for one case or for many at once.

    Attributes:
        at: Which of them, `(...)`.
        fit: With it.
        held: Sizes in standard deviations, `(..., sensor, column)`, with the noise held, each beside those before it.
        z: The same with what the likelihood ratio leaves of it.
        gain: Of all sensors together, nats, less what it costs to have looked at all places, `(...)`.
        p_value: For having looked at all of them, `(...)`.
        relation: Correlation of what the sensors have beside it, `(..., sensor, sensor)`.
        lengths: Of the curve of templates on the sphere, `(..., sensor)`; infinite where only their number counts.
    """

    at: Tensor
    fit: Fit
    held: Tensor
    z: Tensor
    gain: Tensor
    p_value: Tensor
    relation: Tensor
    lengths: Tensor


@dataclass(frozen=True, eq=False)
class Scan:
    """The best template of a family in a case, after so many `looks`; other attributes as in `Best`."""

    family: Family
    best: int
    fit: Fit
    held: Tensor
    z: Tensor
    gain: float
    p_value: float
    relation: Tensor
    lengths: Tensor
    looks: int

    @property
    def place(self) -> float:
        """Samples."""
        return float(self.family.places[self.best])

    @property
    def other(self) -> float | None:
        """Of the second path, where it has a place of its own."""
        return None if self.family.others is None else float(self.family.others[self.best])

    @property
    def design(self) -> Tensor:
        """Paths, `(column, ordinate)`."""
        return self.family.designs[self.best]

    def gain_beside(self, relation: Tensor) -> float:
        """Its gain where what the sensors have beside it is correlated so."""
        return float(surprise(self.z, self.lengths, relation, self.looks)[0])


class SeveralSteps(NamedTuple):
    """Steps in place of any other effect.

    Attributes:
        gain: Of all, nats, less what their places and sizes gain by chance.
        first: A look at the one that tells most, without the others.
    """

    gain: float
    first: SlowLook


@dataclass(frozen=True, eq=False)
class SlowLook:
    """All that scans need of a case; what is derived is computed once."""

    simulation: Told
    noise: SlowNoise
    y: Tensor
    null: Fit
    families: tuple[Family, ...]

    @cached_property
    def scans(self) -> tuple[Scan, ...]:
        """The best of each mechanism; of temperatures the best channel, for having looked at them all."""
        scans = self._alike([self._scan(family) for family in self.families])
        best = []
        for name in dict.fromkeys(s.family.name for s in scans):
            own = [s for s in scans if s.family.name == name]
            first = max(own, key=lambda s: s.gain)
            best.append(replace(first, p_value=sidak(min(s.p_value for s in own), len(own))))
        return tuple(best)

    @staticmethod
    def _alike(scans: list[Scan]) -> list[Scan]:
        """Scans with their gains beside what the sensors have in common where the likeliest of them is explained.

        What a path of another form leaves is common to them as well: weighed by that, the worst would gain most.
        """
        relation = max(scans, key=lambda scan: float(scan.fit.value.sum())).relation
        return [replace(scan, gain=scan.gain_beside(relation), relation=relation) for scan in scans]

    def scan(self, name: str) -> Scan | None:
        """That of one mechanism; None where there is nothing to scan."""
        return next((s for s in self.scans if s.family.name == name), None)

    @cached_property
    def wandering(self) -> float:
        """Nats that slow noise gains in place of any effect, its strength free in each sensor, less one for each."""
        spread = self.noise.spread.clone()
        spread[1:] = _FREE  # all but what is fast
        free = best_fit(replace(self.noise, spread=spread), self.y, start=self.null.log_factors)
        before, after = (float((self.y.square() / v + v.log()).sum()) / 2 for v in (self.null.variance, free.variance))
        return before - after - len(self.y)

    @cached_property
    def several_steps(self) -> SeveralSteps | None:
        """Steps that together leave nothing but noise; None where there is one at most.

        Nor where they go on and on: a path that wanders, or bends, may be cut into ever more of them.
        """
        n_sensors, n_edges = self.of_steps[0].shape
        cost = math.log(n_edges) + n_sensors
        at, sizes, told = steps_one_by_one(*self.of_steps, 2 * cost, MOST_STEPS)
        if not told or len(told) == MOST_STEPS:
            return None
        # One within a block seems to be two at both ends of it.
        others = [k for k, place in enumerate(at) if abs(place - at[0]) > 1]
        if not others:
            return None
        paths = edges()
        fit = best_fit(self.noise, self.y, paths[at], self.null.log_factors)
        left = self.y - fit.size @ paths[at]
        before, after = (
            float((y.square() / v + v.log()).sum()) / 2 for y, v in ((self.y, self.null.variance), (left, fit.variance))
        )
        gain = before - after - cost * len(at)
        alone = self.y - sizes[:, others] @ paths[torch.tensor(at)[others]]
        families = tuple(family for family in self.families if family.name == "step")
        return SeveralSteps(gain, replace(self, y=alone, null=best_fit(self.noise, alone), families=families))

    def _scan(self, family: Family) -> Scan:
        heard = self._heard(family)
        found, coarse = best_place(self.noise, self.y, self.null, family, heard), family
        if float(found.p_value) < _DOUBTED and family.name in _FINE:
            family, found = self._finer(family, found, heard)
        p_value = float(found.p_value)
        if p_value < _DOUBTED:
            p_value = max(p_value, monte_carlo_p_value(p_value, best_place(*self._twins, coarse, heard).p_value))
        best, gain, looks = int(found.at), float(found.gain), len(coarse.places)
        return Scan(family, best, found.fit, found.held, found.z, gain, p_value, found.relation, found.lengths, looks)

    def _finer(self, family: Family, found: Best, heard: Tensor) -> tuple[Family, Best]:
        """The likeliest place of all about the best of a grid, with places about as far apart as the data tell.

        Of a strong effect the best place of a grid leaves more than the noise, and the more noise there seems to be the
        less it tells of the place: both are sought together.
        """
        looks, at = len(family.places), int(found.at)
        best, fit = likeliest(self.noise, self.y, family, at, found.fit)
        for _ in range(_FINER):
            told = explained_by(self.y, fit.variance, family.designs, _concerned(found.held))
            likely = told > told.max() - 2 * PLAUSIBLE
            if int(likely.sum()) >= _LIKELY:
                break
            family = between(family, likely, best)
        family = family.at(*(torch.cat([p, b]) for p, b in zip(family.where, best, strict=True)))
        last = torch.tensor(len(family.places) - 1)
        return family, _judged(self.y, self.noise.own, self.null, family, last, fit, found.lengths, heard, looks)

    def _heard(self, family: Family) -> Tensor:
        """Sensors that count: 0 for steps in those that jump to and fro, which is another mechanism."""
        return torch.ones(len(self.y), dtype=torch.float64) if family.name != "step" else 1.0 - self._to_and_fro

    @cached_property
    def of_steps(self) -> tuple[Tensor, Tensor]:
        """Products with steps at the edges of blocks, weighted as the simulation's noise has it.

        Those of the data `(sensor, edge)`, and of the steps with each other `(sensor, edge, edge)`.
        """
        weight, jumps = 1 / self.noise.own, edges()
        return (weight * self.y) @ jumps.mT, (weight[:, None] * jumps) @ jumps.mT

    @cached_property
    def _to_and_fro(self) -> Tensor:
        pairs = zip(*self.of_steps, strict=True)
        return torch.tensor([jumps_to_and_fro(*pair) for pair in pairs], dtype=torch.float64)

    @cached_property
    def _twins(self) -> tuple[SlowNoise, Tensor, Fit]:
        """Noise as their simulations tell it, ordinates `(twin, sensor, ordinate)`, and fits without an effect.

        A twin has noise that may be behind this simulation; its own simulation tells of it no better than this one.
        """
        generator = torch.Generator().manual_seed(0)
        given = self.simulation
        behind = given.drawn(given.coefficients().expand(_TWINS, -1, -1), generator).coefficients()
        noise = given.drawn(behind, generator).noise()
        normal = torch.randn(_TWINS, *self.y.shape, generator=generator, dtype=torch.float64)
        y = given.noise_of(behind).own.sqrt() * normal
        return noise, y, best_fit(noise, y)


def best_place(noise: SlowNoise, y: Tensor, null: Fit, family: Family, heard: Tensor) -> Best:
    """The best template with the noise refitted beside it, and again with the noise that it leaves.

    Args:
        noise: Of `y`.
        y: Ordinates `(..., sensor, ordinate)`.
        null: Fit without an effect.
        family: Templates.
        heard: 1 for sensors that count, else 0, `(sensor,)`.
    """
    best: Best | None = None
    fit, relation, designs, looks = null, related(y, null.variance, noise.own), family.designs, len(family.places)
    lengths = y.new_full(y.shape[:-1], math.inf)
    for _ in range(_SCANS):
        z = columns(y, fit.variance, designs)
        if designs.shape[1] == 1:
            lengths = curve_length(fit.variance, family.templates, scores(y, fit.variance, family.templates)[1])
        at = most_extreme(z * heard[:, None, None], lengths, relation)
        fit = best_fit(noise, y, designs[at], null.log_factors)
        now = _judged(y, noise.own, null, family, at, fit, lengths, heard, looks)
        relation = now.relation
        best = now if best is None else where(now.p_value < best.p_value, now, best)
    assert best is not None
    return best


def _judged(
    y: Tensor, own: Tensor, null: Fit, family: Family, at: Tensor, fit: Fit, lengths: Tensor, heard: Tensor, looks: int
) -> Best:
    """A template with the noise that it leaves, one of so many `looks` along a curve; see `best_place`."""
    x = family.designs[at]
    left = y - fit.size @ x
    relation = related(left, fit.variance, own)
    root, score = normal_equations(y, fit.variance, x)
    held = torch.linalg.solve_triangular(root, score[..., None], upper=False)[..., 0] * heard[:, None]
    # The noise that fits best without the effect may be stronger in all sensors: that leaves less of it.
    ratio = 2 * (fit.value - null.value).sum(-1).clamp(min=0)
    share = (ratio / held.square().sum((-1, -2)).clamp(min=1e-300)).clamp(max=1)
    z = held * share.sqrt()[..., None, None] / _excess(left, fit.variance).sqrt()[..., None]
    gain, p_value = surprise(z, lengths, relation, looks)
    return Best(at, fit, held, z, gain, p_value, relation, lengths)


@derived
def slow_look(comparison: Comparison) -> SlowLook:
    """What is slow in a case, looked at once for the witness and for all mechanisms."""
    simulation, y = told(comparison), slow_ordinates(comparison.observed.steady[0])
    noise = simulation.noise()
    families = (steps(comparison), warm_ups(comparison), double_warm_ups(comparison), *temperatures(comparison))
    return SlowLook(simulation, noise, y, best_fit(noise, y), families)


def slow_test(comparison: Comparison) -> TestResult:
    """A step, a warm-up, or a temperature that the recording follows."""
    look = slow_look(comparison)
    scan = min(look.scans, key=lambda s: s.p_value)
    which = concerned(scan)
    largest = max(which, key=lambda i: float(scan.z[i].norm()))
    seconds = scan.place / comparison.info.rate
    seen = {
        "step": f"the bias steps near {seconds:.4g} s",
        "warm_up_transient": f"the bias decays after the start, over some {seconds:.3g} s",
        "temperature_drift": f"the bias follows {scan.family.channel}",
    }[scan.family.name]
    return TestResult(
        "slow",
        sidak(scan.p_value, len(look.scans)),
        f"{seen}, most clearly in sensor {comparison.info.sensors[largest]}",
        sensors=which,
        time_s=seconds if scan.family.name == "step" else None,
        channel=scan.family.channel,
    )


def concerned(scan: Scan) -> tuple[int, ...]:
    """Sensors in which a template is there, once it is there at all."""
    return _concerned(scan.held)


def _concerned(held: Tensor) -> tuple[int, ...]:
    return included_sensors(held.square().sum(-1), held.shape[-1], _SEEN).positions


def explained_by(y: Tensor, variance: Tensor, designs: Tensor, which: Sequence[int]) -> Tensor:
    """Twice the nats that each template explains in some sensors, `(template,)`."""
    return columns(y, variance, designs)[list(which)].square().sum((0, -1))


def steps_one_by_one(score: Tensor, gram: Tensor, least: float, most: int) -> tuple[list[int], Tensor, list[float]]:
    """Steps, each where all sensors together tell most of it beside those before.

    Args:
        score: Weighted products of the data with steps at the edges of blocks, `(sensor, edge)`.
        gram: Those of the steps with each other, `(sensor, edge, edge)`.
        least: Twice the nats that a step tells.
        most: Steps.

    Returns:
        Edges, sizes `(sensor, step)`, and twice the nats that each told when it was found.
    """
    at: list[int] = []
    told: list[float] = []
    while True:
        within = gram[:, at][:, :, at]
        sizes = torch.linalg.solve(within, score[:, at, None])[..., 0]
        left = score - (gram[:, :, at] @ sizes[..., None])[..., 0]
        shared = (gram[:, :, at] * torch.linalg.solve(within, gram[:, at]).mT).sum(-1)
        information = gram.diagonal(dim1=-2, dim2=-1) - shared
        information[:, at] = math.inf
        squares = (left.square() / information).sum(0)
        if float(squares.max()) < least or len(at) == most:
            return at, sizes, told
        at.append(int(squares.argmax()))
        told.append(float(squares.max()))


def jumps_to_and_fro(score: Tensor, gram: Tensor) -> bool:
    """Whether a sensor has several jumps that lead between two levels, by its products `(edge,)`, `(edge, edge)`."""
    at, sizes, _ = steps_one_by_one(score[None], gram[None], _JUMP**2, _MOST_JUMPS)
    if len(at) < _FEWEST_JUMPS:
        return False
    jumps = sizes[0]
    levels = torch.cat([torch.zeros_like(jumps[:1]), jumps[torch.tensor(at).argsort()].cumsum(0)])
    return bool(levels.amax() - levels.amin() < _TWO_LEVELS * jumps.abs().median())


def related(left: Tensor, variance: Tensor, own: Tensor) -> Tensor:
    """Correlation of the sensors' slow noise `(..., sensor, sensor)`, shrunk towards none by as much as is chance.

    Noise far above the simulation's `own` variance is another one, which sensors may share almost wholly: how little of
    it they do not share falls off in its own way, so that no ordinate tells it for another.
    """
    low = (left / variance.sqrt())[..., :_LOW]
    c = low @ low.mT
    size = c.diagonal(dim1=-1, dim2=-2).sqrt()
    c = c / size[..., :, None] / size[..., None, :]
    upper = torch.triu_indices(c.shape[-1], c.shape[-1], 1)
    squares = c[..., upper[0], upper[1]].square()
    by_chance = (1 - squares).square().sum(-1) / _LOW
    share = (by_chance / squares.sum(-1).clamp(min=1e-300)).clamp(max=1)[..., None, None]
    c = (1 - share) * c + share * torch.eye(c.shape[-1], dtype=c.dtype)
    louder = (variance / own)[..., :_LOW].log().mean((-1, -2)).exp()[..., None]
    if bool((louder <= _FAR_ABOVE).all()):
        return c
    values, vectors = torch.linalg.eigh(c)
    return (vectors * values.maximum(1 - _FAR_ABOVE / louder)[..., None, :]) @ vectors.mT


def likeliest(noise: SlowNoise, y: Tensor, family: Family, start: int, fit: Fit) -> tuple[list[Tensor], Fit]:
    """The place, `(1,)`, and other of greatest likelihood from one of a family on, with the noise best for each."""
    shift = float(family.places[family.places > 0].min())  # a lag may be none

    def places(x: Array) -> list[Tensor]:
        return [torch.tensor([max(math.exp(v) - shift, 0.0)], dtype=torch.float64) for v in x]

    def fitted(x: Array) -> Fit:
        return best_fit(noise, y, family.at(*places(x)).designs[0], fit.log_factors)

    def loss(x: Array) -> float:
        if (x < first).any() or (x > last).any() or (len(x) > 1 and x[1] - x[0] < _LEAST_APART):
            return math.inf
        return -float(fitted(x).value.sum())

    first, last = (
        np.array([math.log(float(limit(p)) + shift) for p in family.where]) for limit in (torch.min, torch.max)
    )
    x0 = np.array([math.log(float(p[start]) + shift) for p in family.where])
    simplex = np.vstack([x0, x0 + np.diag(np.where(x0 + _SIDE > last, -_SIDE, _SIDE))])
    options = {"initial_simplex": simplex, "xatol": _SURELY_THERE, "fatol": _SAME, "maxfev": _TRIES}
    found = minimize(loss, x0, method="Nelder-Mead", options=options)
    return places(found.x), fitted(found.x)


def between(family: Family, likely: Tensor, best: Sequence[Tensor]) -> Family:
    """The family between the neighbours of those places, and others, that are likely `(template,)`, and the best."""
    spans = []
    for places in family.where:
        every = places.unique()
        at = torch.searchsorted(every, places[likely])
        spans.append((every[max(int(at.min()) - 1, 0)], every[min(int(at.max()) + 1, len(every) - 1)]))
    n = round(_CLOSER ** (1 / len(spans)))
    grids = [torch.linspace(float(low), float(high), n, dtype=torch.float64) for low, high in spans]
    grid = torch.meshgrid(*grids, indexing="ij")
    return family.at(*(torch.cat([p.flatten(), b]) for p, b in zip(grid, best, strict=True)))


def _excess(left: Tensor, variance: Tensor) -> Tensor:
    """By how much steps anywhere are larger than the noise lets expect, mean squares, 1 at least, `(..., sensor)`."""
    size, information = scores(left, variance, edges())
    mean = (size.square() * information).mean(-1)
    return ((mean + mean.mean(-1, keepdim=True)) / 2).clamp(min=1)
