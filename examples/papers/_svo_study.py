"""What the studies of Zhang et al. (2022) share: their arrays, the methods they compare, tables and figures.

Zhang, Cucci, Molinari, Guerrier, Scale-wise Variance Minimization for Optimal Virtual Signals: An Approach for
Redundant Gyroscopes, IEEE Transactions on Signal Processing 70, 2022: [Z].
"""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib
import torch
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.cli.demo.demo import N_SAMPLES, RATE, UNIT, demo_array
from gyrofuse.fusion.weights.rdvg import rdvg
from gyrofuse.fusion.weights.svo import resolve_scale_weights

matplotlib.use("Agg")
import matplotlib.pyplot as plt

N_ARRAYS, N_NEW, N_COVERAGE = 50, 10, 1000  # arrays, new arrays for each, replications of the coverage study
QUICK_ARRAYS, QUICK_NEW, QUICK_SAMPLES = 6, 2, 2**16
# Random walk of [Z] section V-A, (deg/s)^2 per step of 0.1 s. White noise is that of both cases.
_Q = (
    (2.55058e-14, -8.573e-16, 1.02881e-14, -1.62894e-14, -2.40055e-14, -5.5727e-15),
    (-8.573e-16, 4.71536e-14, 1.99331e-14, 1.0717e-15, 3.215e-15, 2.07905e-14),
    (1.02881e-14, 1.99331e-14, 3.489369e-13, -1.281722e-13, 5.5727e-15, -3.02212e-14),
    (-1.62894e-14, 1.0717e-15, -1.281722e-13, 2.091907e-13, 4.09379e-14, 5.4441e-14),
    (-2.40055e-14, 3.215e-15, 5.5727e-15, 4.09379e-14, 5.55127e-14, 2.44342e-14),
    (-5.5727e-15, 2.07905e-14, -3.02212e-14, 5.4441e-14, 2.44342e-14, 2.501286e-13),
)
R = demo_array().components[0][1]
Q = torch.tensor(_Q, dtype=torch.float64)

PAPER = ("SVO long", "SVO short", "RDVG", "equal")
SINGLE = (*PAPER, "model-assisted")  # one weight per sensor
METHODS = (*SINGLE, "multi-scale")
LINES: dict[str, dict[str, Any]] = {
    "SVO long": {"color": "#0072b2", "linewidth": 2.0},
    "SVO short": {"color": "#009e73", "linewidth": 2.0},
    "RDVG": {"color": "#cc79a7", "linewidth": 1.6},
    "equal": {"color": "#d55e00", "linewidth": 1.5, "linestyle": (0, (5, 2))},
    "model-assisted": {"color": "#56b4e9", "linewidth": 1.5, "linestyle": "-."},
    "nonnegative": {"color": "#e69f00", "linewidth": 1.5, "linestyle": "-."},
    "multi-scale": {"color": "#000000", "linewidth": 1.3, "linestyle": ":"},
}


def case1(n_samples: int = N_SAMPLES) -> gf.ArrayModel:
    """White noise and a correlated random walk, [Z] equation (10); a shorter record is the same one sampled less often.

    With fewer samples the walk takes larger steps, so that noises cross over at the same part of the record.
    """
    return gf.ArrayModel([(gf.WhiteNoise(1.0), R), (gf.RandomWalk(1.0), Q * (N_SAMPLES / n_samples) ** 2)])


def case2(n_samples: int = N_SAMPLES) -> gf.ArrayModel:
    """White noise and three AR(1), [Z] equation (13); in a shorter record they decorrelate at the same part of it."""
    components = []
    for process, matrix in demo_array().components:
        if isinstance(process, gf.AR1):
            phi = process.phi ** (N_SAMPLES / n_samples)
            # the spectral density at zero stays
            components.append((gf.AR1(phi, 1.0), matrix * ((1 - phi) / (1 - process.phi)) ** 2))
        else:
            components.append((process, matrix))
    return gf.ArrayModel(components)


def n_levels(n_samples: int) -> int:
    """Levels whose longest filter is half the record: 19 of 1 044 000 samples, as in [Z]."""
    return round(math.log2(n_samples)) - 1


def sampling_rate(n_samples: int) -> float:
    """Rate in Hz of the 29 h record when it has this many samples."""
    return RATE * n_samples / N_SAMPLES


def averaging_times(n_samples: int) -> Tensor:
    """Averaging times `2**(j-1)` samples of all levels, seconds."""
    return torch.exp2(torch.arange(n_levels(n_samples), dtype=torch.float64)) / sampling_rate(n_samples)


@dataclass(frozen=True)
class Study:
    """What a study found.

    Attributes:
        model: Truth.
        n_samples: Length of every array.
        weights: `(array, method, sensor)` of the `SINGLE` methods.
        variance: `(array, new, method, level)`, wavelet variance of the virtual signals of `METHODS` in new arrays.
        best: `(array, new, 2, level)`, the same for the best weights in truth, for long and for short times.
        held: `(array, sensor)`, whether the 95 % interval of the SVO short weight holds the true one.
        sensors: `(level, sensor)`, wavelet variance of the last new array.
        n_indefinite: Arrays in which RDVG's random walk covariance is no covariance.
    """

    model: gf.ArrayModel
    n_samples: int
    weights: Tensor
    variance: Tensor
    best: Tensor
    held: Tensor
    sensors: Tensor
    n_indefinite: int

    @property
    def tau(self) -> Tensor:
        """Averaging times, seconds."""
        return averaging_times(self.n_samples)

    def combined(self, scale_weights: str) -> Tensor:
        """`A0`, true wavelet cross-covariance combined over scales."""
        omega = resolve_scale_weights(scale_weights, n_levels(self.n_samples))
        return torch.einsum("j,jik->ik", omega, self.model.wavelet_cross_covariance(len(omega)))

    def excess_risk(self, scale_weights: str) -> Tensor:
        """`c'A0c / c0'A0c0 - 1`: `(array, method)` of the `SINGLE` methods."""
        combined = self.combined(scale_weights)
        least = torch.linalg.solve(combined, torch.ones_like(combined[0])).sum().reciprocal()  # 1 / (1' A0^-1 1)
        return quadratic(self.weights, combined) / least - 1

    def excess_out_of_sample(self, scale_weights: str) -> Tensor:
        """The same in the new arrays, against the best weights in them, `(method,)` of `METHODS`."""
        omega = resolve_scale_weights(scale_weights, n_levels(self.n_samples))
        best = self.best[:, :, ("long", "short").index(scale_weights)] @ omega
        return (self.variance @ omega).mean((0, 1)) / best.mean() - 1


def quadratic(weights: Tensor, matrix: Tensor) -> Tensor:
    """`c' M c` for weights `(..., sensor)` and matrices `(..., sensor, sensor)`."""
    return torch.einsum("...i,...ik,...k->...", weights, matrix, weights)


def run_study(model: gf.ArrayModel, n_samples: int, n_arrays: int, n_new: int, seed: int) -> Study:
    """Fit every method to `n_arrays` arrays and use it on `n_new` new ones each."""
    generator = torch.Generator().manual_seed(seed)
    levels = n_levels(n_samples)
    truth = model.wavelet_cross_covariance(levels)
    ideal = torch.stack([gf.svo_weights(truth, name) for name in ("long", "short")])
    found: dict[str, list[Tensor]] = {"weights": [], "variance": [], "best": [], "held": []}
    n_indefinite = 0
    for array in range(n_arrays):
        signal = model.simulate(n_samples, generator=generator)
        short = gf.fit_svo(signal, "short", n_levels=levels)
        assisted = gf.fit_svo(signal, "long", n_levels=levels, method="model_assisted", covariance="none")
        multiscale = gf.fit_multiscale(signal, n_levels=levels)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # counted instead
            reduced = rdvg(signal)
        n_indefinite += int(not reduced.positive_definite)
        wccv = short.wavelet_cross_covariance
        long = gf.svo_weights(wccv, "long")
        weights = torch.stack([long, short.weights, reduced.weights, gf.equal_weights(wccv), assisted.weights])
        low, high = short.confidence_interval
        found["weights"].append(weights)
        found["held"].append((low <= ideal[1]) & (ideal[1] <= high))
        for _ in range(n_new):
            signal = model.simulate(n_samples, generator=generator)
            wccv = gf.wavelet_cross_covariance(signal, levels)
            fixed = quadratic(weights[:, None], wccv)  # wavelet variance of c'x: (method, level)
            fused = gf.wavelet_variance(multiscale.virtual(signal)[None], levels).mT
            found["variance"].append(torch.cat([fixed, fused]))
            found["best"].append(quadratic(ideal[:, None], wccv))
        if n_arrays > 10 and (array + 1) % 10 == 0:
            print(f"{array + 1} of {n_arrays} arrays", file=sys.stderr, flush=True)
    stacked = {name: torch.stack(values) for name, values in found.items()}
    for name in ("variance", "best"):
        stacked[name] = stacked[name].unflatten(0, (n_arrays, n_new))
    sensors = wccv.diagonal(dim1=-2, dim2=-1)
    return Study(model=model, n_samples=n_samples, sensors=sensors, n_indefinite=n_indefinite, **stacked)


def average(variance: Tensor) -> tuple[Tensor, Tensor]:
    """Mean over arrays and new arrays `(array, new, ...)`, and half the width of its 95 % interval.

    New arrays with the same weights are not independent, so the interval rests on the means of the arrays.
    """
    means = variance.mean(1)
    return means.mean(0), _t(len(means)) * means.std(0) / math.sqrt(len(means))


def ratio_to_equal(variance: Tensor) -> tuple[Tensor, Tensor]:
    """Ratio of the mean `(array, new, method, level)` to that of equal weights, and half its 95 % interval (delta)."""
    means = variance.mean(1)
    equal = means[:, METHODS.index("equal"), None]
    ratio = means.mean(0) / equal.mean(0)
    residual = (means - ratio * equal) / equal.mean(0)
    return ratio, _t(len(means)) * residual.std(0) / math.sqrt(len(means))


def _t(n: int) -> float:
    return float(stats.t.ppf(0.975, n - 1))


def print_study(study: Study) -> None:
    """Wavelet variances out of sample, excess risks and weights as tables."""
    n_arrays, n_new = study.variance.shape[:2]
    hours = N_SAMPLES / RATE / 3600
    print(
        f"{n_arrays} arrays of {study.n_samples} samples ({hours:g} h at {sampling_rate(study.n_samples):.4g} Hz), "
        f"{n_arrays * n_new} new arrays, {n_levels(study.n_samples)} levels"
    )
    if study.n_indefinite:
        print(f"RDVG's random walk covariance is not positive definite in {study.n_indefinite} of {n_arrays} arrays.")

    mean, _ = average(study.variance)
    ratio, half = ratio_to_equal(study.variance)
    others = [m for m, name in enumerate(METHODS) if name != "equal"]
    print(f"\nWavelet variance of virtual signals in new arrays: equal weights in ({UNIT})^2, others as ratios to it")
    print("with half the width of their 95 % intervals")
    print(f"{'level':>5}  {'tau (s)':>9}  {'equal':>9}  " + "  ".join(f"{METHODS[m]:>15}" for m in others))
    for j, tau in enumerate(study.tau.tolist()):
        row = "  ".join(f"{f'{ratio[m, j]:.3f} +- {half[m, j]:.3f}':>15}" for m in others)
        print(f"{j + 1:>5}  {tau:>9.4g}  {mean[METHODS.index('equal'), j].item():>9.3e}  {row}")

    print("\nExcess risk (%), the combined wavelet variance above the least that one weight per sensor can have:")
    print("under the true noise, mean and median over arrays; and in the new arrays")
    print(f"{'':>15}  {'for long times':^26}  {'for short times':^26}")
    print(f"{'method':>15}  " + "  ".join(f"{name:>8}" for name in 2 * ("mean", "median", "new")))
    risks = [(study.excess_risk(name), study.excess_out_of_sample(name)) for name in ("long", "short")]
    for m, method in enumerate(METHODS):
        cells = []
        for risk, new in risks:
            known = [risk[:, m].mean(), risk[:, m].median()] if method in SINGLE else []
            cells += ["-"] * (2 - len(known)) + [f"{100 * value.item():.2f}" for value in (*known, new[m])]
        print(f"{method:>15}  " + "  ".join(f"{cell:>8}" for cell in cells))

    print("\nWeights, mean and standard deviation over arrays")
    print(f"{'sensor':>15}  " + "  ".join(f"{i:>15}" for i in range(1, study.weights.shape[-1] + 1)))
    for m, method in enumerate(SINGLE):
        pairs = zip(study.weights[:, m].mean(0).tolist(), study.weights[:, m].std(0).tolist(), strict=True)
        print(f"{method:>15}  " + "  ".join(f"{f'{c:+.3f} +- {s:.3f}':>15}" for c, s in pairs))


def plot_variances(study: Study, path: Path) -> None:
    """[Z] figures 2 and 7: wavelet variances in new arrays below, their ratios to equal weights above."""
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(7, 7.6), sharex=True, height_ratios=[1, 1.5], layout="constrained"
    )
    tau = study.tau
    mean, spread = average(study.variance)
    ratio, half = ratio_to_equal(study.variance)
    below.loglog(tau, study.sensors, color="#969696", linewidth=0.8, zorder=1)
    below.lines[0].set_label("sensors of one new array")
    for m, method in enumerate(METHODS):
        line = LINES[method]
        band = {"color": line["color"], "alpha": 0.15, "linewidth": 0}
        below.loglog(tau, mean[m], label=method, **line)
        # intervals of the logarithm
        factor, ratio_factor = (spread / mean)[m].exp(), (half / ratio)[m].exp()
        below.fill_between(tau, mean[m] / factor, mean[m] * factor, **band)
        above.loglog(tau, ratio[m], **line)
        above.fill_between(tau, ratio[m] / ratio_factor, ratio[m] * ratio_factor, **band)
    ticks = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20]
    above.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    above.minorticks_off()
    above.set_ylim(max(0.1, 0.7 * ratio.min().item()), min(20.0, 1.4 * ratio.max().item()))
    below.set_ylim(0.5 * mean.min().item(), 2 * study.sensors.max().item())
    above.set_ylabel("wavelet variance / equal weights")
    below.set_ylabel(f"wavelet variance ({UNIT})$^2$")
    below.set_xlabel("averaging time (s)")
    below.legend(fontsize=8, ncols=2)
    finish(figure, path)


def plot_weights(study: Study, path: Path) -> None:
    """[Z] figures 4 and 8: distribution of the weights of every method."""
    methods = [name for name in SINGLE if name != "equal"]
    n_sensors = study.weights.shape[-1]
    truth = study.model.wavelet_cross_covariance(n_levels(study.n_samples))
    figure, ax = plt.subplots(figsize=(8, 4.4), layout="constrained")
    width = 0.8 / len(methods)
    for k, method in enumerate(methods):
        places = [i + (k - (len(methods) - 1) / 2) * width for i in range(1, n_sensors + 1)]
        box = boxes(ax, study.weights[:, SINGLE.index(method)], places, method, 0.85 * width)
        box["boxes"][0].set_label(method)
    equal = ax.axhline(1 / n_sensors, zorder=1, **LINES["equal"], label="equal")
    for name, marker in (("long", "D"), ("short", "s")):
        best = gf.svo_weights(truth, name)
        k = methods.index(f"SVO {name}")
        places = [i + (k - (len(methods) - 1) / 2) * width for i in range(1, n_sensors + 1)]
        ax.plot(places, best, marker, color="black", markersize=4, fillstyle="none", label=f"best for {name} times")
    equal.set_zorder(0)
    ax.set_xticks(range(1, n_sensors + 1), [str(i) for i in range(1, n_sensors + 1)])
    ax.set_xlim(0.5, n_sensors + 0.5)
    # Outliers of RDVG may lie far away; all but the outermost hundredth of all weights is shown.
    low, high = (study.weights.flatten(0, 1).quantile(q).item() for q in (0.01, 0.99))
    ax.set_ylim(min(low, -0.05) - 0.1 * (high - low), high + 0.1 * (high - low))
    ax.set_xlabel("sensor")
    ax.set_ylabel("weight")
    ax.legend(fontsize=8, ncols=4, loc="lower left", bbox_to_anchor=(0, 1), frameon=False)
    finish(figure, path)


def boxes(ax: Any, values: Tensor, places: list[float], method: str, width: float) -> dict[str, Any]:
    """Boxplots of the columns of `values`, in the colour of a method."""
    color = LINES[method]["color"]
    box: dict[str, Any] = ax.boxplot(
        values.numpy(),
        positions=places,
        widths=width,
        patch_artist=True,
        medianprops={"color": "black"},
        flierprops={"marker": ".", "markersize": 3, "markeredgecolor": color},
        boxprops={"facecolor": color, "alpha": 0.55, "linewidth": 0.7},
        whiskerprops={"color": color},
        capprops={"color": color},
    )
    return box


def finish(figure: Any, path: Path) -> None:
    """Common look, and save."""
    for ax in figure.axes:
        ax.grid(color="#e3e3e3", linewidth=0.7)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def conclusion(number: str, claim: str, numbers: str, holds: bool) -> None:
    """Print a claim, the numbers that it rests on, and the verdict."""
    verdict = "holds" if holds else "does not hold"
    for text, first in ((claim, f"({number}) "), (f"{numbers}: {verdict}", "")):
        print(fill(text, 116, initial_indent=first.ljust(6), subsequent_indent=6 * " "))


def arguments(description: str) -> argparse.ArgumentParser:
    """Parser with the options that all studies have."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small study, in seconds")
    parser.add_argument("--out", type=_folder, default=Path(), help="folder of the figures; the current one by default")
    parser.add_argument("--seed", type=int, default=1, help="of the random numbers")
    return parser


def _folder(name: str) -> Path:
    """Made before anything is computed, so that no study fails when it is done."""
    folder = Path(name)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def figures_written(folder: Path, *names: str) -> None:
    """Say where the figures are."""
    print("\nFigures: " + ", ".join(str(folder / name) for name in names))
