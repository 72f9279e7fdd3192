"""Simulations 1, 2 and 3 of Voirol et al., section 4: estimates of noise models with tones, figures 1, 3, 4 and 9.

Every record is fitted by wavelet moments and once more with spectral refinement, which is all but the maximum of the
likelihood. Bias, spread against theory, coverage of 95 % intervals, the size of the J test, and the paper's conclusions
in numbers. The paper has 500 runs: Simulation 1 at 10 000 to 160 000 samples takes a quarter of an hour, Simulations 2
and 3 at 10 000 000 samples most of a minute a run. `--quick` has some runs of short records.

    python examples/papers/gmwm_simulations.py [--simulation 1|2|3] [--samples T [T ...]] [--runs N] [--quick]
        [--out FOLDER] [--seed N]
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import torch
from _gmwm_study import (
    COLORS,
    N_RUNS,
    N_SAMPLES,
    SIMULATIONS,
    Fits,
    Runs,
    binomial,
    cramer_rao,
    error_boxes,
    held,
    moment_spread,
    simulate_and_fit,
    symbol,
)
from _svo_study import arguments, conclusion, figures_written, finish
from matplotlib.ticker import NullLocator
from scipy import stats
from torch import Tensor

QUICK_SAMPLES = {1: (2048, 8192), 2: (2**20,), 3: (2**16,)}
QUICK_RUNS = {1: 30, 2: 3, 3: 10}
# Standard deviations: a median as close to the truth is centred, and up to so many over the root of the runs by chance.
_NEAR, _BY_CHANCE = 0.25, 4.0
_NEGLIGIBLE = 0.2  # loss of RMSE


def rmse(fit: Fits, truth: Tensor) -> Tensor:
    """Root mean squared error `(parameter,)`."""
    return (fit.params - truth).square().mean(0).sqrt()


def without_tone_term(runs: Runs) -> Tensor:
    """Share of runs `(parameter,)` whose intervals would hold the truth if noise times tone were left out."""
    truth = runs.model.params
    claimed = moment_spread(runs.model, runs.n_samples, runs.variance.shape[-1], tone_term=False) / truth
    width = stats.norm.ppf(0.975) * claimed
    return ((runs.moments.params / truth).log().abs() <= width).double().mean(0)


def print_runs(runs: Runs) -> None:
    """A row for each parameter: both methods beside their theory."""
    truth, n_levels = runs.model.params, runs.variance.shape[-1]
    theory = {"moments": moment_spread(runs.model, runs.n_samples, n_levels)}
    theory["refined"] = bound = cramer_rao(runs.model, runs.n_samples)
    n = len(runs.moments.params)
    print(f"\n{n} runs of {runs.n_samples} samples, {n_levels} levels")
    print(f"bias: mean error over standard deviation (its own is {n**-0.5:.3f}); theory: the latter over theory's;")
    print("held: 95 % intervals with the truth, weak: said to be weakly determined (%); RMSE over the Cramer-Rao bound")
    names = ("bias", "theory", "held", "weak", "RMSE")
    print(f"{'':>22}  {'':>10}  {'':>8}  {'moments':^38}  {'refined':^38}")
    print(f"{'parameter':>22}  {'truth':>10}  {'bound':>8}  " + "  ".join(2 * [" ".join(f"{c:>7}" for c in names)]))
    for k, name in enumerate(runs.model.param_names):
        row = f"{name:>22}  {truth[k].item():>10.4g}  {bound[k].item():>8.2g}"
        for method, expected in theory.items():
            fit: Fits = getattr(runs, method)
            error, spread = fit.params[:, k] - truth[k], fit.params[:, k].std()
            cells = (
                f"{error.mean() / spread:+.2f}",
                f"{spread / expected[k]:.2f}",
                f"{100 * held(fit, truth)[:, k].double().mean():.1f}",
                f"{100 * (~fit.determined[:, k]).double().mean():.1f}",
                f"{rmse(fit, truth)[k] / bound[k]:.2f}",
            )
            row += "  " + " ".join(f"{cell:>7}" for cell in cells)
        print(row)
    p = runs.moments.p_value
    sizes = ", ".join(f"{100 * (p < level).double().mean():.1f} % below {level:g}" for level in (0.1, 0.05, 0.01))
    same = (runs.refined.params == runs.moments.params).all(-1)
    print(f"p values of the J test: {sizes}")
    print(
        f"not converged {int((~runs.moments.converged).sum())}, not finite "
        f"{int((~runs.moments.params.isfinite()).any(-1).sum())}, could not be refined {int(same.sum())} of {n}"
    )
    claimed, shares = without_tone_term(runs), held(runs.moments, truth).double().mean(0)
    for k, name in enumerate(runs.model.param_names):
        if name.endswith("amplitude"):
            low = moment_spread(runs.model, runs.n_samples, n_levels, tone_term=False)[k] / theory["moments"][k]
            print(
                f"{name}: without the product of noise and tone its standard deviation would be said to be {low:.2f} "
                f"of what it is, and {100 * claimed[k]:.1f} % of intervals would hold it ({100 * shares[k]:.1f} % do)"
            )


def print_conclusions(number: int, studies: list[Runs]) -> None:
    print("\nThe paper's conclusions (section 4)")
    last = studies[-1]
    truth, names, n = last.model.params, last.model.param_names, len(last.moments.params)
    noise = torch.tensor([not name.startswith("sinusoid") for name in names])
    errors = torch.stack([rmse(runs.moments, truth) for runs in studies])
    if len(studies) > 1:
        length = torch.tensor([runs.n_samples for runs in studies], dtype=torch.float64).log()
        centred = length - length.mean()
        slopes = (centred[:, None] * errors.log()).sum(0) / centred.square().sum()
        conclusion(
            "fig 1",
            "RMSE falls with the sample size, GMWM is consistent",
            "slopes of ln RMSE by ln T: " + ", ".join(f"{a} {s:.2f}" for a, s in zip(names, slopes, strict=True)),
            bool((errors.diff(dim=0) < 0).all()),
        )
    if number == 1:
        ratios = torch.stack([(rmse(r.moments, truth) / rmse(r.refined, truth))[noise] for r in studies])
        conclusion(
            "fig 1",
            f"the loss of efficiency against likelihood is almost negligible (RMSE of noise parameters at most "
            f"{1 + _NEGLIGIBLE:g} times as large)",
            "RMSE of moments over spectral likelihood: "
            + ", ".join(
                f"{r.min():.2f} to {r.max():.2f} at T = {s.n_samples}" for r, s in zip(ratios, studies, strict=True)
            ),
            bool((ratios < 1 + _NEGLIGIBLE).all()),
        )
    near = max(_NEAR, _BY_CHANCE / n**0.5)
    medians = (last.moments.params - truth).median(0).values / last.moments.params.std(0)
    conclusion(
        "fig 4",
        f"GMWM targets the true values (median of errors within {near:.2f} standard deviations of 0)",
        f"at T = {last.n_samples}: " + ", ".join(f"{a} {m:+.2f}" for a, m in zip(names, medians, strict=True)),
        bool((medians.abs() < near).all()),
    )
    at = [k for k, name in enumerate(names) if name.endswith("amplitude")]
    shares = [without_tone_term(runs)[at] for runs in studies]
    smallest = min(
        binomial(round(s * len(r.moments.params)), len(r.moments.params), 0.95)
        for share, r in zip(shares, studies, strict=True)
        for s in share.tolist()
    )
    conclusion(
        "theorem 1",
        "the covariance of wavelet variances may leave the tones out",
        "95 % intervals of amplitudes that do so hold them in "
        + ", ".join(f"{100 * s:.0f}" for share in shares for s in share.tolist())
        + f" % of runs (smallest binomial p {smallest:.2g})",
        smallest > 0.05 / (len(at) * len(studies)),
    )
    counts = [held(getattr(r, m), truth).sum(0).tolist() for r in studies for m in ("moments", "refined")]
    smallest = min(binomial(int(c), n, 0.95) for row in counts for c in row)
    shares = [100 * c / n for row in counts for c in row]
    conclusion(
        "theorem 2",
        "95 % intervals, with the product of noise and tone, hold the truth as often as they say",
        f"{min(shares):.1f} to {max(shares):.1f} % (smallest p of {len(shares)} binomial tests {smallest:.2g})",
        smallest > 0.05 / len(shares),
    )
    sizes = [int((runs.moments.p_value < 0.05).sum()) for runs in studies]
    smallest = min(binomial(count, n, 0.05) for count in sizes)
    conclusion(
        "J test",
        "it rejects the true model in 5 % of runs",
        ", ".join(f"{100 * c / n:.1f} % at T = {r.n_samples}" for c, r in zip(sizes, studies, strict=True))
        + f" (smallest binomial p {smallest:.2g})",
        smallest > 0.05 / len(studies),
    )


def plot_rmse(studies: list[Runs], path: Path) -> None:
    """[V] figure 1, with tones and with the bounds."""
    model = studies[0].model
    truth, lengths = model.params, [runs.n_samples for runs in studies]
    n = len(truth)
    figure, axes = plt.subplots(2, (n + 1) // 2, figsize=(3.2 * ((n + 1) // 2), 5.6), layout="constrained", sharex=True)
    lines = {
        method: torch.stack([rmse(getattr(runs, method), truth) for runs in studies])
        for method in ("moments", "refined")
    }
    lines["bound"] = torch.stack([cramer_rao(model, length) for length in lengths])
    styles = {"moments": "o-", "refined": "s-", "bound": "--"}
    for k, ax in enumerate(axes.flat[:n]):
        for method, values in lines.items():
            label = "Cramer-Rao bound" if method == "bound" else method
            ax.loglog(lengths, values[:, k], styles[method], color=COLORS[method], markersize=4, label=label)
        ax.set_title(symbol(model.param_names[k]))
        ax.set_xticks(lengths, [f"{length / 1000:g}" for length in lengths])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.set_xlabel("samples / 1000")
    axes[0, 0].set_ylabel("RMSE")
    axes[1, 0].set_ylabel("RMSE")
    axes[0, 0].legend(fontsize=8)
    finish(figure, path)


def plot_estimates(runs: Runs, path: Path) -> None:
    """[V] figures 4 and 9: errors over the standard deviations of the moments' estimates."""
    truth, names = runs.model.params, runs.model.param_names
    figure, ax = plt.subplots(figsize=(1.2 * len(names) + 1.5, 4.2), layout="constrained")
    spread = runs.moments.params.std(0)
    for shift, method in ((-0.18, "moments"), (0.18, "refined")):
        errors = (getattr(runs, method).params - truth) / spread
        places = [k + shift for k in range(len(names))]
        box = error_boxes(ax, errors, places, COLORS[method])
        box["boxes"][0].set_label(method)
    ax.axhline(0, color="#000000", linewidth=0.8, zorder=0)
    ax.set_xticks(range(len(names)), [symbol(name) for name in names])
    ax.set_ylim(-5, 5)
    ax.set_ylabel("error / standard deviation of moments")
    ax.legend(fontsize=8)
    finish(figure, path)


def plot_variances(runs: Runs, path: Path) -> None:
    """[V] figure 3: ten wavelet variances, the model's and those of its processes."""
    figure, ax = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    n_levels = runs.variance.shape[-1]
    tau = torch.exp2(torch.arange(1, n_levels + 1))
    ax.loglog(tau, runs.variance[:10].mT, color="#b0b0b0", linewidth=0.9)
    ax.lines[0].set_label("estimates of ten records")
    whole = runs.model.wavelet_variance(n_levels)
    for process in runs.model.processes:
        part = process.wavelet_variance(n_levels)
        shown = torch.where(part > whole.min() / 30, part, torch.nan)
        if bool(shown.isfinite().any()):
            ax.loglog(tau, shown, linewidth=1.1, linestyle="--", label=process.symbol)
    ax.loglog(tau, whole, color="#d55e00", linewidth=2, label="sum")
    ax.set_xlabel("scale (samples)")
    ax.set_ylabel("wavelet variance")
    ax.legend(fontsize=8)
    finish(figure, path)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--simulation", type=int, choices=tuple(SIMULATIONS), default=1, help="which; 1 by default")
    parser.add_argument("--samples", type=int, nargs="+", help="lengths of the records; the paper's by default")
    parser.add_argument("--runs", type=int, help=f"records of each length; {N_RUNS} by default")
    options = parser.parse_args()
    number = options.simulation
    lengths = sorted(options.samples or (QUICK_SAMPLES if options.quick else N_SAMPLES)[number])
    n_runs = options.runs or (QUICK_RUNS[number] if options.quick else N_RUNS)
    generator = torch.Generator().manual_seed(options.seed)
    studies = []
    print(f"Simulation {number}: {SIMULATIONS[number]}")
    for length in lengths:
        studies.append(simulate_and_fit(SIMULATIONS[number], length, n_runs, generator))
        print_runs(studies[-1])
    print_conclusions(number, studies)
    figures = {"variances": plot_variances, "estimates": plot_estimates}
    for name, plot in figures.items():
        plot(studies[-1], options.out / f"gmwm_simulation{number}_{name}.png")
    if len(studies) > 1:
        plot_rmse(studies, options.out / f"gmwm_simulation{number}_rmse.png")
    drawn = [*figures, "rmse"][: len(figures) + (len(studies) > 1)]
    figures_written(options.out, *(f"gmwm_simulation{number}_{name}.png" for name in drawn))


if __name__ == "__main__":
    main()
