"""Matrices of an array's noise by moments: do they come out right, and what are weights worth that rest on them?

Arrays of Cases 1 and 2 of Zhang et al. (2022), section V, 29 hours of six gyros in 2^16 samples: bias and spread of all
entries of the covariance matrices, what their intervals hold, the size of the J test, and the excess risk of weights
for long times from the fitted model beside those from the measured moments. Figure: the excess risks. `--quick` has 6
arrays in place of 500.

    python examples/papers/gmwm_array.py [--quick] [--out FOLDER] [--seed N]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch
from _svo_study import arguments, case1, case2, figures_written, finish, n_levels, quadratic
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting import ArrayGMWMResult
from gyrofuse.fusion.weights.svo import resolve_scale_weights

_N_ARRAYS, _QUICK_ARRAYS, _N_SAMPLES, _AT_ONCE = 500, 6, 2**16, 10
CASES = {"Case 1": (case1, "WN + RW"), "Case 2": (case2, "WN + 3*AR1")}
METHODS = {"equal": "#d55e00", "SVO": "#0072b2", "model-assisted SVO": "#56b4e9", "array GMWM": "#009e73"}


@dataclass(frozen=True)
class Runs:
    """What one case gave.

    Attributes:
        components: True processes and matrices, in the order of the fit.
        fits: One result for some arrays each.
        risks: Excess risk `c'A0c / c0'A0c0 - 1`, `(array, method)`.
    """

    components: list[tuple[gf.Model, Tensor]]
    fits: list[ArrayGMWMResult]
    risks: Tensor

    def all(self, name: str) -> Tensor:
        """An estimate of all arrays."""
        return torch.cat([getattr(fit, name) for fit in self.fits])

    def limits(self, name: str) -> tuple[Tensor, Tensor]:
        """Intervals of all arrays."""
        low, high = zip(*(getattr(fit, name) for fit in self.fits), strict=True)
        return torch.cat(low), torch.cat(high)


def run(name: str, n_arrays: int, generator: torch.Generator) -> Runs:
    """Simulate and fit."""
    make, formula = CASES[name]
    model = make(_N_SAMPLES)
    levels = n_levels(_N_SAMPLES)
    truth = torch.einsum("j,jab->ab", resolve_scale_weights("long", levels), model.wavelet_cross_covariance(levels))
    best = gf.svo_weights(model.wavelet_cross_covariance(levels), "long")
    fits, risks = [], []
    for done in range(0, n_arrays, _AT_ONCE):
        signal = model.simulate(_N_SAMPLES, batch=(min(_AT_ONCE, n_arrays - done),), generator=generator)
        fits.append(gf.fit_array_gmwm(signal, formula))
        plain, assisted = (
            gf.fit_svo(signal, "long", method=method, covariance="none", n_levels=levels).weights
            for method in ("svo", "model_assisted")
        )
        weights = torch.stack(
            [
                gf.equal_weights(plain.new_zeros(len(plain), levels, 6, 6)),
                plain,
                assisted,
                fits[-1].svo_weights("long"),
            ],
            1,
        )
        risks.append(quadratic(weights, truth) / quadratic(best, truth) - 1)
    components = sorted(model.components, key=_slowness)
    return Runs(components, fits, torch.cat(risks))


def _slowness(component: tuple[Any, Tensor]) -> float:
    """White noise first, then memories from long to short."""
    return -2.0 if isinstance(component[0], gf.WhiteNoise) else -getattr(component[0], "phi", 1.0)


def print_runs(name: str, runs: Runs) -> None:
    """Tables of one case."""
    truth = torch.stack([matrix for _, matrix in runs.components])
    n = len(runs.all("theta"))
    print(
        f"\n{name}: {CASES[name][1]}, {n} arrays of {_N_SAMPLES} samples, {int(runs.all('converged').sum())} converged"
    )
    print("Bias over spread (largest of all entries), spread over reported standard deviation (median), and per cent")
    print("of the 95 % intervals that hold the truth where there are any, of variances, covariances, and correlations")
    print(f"{'process':<12}{'bias':>8}{'spread':>9}{'variances':>11}{'covariances':>13}{'correlations':>14}")
    spread = runs.all("theta").std(0)
    bias = (runs.all("theta").mean(0) - truth) / spread
    ratio = spread / runs.all("theta_std_err").median(0).values
    sd = truth.diagonal(dim1=-2, dim2=-1).sqrt()
    held = [
        torch.where(low.isnan(), torch.nan, ((low <= value) & (value <= high)).double()).nanmean(0)
        for (low, high), value in (
            (runs.limits("confidence_interval"), truth),
            (runs.limits("correlation_interval"), truth / (sd[:, :, None] * sd[:, None])),
        )
    ]
    own = torch.eye(truth.shape[-1], dtype=torch.bool)
    for k, (process, _) in enumerate(runs.components):
        cells = [held[0][k][own], held[0][k][~own], held[1][k][~own]]
        shares = "".join(
            f"{'none' if cell.isnan().all() else format(100 * cell.nanmean().item(), '.1f'):>{width}}"
            for cell, width in zip(cells, (11, 13, 14), strict=True)
        )
        label = process.symbol + (f" {process.phi:.4f}" if isinstance(process, gf.AR1) else "")
        print(f"{label:<12}{bias[k].abs().max().item():>8.2f}{ratio[k].median().item():>9.2f}{shares}")
    for k, label in enumerate(runs.fits[0].param_names):
        phi = runs.components[k + 1][0].phi
        low, high = (limit[:, k] for limit in runs.limits("params_interval"))
        stated = ~low.isnan()
        n_held = int(((low <= phi) & (phi <= high))[stated].sum())
        middle = runs.all("params")[:, k].median().item()
        print(f"{label}: median {middle:.6f}, truth {phi:.6f}, {n_held} of {int(stated.sum())} intervals hold it")
    smallest = torch.linalg.eigvalsh(runs.all("correlation")).min().item()
    print(f"J test rejects {100 * (runs.all('p_value') < 0.05).double().mean().item():.1f} % at 5 %")
    print(f"Smallest eigenvalue of any correlation matrix {smallest:.1e}")
    print("Excess risk of weights for long times, mean and median")
    for label, risk in zip(METHODS, runs.risks.unbind(-1), strict=True):
        print(f"  {label:<20}{risk.mean().item():>9.3f}{risk.median().item():>9.3f}")


def plot_risks(found: dict[str, Runs], path: Path) -> None:
    """Excess risks of both cases as boxes."""
    figure, axes = plt.subplots(1, len(found), figsize=(9, 3.6), layout="constrained", squeeze=False)
    for ax, (name, runs) in zip(axes[0], found.items(), strict=True):
        drawn = ax.boxplot(runs.risks[:, 1:].clamp(min=1e-4).numpy(), sym=".", patch_artist=True)
        for box, colour in zip(drawn["boxes"], list(METHODS.values())[1:], strict=True):
            box.set(facecolor=colour, alpha=0.6)
        ax.axhline(runs.risks[0, 0].item(), color=METHODS["equal"], linestyle="--", label="equal weights")
        ax.set_xticks(range(1, len(METHODS)), list(METHODS)[1:])
        ax.set_yscale("log")
        ax.set_title(name)
        ax.legend()
    axes[0, 0].set_ylabel("excess risk of weights for long times")
    finish(figure, path)


def main() -> None:
    """Run the study."""
    options = arguments(__doc__ or "").parse_args()
    generator = torch.Generator().manual_seed(options.seed)
    n_arrays = _QUICK_ARRAYS if options.quick else _N_ARRAYS
    found = {name: run(name, n_arrays, generator) for name in CASES}
    for name, runs in found.items():
        print_runs(name, runs)
    plot_risks(found, options.out / "gmwm_array_risks.png")
    figures_written(options.out, "gmwm_array_risks.png")


if __name__ == "__main__":
    main()
