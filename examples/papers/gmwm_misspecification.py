"""What tones do to a model without them: Voirol et al., section 5 and figure 6.

Records of the sensor on the rotating table (table 5), an AR1, a random walk and two tones, fitted by the AR1 and the
random walk alone and by the whole model. Parameters of the basic model under both, and what the J test says of each.
The paper has 500 records of 2 879 999 samples, some 10 s each. `--quick` has 8 records of 2^15 samples in which the
random walk is as large at the last level.

    python examples/papers/gmwm_misspecification.py [--samples T] [--runs N] [--quick] [--out FOLDER] [--seed N]
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import torch
from _gmwm_study import (
    EMULATION,
    N_EMULATION,
    N_RUNS,
    Fits,
    binomial,
    error_boxes,
    fits,
    held,
    progress,
    symbol,
    unknown,
    without_tones,
)
from _svo_study import arguments, conclusion, figures_written, finish

import gyrofuse as gf
from gyrofuse.fitting import GMWMResult

QUICK_SAMPLES, QUICK_RUNS = 2**15, 8
KINDS = ("without tones", "with tones")
_COLORS = ("#d55e00", "#0072b2")
_LEVELS = (0.05, 0.01)
_FIGURE = "gmwm_misspecification.png"


def emulation(n_samples: int) -> gf.Model:
    """[V] table 5; the walk of a shorter record is as large beside the noise at the last level."""
    noise, walk, *tones = EMULATION.processes
    return gf.Model([noise, gf.RandomWalk(walk.params.item() * (N_EMULATION / n_samples) ** 2), *tones])


def fit_both(model: gf.Model, n_samples: int, n_runs: int, generator: torch.Generator) -> list[Fits]:
    """Fits of `KINDS`."""
    found: list[list[GMWMResult]] = [[], []]
    at_once = max(1, 2**21 // n_samples)
    for done in range(0, n_runs, at_once):
        signal = model.simulate(n_samples, batch=(min(at_once, n_runs - done), 1), generator=generator)
        for results, kind in zip(found, (without_tones(model), model), strict=True):
            results.append(gf.fit_gmwm(signal, unknown(kind)))
        progress(done + len(signal), n_runs, 5 * at_once)
    return [fits(results) for results in found]


def print_study(model: gf.Model, both: list[Fits]) -> None:
    """Basic parameters under both models, and the J test."""
    basic = without_tones(model)
    print(f"\n{'':>22}  {'':>10}" + "".join(f"  {kind:^46}" for kind in KINDS))
    head = f"{'median':>10}  {'bias':>9}  {'spread':>9}  {'held (%)':>8}"
    print(f"{'parameter':>22}  {'truth':>10}" + f"  {head:>46}" * 2)
    for k, (name, truth) in enumerate(zip(basic.param_names, basic.params.tolist(), strict=True)):
        row = f"{name:>22}  {truth:>10.4g}"
        for fit in both:
            values, hits = fit.params[:, k], held(fit, fit.params.new_full((), truth))[:, k]
            row += (
                f"    {values.median():>10.4g}  {(values.mean() / truth - 1).item():>+9.2%}  "
                f"{(values.std() / abs(truth)).item():>9.2%}  {100 * hits.double().mean():>8.1f}"
            )
        print(row)
    print("bias: of the mean, spread: standard deviation, both relative to the truth; held: 95 % intervals with it")
    for kind, fit in zip(KINDS, both, strict=True):
        p = fit.p_value
        sizes = ", ".join(f"{100 * (p < level).double().mean():.1f} % at {level:g}" for level in _LEVELS)
        print(f"J test {kind}: rejects {sizes}; median p {p.median():.2g}")


def print_conclusions(model: gf.Model, both: list[Fits]) -> None:
    print("\nThe paper's conclusions (section 5, figure 6)")
    basic = without_tones(model)
    names, truth = basic.param_names, basic.params
    wrong, right = (fit.params[:, : len(names)] for fit in both)
    n = len(wrong)
    bias = (wrong.mean(0) - truth) / right.std(0)
    noise = [k for k, name in enumerate(names) if name.startswith("ar1")]
    conclusion(
        "fig 6",
        "without the tones the estimates are biased, above all those of the AR1",
        "mean error in standard deviations of the fit with tones: "
        + ", ".join(f"{name} {b:+.1f}" for name, b in zip(names, bias, strict=True)),
        bool((bias[noise].abs() > 3).all()),
    )
    ratio = wrong.std(0) / right.std(0)
    conclusion(
        "fig 6",
        "without the tones they vary more, above all those of the AR1",
        "standard deviation over that with tones: "
        + ", ".join(f"{name} {r:.2f}" for name, r in zip(names, ratio, strict=True)),
        bool((ratio[noise] > 1).all()),
    )
    centred = (right.mean(0) - truth).abs() / (right.std(0) / n**0.5)
    conclusion(
        "fig 6",
        "with the tones the estimates are centred",
        "mean error in its own standard deviations: "
        + ", ".join(f"{name} {c:.1f}" for name, c in zip(names, centred, strict=True)),
        bool((centred < 3).all()),
    )
    rejected = [(fit.p_value < 0.05).double().mean().item() for fit in both]
    conclusion(
        "J test",
        "it tells that the model without tones is incomplete, and accepts the one with them",
        f"rejected at 0.05: {100 * rejected[0]:.0f} % without, {100 * rejected[1]:.0f} % with tones",
        rejected[0] > 0.95 and binomial(round(n * rejected[1]), n, 0.05) > 0.05,
    )


def plot(model: gf.Model, both: list[Fits], path: Path) -> None:
    """[V] figure 6, one panel for each parameter of the basic model."""
    basic = without_tones(model)
    figure, axes = plt.subplots(1, len(basic.param_names), figsize=(9, 3.8), layout="constrained")
    for k, ax in enumerate(axes):
        for place, (fit, color) in enumerate(zip(both, _COLORS, strict=True)):
            error_boxes(ax, fit.params[:, k : k + 1], [place], color)
        truth = ax.axhline(basic.params[k].item(), color="#000000", linewidth=0.9, linestyle="--")
        ax.set_xticks(range(2), KINDS)
        ax.set_title(symbol(basic.param_names[k]))
        ax.margins(y=0.1)
    figure.legend([truth], ["truth"], loc="outside lower center", fontsize=8)
    finish(figure, path)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--samples", type=int, help=f"length of the records; {N_EMULATION} by default")
    parser.add_argument("--runs", type=int, help=f"records; {N_RUNS} by default")
    options = parser.parse_args()
    n_samples = options.samples or (QUICK_SAMPLES if options.quick else N_EMULATION)
    n_runs = options.runs or (QUICK_RUNS if options.quick else N_RUNS)
    model = emulation(n_samples)
    print(f"{n_runs} records of {n_samples} samples of {model}")
    both = fit_both(model, n_samples, n_runs, torch.Generator().manual_seed(options.seed))
    print_study(model, both)
    print_conclusions(model, both)
    plot(model, both, options.out / _FIGURE)
    figures_written(options.out, _FIGURE)


if __name__ == "__main__":
    main()
