"""Scans of block means for slow effects: templates by place, how surprising the best is, and what it would be.

A scan takes the best of a family of templates (onsets, time constants, lags of a temperature). Its p value is that of
the maximum of a chi-square process along the whitened templates, from the length of the curve they draw on the sphere
(Davies, 1987), and never more than that of so many separate tests.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from scipy import stats
from scipy.signal import lfilter
from torch import Tensor

from gyrofuse.mismatch.case import N_BLOCKS, Case, Scene, block_means
from gyrofuse.mismatch.evidence import Evidence, corrected
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.slow import Fit, SlowNoise, best_fit, differences, scores, slow_noise

_LOW_BINS = 24  # of whitened differences, in which sensors are compared
_DULL = 0.2  # a p value above which the noise is not refitted, although ...
_SWALLOWED = math.sqrt(2)  # ... noise without the effect makes it look that much smaller
_SCANS = 2  # the second with the covariance that the first effect leaves
_PRESENT = 3.0  # standard deviations, noise held: 0.3 % each
_JUMP = 5.0  # standard deviations
_FEWEST_JUMPS, _MOST_JUMPS = 4, 10
_TWO_LEVELS = 1.6  # distance of the outermost levels, in jumps
_TIME_CONSTANTS = 24
_LAGS = 16


class Family(NamedTuple):
    """Templates of one mechanism.

    Attributes:
        name: Of the mechanism.
        templates: Differences of block means for a size of one, `(template, difference)`.
        places: What tells them apart, `(template,)`, samples: onset, time constant or lag.
        channel: Of a temperature, and its row.
        row: Likewise.
    """

    name: str
    templates: Tensor
    places: Tensor
    channel: str | None = None
    row: int = 0


@dataclass(frozen=True, eq=False)
class Scan:
    """The best template of a family.

    Attributes:
        family: Templates.
        best: Which of them.
        fit: With it.
        held: Sizes in standard deviations, `(sensor,)`, with the noise held.
        z: The same with what the likelihood ratio leaves of it.
        relation: Their correlation.
        lengths: Of the family's curves, `(sensor,)`.
        gain: Of all sensors together, nats.
        p_value: For having looked at all of them.
    """

    family: Family
    best: int
    fit: Fit
    held: Tensor
    z: Tensor
    relation: Tensor
    lengths: Tensor
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

    def _scan(self, family: Family) -> Scan:
        """Best template with the noise refitted beside it, and once more with the noise that it leaves."""
        best = self._seen(family, self.null, None)
        if _p_value(_SWALLOWED * best.z, best.relation, best.lengths, len(family.places)) > _DULL:
            return best
        tried: set[int] = set()
        seen = best
        while seen.best not in tried and len(tried) < _SCANS:
            tried.add(seen.best)
            x = seen.template.expand(len(self.y), -1)
            fit = best_fit(self.noise, self.y, x, self.null.log_factors)
            size, information = scores(self.y, fit.inverse, seen.template[None])
            held = (size * information.sqrt())[:, 0] * self._heard(family)
            # The noise that fits best without the effect may be stronger in all sensors: that leaves less of it.
            ratio = 2 * float((fit.value - self.null.value).sum())
            share = min(max(ratio, 0.0) / max(float(held.square().sum()), 1e-300), 1.0)
            z = held * math.sqrt(share) / self._excess(fit, seen.template).sqrt()
            relation = self._relation(fit, seen.template)
            fitted = _of(family, seen.best, fit, held, z, relation, seen.lengths)
            best = fitted if len(tried) == 1 or fitted.p_value < best.p_value else best
            seen = self._seen(family, fit, seen.template)
        return best

    def _seen(self, family: Family, fit: Fit, template: Tensor | None) -> Scan:
        """Best template with the noise held, which `template` was fitted beside."""
        size, information = scores(self.y, fit.inverse, family.templates)
        z = size * information.sqrt() * self._heard(family)[:, None]  # (sensor, template)
        lengths = curve_length(fit.inverse, family.templates, information)
        relation = self._relation(fit, template)
        at = _most_extreme(z, lengths, relation)
        return _of(family, at, fit, z[:, at], z[:, at], relation, lengths)

    def _heard(self, family: Family) -> Tensor:
        """Sensors that count: 0 for steps in those that jump to and fro, which is another mechanism."""
        return torch.ones(len(self.y), dtype=torch.float64) if family.name != "step" else 1.0 - self._to_and_fro

    @cached_property
    def _to_and_fro(self) -> Tensor:
        inverse = torch.cholesky_inverse(
            torch.linalg.cholesky(self.noise.covariance(self.noise.centre.expand(len(self.y), -1)))
        )
        pairs = zip(self.y, inverse, strict=True)
        return torch.tensor([jumps_to_and_fro(y, own) for y, own in pairs], dtype=torch.float64)

    def _excess(self, fit: Fit, template: Tensor) -> Tensor:
        """By how much steps anywhere are larger than the noise lets expect, mean squares, 1 at least, `(sensor,)`."""
        size, information = scores(self.y - fit.size[:, None] * template, fit.inverse, self._probes)
        mean = (size.square() * information).mean(-1)
        return ((mean + mean.mean()) / 2).clamp(min=1)

    @cached_property
    def _probes(self) -> Tensor:
        """Steps at every edge of blocks."""
        return torch.eye(self.y.shape[-1], dtype=torch.float64)

    def _relation(self, fit: Fit, template: Tensor | None) -> Tensor:
        """Correlation of the sensors' slow noise, shrunk towards none by as much as chance explains of it."""
        left = self.y if template is None else self.y - fit.size[:, None] * template
        white = (torch.linalg.cholesky(fit.inverse).mT @ left[..., None])[..., 0]
        low = torch.fft.rfft(white)[:, 1 : _LOW_BINS + 1]
        c = (low @ low.mH).real
        c = c / c.diagonal().sqrt().outer(c.diagonal().sqrt())
        upper = torch.triu_indices(len(c), len(c), 1)
        r = c[upper[0], upper[1]]
        by_chance = float((1 - r.square()).square().sum() / (2 * _LOW_BINS))
        share = min(by_chance / max(float(r.square().sum()), 1e-300), 1.0)
        return (1 - share) * c + share * torch.eye(len(c), dtype=c.dtype)


@remembered
def slow_look(case: Case) -> SlowLook:
    """What is slow in a case, looked at once for the witness and for all mechanisms."""
    noise, y = slow_noise(case), differences(case.recording)
    return SlowLook(noise, y, best_fit(noise, y), (steps(case), warm_ups(case), *temperatures(case)))


def slow_witness(case: Case) -> Evidence:
    """A step, a warm-up, or a temperature that the recording follows."""
    look = slow_look(case)
    scan = min(look.scans, key=lambda s: s.p_value)
    largest = int(scan.z.abs().argmax())
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
        sensors=concerned(scan) or (largest,),
        time_s=seconds if scan.family.name == "step" else None,
        channel=scan.family.channel,
    )


def concerned(scan: Scan) -> tuple[int, ...]:
    """Sensors in which a template is there, once it is there at all."""
    return tuple((scan.held.abs() > _PRESENT).nonzero()[:, 0].tolist())


def steps(case: Case) -> Family:
    """Steps at the edges of blocks and in their middles."""
    n = N_BLOCKS - 1
    edges = torch.eye(n, dtype=torch.float64)
    middles = (edges[:-1] + edges[1:]) / 2
    templates = torch.cat([edges, middles])
    onsets = torch.cat([torch.arange(1.0, n + 1), torch.arange(1.5, n)]).to(torch.float64)
    order = onsets.argsort()
    return Family("step", templates[order], onsets[order] * case.block)


def warm_ups(case: Case, time_constants: Tensor | None = None) -> Family:
    """Decays `exp(-t / tau)` with time constants `(template,)`, samples; by default from half a block to the record."""
    if time_constants is None:
        time_constants = torch.logspace(
            math.log10(case.block / 2), math.log10(case.n_samples), _TIME_CONSTANTS, dtype=torch.float64
        )
    tau = time_constants[:, None]
    # The mean over a block, a geometric sum.
    mean = torch.expm1(-case.block / tau) / torch.expm1(-1 / tau) / case.block
    means = mean * (-torch.arange(N_BLOCKS) * case.block / tau).exp()
    return Family("warm_up_transient", means.diff(), time_constants)


def temperatures(case: Case) -> list[Family]:
    """Each row of each temperature, with lags from none to a quarter of the record."""
    lags = torch.logspace(math.log10(case.block / 2), math.log10(case.n_samples / 4), _LAGS - 1, dtype=torch.float64)
    lags = torch.cat([torch.zeros(1, dtype=torch.float64), lags])
    return [temperature(case.scene, channel, row, lags, case.n_samples) for channel, row in temperature_rows(case)]


def temperature_rows(case: Case) -> list[tuple[str, int]]:
    """Names and rows of the channels that are temperatures, whole, and not constant."""
    return [
        (name, row)
        for name, values in case.scene.channels.items()
        if name.lower().startswith("temperature")
        for row, channel in enumerate(values.reshape(-1, values.shape[-1]))
        if bool(channel.isfinite().all()) and bool(channel.amax() > channel.amin())
    ]


def temperature(scene: Scene, channel: str, row: int, lags: Tensor, n_samples: int) -> Family:
    """One row with lags `(template,)` in samples."""
    paths = torch.stack([lagged(scene, channel, row, float(lag), n_samples) for lag in lags])
    return Family("temperature_drift", block_means(paths).diff(), lags, channel, row)


def lagged(scene: Scene, channel: str, row: int, lag: float, n_samples: int) -> Tensor:
    """Temperature of what follows a channel with a lag in samples, `tau dy/dt = x - y`, from equilibrium, `(time,)`."""
    x = scene.channels[channel]
    x = x.reshape(-1, x.shape[-1])[row].to(torch.float64)
    if len(x) < n_samples:
        raise ValueError(
            f"`channels`: expected {channel!r} at {n_samples} samples or more, got {len(x)}; "
            "give it for the whole record"
        )
    x = x[:n_samples]
    if not lag:
        return x
    keeps = math.exp(-1 / lag)
    y, _ = lfilter([1 - keeps], [1, -keeps], x.numpy(), zi=[keeps * float(x[0])])
    return torch.from_numpy(y)


def jumps_to_and_fro(y: Tensor, inverse: Tensor) -> bool:
    """Whether differences `(difference,)` have several jumps that lead between two levels, found one by one."""
    at: list[int] = []
    jumps = torch.zeros(0, dtype=y.dtype)
    while len(at) < _MOST_JUMPS:
        within = inverse[at][:, at]
        jumps = torch.linalg.solve(within, (inverse @ y)[at])
        left = inverse @ y - inverse[:, at] @ jumps
        information = inverse.diagonal() - (inverse[:, at] * torch.linalg.solve(within, inverse[at]).mT).sum(-1)
        information[at] = math.inf
        squares = left.square() / information
        if float(squares.max()) < _JUMP**2:
            break
        at.append(int(squares.argmax()))
    if len(at) < _FEWEST_JUMPS:
        return False
    order = torch.tensor(at[: len(jumps)]).argsort()
    levels = torch.cat([torch.zeros_like(jumps[:1]), jumps[order].cumsum(0)])
    return bool(levels.amax() - levels.amin() < _TWO_LEVELS * jumps.abs().median())


def curve_length(inverse: Tensor, templates: Tensor, information: Tensor) -> Tensor:
    """Length of the curve of whitened unit templates on the sphere, `(sensor,)`."""
    inner = ((templates[:-1] @ inverse) * templates[1:]).sum(-1)
    cosine = inner / (information[:, :-1] * information[:, 1:]).sqrt()
    return cosine.clamp(-1, 1).arccos().sum(-1)


def expected_exceedances(q: Tensor, dof: int, length: Tensor, places: int) -> Tensor:
    """How often a chi-square process along a curve exceeds `q`, by Davies (1987), or by the number of its places."""
    one = torch.from_numpy(stats.chi2.sf(q.numpy(), dof))
    high = q.clamp(min=max(dof - 1, 1e-3))  # below the mode, upcrossings do not count the places
    log_rate = (dof - 1) / 2 * (high / 2).log() - high / 2 - math.lgamma(dof / 2) - math.log(math.pi) / 2
    return torch.minimum(one + length * log_rate.exp(), places * one)


def _of(family: Family, best: int, fit: Fit, held: Tensor, z: Tensor, relation: Tensor, lengths: Tensor) -> Scan:
    gain = float(_pooled(z[:, None], relation)[0]) / 2
    p_value = _p_value(z, relation, lengths, len(family.places))
    return Scan(family, best, fit, held, z, relation, lengths, gain, p_value)


def _pooled(z: Tensor, relation: Tensor) -> Tensor:
    """`z' R^-1 z`, `(sensor, template)` -> `(template,)`."""
    return (z * torch.linalg.solve(relation, z)).sum(0)


def _most_extreme(z: Tensor, lengths: Tensor, relation: Tensor) -> int:
    """Template that is least expected, all sensors together or one alone."""
    return int(torch.minimum(*_expected(z, lengths, relation, z.shape[1])).argmin())


def _p_value(z: Tensor, relation: Tensor, lengths: Tensor, places: int) -> float:
    """Of the best template: exceedances come as in a Poisson process."""
    together, alone = (float(expected[0]) for expected in _expected(z[:, None], lengths, relation, places))
    return -math.expm1(-together) if len(z) == 1 else corrected(-math.expm1(-min(together, alone)), 2)


def _expected(z: Tensor, lengths: Tensor, relation: Tensor, places: int) -> tuple[Tensor, Tensor]:
    """How many templates were expected to do as well, for each `(template,)`: all sensors together, the best alone."""
    together = expected_exceedances(_pooled(z, relation), len(z), lengths.mean(), places)
    alone = expected_exceedances(z.square(), 1, lengths[:, None], places)
    return together, len(z) * alone.amin(0)
