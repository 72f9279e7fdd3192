"""How often the intervals hold the truth: figure 5 of Zhang et al. (2022), for more noises and methods.

Nominal 95 % intervals of the SVO weights by a fitted model and by the paper's block bootstrap, for short and for long
averaging times, those of the record and those of the paper's record cut to as many levels as there are; and of the
wavelet variance of single sensors at every level that has two windows side by side (`M_j >= 2 tau_j`). 1000 arrays of
2^13 and of 2^16 samples for every noise; `--quick` has 30 arrays of 2^12 samples, wavelet variances of one sensor, and
no averaging times of the paper's record.

The noises: Case 1 (white noise and random walk) and Case 2 (white noise and three AR(1)) of the paper, which take the
same part of a record as in its 29 hours, Case 1 with Laplace innovations, and Case 1 with a wandering tone that all
sensors feel.

    python examples/papers/svo_coverage.py [--quick] [--out FOLDER] [--seed N]
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from _svo_study import LINES, N_COVERAGE, N_SAMPLES, R, arguments, case1, case2, figures_written, finish, n_levels
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fusion.weights.svo import resolve_scale_weights

LEVEL = 0.95
SIZES = (2**13, 2**16)
QUICK_REPLICATIONS, QUICK_SIZES = 30, (2**12,)
BATCH = {2**12: 60, 2**13: 50, 2**16: 10}
COVARIANCES = {"model": "model", "block bootstrap": "block_bootstrap"}
# The wandering tone: gains as parts of the white noise, angular frequency (rad) and the variance of its steps.
_GAINS = 0.7 * R.diagonal().sqrt() * torch.tensor([0.5, 0.4, 0.3, 0.5, 0.2, 0.4], dtype=torch.float64)
_FREQUENCY, _WANDER = 0.125, 2e-3
# Far enough from the digits that small numbers lose.
_SCALE = 1e4

Simulate = Callable[[int, int, torch.Generator], Tensor]


def simulate_case1(n_samples: int, n_arrays: int, generator: torch.Generator) -> Tensor:
    return case1(n_samples).simulate(n_samples, batch=(n_arrays,), generator=generator)


def simulate_case2(n_samples: int, n_arrays: int, generator: torch.Generator) -> Tensor:
    return case2(n_samples).simulate(n_samples, batch=(n_arrays,), generator=generator)


def simulate_laplace(n_samples: int, n_arrays: int, generator: torch.Generator) -> Tensor:
    """Case 1 with sources that have the same variances but heavier tails."""
    (_, white), (_, walk) = case1(n_samples).components
    sources = []
    for matrix in (white, walk):
        # A difference of two exponential numbers over sqrt(2) is Laplace of variance 1.
        shape = (2, n_arrays, len(matrix), n_samples)
        positive, negative = -torch.rand(shape, dtype=torch.float64, generator=generator).clamp(min=1e-300).log()
        sources.append(torch.linalg.cholesky(matrix) @ ((positive - negative) / math.sqrt(2)))
    return sources[0] + sources[1].cumsum(-1)


def simulate_tone(n_samples: int, n_arrays: int, generator: torch.Generator) -> Tensor:
    """Case 1 with a tone whose phase is a random walk."""
    steps = torch.randn((n_arrays, 1, n_samples), dtype=torch.float64, generator=generator)
    start = 2 * math.pi * torch.rand((n_arrays, 1, 1), dtype=torch.float64, generator=generator)
    phase = start + (_FREQUENCY + math.sqrt(_WANDER) * steps).cumsum(-1)
    tone = math.sqrt(2) * _GAINS[:, None] * phase.cos()
    return simulate_case1(n_samples, n_arrays, generator) + tone


def true_tone(n_samples: int) -> Tensor:
    """Wavelet cross-covariance of Case 1 with the tone: its autocovariance is `g g' exp(-wander k / 2) cos(f k)`."""
    truth = case1(n_samples).wavelet_cross_covariance(n_levels(n_samples))
    variances = []
    for level in range(1, len(truth) + 1):
        tau = 2**level
        lag = torch.arange(tau, dtype=torch.float64)
        # Of the Haar filter +1/tau, -1/tau with itself; lags of either sign count.
        filters = torch.where(lag <= tau / 2, tau - 3 * lag, lag - tau) / tau**2
        filters[1:] *= 2
        variances.append((filters * torch.exp(-_WANDER * lag / 2) * torch.cos(_FREQUENCY * lag)).sum())
    return truth + torch.stack(variances)[:, None, None] * torch.outer(_GAINS, _GAINS)


@dataclass(frozen=True)
class Noise:
    """How a noise is simulated, `(n_samples, n_arrays, generator)`, and its wavelet cross-covariance in truth."""

    simulate: Simulate
    truth: Callable[[int], Tensor]


def _true_case1(n_samples: int) -> Tensor:
    return case1(n_samples).wavelet_cross_covariance(n_levels(n_samples))


def _true_case2(n_samples: int) -> Tensor:
    return case2(n_samples).wavelet_cross_covariance(n_levels(n_samples))


NOISES = {
    "Case 1": Noise(simulate_case1, _true_case1),
    "Case 2": Noise(simulate_case2, _true_case2),
    "Case 1, Laplace": Noise(simulate_laplace, _true_case1),
    "Case 1 and tone": Noise(simulate_tone, true_tone),
}


@dataclass(frozen=True)
class Coverage:
    """Numbers of replications in which intervals held the truth.

    Attributes:
        n: Replications.
        weights: `(sensor,)` by scale weights and covariance.
        variance: `(level, sensor)`, wavelet variances.
    """

    n: int
    weights: dict[tuple[str, str], Tensor]
    variance: Tensor


def cover(
    noise: Noise, n_samples: int, n_arrays: int, sensors: slice, cut: bool, generator: torch.Generator
) -> Coverage:
    """Count how often the intervals hold the truth in `n_arrays` arrays; `cut` as in `scales`."""
    truth, levels = noise.truth(n_samples), n_levels(n_samples)
    # M_j >= 2 tau_j: two windows side by side
    known = sum((n_samples - 2**j + 1) >= 2 * 2**j for j in range(1, levels + 1))
    scale_weights = scales(levels, cut)
    weights = {(w, c): torch.zeros(len(R), dtype=torch.long) for w in scale_weights for c in COVARIANCES}
    own = truth[:known].diagonal(dim1=-2, dim2=-1)[:, sensors]
    variance = torch.zeros(own.shape, dtype=torch.long)
    done = 0
    while done < n_arrays:
        batch = min(BATCH[n_samples], n_arrays - done)
        signal = _SCALE * noise.simulate(n_samples, batch, generator)
        for (name, covariance), count in weights.items():
            omega = scale_weights[name]
            best = gf.svo_weights(truth, omega)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that the bootstrap is poor at the last levels is what we measure
                fitted = gf.fit_svo(signal, omega, covariance=COVARIANCES[covariance], n_levels=levels)
            count += _held(fitted.confidence_interval, best)
        interval = gf.wavelet_variance_interval(signal[:, sensors], known)
        variance += _held(interval, _SCALE**2 * own)
        done += batch
    return Coverage(n_arrays, weights, variance)


def scales(levels: int, cut: bool) -> dict[str, Tensor]:
    """Scale weights by name, with those of the paper's record `cut` to these levels or without."""
    found = {name: resolve_scale_weights(name, levels) for name in ("short", "long")}
    for name in tuple(found) if cut else ():
        known = resolve_scale_weights(name, n_levels(N_SAMPLES))[:levels]
        found[f"{name}, cut"] = known / known.sum()
    return found


def _held(interval: gf.ConfidenceInterval, truth: Tensor) -> Tensor:
    low, high = interval
    return ((low <= truth) & (truth <= high)).sum(0)


def band(n: int) -> tuple[float, float]:
    """Where 95 % of coverages lie when the intervals are right, as shares of `n` replications."""
    low, high = stats.binom.interval(0.95, n, LEVEL)
    return low / n, high / n


def print_coverage(found: dict[tuple[str, int], Coverage]) -> None:
    for (name, n_samples), coverage in found.items():
        low, high = (100 * edge for edge in band(coverage.n))
        print(f"\n{name}, {coverage.n} arrays of {n_samples} samples: coverage (%) of 95 % intervals;")
        print(f"95 % of right ones lie in [{low:.1f}, {high:.1f}]; [ ]: binomial 95 % interval of the mean's coverage")
        print(f"{'weights':>10}  {'covariance':>15}  " + "  ".join(f"{i:>5}" for i in range(1, len(R) + 1)) + "   mean")
        for (scale, covariance), held in coverage.weights.items():
            cells = "  ".join(f"{100 * share:>5.1f}" for share in (held / coverage.n).tolist())
            print(f"{scale:>10}  {covariance:>15}  {cells}  {_with_interval(held, coverage.n)}")
        print(f"wavelet variance of {coverage.variance.shape[1]} sensor(s), by level")
        print(f"{'level':>7}  {'M_j / tau_j':>15}  {'least':>5}  {'most':>5}   mean")
        for j, held in enumerate(coverage.variance, 1):
            shares = 100 * held / coverage.n
            windows = (n_samples - 2**j + 1) / 2**j
            ends = f"{shares.min().item():>5.1f}  {shares.max().item():>5.1f}"
            print(f"{j:>7}  {windows:>15.1f}  {ends}  {_with_interval(held, coverage.n)}")


def _with_interval(held: Tensor, n: int) -> str:
    """Mean over sensors, with the exact binomial interval of as many replications: sensors are not independent."""
    mean = held.double().mean().item()
    interval = stats.binomtest(round(mean), n).proportion_ci(method="exact")
    return f"{100 * mean / n:>5.1f} [{100 * interval.low:.1f}, {100 * interval.high:.1f}]"


def plot_coverage(found: dict[tuple[str, int], Coverage], n_samples: int, path: Path) -> None:
    """Coverage of weights by sensor, and of wavelet variances by level; the band holds 95 % of right ones."""
    figure, axes = plt.subplots(len(NOISES), 3, figsize=(10, 2.3 * len(NOISES)), sharey=True, layout="constrained")
    for row, name in zip(axes, NOISES, strict=True):
        coverage = found[name, n_samples]
        for ax, scale in zip(row, ("short", "long"), strict=False):
            for k, (covariance, marker) in enumerate((("model", "o"), ("block bootstrap", "s"))):
                shares = coverage.weights[scale, covariance] / coverage.n
                places = [i + 0.2 * (k - 0.5) for i in range(1, len(R) + 1)]
                color = LINES["SVO long" if covariance == "model" else "RDVG"]["color"]
                ax.plot(places, shares, marker, color=color, markersize=5, label=covariance, clip_on=False)
            ax.set_xticks(range(1, len(R) + 1))
            ax.set_title(f"{name}: SVO {scale} weights", loc="left", fontsize=9)
        ends = coverage.variance / coverage.n
        levels = range(1, len(ends) + 1)
        row[2].vlines(levels, ends.amin(1), ends.amax(1), color=LINES["SVO long"]["color"], linewidth=1)
        row[2].plot(levels, ends.mean(1), "o", color=LINES["SVO long"]["color"], markersize=4)
        row[2].set_title(f"{name}: wavelet variances", loc="left", fontsize=9)
        row[0].set_ylabel("coverage")
        for ax in row:
            ax.axhspan(*band(coverage.n), color="#bdbdbd", alpha=0.5, linewidth=0, zorder=0)
            ax.axhline(LEVEL, color="#6b6b6b", linewidth=0.8, zorder=1)
    for ax, label in zip(axes[-1], ("sensor", "sensor", "level"), strict=True):
        ax.set_xlabel(label)
    lowest = min((held / c.n).min().item() for c in found.values() for held in (*c.weights.values(), c.variance))
    axes[0, 0].set_ylim(max(0.0, min(0.85, lowest - 0.03)), 1.005)
    axes[0, 0].legend(fontsize=8, loc="lower right")
    finish(figure, path)


def main() -> None:
    options = arguments(__doc__).parse_args()
    sizes, n_arrays = (QUICK_SIZES, QUICK_REPLICATIONS) if options.quick else (SIZES, N_COVERAGE)
    sensors = slice(1) if options.quick else slice(None)
    found, generator = {}, torch.Generator().manual_seed(options.seed)
    for n_samples in sizes:
        for name, noise in NOISES.items():
            found[name, n_samples] = cover(noise, n_samples, n_arrays, sensors, not options.quick, generator)
            if not options.quick:
                print(f"{name}, {n_samples} samples: done", file=sys.stderr, flush=True)
    print_coverage(found)
    names = [f"svo_coverage_{n_samples}.png" for n_samples in sizes]
    for n_samples, name in zip(sizes, names, strict=True):
        plot_coverage(found, n_samples, options.out / name)
    figures_written(options.out, *names)


if __name__ == "__main__":
    main()
