"""What is sudden: outliers and jumps, against those that the simulation has itself."""

from __future__ import annotations

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import Evidence, corrected, surpassing
from gyrofuse.mismatch.haar_kurtosis import kurtosis_p_values
from gyrofuse.mismatch.normality import TAILS, gaussian_sensors
from gyrofuse.mismatch.prediction_errors import left_out, pooled_squares, smooth_sd
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.shocks import WeakOutliers, weak_outliers
from gyrofuse.mismatch.side import Side
from gyrofuse.mismatch.stats.local_level import local_level
from gyrofuse.mismatch.stats.predictive_tail import dispersion, equal_rates_p_value, tail_p_values

_HEAVY = 0.05  # p value of tails that a Gaussian model may have with what was built into it


def _tail_p(recorded: Tensor, simulated: Tensor, probability: float) -> Tensor:
    """p value of so many exceedances, `(..., time)` each, of a level that noise exceeds with `probability`."""
    own, other = recorded.sum(-1).to(torch.float64).numpy(), simulated.sum(-1).to(torch.float64)
    n, m = recorded.shape[-1], simulated.shape[-1]
    gaussian = stats.poisson.sf(own - 1, n * probability)
    heavy = stats.poisson.sf(other.numpy() - 1, m * probability) < _HEAVY
    two_sample = stats.binom.sf(own - 1, own + other.numpy(), n / (n + m))
    return torch.where(torch.as_tensor(heavy), torch.as_tensor(two_sample), torch.as_tensor(gaussian))


def spike_p_values(case: Case) -> Tensor:
    """p values of the tails of each sensor, and of all together, `(sensor + 1,)`, for all the levels looked at.

    Against a Gaussian's tail where the simulation has it, else against what its own tail predicts; of all together then
    against as many in the simulation.
    """
    gaussian = gaussian_sensors(case.simulated)
    every = bool(gaussian.all())
    recorded, simulated = left_out(case.recorded).z, left_out(case.simulated).z
    p_values = _against_gaussian(recorded, simulated)
    if every:
        return p_values
    recorded, simulated = (_levelled(side) for side in (case.recorded, case.simulated))
    predicted = tail_p_values(recorded[0].numpy(), simulated.movedim(1, 0).numpy())
    together = _as_many(pooled_squares(recorded)[0], pooled_squares(simulated), case.n_sensors)
    return torch.cat([torch.where(gaussian, p_values[:-1], torch.from_numpy(predicted)), together[None]])


def _levelled(side: Side) -> Tensor:
    """Errors `(record, sensor, time)` over the local level of the noise, in a robust sd of theirs."""
    expected = left_out(side)
    z = expected.z / local_level(expected.white).sqrt()
    return z / smooth_sd(z)[..., None]


def _against_gaussian(recorded: Tensor, simulated: Tensor) -> Tensor:
    """Of errors `(record, sensor, time)`."""
    own_q, other_q = pooled_squares(recorded)[0], pooled_squares(simulated).flatten()
    z, other = recorded[0].abs(), simulated.abs().movedim(1, 0).flatten(1)
    best = torch.ones(len(z) + 1, dtype=torch.float64)
    for level in TAILS:
        p = 2 * float(stats.norm.sf(level))
        together = float(stats.chi2.isf(p, len(z)))
        single = _tail_p(z > level, other > level, p)
        pooled = _tail_p(own_q > together, other_q > together, p)
        best = torch.minimum(best, torch.cat([single, pooled[None]]))
    return -torch.expm1(len(TAILS) * torch.log1p(-best.clamp(max=1 - 1e-16)))


def _as_many(recorded: Tensor, simulated: Tensor, n_sensors: int) -> Tensor:
    """p value of so many squares `(time,)` beyond the levels, as many in the simulation `(record, time)`."""
    levels = torch.tensor([stats.chi2.isf(2 * stats.norm.sf(level), n_sensors) for level in TAILS])
    own, other = ((q > levels[:, None]).sum(-1).numpy() for q in (recorded, simulated.flatten()))
    clumps = dispersion((simulated > levels[0]).numpy())
    p = equal_rates_p_value(own / clumps, other / clumps, recorded.numel() / simulated.numel())
    return torch.tensor(corrected(float(p.min()), len(TAILS)), dtype=torch.float64)


def spike_p_value(case: Case) -> float:
    """p value of outliers anywhere, by the tails or by many weak ones."""
    tails = spike_p_values(case)
    return corrected(min(corrected(float(tails.min()), len(tails)), _many_p_value(case)), 2)


def _many_p_value(case: Case) -> float:
    """Of many weak outliers in the sensors whose tails the simulation knows to be Gaussian."""
    own = likely_outliers(case)
    if own is None:
        return 1.0
    simulated = left_out(case.simulated).z[0][gaussian_sensors(case.simulated)]
    return surpassing(own.p_value, weak_outliers(simulated).p_value)


@remembered
def likely_outliers(case: Case) -> WeakOutliers | None:
    """Evidence of weak outliers, in the sensors whose tails are Gaussian in the simulation; None if none are."""
    gaussian = gaussian_sensors(case.simulated)
    if not bool(gaussian.any()):
        return None
    found = weak_outliers(left_out(case.recorded).z[0][gaussian])
    sensors = torch.zeros(case.n_sensors, dtype=found.sensors.dtype)
    sensors[gaussian] = found.sensors
    return found._replace(sensors=sensors)


def spike_witness(case: Case) -> Evidence:
    """Outliers of single samples, sensor by sensor and all together."""
    p_values, p_value = spike_p_values(case), spike_p_value(case)
    z = left_out(case.recorded).z[0].abs()
    worst = int(p_values[:-1].argmin())
    at = int(z[worst].argmax())
    count = int((z[worst] > 5).sum())
    words = (
        f"{count} samples beyond 5 sd in sensor {case.scene.sensors[worst]}, the largest {float(z[worst, at]):.3g} sd"
    )
    sensors: tuple[int, ...] = (worst,)
    if corrected(float(p_values.min()), len(p_values)) > p_value and (many := likely_outliers(case)) is not None:
        sensors = tuple((many.sensors > 0.5).nonzero()[:, 0].tolist()) or sensors
        words = f"outliers of {many.size:g} sd {'in several sensors at once' if many.shock else 'in single sensors'}"
    return Evidence("spike", p_value, words, sensors=sensors, levels=(1,), time_s=at / case.scene.rate)


def jump_witness(case: Case) -> Evidence:
    """Jumps between levels, from the kurtosis of Haar coefficients at every scale."""
    tails = kurtosis_p_values(case)
    level, sensor = divmod(int(tails.argmin()), tails.shape[1])
    return Evidence(
        "jump",
        corrected(float(tails.min()), tails.numel()),
        f"wavelet coefficients at level {level + 1} that are not normal in sensor {case.scene.sensors[sensor]}",
        sensors=(sensor,),
        levels=(level + 1,),
    )
