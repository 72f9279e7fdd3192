"""A sensor's own high-pass filter."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.components import NO_SHARED, Term
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import order_of, stopped
from gyrofuse.mismatch.likelihoods.spectra.fit import pieces
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground
from gyrofuse.mismatch.likelihoods.spectra.ratios import FLOOR, Ratios
from gyrofuse.mismatch.likelihoods.spectra.starts import closest_starts
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.mechanisms.spectra.findings import found, half_power_words, spanned
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import chosen_shape, refit
from gyrofuse.mismatch.mechanisms.spectra.rivals import fit_alone
from gyrofuse.mismatch.mechanisms.spectra.spectral import Filter
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import OfSensors

_FORMS = ("bilinear", "bilinear2", "bilinear4", "bilinear8", "bilinear16")  # as those of low passes are called


@dataclass(frozen=True, eq=False)
class HighPass(Term):
    """A high pass of each sensor: local is `log tan(pi f_c)`.

    Shared is what it keeps from passing far below, in nepers; without that number it is all.
    """

    name: ClassVar[str] = "high_pass"
    acts: ClassVar[str] = "filter"
    turns: ClassVar[bool] = True
    lower: ClassVar[float] = -12.0  # corner at the rate over 10^6
    upper: ClassVar[float] = math.log(math.tan(math.pi * 0.45))
    deepest: ClassVar[float] = 40.0  # nepers: nothing is let through

    kind: str = "bilinear"

    @classmethod
    def starts(cls, ground: Ground, kind: str, shared: Tensor = NO_SHARED) -> HighPass:
        """Corners to start from: all in one, `local` is `(start, 1, 1)`."""
        numbers = torch.linspace(_number(float(ground.bands.frequency[0])), cls.upper, 37, dtype=torch.float64)
        every = torch.ones(1, len(ground.mean), dtype=torch.bool)
        return cls(numbers[:, None, None], every, shared, kind)

    def grid(self, ground: Ground) -> HighPass:
        return type(self).starts(ground, self.kind, self.shared)

    def step_limit(self) -> tuple[Tensor, Tensor]:
        return torch.full_like(self.local, 0.7), torch.ones_like(self.shared)

    def within(self) -> HighPass:
        local = self.local.clamp(min=self.lower, max=self.upper)
        return replace(self, local=local, shared=self.shared.clamp(min=0.0, max=self.deepest))

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        below = local[..., 0, :, None] - torch.tan(math.pi * ground.nodes).log()
        passed = torch.sigmoid(-2 * order_of(self.kind) * below)
        if shared.shape[-1]:
            passed = passed + (1 - passed) * (-2 * shared[..., :1, None]).exp()
        return torch.where(self.free[0, :, None], passed, 1.0)

    @property
    def depth(self) -> float:
        """What it keeps from passing, nepers."""
        return float(self.shared[0]) if len(self.shared) else self.deepest

    def turn(self, f: Tensor) -> Tensor:
        response = high_pass_response(f, self.local[0], self.depth, self.kind)
        return torch.where(self.free[0, :, None], response.sgn(), 1.0)

    def form_cost(self, n_sensors: int) -> float:
        return super().form_cost(n_sensors) + math.log(len(_FORMS))

    def everywhere(self, ground: Ground) -> Term:
        faint = _number(float(ground.bands.frequency[0]) / 2)
        return replace(self, free=torch.ones_like(self.free), local=torch.where(self.free, self.local, faint))


@dataclass(frozen=True, eq=False)
class HighPassFilter(Filter):
    """`S_i -> |H_i(f)|^2 S_i`, Butterworth's: `(1 + d^2 x^2m) / (1 + x^2m)`, `x = tan(pi f_c) / tan(pi f)`.

    Accelerometers that are coupled by a capacitor have one, gyros whose bias a driver takes off as it goes. It takes
    walks, drifts and the bias along. Less slow noise alone would leave white noise where it is.

    Attributes:
        corner: `f_c`, where half of the power passes, cycles per sample, `(sensor,)`; 0 is none.
        depth: `-log d`, of what it lets through far below.
        kind: Form of the filter, "bilinear" with its order `m`, if that is not one.
    """

    name: ClassVar[str] = "high_pass"
    rivals: ClassVar[tuple[str, ...]] = ("parameter_shift", "notch")
    separated_by: ClassVar[str] = "the response to a slow known motion"
    made_of: ClassVar[str] = "filter"
    corner: OfSensors
    depth: float
    kind: str

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        if any(isinstance(term, HighPass) for term in company):
            return ()
        both = _starts(data, company)
        return [next(start for start in both if bool(len(start.shared)) == seen) for seen in (False, True)]

    @classmethod
    def forms(cls, data: Ratios, term: Term, company: Sequence[Term]) -> Iterable[Term]:
        if not isinstance(term, HighPass):
            return ()
        alike = [form for form in _starts(data, company) if len(form.shared) == len(term.shared)]
        return [form for form in alike if form.kind != term.kind]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        shape = chosen_shape(comparison, cls.name, level)
        if shape is None or not isinstance(shape.term, HighPass):
            return None
        effect, rate = cls.of(shape.term).let_through(comparison), comparison.info.rate
        sensors = tuple(effect.corner.nonzero()[:, 0].tolist())
        forms = [(form, sd) for form, sd in ((shape.term, shape.sd), *shape.forms) if isinstance(form, HighPass)]
        parameters = {}
        for i in sensors:
            limits = [
                spanned(lambda x: rate * _corner(x), float(form.local[0, i]), float(sd[0][0, i]), "Hz")
                for form, sd in forms
            ]
            lowest, highest = min(one.low for one in limits), max(one.high for one in limits)
            parameters[f"corner[{i}]"] = limits[0]._replace(low=lowest, high=highest)
        inside = (rate * effect.corner[list(sensors)]).tolist()
        return found(
            effect,
            shape,
            sensors,
            parameters,
            f"a high-pass filter in {comparison.info.named(sensors, 'all sensors')} that the simulation does not have, "
            f"{half_power_words(inside)}",
            frequency_hz=min(inside),
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        found = fit_alone(comparison, finding.sensors, lambda data: _starts(data, [])[0])
        if found is None or not isinstance(term := found[0], HighPass):
            return None
        return Rival(cls.of(term), found[1])

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> HighPassFilter | None:
        return cls.of(term) if isinstance(term, HighPass) else None

    @classmethod
    def of(cls, term: HighPass) -> HighPassFilter:
        """What a term stands for."""
        corner = torch.where(term.free[0], term.local[0].exp().atan() / math.pi, 0.0)
        return cls(corner, term.depth, term.kind)

    @property
    def seen(self) -> bool:
        """Whether spectra tell what it lets through."""
        return math.exp(-2 * self.depth) > FLOOR

    def let_through(self, comparison: Comparison) -> HighPassFilter:
        """With the depth that powers far below the corners, slower than any block, are likeliest with."""
        far, f = 4, comparison.bands.frequency
        d, s, has = comparison.observed.dof, comparison.reference.dof, self.corner > 0
        slow = (d > 0) & (s > 0) & (f < self.corner[has].min() / far)
        d, s = d[slow], s[slow]
        ratio = (comparison.observed.power / comparison.reference.power)[has][:, slow]

        def log_likelihood(effect: HighPassFilter) -> float:
            """That of a ratio of powers (Fisher's F), up to a constant."""
            x = ratio / effect.response(f[slow])[has].abs().square()
            return float((d * x.log() - (d + s) * (d * x + s).log()).sum())

        depths = [HighPass.deepest, self.depth]
        if ratio.numel():
            depths.append(-float(ratio.median().log()) / 2)
        return max((replace(self, depth=depth) for depth in depths), key=log_likelihood)

    def response(self, f: Tensor) -> Tensor:
        has = self.corner > 0
        number = torch.where(has, self.corner.clamp(min=1e-9), 0.1).mul(math.pi).tan().log()
        return torch.where(has[:, None], high_pass_response(f, number, self.depth, self.kind), 1.0)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        has = self.corner > 0
        number = torch.where(has, self.corner.clamp(min=1e-9).mul(math.pi).tan().log(), 0.0)
        shared = torch.tensor([self.depth], dtype=torch.float64) if self.seen else NO_SHARED
        found = refit(comparison, fold, HighPass(number[None], has[None], shared, self.kind), self.company)
        assert isinstance(found, HighPass)
        again = self.of(found)
        return replace(self, corner=again.corner, depth=again.depth if self.seen else self.depth)


def high_pass_response(f: Tensor, number: Tensor, depth: float, kind: str) -> Tensor:
    """Complex response `(sensor, frequency)` at `f` cycles per sample, of numbers `log tan(pi f_c)` `(sensor,)`."""
    u = torch.tan(math.pi * f) / number.exp()[:, None]
    return stopped(torch.full(u.shape, -1j, dtype=torch.complex128), u, depth, order_of(kind))


def _starts(data: Ratios, company: Sequence[Term]) -> list[HighPass]:
    """Every form at its likeliest corners, one that lets nothing through and one that does, the likeliest first."""
    some = torch.full((1,), 3.0, dtype=torch.float64)
    families = [HighPass.starts(data.ground, kind, shared) for kind in _FORMS for shared in (NO_SHARED, some)]
    found = closest_starts(data, pieces(data, company), families)
    return [start for start in found if isinstance(start, HighPass)]


def _number(f: float) -> float:
    return math.log(math.tan(math.pi * f))


def _corner(number: float) -> float:
    """Cycles per sample."""
    return math.atan(math.exp(number)) / math.pi
