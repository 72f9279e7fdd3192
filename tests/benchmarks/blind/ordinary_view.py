"""The ordinary view: wavelet variances of recording and simulation side by side. What it does not show is concealed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f

from .analog import Base
from .cases import Case, make_case

Array = NDArray[np.float64]


def haar_variances(signal: Array, n_levels: int) -> Array:
    """(sensor, level) by the averaging pyramid, all overlapping coefficients."""
    averages, variances = signal, []
    for level in range(n_levels):
        lag = 2**level
        difference = (averages[:, lag:] - averages[:, :-lag]) / 2
        variances.append(np.mean(difference**2, axis=1))
        averages = (averages[:, lag:] + averages[:, :-lag]) / 2
    return np.stack(variances, axis=1)


def freedom(n_samples: int, n_levels: int) -> Array:
    """Equivalent degrees of freedom per level: those of a random walk, at the first level of white noise."""
    tau = 2.0 ** np.arange(1, n_levels + 1)
    return np.maximum(np.minimum(1.9 / tau, 2 / 3) * (n_samples - tau + 1), 1.0)


def ordinary_p_value(recording: Array, simulation: dict[str, Any]) -> float:
    """Smallest p over levels and sensors, times their number."""
    simulated = simulation["gyro"] if "gyro" in simulation else _simulated(simulation["terms"], 16 * recording.shape[1])
    levels = int(np.log2(min(recording.shape[1], simulated.shape[1]))) - 2
    ratio = haar_variances(recording, levels) / haar_variances(simulated, levels)
    upper = f.sf(ratio, freedom(recording.shape[1], levels), freedom(simulated.shape[1], levels))
    return float(min(1.0, 2 * np.minimum(upper, 1 - upper).min() * upper.size))


def _simulated(terms: list[list[list[Any]]], n_samples: int) -> Array:
    """One long realisation of the simulator's terms, always the same."""
    base = Base(
        white=np.array([p["variance"] for sensor in terms for name, p in sensor if name == "white_noise"]),
        phi=np.array([[p["phi"] for name, p in sensor if name == "ar1"] for sensor in terms]),
        variance=np.array([[p["variance"] for name, p in sensor if name == "ar1"] for sensor in terms]),
        walk=np.array([p["variance"] for sensor in terms for name, p in sensor if name == "random_walk"]),
        bias=np.zeros(len(terms)),
        rate=1.0,
    )
    return base.simulate(n_samples, np.random.default_rng(0))


def is_concealed(case: Case, false_alarm: float = 0.01) -> bool:
    """Whether the ordinary view of a case with one effect shows nothing; without one there is nothing to conceal."""
    if case.truth["group"] not in ("mechanism", "pair"):
        return False
    return ordinary_p_value(case.recording["gyro"], case.simulation) > false_alarm


def concealed(truth: dict[str, Any], false_alarm: float = 0.01) -> bool:
    """The same of a case that is made once more from its truth."""
    if truth["group"] == "real":
        return False
    case = make_case(truth["kind"], truth["nats"], truth["seed"], **truth["asked"])
    return is_concealed(case, false_alarm)
