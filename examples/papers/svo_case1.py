"""Case 1 of Zhang et al. (2022), section V-A: six gyros with white noise and a correlated random walk.

Weights from 50 arrays of 29 hours by every method, and what they make of 10 new arrays each: figures 2 (wavelet
variances), 3 (estimated noise of the virtual signals) and 4 (weights) of the paper, and its four conclusions in
numbers. `--quick` has 6 arrays, 2 new ones each, and 2^16 samples instead of 1 044 000 for the same 29 hours.

    python examples/papers/svo_case1.py [--quick] [--out FOLDER] [--seed N]
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import torch
from _svo_study import (
    METHODS,
    N_ARRAYS,
    N_NEW,
    N_SAMPLES,
    PAPER,
    QUICK_ARRAYS,
    QUICK_NEW,
    QUICK_SAMPLES,
    SINGLE,
    UNIT,
    Q,
    R,
    Study,
    arguments,
    average,
    boxes,
    case1,
    conclusion,
    figures_written,
    finish,
    plot_variances,
    plot_weights,
    print_study,
    quadratic,
    run_study,
)
from scipy import stats
from torch import Tensor

_ROUNDS = 20


def white_noise_and_walk(variance: Tensor, n_samples: int) -> tuple[Tensor, Tensor]:
    """White noise `sigma^2` and random walk `gamma^2` that fit wavelet variances `(..., level)`.

    Least squares of `sigma^2 / tau + gamma^2 (tau^2 + 2) / (12 tau)` relative to the fit itself, weighted by degrees
    of freedom: the maximum likelihood of independent chi-square levels.
    """
    tau = torch.exp2(torch.arange(1, variance.shape[-1] + 1, dtype=torch.float64))
    degrees = ((n_samples - tau + 1) / tau).clamp(min=1)
    regressors = torch.stack([1 / tau, (tau**2 + 2) / (12 * tau)], -1)  # (level, parameter)
    fit = variance
    for _ in range(_ROUNDS):
        weighted = regressors * (degrees / fit**2)[..., None]  # (..., level, parameter)
        right = (weighted * variance[..., None]).sum(-2)
        parameters = torch.linalg.solve(weighted.mT @ regressors, right).clamp(min=0)
        fit = parameters @ regressors.mT
    return parameters[..., 0], parameters[..., 1]


def estimates(study: Study) -> tuple[Tensor, Tensor]:
    """Estimates `(virtual signal, method)` of both parameters; the walk per step of 0.1 s."""
    sigma2, gamma2 = white_noise_and_walk(study.variance, study.n_samples)
    return sigma2.flatten(0, 1), gamma2.flatten(0, 1) * (study.n_samples / N_SAMPLES) ** 2


def print_estimates(study: Study, sigma2: Tensor, gamma2: Tensor) -> None:
    print(f"\nWhite noise sigma^2 (1e-8 ({UNIT})^2) and random walk gamma^2 (1e-14 ({UNIT})^2 per 0.1 s) of the")
    print("virtual signals in new arrays: estimates (median, quartiles), and c'Rc and c'Qc of the weights (median)")
    print(f"{'method':>15}  {'sigma^2':>24}  {'in truth':>8}  {'gamma^2':>24}  {'in truth':>8}")
    for m, method in enumerate(METHODS):
        cells = []
        for values, scale, matrix in ((sigma2, 1e8, R), (gamma2, 1e14, Q)):
            low, middle, high = (scale * values[:, m]).quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist()
            cells.append(f"{f'{middle:.3f} [{low:.3f}, {high:.3f}]':>24}")
            single = f"{scale * quadratic(study.weights[:, m], matrix).median():.3f}" if method in SINGLE else "-"
            cells.append(f"{single:>8}")
        print(f"{method:>15}  " + "  ".join(cells))


def plot_estimates(sigma2: Tensor, gamma2: Tensor, path: Path) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
    labels = (f"white noise $\\sigma^2$ ({UNIT})$^2$", f"random walk $\\gamma^2$ ({UNIT})$^2$ per 0.1 s")
    for ax, values, label in zip(axes, (sigma2, gamma2), labels, strict=True):
        for m, method in enumerate(METHODS):
            boxes(ax, values[:, m : m + 1], [m], method, 0.6)
        ax.set_xticks(range(len(METHODS)), METHODS, rotation=30, ha="right", fontsize=8)
        ax.set_ylabel(label)
        ax.set_yscale("log")
    finish(figure, path)


def print_conclusions(study: Study, gamma2: Tensor) -> None:
    print("\nThe paper's conclusions (section V-A), among its four methods")
    walk = gamma2.median(0).values
    spread = quadratic(study.weights, Q).std(0)  # of the walk that the weights leave in truth, over arrays
    long, short, rdvg, equal = (METHODS.index(name) for name in PAPER)
    mean, _ = average(study.variance)
    numbers = ", ".join(f"{name} {1e14 * walk[m].item():.3f}" for m, name in enumerate(PAPER))
    conclusion("i", "RDVG has the smallest random walk", f"1e14 gamma^2: {numbers}", walk[:4].argmin().item() == rdvg)
    conclusion(
        "i",
        "SVO for long times has a low random walk too, near RDVG's but with greater spread",
        f"median {walk[long] / walk[rdvg]:.2f} times RDVG's ({walk[equal] / walk[rdvg]:.2f} with equal weights), "
        f"standard deviation of c'Qc over arrays {spread[long] / spread[rdvg]:.2f} times RDVG's",
        bool((walk[long] < (walk[rdvg] + walk[equal]) / 2) & (spread[long] > spread[rdvg])),
    )
    weights = study.weights.mean(0)
    drifting, noisy = [2, 3, 5], [0, 1, 5]  # sensors with the largest diagonal of Q, and of R
    below = [
        (weights[rdvg], drifting, "RDVG of sensors 3, 4, 6"),
        (weights[long], drifting, "SVO long of 3, 4, 6"),
        (weights[short], noisy, "SVO short of 1, 2, 6"),
    ]
    numbers = "; ".join(f"{name} {', '.join(f'{c:+.3f}' for c in w[which].tolist())}" for w, which, name in below)
    conclusion(
        "ii",
        "sensors that are noisiest where a method looks get less than 1/6",
        f"mean weights: {numbers}",
        all(bool((w[which] < 1 / 6).all()) for w, which, _ in below),
    )
    first, last = mean[:4, 0] / mean[equal, 0], mean[:4, -1] / mean[equal, -1]
    conclusion(
        "iii",
        "SVO adapts to its scale weights: short is the best at the first level, long beats it and equal at the last",
        f"wavelet variance over equal: short {first[short]:.3f} at the first level (RDVG {first[rdvg]:.3f}), "
        f"long {last[long]:.3f} at the last (short {last[short]:.3f})",
        bool((first.argmin() == short) & (last[long] < last[short]) & (last[long] < 1)),
    )
    n_arrays = len(study.held)
    held = study.held.sum(0).tolist()
    p = min(stats.binomtest(k, n_arrays, 0.95).pvalue for k in held)
    conclusion(
        "iv",
        "95 % intervals of the SVO short weights hold the true ones as often as they say",
        f"in {', '.join(map(str, held))} of {n_arrays} arrays (smallest p of 6 binomial tests {p:.3f})",
        p > 0.05 / len(held),
    )


def main() -> None:
    options = arguments(__doc__).parse_args()
    n_samples = QUICK_SAMPLES if options.quick else N_SAMPLES
    sizes = (QUICK_ARRAYS, QUICK_NEW) if options.quick else (N_ARRAYS, N_NEW)
    study = run_study(case1(n_samples), n_samples, *sizes, options.seed)
    sigma2, gamma2 = estimates(study)
    print_study(study)
    print_estimates(study, sigma2, gamma2)
    print_conclusions(study, gamma2)
    plot_variances(study, options.out / "svo_case1_variances.png")
    plot_estimates(sigma2, gamma2, options.out / "svo_case1_estimates.png")
    plot_weights(study, options.out / "svo_case1_weights.png")
    figures_written(options.out, *(f"svo_case1_{name}.png" for name in ("variances", "estimates", "weights")))


if __name__ == "__main__":
    main()
