"""What the studies of Voirol et al. share: their models, many fits of each, and what theory says of them.

Voirol, Cucci, Karemera, Chu, Molinari, Guerrier, Accounting for Vibration Noise in Stochastic Measurement Errors: [V].
"""

from __future__ import annotations

import functools
import math
import sys
import warnings
from dataclasses import dataclass
from typing import Any

import torch
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting import GMWMResult
from gyrofuse.fitting.moments.covariance import moment_covariance

N_RUNS = 500
_AT_ONCE = 2**21  # samples simulated and fitted together
_NODES = 256  # frequencies of an information integral

# [V] tables 2 to 4; AR1s from slow to fast and tones from high to low frequency, as fits give them.
SIMULATIONS: dict[int, gf.Model] = {
    1: gf.WhiteNoise(1.0) + gf.AR1(0.975, 0.03) + gf.RandomWalk(0.0004) + gf.Sinusoid(0.85, 0.35),
    2: gf.AR1(0.999995, 3e-11) + gf.AR1(0.1107083, 5.278666e-4) + gf.Sinusoid(0.025, 0.056) + gf.Sinusoid(0.0015, 8e-5),
    3: gf.WhiteNoise(8e-4) + gf.AR1(0.9997083, 9e-9) + gf.RandomWalk(3e-11) + gf.Sinusoid(0.025, 0.056),
}
N_SAMPLES: dict[int, tuple[int, ...]] = {
    1: (10_000, 20_000, 40_000, 80_000, 160_000),
    2: (10_000_000,),
    3: (10_000_000,),
}
# [V] table 5, the sensor on the rotating table.
N_EMULATION = 2_879_999
EMULATION = (
    gf.AR1(0.1851173, 0.03559081)
    + gf.RandomWalk(8.692479e-10)
    + gf.Sinusoid(0.3235864, 1.199147)
    + gf.Sinusoid(0.1359012, 0.1357501)
)

_SYMBOLS = {
    "white_noise.variance": r"$\sigma^2$",
    "random_walk.variance": r"$\gamma^2$",
    "phi": r"$\phi_{}$",
    "variance": r"$\varsigma^2_{}$",
    "amplitude": r"$\alpha_{}$",
    "beta": r"$\beta_{}$",
}
COLORS = {"moments": "#0072b2", "refined": "#009e73", "likelihood": "#d55e00", "bound": "#000000"}


def unknown(model: gf.Model) -> gf.Model:
    """The same sum with all parameters to be estimated."""
    return gf.Model([type(process)() for process in model.processes])


def symbol(name: str) -> str:
    """A parameter's letter in [V], for figures."""
    if name in _SYMBOLS:
        return _SYMBOLS[name]
    process, parameter = name.split(".")
    return _SYMBOLS[parameter].replace("{}", process.rsplit("_", 1)[1])


@dataclass(frozen=True)
class Fits:
    """Estimates of many runs.

    Attributes:
        params: `(run, parameter)`.
        low: Lower limits of the 95 % intervals, the same.
        high: Upper limits.
        determined: Whether the fit says that the data tell more than the order of magnitude, the same.
        converged: `(run,)`.
        p_value: Of the J test, `(run,)`.
    """

    params: Tensor
    low: Tensor
    high: Tensor
    determined: Tensor
    converged: Tensor
    p_value: Tensor

    def of(self, which: Tensor) -> Fits:
        """Some of the runs."""
        return Fits(*(value[which] for value in vars(self).values()))


@dataclass(frozen=True)
class Runs:
    """Simulated records and what was fitted to them.

    Attributes:
        model: Truth.
        n_samples: Length of each record.
        moments: The moments' fits.
        refined: The same, refined by the spectral likelihood.
        variance: Wavelet variances `(run, level)`.
    """

    model: gf.Model
    n_samples: int
    moments: Fits
    refined: Fits
    variance: Tensor


def fits(results: list[GMWMResult]) -> Fits:
    """Results of records `(run, 1, time)`, one after the other."""

    def joined(values: list[Tensor]) -> Tensor:
        return torch.cat(values)[:, 0]

    return Fits(
        joined([r.params for r in results]),
        joined([r.confidence_interval.low for r in results]),
        joined([r.confidence_interval.high for r in results]),
        joined([r.determined for r in results]),
        joined([r.converged for r in results]),
        joined([r.p_value for r in results]),
    )


def simulate_and_fit(model: gf.Model, n_samples: int, n_runs: int, generator: torch.Generator) -> Runs:
    """Fit the true kind of model to `n_runs` records, with and without refinement."""
    at_once = max(1, _AT_ONCE // n_samples)
    found: dict[bool, list[GMWMResult]] = {False: [], True: []}
    for done in range(0, n_runs, at_once):
        signal = model.simulate(n_samples, batch=(min(at_once, n_runs - done), 1), generator=generator)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # fits that could not be refined are counted instead
            for refine, results in found.items():
                results.append(gf.fit_gmwm(signal, unknown(model), refine=refine))
        progress(done + len(signal), n_runs, 5 * at_once)
    variance = torch.cat([result.wavelet_variance for result in found[False]])[..., 0]
    return Runs(model, n_samples, fits(found[False]), fits(found[True]), variance)


def progress(done: int, total: int, every: int) -> None:
    """Say on the error stream how far a long study is, every so many runs."""
    if total > every and (done % every == 0 or done == total):
        print(f"{done} of {total} runs", file=sys.stderr, flush=True)


def without_tones(model: gf.Model) -> gf.Model:
    """The noise alone."""
    return gf.Model([process for process in model.processes if not isinstance(process, gf.Sinusoid)])


def is_frequency(model: gf.Model) -> Tensor:
    """Which parameters are frequencies of tones."""
    return torch.tensor([name.endswith("beta") for name in model.param_names])


@functools.cache
def cramer_rao(model: gf.Model, n_samples: int) -> Tensor:
    """Least standard deviation `(parameter,)` of unbiased estimates from a long record.

    The information on noise is `T int_0^1/2 (d ln S)(d ln S)' df`; that on tones is Hannan's, `var a = 2 S / T` and
    `var beta = 24 S / (a^2 T^3)`.
    """
    noise = without_tones(model)
    lowest = math.log(1 / (4 * n_samples))  # halfway to the first ordinate
    edges = torch.linspace(lowest, math.log(0.5), _NODES + 1, dtype=torch.float64).exp()
    f, width = (edges[1:] * edges[:-1]).sqrt(), edges.diff()
    theta = noise.params

    def log_density(log_scale: Tensor) -> Tensor:
        return noise.with_params(theta * log_scale.exp()).spectrum(f).log()

    slopes: Any = torch.autograd.functional.jacobian(log_density, torch.zeros_like(theta), vectorize=True)
    information = n_samples * slopes.mT @ (width[:, None] * slopes)
    own = iter((torch.linalg.inv(information).diagonal().sqrt() * theta).tolist())
    bounds = []
    for process in model.processes:
        if isinstance(process, gf.Sinusoid):
            amplitude, beta = process.params.tolist()
            density = noise.spectrum(beta / (2 * math.pi)).item()
            bounds += [math.sqrt(2 * density / n_samples), math.sqrt(24 * density / n_samples**3) / amplitude]
        else:
            bounds += [next(own) for _ in process.parameters]
    return torch.tensor(bounds, dtype=torch.float64)


@functools.cache
def moment_spread(model: gf.Model, n_samples: int, n_levels: int, tone_term: bool = True) -> Tensor:
    """Standard deviation `(parameter,)` of the moments' estimates by [V] theorem 2; of frequencies the bound.

    Args:
        model: Truth.
        n_samples: Length of the record.
        n_levels: Levels fitted.
        tone_term: Whether wavelet variances vary by the product of noise and tone too, which [V] theorem 1 leaves out.
    """
    theta = model.params
    slopes: Any = torch.autograd.functional.jacobian(lambda t: model.with_params(t).wavelet_variance(n_levels), theta)
    free = ~is_frequency(model)
    columns = (slopes * theta)[:, free]
    covariance = moment_covariance(model, n_samples, n_levels)
    weighted = torch.linalg.solve(covariance, columns)
    gain = torch.linalg.solve(columns.mT @ weighted, weighted.mT)
    varies = covariance if tone_term else moment_covariance(without_tones(model), n_samples, n_levels)
    spread = cramer_rao(model, n_samples).clone()
    spread[free] = (gain @ varies @ gain.mT).diagonal().sqrt() * theta[free]
    return spread


def held(fit: Fits, truth: Tensor) -> Tensor:
    """Which intervals hold the truth, `(run, parameter)`."""
    return (fit.low <= truth) & (truth <= fit.high)


def binomial(count: int, n: int, share: float) -> float:
    """p value of a binomial test."""
    return float(stats.binomtest(count, n, share).pvalue)


def error_boxes(ax: Any, values: Tensor, places: list[float], color: str, width: float = 0.3) -> dict[str, Any]:
    """Boxplots of the columns of `values` in one colour."""
    box: dict[str, Any] = ax.boxplot(
        values.numpy(),
        positions=places,
        widths=width,
        patch_artist=True,
        medianprops={"color": "black"},
        flierprops={"marker": ".", "markersize": 3, "markeredgecolor": color},
        boxprops={"facecolor": color, "alpha": 0.55, "linewidth": 0.7},
    )
    return box
