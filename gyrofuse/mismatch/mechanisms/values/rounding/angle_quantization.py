"""Quantisation of the integrated angle where the simulation has none: counts of a sensor that puts out angles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.angle_counts import angle_counts, counted
from gyrofuse.mismatch.likelihoods.spectra.components import NO_SHARED, Term
from gyrofuse.mismatch.likelihoods.spectra.fit import pieces
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.likelihoods.spectra.starts import best_start
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.mechanisms.spectra.findings import found, spanned
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import chosen_shape, refit
from gyrofuse.mismatch.mechanisms.spectra.rivals import fit_alone
from gyrofuse.mismatch.mechanisms.spectra.spectral import Addition
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors


@dataclass(frozen=True, eq=False)
class AngleNoise(Term):
    """`4 q sin(pi f)^2` added: the local number is `q`."""

    name: ClassVar[str] = "quantization_noise"
    lower: ClassVar[float] = 0.0

    @classmethod
    def starts(cls, ground: Ground) -> AngleNoise:
        """Levels to start from, `local` is `(start, 1, sensor)`."""
        unit = (ground.density / _profile(ground.nodes)).amin(-1)
        every = torch.ones(1, len(unit), dtype=torch.bool)
        return cls(torch.logspace(-2, 4, 19, dtype=torch.float64)[:, None, None] * unit, every, NO_SHARED)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        return local[..., 0, :, None] * _profile(ground.nodes)


@dataclass(frozen=True, eq=False)
class AngleQuantization(Addition):
    """`S_i -> S_i + 4 q_i sin(pi f)^2`: quantisation noise, the first difference of white noise of the angle.

    It falls as one over the averaging time in an Allan deviation. Of rounded values themselves the noise is white.

    Attributes:
        variance: `q`, of the angle's white noise, `(sensor,)`, unit of the signal squared.
    """

    name: ClassVar[str] = "quantization_noise"
    rivals: ClassVar[tuple[str, ...]] = ("parameter_shift", "low_pass", "flicker", "common_mode")
    separated_by: ClassVar[str] = "a recording at a higher rate"
    leaves_levels: ClassVar[bool] = True
    variance: OfSensors

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        if any(isinstance(term, AngleNoise) for term in company):
            return ()
        return (best_start(data, pieces(data, company), AngleNoise.starts(data.ground))[0],)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        shape = chosen_shape(comparison, cls.name, level)
        if shape is None:
            return None
        q, sd, info = shape.term.local[0], shape.sd[0][0], comparison.info
        sensors = tuple(int(i) for i in shape.term.free[0].nonzero()[:, 0])
        unit = info.measure.removesuffix("/s") if info.measure.endswith("/s") else f"{info.measure} s"
        parameters = {
            f"angle[{i}]": spanned(lambda x: math.sqrt(max(x, 0.0)) / info.rate, float(q[i]), float(sd[i]), unit)
            for i in sensors
        }
        largest = max(sensors, key=lambda i: float(q[i]))
        return found(
            cls(q),
            shape,
            sensors,
            parameters,
            f"quantisation noise of the angle in {info.named(sensors, 'all sensors')} beyond the simulation's, an angle"
            f" of up to {parameters[f'angle[{largest}]'].value:.3g} {unit} rms (sensor {info.sensors[largest]})",
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        alone = fit_alone(
            comparison,
            finding.sensors,
            lambda data: best_start(data, pieces(data, []), AngleNoise.starts(data.ground))[0],
        )
        return None if alone is None else Rival(cls(alone[0].local[0]), alone[1])

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> AngleQuantization | None:
        return cls(term.local[0]) if isinstance(term, AngleNoise) else None

    def density(self, f: Tensor) -> Tensor:
        return torch.diag_embed(self.variance * _profile(f)[:, None])

    def path(self, n_samples: int, generator: torch.Generator) -> Tensor:
        angle = torch.randn(len(self.variance), n_samples + 1, generator=generator, dtype=torch.float64)
        return self.variance.sqrt()[:, None] * angle.diff(dim=-1)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        own = self.variance[None]
        term = AngleNoise(own, own > 0, NO_SHARED)
        return replace(self, variance=refit(comparison, fold, term, self.company).local[0])


@dataclass(frozen=True, eq=False)
class AngleCounts(Mechanism):
    """`y_t = q (round(A_t / q) - round(A_(t-1) / q))`, `A` the sum of `x`: the angle is counted, not the rate.

    Attributes:
        grid: The values' grid, of steps `q`.
    """

    name: ClassVar[str] = AngleQuantization.name
    likelihood: ClassVar[str] = Quantization.likelihood
    separated_by: ClassVar[str] = AngleQuantization.separated_by
    stage: ClassVar[int] = Quantization.stage
    grid: Quantization

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found, info = angle_counts(comparison, level), comparison.info
        if not found:
            return None
        grid = Quantization.on(comparison, found)
        sensors, unit = tuple(found), info.measure.removesuffix("/s") if info.measure.endswith("/s") else info.measure
        parameters = grid.step_limits(comparison, found)
        counts = sorted({float(f"{own.step / info.rate:.4g}") for own in found.values()})
        return cls(grid).found(
            f"{info.named(sensors, 'all sensors')} count an angle in steps of {counts[0]:.4g}"
            + (f" to {counts[-1]:.4g}" if len(counts) > 1 else "")
            + f" {unit}: values lie on a grid, and what rounding adds is gone from one sample to the next",
            0.0,
            sensors,
            parameters,
            levels=(1,),
            gain=grid.log_ratio(comparison),
        )

    def fit_without(self, comparison: Comparison, fold: int) -> AngleCounts:
        return replace(self, grid=self.grid.fit_without(comparison, fold))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return self.grid.held_out_scores(comparison, fold)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        self.grid.plot(comparison, ax, sensor=sensor, fitted=fitted)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        """From an angle of zero on; a grid of the recording has zero on it."""
        step = self.grid.step
        return torch.where(step[:, None] > 0, counted(signal, torch.where(step > 0, step, 1.0)), signal)


def _profile(f: Tensor) -> Tensor:
    """Density of the first difference of white noise at `f` cycles per sample."""
    return 4 * torch.sin(math.pi * f).square()
