"""What is sudden: outliers and jumps, against those that the simulation has itself."""

from __future__ import annotations

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.variance.haar_kurtosis import kurtosis_p_values
from gyrofuse.mismatch.detectors.variance.normality import TAILS, gaussian_sensors
from gyrofuse.mismatch.detectors.variance.weak_outliers import WeakOutliers, weak_outliers
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out, pooled_squares, smooth_sd
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.local_level import local_level
from gyrofuse.mismatch.stats.multiplicity import p_value_beyond_reference, sidak
from gyrofuse.mismatch.stats.predictive_tail import dispersion, equal_rates_p_value, tail_p_values

_HEAVY = 0.05  # p value of tails that a Gaussian model may have with what was built into it


def _tail_p(observed: Tensor, reference: Tensor, probability: float) -> Tensor:
    """p value of so many exceedances, `(..., time)` each, of a level that noise exceeds with `probability`."""
    own, other = observed.sum(-1).to(torch.float64).numpy(), reference.sum(-1).to(torch.float64)
    n, m = observed.shape[-1], reference.shape[-1]
    gaussian = stats.poisson.sf(own - 1, n * probability)
    heavy = stats.poisson.sf(other.numpy() - 1, m * probability) < _HEAVY
    two_sample = stats.binom.sf(own - 1, own + other.numpy(), n / (n + m))
    return torch.where(torch.as_tensor(heavy), torch.as_tensor(two_sample), torch.as_tensor(gaussian))


def spike_p_values(comparison: Comparison) -> Tensor:
    """p values of the tails of each sensor, and of all together, `(sensor + 1,)`, for all the levels looked at.

    Against a Gaussian's tail where the simulation has it, else against what its own tail predicts; of all together then
    against as many in the simulation.
    """
    gaussian = gaussian_sensors(comparison.reference)
    every = bool(gaussian.all())
    observed, reference = left_out(comparison.observed).z, left_out(comparison.reference).z
    p_values = _against_gaussian(observed, reference)
    if every:
        return p_values
    observed, reference = (_levelled(side) for side in (comparison.observed, comparison.reference))
    predicted = tail_p_values(observed[0].numpy(), reference.movedim(1, 0).numpy())
    together = _as_many(pooled_squares(observed)[0], pooled_squares(reference), comparison.n_sensors)
    return torch.cat([torch.where(gaussian, p_values[:-1], torch.from_numpy(predicted)), together[None]])


def _levelled(side: Records) -> Tensor:
    """Errors `(record, sensor, time)` over the local level of the noise, in a robust sd of theirs."""
    expected = left_out(side)
    z = expected.z / local_level(expected.white).sqrt()
    return z / smooth_sd(z)[..., None]


def _against_gaussian(observed: Tensor, reference: Tensor) -> Tensor:
    """Of errors `(record, sensor, time)`."""
    own_q, other_q = pooled_squares(observed)[0], pooled_squares(reference).flatten()
    z, other = observed[0].abs(), reference.abs().movedim(1, 0).flatten(1)
    best = torch.ones(len(z) + 1, dtype=torch.float64)
    for level in TAILS:
        p = 2 * float(stats.norm.sf(level))
        together = float(stats.chi2.isf(p, len(z)))
        single = _tail_p(z > level, other > level, p)
        pooled = _tail_p(own_q > together, other_q > together, p)
        best = torch.minimum(best, torch.cat([single, pooled[None]]))
    return -torch.expm1(len(TAILS) * torch.log1p(-best.clamp(max=1 - 1e-16)))


def _as_many(observed: Tensor, reference: Tensor, n_sensors: int) -> Tensor:
    """p value of so many squares `(time,)` beyond the levels, as many in the simulation `(record, time)`."""
    levels = torch.tensor([stats.chi2.isf(2 * stats.norm.sf(level), n_sensors) for level in TAILS])
    own, other = ((q > levels[:, None]).sum(-1).numpy() for q in (observed, reference.flatten()))
    clumps = dispersion((reference > levels[0]).numpy())
    p = equal_rates_p_value(own / clumps, other / clumps, observed.numel() / reference.numel())
    return torch.tensor(sidak(float(p.min()), len(TAILS)), dtype=torch.float64)


def spike_p_value(comparison: Comparison) -> float:
    """p value of outliers anywhere, by the tails or by many weak ones."""
    tails = spike_p_values(comparison)
    return sidak(min(sidak(float(tails.min()), len(tails)), _many_p_value(comparison)), 2)


def _many_p_value(comparison: Comparison) -> float:
    """Of many weak outliers in the sensors whose tails the simulation knows to be Gaussian."""
    own = likely_outliers(comparison)
    if own is None:
        return 1.0
    reference = left_out(comparison.reference).z[0][gaussian_sensors(comparison.reference)]
    return p_value_beyond_reference(own.p_value, weak_outliers(reference).p_value)


@derived
def likely_outliers(comparison: Comparison) -> WeakOutliers | None:
    """Evidence of weak outliers, in the sensors whose tails are Gaussian in the simulation; None if none are."""
    gaussian = gaussian_sensors(comparison.reference)
    if not bool(gaussian.any()):
        return None
    found = weak_outliers(left_out(comparison.observed).z[0][gaussian])
    sensors = torch.zeros(comparison.n_sensors, dtype=found.sensors.dtype)
    sensors[gaussian] = found.sensors
    return found._replace(sensors=sensors)


def outliers_test(comparison: Comparison) -> TestResult:
    """Outliers of single samples, sensor by sensor and all together."""
    p_values, p_value = spike_p_values(comparison), spike_p_value(comparison)
    z = left_out(comparison.observed).z[0].abs()
    worst = int(p_values[:-1].argmin())
    at = int(z[worst].argmax())
    count = int((z[worst] > 5).sum())
    name = comparison.info.sensors[worst]
    words = f"{count} samples beyond 5 sd in sensor {name}, the largest {float(z[worst, at]):.3g} sd"
    sensors: tuple[int, ...] = (worst,)
    if sidak(float(p_values.min()), len(p_values)) > p_value and (many := likely_outliers(comparison)) is not None:
        sensors = tuple((many.sensors > 0.5).nonzero()[:, 0].tolist()) or sensors
        words = f"outliers of {many.size:g} sd {'in several sensors at once' if many.shock else 'in single sensors'}"
    return TestResult("spike", p_value, words, sensors=sensors, levels=(1,), time_s=at / comparison.info.rate)


def jump_test(comparison: Comparison) -> TestResult:
    """Jumps between levels, from the kurtosis of Haar coefficients at every scale."""
    tails = kurtosis_p_values(comparison)
    level, sensor = divmod(int(tails.argmin()), tails.shape[1])
    return TestResult(
        "jump",
        sidak(float(tails.min()), tails.numel()),
        f"wavelet coefficients at level {level + 1} that are not normal in sensor {comparison.info.sensors[sensor]}",
        sensors=(sensor,),
        levels=(level + 1,),
    )
