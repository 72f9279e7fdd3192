"""Running time of wavelet moments with a tone, Voirol et al. section 4 and figure 2, and what takes it.

The model of Simulation 1 in single records of 10 000 to 10 000 000 samples: wavelet variances, tones, the rest of the
fit, and spectral refinement, the median of several turns. The first fit of a length also tabulates what covariances of
its moments need, once for all later fits. `--quick` has records of 10 000 and 40 000 samples.

    python examples/papers/gmwm_running_time.py [--samples T [T ...]] [--turns N] [--quick] [--out FOLDER] [--seed N]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from _gmwm_study import SIMULATIONS, unknown
from _svo_study import arguments, conclusion, figures_written, finish
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting.spectral.tones import find_tones

SAMPLES = (10_000, 20_000, 40_000, 80_000, 160_000, 1_000_000, 10_000_000)
QUICK_SAMPLES = (10_000, 40_000)
STAGES = ("wavelet variance", "tones", "moments", "refinement")
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
_FIGURE = "gmwm_running_time.png"
# [V] figure 2 and its text: maximum likelihood at 10 000 and 160 000 samples, and the most that GMWM took.
_LIKELIHOOD, _MOST = {10_000: 2.0, 160_000: 5 * 3600.0}, 0.5


def seconds(call: Callable[[], object]) -> float:
    """CPU time of a call, which other programs hardly disturb."""
    start = time.process_time()
    call()
    return time.process_time() - start


def stages(signal: Tensor, turns: int) -> tuple[list[float], float]:
    """Seconds of the stages, and by how much the first fit of its length took longer."""
    model = unknown(SIMULATIONS[1])
    n_levels = signal.shape[-1].bit_length() - 2  # as many as a fit takes
    first = seconds(lambda: gf.fit_gmwm(signal, model))
    calls: tuple[Callable[[], object], ...] = (
        lambda: gf.wavelet_variance(signal, n_levels),
        lambda: find_tones(signal, 1),
        lambda: gf.fit_gmwm(signal, model),
        lambda: gf.fit_gmwm(signal, model, refine=True),
    )
    times = [[seconds(call) for call in calls] for _ in range(turns)]
    variance, tones, fit, refined = torch.tensor(times).median(0).values.tolist()
    return [variance, tones, max(fit - variance - tones, 0.0), max(refined - fit, 0.0)], max(first - fit, 0.0)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--samples", type=int, nargs="+", help="lengths of the records")
    parser.add_argument("--turns", type=int, default=3, help="of each length; the median counts")
    options = parser.parse_args()
    lengths = sorted(options.samples or (QUICK_SAMPLES if options.quick else SAMPLES))
    generator = torch.Generator().manual_seed(options.seed)
    # What a first call of anything costs is not of interest.
    stages(SIMULATIONS[1].simulate(4096, batch=(1,), generator=generator), 1)
    print(f"{SIMULATIONS[1]}, one record, {torch.get_num_threads()} thread(s)")
    print("CPU seconds, in brackets the share of the refined fit")
    print(
        f"{'samples':>9}  "
        + "  ".join(f"{name:>16}" for name in STAGES)
        + f"  {'GMWM':>8}  {'refined':>8}  {'first':>8}"
    )
    rows, totals = [], {}
    for length in lengths:
        parts, first = stages(SIMULATIONS[1].simulate(length, batch=(1,), generator=generator), options.turns)
        whole, gmwm = sum(parts), sum(parts[:3])
        cells = "  ".join(f"{f'{part:.4f} ({100 * part / whole:.0f} %)':>16}" for part in parts)
        print(f"{length:>9}  {cells}  {gmwm:>8.4f}  {whole:>8.4f}  {f'+{first:.3f}':>8}", flush=True)
        rows.append(parts)
        totals[length] = gmwm
    print_conclusions(totals)
    plot(lengths, rows, options.out / _FIGURE)
    figures_written(options.out, _FIGURE)


def print_conclusions(totals: dict[int, float]) -> None:
    print("\nThe paper's conclusions (section 4)")
    own = {length: total for length, total in totals.items() if length <= max(_LIKELIHOOD)}
    if own:
        conclusion(
            "fig 2",
            f"GMWM takes less than {_MOST:g} s at all sample sizes up to 160 000",
            ", ".join(f"{total:.3f} s at T = {length}" for length, total in own.items()),
            max(own.values()) < _MOST,
        )
    both = [length for length in totals if length in _LIKELIHOOD]
    if both:
        ratios = {length: _LIKELIHOOD[length] / totals[length] for length in both}
        conclusion(
            "fig 2",
            "it is 1200 times or more as fast as maximum likelihood",
            ", ".join(f"{r:.3g} times at T = {length}" for length, r in ratios.items())
            + " by the paper's times of likelihood (below 2 s and above 5 h), on another computer",
            min(ratios.values()) >= 1200,
        )


def plot(lengths: list[int], rows: list[list[float]], path: Path) -> None:
    """Seconds of every stage by length, and of both fits."""
    figure, ax = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    for name, color, values in zip(STAGES, _COLORS, zip(*rows, strict=True), strict=True):
        ax.loglog(lengths, [value or float("nan") for value in values], "o-", color=color, markersize=4, label=name)
    ax.loglog(lengths, [sum(row[:3]) for row in rows], "k-", linewidth=2, label="GMWM")
    ax.loglog(lengths, [sum(row) for row in rows], "k:", linewidth=2, label="GMWM, refined")
    ax.set_xlabel("samples")
    ax.set_ylabel("CPU time (s)")
    figure.legend(loc="outside right upper", fontsize=8)
    finish(figure, path)


if __name__ == "__main__":
    main()
