"""Scans of block means for slow effects: how surprising the best template is, and what it would be.

A scan takes the best of a family of templates (onsets, time constants, lags of a temperature). Its p value is that of
the maximum of a chi-square process along the whitened templates, from the length of the curve they draw on the sphere
(Davies, 1987), and never more than that of so many separate tests. Where it is small it is held against twins: block
means without an effect, beside simulations that tell of their noise no better than the one at hand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import Evidence, calibrated, corrected
from gyrofuse.mismatch.partakers import partakers
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.slow import Fit, SlowNoise, Told, best_fit, scores, slow_ordinates, told, where
from gyrofuse.mismatch.slow_families import Family, edges, steps, temperatures, warm_ups

_LOW = 48  # ordinates in which sensors are compared
_SCANS = 2  # the second with the covariance that the first effect leaves
_FREE = 5.0  # sd of log factors that nothing is known of
_SEEN = 0.02  # chance that a sensor seems to have a template, of those that are taken for sure to begin with
_JUMP = 5.0  # standard deviations
_FEWEST_JUMPS, _MOST_JUMPS = 4, 10
_TWO_LEVELS = 1.6  # distance of the outermost levels, in jumps
_TWINS = 256
_DOUBTED = 0.01  # p values below are held against twins
_FAR = 1000.0  # of chi-squares, beyond which tails are zero to rounding


class Best(NamedTuple):
    """The best template of a family, for one case or for many at once.

    Attributes:
        at: Which of them, `(...)`.
        fit: With it.
        held: Sizes in standard deviations, `(..., sensor)`, with the noise held.
        z: The same with what the likelihood ratio leaves of it.
        gain: Of all sensors together, nats, less what it costs to have looked at all places, `(...)`.
        p_value: For having looked at all of them, `(...)`.
    """

    at: Tensor
    fit: Fit
    held: Tensor
    z: Tensor
    gain: Tensor
    p_value: Tensor


@dataclass(frozen=True, eq=False)
class Scan:
    """The best template of a family in a case; attributes as in `Best`."""

    family: Family
    best: int
    fit: Fit
    held: Tensor
    z: Tensor
    gain: float
    p_value: float

    @property
    def place(self) -> float:
        """Samples."""
        return float(self.family.places[self.best])

    @property
    def template(self) -> Tensor:
        return self.family.templates[self.best]


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
        scans = [self._scan(family) for family in self.families]
        best = []
        for name in dict.fromkeys(s.family.name for s in scans):
            own = [s for s in scans if s.family.name == name]
            first = max(own, key=lambda s: s.gain)
            best.append(replace(first, p_value=corrected(first.p_value, len(own))))
        return tuple(best)

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

    def _scan(self, family: Family) -> Scan:
        heard = self._heard(family)
        found = best_place(self.noise, self.y, self.null, family, heard)
        p_value = float(found.p_value)
        if p_value < _DOUBTED:
            p_value = max(p_value, calibrated(p_value, best_place(*self._twins, family, heard).p_value))
        return Scan(family, int(found.at), found.fit, found.held, found.z, float(found.gain), p_value)

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
    fit, relation = null, related(y, null.variance)
    for _ in range(_SCANS):
        size, information = scores(y, fit.variance, family.templates)
        lengths = curve_length(fit.variance, family.templates, information)
        at = _most_extreme(size * information.sqrt() * heard[:, None], lengths, relation)
        x = family.templates[at][..., None, :]
        fit = best_fit(noise, y, x, null.log_factors)
        left = y - fit.size[..., None] * x
        relation = related(left, fit.variance)
        held = fit.size * (x.square() / fit.variance).sum(-1).sqrt() * heard
        # The noise that fits best without the effect may be stronger in all sensors: that leaves less of it.
        ratio = 2 * (fit.value - null.value).sum(-1).clamp(min=0)
        share = (ratio / held.square().sum(-1).clamp(min=1e-300)).clamp(max=1)
        z = held * share.sqrt()[..., None] / _excess(left, fit.variance).sqrt()
        gain, p_value = _surprise(z, lengths, relation, len(family.places))
        now = Best(at, fit, held, z, gain, p_value)
        best = now if best is None else where(p_value < best.p_value, now, best)
    assert best is not None
    return best


@remembered
def slow_look(case: Case) -> SlowLook:
    """What is slow in a case, looked at once for the witness and for all mechanisms."""
    simulation, y = told(case), slow_ordinates(case.recorded.steady[0])
    noise, families = simulation.noise(), (steps(case), warm_ups(case), *temperatures(case))
    return SlowLook(simulation, noise, y, best_fit(noise, y), families)


def slow_witness(case: Case) -> Evidence:
    """A step, a warm-up, or a temperature that the recording follows."""
    look = slow_look(case)
    scan = min(look.scans, key=lambda s: s.p_value)
    which = concerned(scan)
    largest = max(which, key=lambda i: float(scan.z[i].abs()))
    seconds = scan.place / case.scene.rate
    seen = {
        "step": f"the bias steps near {seconds:.4g} s",
        "warm_up_transient": f"the bias decays after the start, over some {seconds:.3g} s",
        "temperature_drift": f"the bias follows {scan.family.channel}",
    }[scan.family.name]
    return Evidence(
        "slow",
        corrected(scan.p_value, len(look.scans)),
        f"{seen}, most clearly in sensor {case.scene.sensors[largest]}",
        sensors=which,
        time_s=seconds if scan.family.name == "step" else None,
        channel=scan.family.channel,
    )


def concerned(scan: Scan) -> tuple[int, ...]:
    """Sensors in which a template is there, once it is there at all."""
    return partakers(scan.held.square(), 1, _SEEN).positions


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


def related(left: Tensor, variance: Tensor) -> Tensor:
    """Correlation of the sensors' slow noise `(..., sensor, sensor)`, shrunk towards none by as much as is chance."""
    low = (left / variance.sqrt())[..., :_LOW]
    c = low @ low.mT
    size = c.diagonal(dim1=-1, dim2=-2).sqrt()
    c = c / size[..., :, None] / size[..., None, :]
    upper = torch.triu_indices(c.shape[-1], c.shape[-1], 1)
    squares = c[..., upper[0], upper[1]].square()
    by_chance = (1 - squares).square().sum(-1) / _LOW
    share = (by_chance / squares.sum(-1).clamp(min=1e-300)).clamp(max=1)[..., None, None]
    return (1 - share) * c + share * torch.eye(c.shape[-1], dtype=c.dtype)


def curve_length(variance: Tensor, templates: Tensor, information: Tensor) -> Tensor:
    """Length of the curve of whitened unit templates on the sphere, `(..., sensor)`."""
    inner = (1 / variance) @ (templates[:-1] * templates[1:]).mT
    cosine = inner / (information[..., :-1] * information[..., 1:]).sqrt()
    return cosine.clamp(-1, 1).arccos().sum(-1)


def expected_exceedances(q: Tensor, dof: int, length: Tensor, places: int) -> Tensor:
    """How often a chi-square process along a curve exceeds `q`, by Davies (1987), or by the number of its places."""
    one = torch.special.gammaincc(torch.full_like(q, dof / 2), q / 2)
    high = q.clamp(min=max(dof - 1, 1e-3))  # below the mode, upcrossings do not count the places
    log_rate = (dof - 1) / 2 * (high / 2).log() - high / 2 - math.lgamma(dof / 2) - math.log(math.pi) / 2
    return torch.minimum(one + length * log_rate.exp(), places * one)


def _excess(left: Tensor, variance: Tensor) -> Tensor:
    """By how much steps anywhere are larger than the noise lets expect, mean squares, 1 at least, `(..., sensor)`."""
    size, information = scores(left, variance, edges())
    mean = (size.square() * information).mean(-1)
    return ((mean + mean.mean(-1, keepdim=True)) / 2).clamp(min=1)


def _pooled(z: Tensor, relation: Tensor) -> Tensor:
    """`z' R^-1 z`, `(..., sensor, template)` -> `(..., template)`."""
    return (z * torch.linalg.solve(relation, z)).sum(-2)


def _most_extreme(z: Tensor, lengths: Tensor, relation: Tensor) -> Tensor:
    """Template that is least expected, all sensors together or one alone, `(...)`."""
    n_sensors, places = z.shape[-2:]
    pooled, at = _pooled(z, relation).max(-1)
    squares, alone_at = z.square().max(-1)  # (..., sensor)
    together = expected_exceedances(pooled, n_sensors, lengths.mean(-1), places)
    alone, which = expected_exceedances(squares, 1, lengths, places).min(-1)
    better = n_sensors * alone < together
    return torch.where(better, alone_at.gather(-1, which[..., None])[..., 0], at)


def _surprise(z: Tensor, lengths: Tensor, relation: Tensor, places: int) -> tuple[Tensor, Tensor]:
    """Gain of sizes `(..., sensor)` less the price of having looked everywhere, and p value of the best template."""
    n_sensors = z.shape[-1]
    pooled = _pooled(z[..., None], relation)[..., 0]
    together = expected_exceedances(pooled, n_sensors, lengths.mean(-1), places)
    far = pooled.clamp(max=_FAR)
    here = torch.special.gammaincc(torch.full_like(far, n_sensors / 2), far / 2)
    gain = pooled / 2 - (expected_exceedances(far, n_sensors, lengths.mean(-1), places) / here).log()
    if n_sensors == 1:
        return gain, -torch.expm1(-together)
    alone = n_sensors * expected_exceedances(z.square(), 1, lengths, places).amin(-1)
    # The better of two ways, where exceedances come as in a Poisson process.
    return gain, -torch.expm1(-2 * torch.minimum(together, alone))
