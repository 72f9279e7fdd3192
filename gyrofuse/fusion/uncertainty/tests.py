"""What a user asks of SVO weights: would equal ones do, does a sensor earn its place, is the recording long enough?

SVO weights are coefficients of a regression, that of one combination of the sensors on the differences between them:
`c' A c` is its residual. A hypothesis that fixes `k` of the `p - 1` coefficients makes the residual larger, by the
excess

    g = c_H' A c_H / c' A c - 1 = (c - c_H)' A (c - c_H) / c' A c

where `c_H` are the best weights under the hypothesis. If it holds, chance alone gives an excess whose mean follows from
the covariance of the weights, and the ratio of the two is referred to an F law. For one level of `n` Gaussian
observations that is the F test of a regression, exact, with `k` and `n - p + 1` degrees of freedom; over several
levels, which hold different numbers of observations, it is Box's approximation. It needs no inverse of the covariance
of the weights, which few observations would spoil.

References:
    G. E. P. Box, Annals of Mathematical Statistics 25, 1954, theorem 3.1; for the interval of the excess, which is
    that of a squared multiple correlation, Y. S. Lee, Journal of the Royal Statistical Society B 33, 1971.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.results import ConfidenceInterval, listed, named, numbered

# An excess of wavelet variance below this is small: 2.5 % of a deviation.
SMALL_EXCESS = 0.05
# Weights are resolved when each rests on so many observations for each sensor,
_OBSERVATIONS_PER_SENSOR = 2
# and the levels that decide hold one for each.
_DECIDING_PER_SENSOR = 1
# scipy knows no F law of infinitely many degrees of freedom; so many are as good.
_MANY = 1e8


@dataclass(frozen=True, eq=False)
class Evidence:
    """SVO weights with all that tells how far they can be trusted, in float64.

    Attributes:
        weights: `(..., sensor)`.
        covariance: `(..., sensor, sensor)` of the estimated weights themselves.
        weights_degrees: `(..., sensor)`, degrees of freedom of each of their variances.
        wccv: `(..., level, sensor, sensor)`, zero where a level does not count.
        scale_weights: `(level,)`.
        degrees: `(..., level)`, independent observations of each level.
        confidence_level: Of intervals.
    """

    weights: Tensor
    covariance: Tensor
    weights_degrees: Tensor
    wccv: Tensor
    scale_weights: Tensor
    degrees: Tensor
    confidence_level: float

    @property
    def combined(self) -> Tensor:
        """`A`, `(..., sensor, sensor)`."""
        return torch.einsum("j,...jik->...ik", self.scale_weights, self.wccv)

    @property
    def residual(self) -> Tensor:
        """`c' A c`, `(...)`."""
        return quadratic(self.weights, self.combined)

    @property
    def influence(self) -> Tensor:
        """`B = (I - c 1') A^-1`, `(..., sensor, sensor)`."""
        inverse = torch.linalg.inv(self.combined)
        return inverse - self.weights[..., :, None] * inverse.sum(-2, keepdim=True)

    @property
    def unit_variance(self) -> Tensor:
        """Variance `B_ii c' A c` of each weight for one observation, `(..., sensor)`."""
        return self.influence.diagonal(dim1=-2, dim2=-1) * self.residual[..., None]

    @property
    def noise(self) -> Tensor:
        """`V A / c' A c`, `(..., sensor, sensor)`; its trace is the excess that chance gives all weights on average."""
        return self.covariance @ self.combined / self.residual[..., None, None]

    @property
    def observations(self) -> Tensor:
        """Independent observations that each weight rests on, `(..., sensor)`.

        For one level of n of them `V_ii = B_ii c' A c / (n - p + 1)`.
        """
        n_sensors = self.weights.shape[-1]
        return self.unit_variance / self.covariance.diagonal(dim1=-2, dim2=-1) + n_sensors - 1

    @property
    def deciding(self) -> Tensor:
        """Observations of the levels that decide how well the weights are known, `(...)`, in the harmonic mean.

        A level adds about `(omega_j tr(B Gamma_j))^2 / eta_j` to the variance of the weights. Where levels of few
        observations decide, that variance itself is known no better than these few tell.
        """
        trace = torch.einsum("...ik,...jki->...j", self.influence, self.wccv)
        added = (self.scale_weights * trace).square() / self.degrees
        return added.sum(-1) / (added / self.degrees).sum(-1)

    @property
    def resolved(self) -> Tensor:
        """Whether there are observations enough to rely on the covariance of the weights, `(...)`."""
        n_sensors = self.weights.shape[-1]
        enough = self.observations.amin(-1) >= _OBSERVATIONS_PER_SENSOR * n_sensors
        return enough & (self.deciding >= _DECIDING_PER_SENSOR * n_sensors)


@dataclass(frozen=True, eq=False)
class Answer(ABC):
    """What the answers below share: text for each item of a batch, and plain numbers."""

    @abstractmethod
    def summary(self) -> str:
        """The answer in words and numbers."""

    def __str__(self) -> str:
        return self.summary()

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain lists and numbers, ready for JSON (NaN and infinities as None)."""
        return {field.name: _plain(getattr(self, field.name)) for field in fields(self)}


@dataclass(frozen=True, eq=False)
class WeightsTest(Answer):
    """A test of a hypothesis about the best weights, and what it costs to act on the hypothesis.

    Attributes:
        subject: What the hypothesis would have: `"equal weights"`, or `"leaving out sensor 3"`.
        statistic: `(...)`, the excess over what chance alone gives on average.
        degrees_of_freedom: Numerator and denominator of the F law of the statistic, `(...)` each.
        p_value: `(...)`, probability of such a statistic or a larger one if the hypothesis holds; where `resolved` is
            False, exact for scale weights on one level only, and far too large where long levels decide.
        excess: `(...)`, how much larger the wavelet variance, combined over scales, is in this recording with the best
            weights under the hypothesis; a ratio less 1.
        confidence_interval: Limits `(...)` of the true excess over the best weights there are.
        confidence_level: Of the interval; a p-value below one minus this is called significant.
        resolved: `(...)`, whether the recording holds enough observations to rely on any of this.
    """

    subject: str
    statistic: Tensor
    degrees_of_freedom: tuple[Tensor, Tensor]
    p_value: Tensor
    excess: Tensor
    confidence_interval: ConfidenceInterval
    confidence_level: float
    resolved: Tensor

    @property
    def small(self) -> Tensor:
        """Whether acting on the hypothesis costs little, at most 5 %, `(...)`."""
        return self.confidence_interval.high < SMALL_EXCESS

    @property
    def significant(self) -> Tensor:
        """Whether the hypothesis is refused, `(...)`; a recording too short to judge refuses none."""
        return self.resolved & (self.p_value < 1 - self.confidence_level)

    def summary(self) -> str:
        """What the test says, in a sentence for each item of a batch."""
        low, high = self.confidence_interval
        columns = (self.statistic, *self.degrees_of_freedom, self.p_value, self.excess, low, high)
        verdicts = zip(*(v.reshape(-1).tolist() for v in (self.resolved, self.small, self.significant)), strict=True)
        sentences = []
        for verdict, row in zip(verdicts, _rows(*columns), strict=True):
            f, numerator, denominator, p, excess, lower, upper = row
            tested = f"; F({numerator:.3g}, {denominator:.3g}) = {f:.3g}, {_p_value(p)}" if verdict[0] else ""
            sentences.append(
                f"{self.subject[0].upper()}{self.subject[1:]}: {_cost(*verdict)}, {_percent(excess)} more combined "
                f"wavelet variance in this recording, {100 * self.confidence_level:g} % interval "
                f"{_percents(lower, upper)}{tested}."
            )
        return _lines(sentences, self.p_value)


@dataclass(frozen=True, eq=False)
class EnoughData(Answer):
    """Whether a recording is long enough for the weights that were fitted to it.

    Attributes:
        effective_observations: `(..., sensor)`, number of independent observations that each weight rests on.
        deciding_observations: `(...)`, how many the levels that decide hold.
        expected_excess: `(...)`, how much larger the wavelet variance, combined over scales, is on average with
            weights estimated from such a recording than with the best ones; a ratio less 1.
        largest_excess: What is asked of `expected_excess`.
        times_longer: `(...)`, how many times as long a recording, with the same levels, would meet that; 1 if this one
            does.
        resolved: `(...)`, whether every weight rests on two observations for each sensor, and the levels that decide
            hold one; where not, all other figures are no more than a hint.
        enough: `(...)`, resolved and no more than the largest excess.
    """

    effective_observations: Tensor
    deciding_observations: Tensor
    expected_excess: Tensor
    largest_excess: float
    times_longer: Tensor
    resolved: Tensor
    enough: Tensor

    def summary(self) -> str:
        """The answer, in a sentence for each item of a batch."""
        n_sensors = self.effective_observations.shape[-1]
        columns = (self.effective_observations.amin(-1), self.deciding_observations, self.expected_excess)
        sentences = []
        for observations, deciding, excess, times, resolved in _rows(*columns, self.times_longer, self.resolved):
            costs = f"{observations:.0f} observations for {n_sensors} weights, whose errors cost {_percent(excess)}"
            if not resolved:
                few = min(observations, deciding)
                sentence = (
                    f"too short, {few:.2g} observations decide {n_sensors} weights; record longer or use fewer levels"
                )
            elif excess <= self.largest_excess:
                sentence = f"long enough, {costs} on average"
            else:
                sentence = f"rather short, {costs}; {_percent(self.largest_excess)} takes {times:.2g} times as long"
            sentences.append(f"Recording: {sentence}.")
        return _lines(sentences, self.enough)


def equal_weights_test(evidence: Evidence) -> WeightsTest:
    """Test whether equal weights are the best."""
    noise, weights = evidence.noise, evidence.weights
    by_chance = noise.diagonal(dim1=-2, dim2=-1).sum(-1)
    # Box: p - 1 where all differences between sensors are known equally well, fewer where some are known worse.
    numerator = by_chance.square() / torch.einsum("...ik,...ki->...", noise, noise)
    excess = quadratic(weights - 1 / weights.shape[-1], evidence.combined) / evidence.residual
    return _tested("equal weights", evidence, excess, by_chance, numerator, evidence.weights_degrees.amin(-1))


def dropped_sensor_test(evidence: Evidence, sensor: int, name: str) -> WeightsTest:
    """Test whether the best weight of a sensor is zero: Student's t, squared.

    Without sensor i the excess is `1' A^-1 1 / 1' A_-i^-1 1 - 1 = c_i^2 / (B_ii c' A c)`, `A_-i` being `A` without it.
    """
    unit = evidence.unit_variance[..., sensor]
    excess = evidence.weights[..., sensor].square() / unit
    by_chance = evidence.covariance[..., sensor, sensor] / unit
    degrees = evidence.weights_degrees[..., sensor]
    return _tested(f"leaving out sensor {name}", evidence, excess, by_chance, torch.ones_like(excess), degrees)


def enough_data(evidence: Evidence, largest_excess: float) -> EnoughData:
    """Ask whether weights rest on enough observations for errors that cost no more than `largest_excess` on average."""
    # (p - 1) / (n - p + 1) for one level of n observations, so that n grows like 1 + 1 / excess.
    excess = evidence.noise.diagonal(dim1=-2, dim2=-1).sum(-1)
    resolved = evidence.resolved
    return EnoughData(
        effective_observations=evidence.observations,
        deciding_observations=evidence.deciding,
        expected_excess=excess,
        largest_excess=largest_excess,
        times_longer=((1 + 1 / largest_excess) / (1 + 1 / excess)).clamp(min=1),
        resolved=resolved,
        enough=resolved & (excess <= largest_excess),
    )


def verdicts(evidence: Evidence, names: tuple[str, ...]) -> list[str]:
    """Answers for one virtual gyro, a line of text for each question."""
    data = enough_data(evidence, SMALL_EXCESS)
    if not data.resolved:
        return [str(data)]
    equal = equal_weights_test(evidence)
    answer = "good enough" if equal.small else "not good enough" if equal.significant else "perhaps good enough"
    low, high = (limit.item() for limit in equal.confidence_interval)
    drops = [dropped_sensor_test(evidence, i, name) for i, name in enumerate(names)]
    idle = [i for i, drop in enumerate(drops) if drop.small]
    unsure = [i for i, drop in enumerate(drops) if not (drop.small or drop.significant)]
    parts = [f"{named(names, idle)} could be left out"] if idle else []
    parts += [f"{named(names, unsure)} may or may not be needed"] if unsure else []
    return [
        f"Equal weights: {answer}, {_percents(low, high)} more combined wavelet variance than the best weights.",
        f"Sensors: {'; '.join(parts) or 'each earns its place'}.",
        str(data),
    ]


def _tested(
    subject: str, evidence: Evidence, excess: Tensor, by_chance: Tensor, numerator: Tensor, denominator: Tensor
) -> WeightsTest:
    from scipy import stats

    level = evidence.confidence_level
    denominator = torch.minimum(denominator.to(excess), evidence.deciding).clamp(1.0, _MANY)
    statistic = excess / by_chance
    p_value = stats.f.sf(*(values.cpu().numpy() for values in (statistic, numerator, denominator)))
    return WeightsTest(
        subject=subject,
        statistic=statistic,
        degrees_of_freedom=(numerator, denominator),
        p_value=torch.as_tensor(p_value).to(excess),
        excess=excess,
        confidence_interval=_excess_interval(excess, by_chance, numerator, denominator, level),
        confidence_level=level,
        resolved=evidence.resolved,
    )


def _excess_interval(
    excess: Tensor, by_chance: Tensor, numerator: Tensor, denominator: Tensor, confidence_level: float
) -> ConfidenceInterval:
    """Limits of the true excess: those with which the one found would just be as far out as the tails allow.

    With a true excess `e` and `n` observations, of which `n - k` are left for the residual, the numerator has the
    cumulants of `k - n` squares of normal variables and of `n` that are `1 + e` times as large. Lee matches three of
    them by a scaled noncentral chi-square.
    """
    import numpy as np
    from scipy import special, stats

    g, t, k, m = (values.cpu().numpy() for values in (excess, by_chance, numerator, denominator))
    n = k / t + k
    tail = (1 - confidence_level) / 2

    def probability(found: np.ndarray, true: np.ndarray) -> np.ndarray:
        first, second, third = (k + n * np.expm1(r * np.log1p(true)) for r in (1, 2, 3))
        scale = (second - np.sqrt(np.maximum(second**2 - first * third, 0))) / first
        noncentrality = np.maximum(second / scale**2 - first / scale, 0)
        free = first / scale - noncentrality
        return special.ncfdtr(free, m, noncentrality, found / t * k / (scale * free))

    def solved(found: np.ndarray, wanted: float) -> np.ndarray:
        """The true excess at which `probability`, which falls with it, is as wanted: its logarithm by bisection."""
        low, high = np.log(1e-9 * (found + t)), np.log(1e6 * (found + t))
        for _ in range(32):
            middle = (low + high) / 2
            above = probability(found, np.exp(middle)) > wanted
            low, high = np.where(above, middle, low), np.where(above, high, middle)
        return np.where(probability(found, np.zeros_like(found)) <= wanted, 0.0, np.exp(high))

    # Less than half of all recordings show without any true excess is no evidence of less than none.
    least = t * stats.f.ppf(0.5, k, m)
    low, high = solved(g, 1 - tail), solved(np.maximum(g, least), tail)
    return ConfidenceInterval(torch.as_tensor(low).to(excess), torch.as_tensor(high).to(excess))


def quadratic(vector: Tensor, matrix: Tensor) -> Tensor:
    return torch.einsum("...i,...ik,...k->...", vector, matrix, vector)


def _plain(value: Any) -> Any:
    if isinstance(value, Tensor):
        return listed(value)
    if isinstance(value, ConfidenceInterval):
        return {"low": listed(value.low), "high": listed(value.high)}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _rows(*columns: Tensor) -> list[tuple[float, ...]]:
    """Columns of the same shape `(...)` as one row of numbers for each item."""
    return list(zip(*(column.reshape(-1).tolist() for column in columns), strict=True))


def _lines(sentences: list[str], like: Tensor, most: int = 8) -> str:
    """Sentences of a batch, numbered."""
    if like.ndim == 0:
        return sentences[0]
    lines = [f"[{name}] {sentence}" for name, sentence in zip(numbered(len(sentences)), sentences, strict=True)]
    return "\n".join(lines[:most] + ([f"... and {len(lines) - most} more"] if len(lines) > most else []))


def _cost(resolved: bool, small: bool, significant: bool) -> str:
    if not resolved:
        return "too short a recording to judge"
    return "a small loss" if small else "a loss" if significant else "perhaps a loss"


def _percent(ratio: float) -> str:
    return f"{100 * ratio:.3g} %" if ratio < 10 else f"{100 * ratio:.0f} %"


def _percents(low: float, high: float) -> str:
    return f"{_percent(low).removesuffix(' %')} to {_percent(high)}"


def _p_value(p: float) -> str:
    return f"p = {p:.2g}" if p >= 1e-4 else "p < 0.0001"
