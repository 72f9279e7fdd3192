"""Tests of SVO weights: are equal weights as good, is a sensor needed, is the recording long enough?

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

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse._base.results import ConfidenceInterval, Result, named, numbered
from gyrofuse.fusion.weights.svo import influence_matrix
from gyrofuse.wavelets.moments import combined_covariance

# Excess of the combined wavelet variance, a ratio less 1, up to which a loss is called small: 2.5 % of a deviation,
# below what two recordings of one array differ by.
SMALL_EXCESS = 0.05


@dataclass(frozen=True, eq=False)
class WeightsInference:
    """SVO weights with what inference on them needs, in float64.

    Attributes:
        weights: `(..., sensor)`.
        covariance: `(..., sensor, sensor)`, covariance of the estimated weights themselves.
        weights_dof: `(..., sensor)`, degrees of freedom of the variance of each weight.
        wccv: `(..., level, sensor, sensor)`, zero where a level does not count.
        scale_weights: `(level,)`.
        dof: `(..., level)`, independent observations of each level.
        confidence_level: Confidence level of intervals.
    """

    weights: Tensor
    covariance: Tensor
    weights_dof: Tensor
    wccv: Tensor
    scale_weights: Tensor
    dof: Tensor
    confidence_level: float

    @property
    def combined(self) -> Tensor:
        """`A`, `(..., sensor, sensor)`."""
        return combined_covariance(self.wccv, self.scale_weights)

    @property
    def residual(self) -> Tensor:
        """`c' A c`, `(...)`."""
        return _quadratic(self.weights, self.combined)

    @property
    def influence(self) -> Tensor:
        """`B = (I - c 1') A^-1`, `(..., sensor, sensor)`."""
        return influence_matrix(self.combined, self.weights)

    @property
    def unit_variance(self) -> Tensor:
        """Variance `B_ii c' A c` of each weight for one observation, `(..., sensor)`."""
        return self.influence.diagonal(dim1=-2, dim2=-1) * self.residual[..., None]

    @property
    def noise(self) -> Tensor:
        """`V A / c' A c`, `(..., sensor, sensor)`; its trace is the mean excess by sampling error of all weights."""
        return self.covariance @ self.combined / self.residual[..., None, None]

    @property
    def observations(self) -> Tensor:
        """Effective number of independent observations of each weight, `(..., sensor)`.

        For one level of n of them `V_ii = B_ii c' A c / (n - p + 1)`.
        """
        n_sensors = self.weights.shape[-1]
        return self.unit_variance / self.covariance.diagonal(dim1=-2, dim2=-1) + n_sensors - 1

    @property
    def dominant(self) -> Tensor:
        """Observations of the levels that dominate the variance of the weights, `(...)`, in the harmonic mean.

        A level adds about `(omega_j tr(B Gamma_j))^2 / eta_j` to the variance of the weights. Where levels of few
        observations dominate, that variance has hardly more degrees of freedom than these.
        """
        trace = torch.einsum("...ik,...jki->...j", self.influence, self.wccv)
        added = (self.scale_weights * trace).square() / self.dof
        return added.sum(-1) / (added / self.dof).sum(-1)

    @property
    def resolved(self) -> Tensor:
        """Whether the covariance of the weights is reliable, `(...)`.

        Each weight has at least two observations for each sensor, and the dominant levels have one for each sensor.
        """
        n_sensors = self.weights.shape[-1]
        return (self.observations.amin(-1) >= 2 * n_sensors) & (self.dominant >= n_sensors)


@dataclass(frozen=True, eq=False)
class WeightsTest(Result):
    """A test of a hypothesis about the best weights, and what it costs to act on the hypothesis.

    Attributes:
        subject: The hypothesis: `"equal weights"`, or `"leaving out sensor 3"`.
        statistic: `(...)`, excess over its mean by chance under the hypothesis.
        dof: Numerator and denominator degrees of freedom of the F law of the statistic, `(...)` each.
        p_value: `(...)`, probability of such a statistic or a larger one under the hypothesis; where `resolved` is
            False, exact for scale weights on one level only, and far too large where long levels dominate.
        excess: `(...)`, wavelet variance, combined over scales, of the best weights under the hypothesis over that of
            the SVO weights in this recording, less 1.
        confidence_interval: Limits `(...)` of the true excess over the best weights.
        confidence_level: Confidence level of the interval; a p-value below one minus it is significant.
        resolved: `(...)`, whether the recording holds enough observations for the test.
    """

    subject: str
    statistic: Tensor
    dof: tuple[Tensor, Tensor]
    p_value: Tensor
    excess: Tensor
    confidence_interval: ConfidenceInterval
    confidence_level: float
    resolved: Tensor
    degrees_of_freedom = RenamedAttribute("dof")
    _batched = ("statistic", "dof", "p_value", "excess", "confidence_interval", "resolved")
    _keys: ClassVar[dict[str, str]] = {"dof": "degrees_of_freedom"}

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions; `()` for a single array."""
        return tuple(self.p_value.shape)

    @property
    def small(self) -> Tensor:
        """Whether the loss under the hypothesis is small, less than 5 %, `(...)`."""
        return self.confidence_interval.high < SMALL_EXCESS

    @property
    def significant(self) -> Tensor:
        """Whether the hypothesis is rejected, `(...)`; never by a recording that is too short."""
        return self.resolved & (self.p_value < 1 - self.confidence_level)

    def summary(self) -> str:
        """What the test says, in a sentence for each item of a batch."""
        low, high = self.confidence_interval
        columns = (self.statistic, *self.dof, self.p_value, self.excess, low, high)
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
        return _lines(sentences, self.batch_shape)


@dataclass(frozen=True, eq=False)
class EnoughData(Result):
    """Whether a recording is long enough for the weights that were fitted to it.

    Attributes:
        effective_observations: `(..., sensor)`, effective number of independent observations of each weight.
        deciding_observations: `(...)`, observations of the levels that dominate the variance of the weights.
        expected_excess: `(...)`, mean wavelet variance, combined over scales, of weights estimated from such a
            recording over that of the best weights, less 1.
        largest_excess: Required limit of `expected_excess`.
        times_longer: `(...)`, factor on the length of the recording, with the same levels, at which the limit is met;
            1 if it is met already.
        resolved: `(...)`, whether every weight has two observations for each sensor, and the dominant levels one;
            otherwise all other figures are rough.
        enough: `(...)`, resolved and no more than the largest excess.
    """

    effective_observations: Tensor
    deciding_observations: Tensor
    expected_excess: Tensor
    largest_excess: float
    times_longer: Tensor
    resolved: Tensor
    enough: Tensor
    _batched = tuple(
        "effective_observations deciding_observations expected_excess times_longer resolved enough".split()
    )

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions; `()` for a single array."""
        return tuple(self.enough.shape)

    def summary(self) -> str:
        """The answer, in a sentence for each item of a batch."""
        n_sensors = self.effective_observations.shape[-1]
        columns = (self.effective_observations.amin(-1), self.deciding_observations, self.expected_excess)
        sentences = []
        for observations, dominant, excess, times, resolved in _rows(*columns, self.times_longer, self.resolved):
            costs = f"{observations:.0f} observations for {n_sensors} weights, whose errors cost {_percent(excess)}"
            if not resolved:
                few = min(observations, dominant)
                sentence = (
                    f"too short, {few:.2g} observations decide {n_sensors} weights; record longer or use fewer levels"
                )
            elif excess <= self.largest_excess:
                sentence = f"long enough, {costs} on average"
            else:
                sentence = f"rather short, {costs}; {_percent(self.largest_excess)} takes {times:.2g} times as long"
            sentences.append(f"Recording: {sentence}.")
        return _lines(sentences, self.batch_shape)


def equal_weights_test(inference: WeightsInference) -> WeightsTest:
    """Test whether equal weights are the best.

    Args:
        inference: SVO weights with their covariance.
    """
    noise, weights = inference.noise, inference.weights
    by_chance = noise.diagonal(dim1=-2, dim2=-1).sum(-1)
    # Box: p - 1 where all differences between sensors are equally well known, fewer otherwise.
    numerator = by_chance.square() / torch.einsum("...ik,...ki->...", noise, noise)
    excess = _quadratic(weights - 1 / weights.shape[-1], inference.combined) / inference.residual
    return _tested("equal weights", inference, excess, by_chance, numerator, inference.weights_dof.amin(-1))


def dropped_sensor_test(inference: WeightsInference, sensor: int, name: str) -> WeightsTest:
    """Test whether the best weight of a sensor is zero: Student's t, squared.

    Without sensor i the excess is `1' A^-1 1 / 1' A_-i^-1 1 - 1 = c_i^2 / (B_ii c' A c)`, `A_-i` being `A` without it.

    Args:
        inference: SVO weights with their covariance.
        sensor: Index of the sensor.
        name: Name of the sensor.
    """
    unit = inference.unit_variance[..., sensor]
    excess = inference.weights[..., sensor].square() / unit
    by_chance = inference.covariance[..., sensor, sensor] / unit
    dof = inference.weights_dof[..., sensor]
    return _tested(f"leaving out sensor {name}", inference, excess, by_chance, torch.ones_like(excess), dof)


def enough_data(inference: WeightsInference, largest_excess: float) -> EnoughData:
    """Test whether the recording is long enough.

    Args:
        inference: SVO weights with their covariance.
        largest_excess: Mean loss by errors of the weights, a ratio less 1, that is acceptable.
    """
    # (p - 1) / (n - p + 1) for one level of n observations, so that n grows like 1 + 1 / excess.
    excess = inference.noise.diagonal(dim1=-2, dim2=-1).sum(-1)
    resolved = inference.resolved
    return EnoughData(
        effective_observations=inference.observations,
        deciding_observations=inference.dominant,
        expected_excess=excess,
        largest_excess=largest_excess,
        times_longer=((1 + 1 / largest_excess) / (1 + 1 / excess)).clamp(min=1),
        resolved=resolved,
        enough=resolved & (excess <= largest_excess),
    )


def verdicts(inference: WeightsInference, names: tuple[str, ...]) -> list[str]:
    """Results of all tests for one virtual gyro, one line of text each.

    Args:
        inference: SVO weights with their covariance, without batch dimensions.
        names: Name of each sensor.
    """
    data = enough_data(inference, SMALL_EXCESS)
    if not data.resolved:
        return [str(data)]
    equal = equal_weights_test(inference)
    answer = "good enough" if equal.small else "not good enough" if equal.significant else "perhaps good enough"
    low, high = (limit.item() for limit in equal.confidence_interval)
    drops = [dropped_sensor_test(inference, i, name) for i, name in enumerate(names)]
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
    subject: str, inference: WeightsInference, excess: Tensor, by_chance: Tensor, numerator: Tensor, denominator: Tensor
) -> WeightsTest:
    from scipy import stats

    level = inference.confidence_level
    denominator = torch.minimum(denominator.to(excess), inference.dominant)
    denominator = denominator.clamp(1.0, 1e8)  # scipy has no F law of infinitely many degrees of freedom
    statistic = excess / by_chance
    p_value = stats.f.sf(*(values.cpu().numpy() for values in (statistic, numerator, denominator)))
    return WeightsTest(
        subject=subject,
        statistic=statistic,
        dof=(numerator, denominator),
        p_value=torch.as_tensor(p_value).to(excess),
        excess=excess,
        confidence_interval=_excess_interval(excess, by_chance, numerator, denominator, level),
        confidence_level=level,
        resolved=inference.resolved,
    )


def _excess_interval(
    excess: Tensor, by_chance: Tensor, numerator: Tensor, denominator: Tensor, confidence_level: float
) -> ConfidenceInterval:
    """Limits of the true excess: the values under which the excess found is a quantile at either tail.

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

    # An excess below its median under a true excess of 0 is taken as that median for the upper limit.
    least = t * stats.f.ppf(0.5, k, m)
    low, high = solved(g, 1 - tail), solved(np.maximum(g, least), tail)
    return ConfidenceInterval(torch.as_tensor(low).to(excess), torch.as_tensor(high).to(excess))


def _quadratic(vector: Tensor, matrix: Tensor) -> Tensor:
    return torch.einsum("...i,...ik,...k->...", vector, matrix, vector)


def _rows(*columns: Tensor) -> list[tuple[float, ...]]:
    """Columns of the same shape `(...)` as one row of numbers for each item."""
    return list(zip(*(column.reshape(-1).tolist() for column in columns), strict=True))


def _lines(sentences: list[str], batch: tuple[int, ...], most: int = 8) -> str:
    """Sentences of a batch, numbered."""
    if not batch:
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
