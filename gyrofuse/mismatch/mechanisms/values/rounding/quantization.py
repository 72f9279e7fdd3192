"""Rounding of the rate to whole steps: a converter that the simulator left out, or that of the simulation itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.lattices import (
    Lattice,
    distinct_values,
    exact_lattices,
    off_lattice,
    simulated_lattices,
)
from gyrofuse.mismatch.detectors.values.quantisation_grid import missing_lattices
from gyrofuse.mismatch.detectors.values.truncation import cut_off_gain
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.values.rounding.dead_band import DeadBand
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.filters import filtered
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.limits import Z

_TABLE = 1024  # points of a law
_EVEN = 3.0  # steps, sd: over more of them all distances from the lattice are as likely
_TAILS = 6.0  # sd
_TOO_COARSE = 0.4  # rms change between samples, steps: of white noise that of 0.28 steps
_STEEPEST, _FLAT = 8.0, 1e-4  # slopes of a logarithm of density over a step
_RIDGE = 1e-3  # of correlations
_SHARPEST = 0.02  # smallest blur, steps: it bounds the log likelihood ratio of an exact grid


@dataclass(frozen=True, eq=False)
class Quantization(Mechanism):
    """`y = offset + step round((x - offset)/step)`: an exact lattice of values, or one blurred by what came after.

    A converter that drops the fraction cuts values off towards zero: the step there is twice as wide.

    Looks like white noise of variance `step^2/12`; the values on their lattice tell them apart. Noise added after the
    rounding is no part of it. A simulation that rounds itself, to coarser steps, does so no more.

    Attributes:
        step: `(sensor,)`, unit of the signal; 0 where a sensor is not rounded.
        offset: `(sensor,)`, likewise: the lattice's point next to 0.
        blur: `(sensor,)`, sd of what was added after the rounding, steps.
        centre: Mean of what was rounded, `(sensor,)`, unit of the signal: where it lies between two steps makes what a
            few of them do to noise. A hidden lattice lies as far from the mean of a simulation, whose bias is its own.
        replaced: Steps of the simulation's own rounding that it takes the place of, one for each sensor, likewise; 0
            where it does not.
        cut_off: Whether values are cut off towards zero in place of being rounded, for each sensor; none by default.
    """

    name: ClassVar[str] = "quantization"
    likelihood: ClassVar[str] = "values"
    separated_by: ClassVar[str] = "the values as the converter gives them, before filters and averages"
    stage: ClassVar[int] = 2
    step: OfSensors
    offset: OfSensors
    blur: OfSensors
    centre: OfSensors
    replaced: tuple[float, ...] = ()
    cut_off: tuple[bool, ...] = ()

    @classmethod
    def in_reference(cls, comparison: Comparison) -> Quantization | None:
        """The exact grids of a simulation's values, those fine enough to be undone; None without."""
        side, fine = comparison.reference, _undone(comparison)
        if not fine:
            return None
        rows = [
            own if own is not None and i in fine else Lattice.none()
            for i, own in enumerate(simulated_lattices(comparison))
        ]
        step, offset = torch.tensor([row[:2] for row in rows], dtype=torch.float64).mT
        return cls(step, offset, torch.zeros_like(step), side.signal.mean((0, -1)), cut_off=_any_cut_off(rows))

    def undo_in_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The case of a simulation that was rounded so: what is built in from now on comes before that.

        What was rounded may have been anywhere within half a step. There the noise's density, a normal one given all
        other samples, is close to exponential, with the slope of its logarithm at the rounded value. Where noise falls
        below what rounding adds, as after a filter, that is white still: it is taken off.
        """
        side = comparison.reference
        white = whitened(side.noise, comparison.base)
        covariance = (white @ white.mT).mean(0) / white.shape[-1]  # of sensors that share noise
        slope = -self._divisor * whitened(
            torch.linalg.solve(_correlation(covariance), white), comparison.base
        )  # per step
        slope = slope.clamp(-_STEEPEST, _STEEPEST)
        slope = torch.where(slope.abs() < _FLAT, _FLAT, slope)
        share = torch.rand(slope.shape, dtype=slope.dtype, generator=generator)
        within = torch.log1p(share * torch.expm1(slope)) / slope - 0.5
        again: Callable[[Tensor], Tensor] = partial(self.apply, info=comparison.info, generator=generator)
        converter = (*comparison.converter, (self.stage, again))
        if self.cut_off:
            away = (side.signal / self._divisor).round().sign()
            within = torch.where(self._cut, torch.where(away == 0, 2 * within, within + away / 2), within)
        analog = side.signal + self.step[:, None] * within
        analog = filtered(analog, partial(self._without_rounding, side, replace(side, signal=analog)))
        return self._known_of_both(replace(comparison, analog=analog, converter=converter))

    def _without_rounding(self, side: Records, analog: Records, f: Tensor) -> Tensor:
        """Factors `(sensor, frequency)` that make of analogue records what the spectra of the rounded ones say."""
        f, least = f.clamp(min=0.5 / side.signal.shape[-1]), 1e-3
        density = side.density(f)
        added = self.step[:, None].square() / 12
        faint = 0.3  # of the power, from which on what was estimated tells less
        true = (density - added).maximum(least * density)
        below = ((added > faint * density) & (f > 0.05)).any(-1, keepdim=True)
        return torch.where(below, (true / analog.density(f)).sqrt().clamp(max=1.2), 1.0)

    def in_unit(self, factor: float) -> Quantization:
        """The same of numbers that are a factor larger."""
        step, offset, centre = (factor * numbers for numbers in (self.step, self.offset, self.centre))
        return replace(
            self, step=step, offset=offset, centre=centre, replaced=tuple(factor * one for one in self.replaced)
        )

    def left_of(self, own: Sequence[Mechanism]) -> tuple[Mechanism, ...]:
        kept = torch.tensor(self.replaced) == 0
        return tuple(
            replace(effect, step=torch.where(kept, effect.step, 0.0))
            if self.replaced and isinstance(effect, Quantization)
            else effect
            for effect in own
        )

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        # A value that recurs lies on lattices of many steps, which would all be taken for hidden ones.
        band = DeadBand.detect_and_fit(comparison, level)
        if band is not None:
            return band
        p_value, found, coarser = missing_lattices(comparison, level)
        undone = _undone(comparison)
        coarser = {i: own for i, own in coarser.items() if i in undone}
        if not found and not coarser:
            return None
        effect = cls.on(comparison, found, coarser)
        step, blur = effect.step, effect.blur
        sensors = tuple(sorted({*found, *coarser}))
        parameters = {
            f"simulated_lsb[{i}]": Parameter.exact(own.step, comparison.info.measure) for i, own in coarser.items()
        }
        parameters |= effect.step_limits(comparison, found)
        words = []
        if found:
            where = comparison.info.named(tuple(found), "all sensors")
            hidden = ", hidden under what was added later" if float(blur.max()) > 0 else ""
            cut = [i for i, own in found.items() if own.cut_off]
            how = f", cut off towards zero in {comparison.info.named(cut, 'all of them')}" if cut else ""
            words.append(
                f"the rate is rounded to steps of {_several(step[list(found)])} {comparison.info.measure} in {where}"
                f"{hidden}{how}"
            )
        if coarser:
            steps = _several(torch.tensor([own.step for own in coarser.values()], dtype=torch.float64))
            theirs = f"the simulation rounds to steps of {steps} {comparison.info.measure}"
            if set(coarser) == set(found):
                words[-1] += f", where {theirs}"
            else:
                where = comparison.info.named(tuple(coarser), "all sensors")
                words.append(f"{theirs} in {where}, the recording does not")
        coarse = _too_coarse(comparison.recording, found)
        if coarse:
            words.append(
                f"the noise of {comparison.info.named(coarse)} is so much smaller that nothing else can be told there"
            )
        return effect.found(
            "; ".join(words),
            p_value,
            sensors,
            parameters,
            levels=(1,),
            gain=effect.log_ratio(comparison),
            hides=tuple(coarse),
        )

    @classmethod
    def on(
        cls, comparison: Comparison, found: Mapping[int, Lattice], coarser: Mapping[int, Lattice] | None = None
    ) -> Quantization:
        """Grids of sensors, and those of the simulation that they take the place of, by position of the sensor."""
        every, coarser = range(comparison.n_sensors), coarser or {}
        rows = [found.get(i, Lattice.none()) for i in every]
        step, offset, blur = (torch.tensor([row[k] for row in rows], dtype=torch.float64) for k in range(3))
        replaced = tuple(coarser.get(i, Lattice.none()).step for i in every) if coarser else ()
        effect = cls(step, offset, blur, comparison.recording.mean(-1), replaced, _any_cut_off(rows))
        return effect._placed(effect._values(comparison))

    def step_limits(self, comparison: Comparison, sensors: Iterable[int]) -> dict[str, Parameter]:
        """Steps of some sensors as numbers of a finding."""
        limits = {}
        for i in sensors:
            reach = Z * self._step_sd(i, comparison.recording[i])
            limits[f"lsb[{i}]"] = Parameter.around(float(self.step[i]), reach, comparison.info.measure)
        return limits

    def log_ratio(self, comparison: Comparison) -> float:
        """Log likelihood of all values over that of none on a grid, nats."""
        return float(self._scores(comparison).sum())

    def fit_without(self, comparison: Comparison, fold: int) -> Quantization:
        return self._placed(self._values(comparison)[:, estimation_samples(comparison.n_samples, fold)])

    def _values(self, comparison: Comparison) -> Tensor:
        """The recording `(sensor, time)`, as it came where its lattice is exact."""
        return torch.where(self.blur[:, None] > 0, comparison.recording, comparison.as_came.signal[0])

    def _placed(self, signal: Tensor) -> Quantization:
        """With offset and blur of samples `(sensor, time)`, for the steps as they are."""
        turn = torch.exp(2j * math.pi * off_lattice(signal, self._divisor, self.offset[:, None])).mean(-1)
        offset = self.offset + turn.angle() / (2 * math.pi) * self.step
        blur = torch.sqrt(-2 * turn.abs().clamp(1e-6, 1.0).log()) / (2 * math.pi)
        return replace(self, offset=offset, blur=torch.where(self.blur > 0, blur, self.blur))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        step = float(self.step[sensor]) or self.replaced[sensor]  # where only the simulation has one, of that
        pictures.distance_from_grid(ax, comparison, sensor, step, float(self.offset[sensor]))

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        """Values get the law that they have in the recording, in the order in which they are.

        Without blur that is rounding. Hidden under noise that the simulation knows already, it adds next to nothing.
        """
        own = signal.mean(-1, keepdim=True) - self.centre[:, None]
        offset = self.offset[:, None] + torch.where(self.blur[:, None] > 0, own, 0.0)
        records = ((signal - offset) / self._divisor).reshape(-1, *signal.shape[-2:])
        moved = [_blurred(row, float(blur)) for record in records for row, blur in zip(record, self.blur, strict=True)]
        placed = torch.stack(moved).view_as(signal) * self._divisor + offset
        if self.cut_off:
            # A simulation's bias is its own: where zero lies is a matter of the recording's.
            placed = torch.where(self._cut, ((signal - own) / self._divisor).trunc() * self._divisor, placed)
        return torch.where(self.step[:, None] > 0, placed, signal)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return held_out_blocks(self._scores(comparison), fold).sum((0, -1))

    @property
    def _cut(self) -> Tensor:
        """Sensors whose values are cut off, `(sensor, 1)`."""
        return torch.tensor(self.cut_off or [False] * len(self.step))[:, None]

    @property
    def _divisor(self) -> Tensor:
        return torch.where(self.step > 0, self.step, 1.0)[:, None]

    def _scores(self, comparison: Comparison) -> Tensor:
        """Log density of the distances from the lattice against an even one, `(sensor, time)`: a wrapped normal's.

        Or against that of the simulation's lattice, where it has one.
        """
        signal = self._values(comparison)
        scores = _log_density(signal, self.step, self.offset, self.blur) + _cut_scores(comparison, self._cut)
        if not self.replaced:
            return scores
        own = [
            Lattice.none() if not step or lattice is None else lattice
            for step, lattice in zip(self.replaced, simulated_lattices(comparison), strict=True)
        ]
        step, offset = torch.tensor([lattice[:2] for lattice in own], dtype=torch.float64).mT
        cut = torch.tensor([lattice.cut_off is True for lattice in own])[:, None]
        return scores - _log_density(signal, step, offset, torch.zeros_like(step)) - _cut_scores(comparison, cut)

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The simulation's own rounding goes where this one takes its place."""
        sensors = [i for i, step in enumerate(self.replaced) if step]
        comparison = comparison.without_converter(self.stage, sensors) if sensors else comparison
        return self._known_of_both(super().apply_to_reference(comparison, generator))

    def _known_of_both(self, comparison: Comparison) -> Comparison:
        """The case of a simulation that is rounded so, where the recording is as well: what that adds is known."""
        alike = 0.01  # of a step
        theirs = torch.tensor(
            [0.0 if own is None else own.step for own in exact_lattices(comparison.as_came)], dtype=torch.float64
        )
        both = (self.blur == 0) & ((theirs - self.step).abs() < alike * self.step)
        before = torch.zeros_like(self.step) if comparison.rounding is None else comparison.rounding
        kept = torch.where(torch.tensor(self.replaced) > 0, 0.0, before) if self.replaced else before
        return replace(comparison, rounding=torch.where(both, self.step.square() / 12, kept))

    def _step_sd(self, sensor: int, signal: Tensor) -> float:
        """From the information of each distance on the lattice, as values spread over many steps."""
        r = (torch.arange(2048, dtype=torch.float64) + 0.5) / 2048 - 0.5
        density = _wrapped_normal(r, self.blur[sensor].clamp(min=1e-3))
        slope = density.roll(-1) - density.roll(1)
        information = float((slope.square() / density.clamp(min=1e-12)).mean()) * 1024**2
        spread = float((signal / self.step[sensor]).std())
        return float(self.step[sensor]) / math.sqrt(max(information * len(signal) * spread**2, 1e-300))


def _undone(comparison: Comparison) -> set[int]:
    """Sensors whose exact grid in the simulation is fine enough to be undone: what rounding adds is white."""
    side, least_change, least_spread = comparison.reference, 0.57, 0.5  # steps, rms from sample to sample, and at all
    change = side.signal.diff().square().mean((0, -1)).sqrt()
    spread = side.signal.var(-1).mean(0).sqrt()
    coarsest = torch.minimum(change / least_change, spread / least_spread)
    lattices = simulated_lattices(comparison)
    return {i for i, own in enumerate(lattices) if own is not None and own.step < float(coarsest[i])}


def _log_density(signal: Tensor, step: Tensor, offset: Tensor, blur: Tensor) -> Tensor:
    """Of distances from a lattice against an even one, `(sensor, time)`, nats; 0 where there is no step."""
    place = off_lattice(signal, torch.where(step > 0, step, 1.0)[:, None], offset[:, None])
    density = _wrapped_normal(place, blur.clamp(min=_SHARPEST)[:, None])
    return torch.where(step[:, None] > 0, density.clamp(min=1e-12).log(), 0.0)


def _any_cut_off(lattices: Sequence[Lattice]) -> tuple[bool, ...]:
    """Of each sensor; none where no sensor's values are cut off."""
    cut = tuple(own.cut_off is True for own in lattices)
    return cut if any(cut) else ()


def _cut_scores(comparison: Comparison, cut: Tensor) -> Tensor:
    """Log likelihood ratio of each sample that values are cut off towards zero, where they are said to be."""
    side = comparison.as_came
    scores = torch.zeros_like(side.signal[0])
    for i in cut[:, 0].nonzero()[:, 0].tolist():
        lattice = exact_lattices(side)[i]
        if lattice is not None:
            unique, counts = distinct_values(side)[i]
            scores[i] = cut_off_gain(side.signal[0, i], unique, counts, lattice.step)
    return scores


def _correlation(covariance: Tensor) -> Tensor:
    """Of a covariance, with a ridge where sensors are copies of each other."""
    size = covariance.diagonal().rsqrt()
    return covariance * size[:, None] * size + _RIDGE * torch.eye(len(size), dtype=size.dtype)


def _too_coarse(signal: Tensor, found: dict[int, Lattice]) -> list[int]:
    """Sensors `(sensor, time)` whose values hardly leave one step of an exact lattice from one sample to the next."""
    change = signal.diff().square().mean(-1).sqrt()
    return [i for i, own in found.items() if not own.blur and float(change[i]) < _TOO_COARSE * own.step]


def _blurred(place: Tensor, blur: float) -> Tensor:
    """Values, steps, mapped in order to such as were rounded and got a blur."""
    spread = float(place.std())
    variance = spread**2 - blur**2 - 1 / 12  # before rounding, which adds a twelfth on average over all biases
    if blur == 0 or spread > _EVEN or variance <= 0:
        nearest = place.round()
        return nearest + _pulled((place - nearest).contiguous(), blur)
    # Over a few steps their shares are those of a normal variable.
    middle, reach = float(place.mean()), math.ceil(_TAILS * spread)
    table = middle + spread * torch.linspace(-_TAILS, _TAILS, _TABLE + 1, dtype=torch.float64)
    steps = torch.arange(round(middle) - reach, round(middle) + reach + 1, dtype=torch.float64)
    edges = torch.special.ndtr((torch.cat([steps - 0.5, steps[-1:] + 0.5]) - middle) / math.sqrt(variance))
    below = torch.special.ndtr((table[:, None] - steps) / blur) @ (edges.diff() / edges.diff().sum())
    wanted = torch.special.ndtr((table - middle) / spread)
    # Where values of the one law lie in the other, and from there on as far away as they were.
    right = torch.searchsorted(below, wanted).clamp(1, _TABLE)
    share = (wanted - below[right - 1]) / (below[right] - below[right - 1]).clamp(min=1e-300)
    moved = table[right - 1] + share.clamp(0, 1) * (table[right] - table[right - 1]) - table
    at = ((place - table[0]) / (table[1] - table[0])).clamp(0, _TABLE - 1e-9)
    before = at.long()
    return place + torch.lerp(moved[before], moved[before + 1], at - before)


def _pulled(place: Tensor, blur: float) -> Tensor:
    """Even distances from a lattice, steps, mapped in order to those of a wrapped normal variable."""
    if blur < 1 / _TABLE:  # a wrapped normal narrower than a cell of the table has no density there
        return torch.zeros_like(place)
    edges = torch.linspace(-0.5, 0.5, _TABLE + 1, dtype=torch.float64)
    middle = (edges[1:] + edges[:-1]) / 2
    total = torch.nn.functional.pad(_wrapped_normal(middle, torch.tensor(blur)).cumsum(0), (1, 0))
    total = total / total[-1].clone() - 0.5
    right = torch.bucketize(place, total).clamp(1, _TABLE)
    share = (place - total[right - 1]) / (total[right] - total[right - 1]).clamp(min=1e-300)
    return edges[right - 1] + share.clamp(0, 1) * (edges[right] - edges[right - 1])


def _wrapped_normal(place: Tensor, sd: Tensor) -> Tensor:
    """Density at `place`, within half a turn of 0, of a normal variable on a circle of length one."""
    turns = torch.arange(-3, 4, dtype=torch.float64)
    normal = torch.zeros_like(place)
    for turn in turns.tolist():
        normal = normal + torch.exp(-((place - turn) / sd).square() / 2)
    return normal / (math.sqrt(2 * math.pi) * sd)


def _several(values: Tensor) -> str:
    """One number for values that agree, else the range."""
    low, high = float(values.min()), float(values.max())
    return f"{low:.4g}" if high <= low * (1 + 1e-3) else f"{low:.4g} to {high:.4g}"
