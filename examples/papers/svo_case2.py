"""Case 2 of Zhang et al. (2022), section V-B: six gyros with white noise and three AR(1) that correlate.

Weights from 50 arrays of 29 hours by every method, and what they make of 10 new arrays each: figures 7 (wavelet
variances) and 8 (weights) of the paper, and what it reads from them. `--quick` has 6 arrays, 2 new ones each, and
2^16 samples instead of 1 044 000 for the same 29 hours.

    python examples/papers/svo_case2.py [--quick] [--out FOLDER] [--seed N]
"""

from __future__ import annotations

from _svo_study import (
    METHODS,
    N_ARRAYS,
    N_NEW,
    N_SAMPLES,
    PAPER,
    QUICK_ARRAYS,
    QUICK_NEW,
    QUICK_SAMPLES,
    Study,
    arguments,
    average,
    case2,
    conclusion,
    figures_written,
    plot_variances,
    plot_weights,
    print_study,
    run_study,
)


def print_conclusions(study: Study) -> None:
    print("\nWhat the paper reads from its figures (section V-B), among its four methods")
    mean, _ = average(study.variance)
    long, short, rdvg, equal = (METHODS.index(name) for name in PAPER)
    mean = mean / mean[equal]
    least = mean[rdvg] / mean[[long, short, equal]].amax(0)
    conclusion(
        "i",
        "RDVG, whose model is wrong here, has the largest wavelet variance at all levels",
        f"over the largest of the others: {least.min():.2f} to {least.max():.2f} times, "
        f"largest at {int((least > 1).sum())} of {len(least)} levels",
        bool((least > 1).all()),
    )
    conclusion(
        "ii",
        "SVO for long times is the best at the last level, SVO for short times at the first",
        f"over equal weights: long {mean[long, -1]:.3f} (short {mean[short, -1]:.3f}) at the last level, "
        f"short {mean[short, 0]:.3f} (long {mean[long, 0]:.3f}) at the first",
        bool((mean[:4, -1].argmin() == long) & (mean[:4, 0].argmin() == short)),
    )
    conclusion(
        "iii",
        "SVO for short times still beats equal weights and RDVG at long times",
        f"over equal weights at the last three levels: {', '.join(f'{v:.3f}' for v in mean[short, -3:].tolist())}",
        bool((mean[short, -3:] < 1).all() & (mean[short, -3:] < mean[rdvg, -3:]).all()),
    )
    spread = study.weights.std(0).mean(-1)
    conclusion(
        "iv",
        "RDVG's weights vary most",
        "standard deviation over arrays: " + ", ".join(f"{name} {spread[METHODS.index(name)]:.3f}" for name in PAPER),
        spread[:4].argmax().item() == rdvg,
    )


def main() -> None:
    options = arguments(__doc__).parse_args()
    n_samples = QUICK_SAMPLES if options.quick else N_SAMPLES
    sizes = (QUICK_ARRAYS, QUICK_NEW) if options.quick else (N_ARRAYS, N_NEW)
    study = run_study(case2(n_samples), n_samples, *sizes, options.seed)
    print_study(study)
    print_conclusions(study)
    plot_variances(study, options.out / "svo_case2_variances.png")
    plot_weights(study, options.out / "svo_case2_weights.png")
    figures_written(options.out, "svo_case2_variances.png", "svo_case2_weights.png")


if __name__ == "__main__":
    main()
