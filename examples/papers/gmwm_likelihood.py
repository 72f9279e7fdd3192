"""Wavelet moments beside exact maximum likelihood: Voirol et al., section 4, figures 1, 2 and 9.

Records of 10 000 samples of Simulation 1, without the tone and with it, fitted by wavelet moments, by these refined by
the spectral likelihood, and by the maximum of the exact likelihood that a Kalman filter gives, searched for from the
moments' fit. Unlike the paper's, this likelihood does not know the frequency. RMSE, running time, and the paper's
conclusions in numbers; 200 records of each take some ten minutes. `--quick` has 3 records of 1024 samples.

    python examples/papers/gmwm_likelihood.py [--samples T] [--runs N] [--quick] [--out FOLDER] [--seed N]
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from _gmwm_study import COLORS, SIMULATIONS, cramer_rao, error_boxes, progress, symbol, unknown, without_tones
from _svo_study import arguments, conclusion, figures_written, finish
from scipy import optimize
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting import GMWMResult

N_SAMPLES, N_RUNS = 10_000, 200
QUICK_SAMPLES, QUICK_RUNS = 1024, 3
METHODS = ("moments", "refined", "likelihood")
_NEGLIGIBLE = 0.2  # loss of RMSE
_FEWEST_TIMES = 12  # as fast, for the smallest sample size of figure 2
_FURTHEST = 40.0  # standard deviations that a search may go, or until a variance has all but vanished
_FIGURE = "gmwm_likelihood.png"


@dataclass(frozen=True)
class Study:
    """Estimates `(run, method, parameter)` of `METHODS`, their CPU seconds `(run, method)`, and failed searches."""

    model: gf.Model
    n_samples: int
    params: Tensor
    seconds: Tensor
    n_failed: int

    @property
    def rmse(self) -> Tensor:
        """Root mean squared error `(method, parameter)`."""
        return (self.params - self.model.params).square().mean(0).sqrt()


def unbounded(params: Tensor, names: tuple[str, ...]) -> Tensor:
    """Logarithms of variances and amplitudes, `atanh phi`, and frequencies as they are."""
    phi, beta = _kinds(names)
    positive = torch.where(phi | beta, 1.0, params)
    return torch.where(phi, torch.where(phi, params, 0.0).atanh(), torch.where(beta, params, positive.log()))


def bounded(x: Tensor, names: tuple[str, ...]) -> Tensor:
    """The inverse."""
    phi, beta = _kinds(names)
    return torch.where(phi, x.tanh(), torch.where(beta, x, x.exp()))


def _kinds(names: tuple[str, ...]) -> tuple[Tensor, ...]:
    """Which parameters are `phi`, and which are `beta`."""
    return tuple(torch.tensor([name.endswith(kind) for name in names]) for kind in (".phi", ".beta"))


def maximum_likelihood(signal: Tensor, start: GMWMResult, scale: Tensor) -> tuple[Tensor, bool]:
    """Parameters at the maximum of the exact likelihood of a record `(time,)`, searched for from a moment fit.

    Args:
        signal: Record.
        start: Moment fit of it; a variance at zero starts from a tenth of its upper limit.
        scale: Steps `(parameter,)` of the unbounded parameters that are alike to the likelihood.
    """
    names = start.param_names
    first = torch.where(start.params[0] == 0, start.confidence_interval.high[0] / 10, start.params[0])
    first = unbounded(first, names)

    def objective(z: np.ndarray) -> tuple[float, np.ndarray]:
        steps = torch.from_numpy(z).requires_grad_()
        model = start.model.with_params(bounded(first + scale * steps, names))
        value = -gf.state_space(model, 1.0).kalman_log_likelihood(signal)
        (slope,) = torch.autograd.grad(value, steps)
        return value.item(), slope.numpy()

    found = optimize.minimize(
        objective,
        np.zeros(len(names)),
        jac=True,
        method="L-BFGS-B",
        bounds=[(-_FURTHEST, _FURTHEST)] * len(names),
        options={"ftol": 1e-12, "gtol": 1e-3},
    )
    return bounded(first + scale * torch.from_numpy(found.x), names), bool(found.success)


def run_study(model: gf.Model, n_samples: int, n_runs: int, generator: torch.Generator) -> Study:
    """Fit every record by every method."""
    names, truth = model.param_names, model.params
    # Cramer-Rao bounds of the unbounded parameters
    slope = torch.autograd.functional.jacobian(lambda p: unbounded(p, names), truth).diagonal()
    scale = cramer_rao(model, n_samples) * slope
    gf.fit_gmwm(model.simulate(n_samples, batch=(1,), generator=generator), unknown(model), refine=True)  # tabulates
    params, seconds, n_failed = [], [], 0
    for run in range(n_runs):
        signal = model.simulate(n_samples, batch=(1,), generator=generator)
        times = [time.process_time()]
        moments = gf.fit_gmwm(signal, unknown(model))
        times.append(time.process_time())
        refined = gf.fit_gmwm(signal, unknown(model), refine=True)
        times.append(time.process_time())
        likely, success = maximum_likelihood(signal[0], moments, scale)
        times.append(time.process_time())
        n_failed += not success
        params.append(torch.stack([moments.params[0], refined.params[0], likely]))
        seconds.append(torch.tensor(times).diff())
        progress(run + 1, n_runs, 5)
    return Study(model, n_samples, torch.stack(params), torch.stack(seconds), n_failed)


def print_study(study: Study) -> None:
    truth, bound = study.model.params, cramer_rao(study.model, study.n_samples)
    n_runs = len(study.params)
    print(f"\n{n_runs} records of {study.n_samples} samples of {study.model}")
    print("RMSE over the Cramer-Rao bound; mean error over standard deviation; RMSE over that of exact likelihood")
    print(
        f"{'':>22}  {'':>9}" + "".join(f"  {head:^26}" for head in ("RMSE / bound", "bias / spread")) + "  RMSE ratio"
    )
    columns = "  ".join(f"{method[:8]:>8}" for method in METHODS)
    print(f"{'parameter':>22}  {'truth':>9}  {columns}  {columns}   moments   refined")
    bias = (study.params.mean(0) - truth) / study.params.std(0)
    for k, name in enumerate(study.model.param_names):
        cells = [f"{v:.3f}" for v in study.rmse[:, k] / bound[k]] + [f"{v:+.2f}" for v in bias[:, k]]
        cells += [f"{v:.3f}" for v in study.rmse[:2, k] / study.rmse[2, k]]
        print(f"{name:>22}  {truth[k].item():>9.4g}  " + "  ".join(f"{cell:>8}" for cell in cells))
    mean = study.seconds.mean(0)
    times = ", ".join(f"{method} {t:.3f} s" for method, t in zip(METHODS, mean.tolist(), strict=True))
    print(f"CPU time: {times}; searches of the likelihood that failed: {study.n_failed} of {n_runs}")


def print_conclusions(studies: list[Study]) -> None:
    print("\nThe paper's conclusions (section 4)")
    for study in studies:
        what = f"{'without' if len(study.model.processes) == 3 else 'with'} tone"
        noise = [k for k, name in enumerate(study.model.param_names) if not name.startswith("sinusoid")]
        ratio = (study.rmse[:2] / study.rmse[2])[:, noise]
        names = [study.model.param_names[k] for k in noise]
        conclusion(
            "fig 1",
            f"the loss of efficiency of GMWM against maximum likelihood is almost negligible, {what} (RMSE at most "
            f"{1 + _NEGLIGIBLE:g} times as large)",
            ", ".join(f"{name} {r:.2f}" for name, r in zip(names, ratio[0], strict=True)),
            bool((ratio[0] < 1 + _NEGLIGIBLE).all()),
        )
        conclusion(
            "fig 9",
            f"maximum likelihood is the more efficient of both, {what}",
            ", ".join(f"{name} {r:.2f}" for name, r in zip(names, ratio[0], strict=True))
            + f"; geometric mean {ratio[0].log().mean().exp():.3f}, refined {ratio[1].log().mean().exp():.3f}",
            bool(ratio[0].log().mean() > 0),
        )
        seconds = study.seconds.mean(0)
        conclusion(
            "fig 2",
            f"GMWM is many times as fast, {what} ({_FEWEST_TIMES} times at the least)",
            f"{seconds[2] / seconds[0]:.1f} times, refined {seconds[2] / seconds[1]:.1f} at T = {study.n_samples}",
            bool(seconds[2] / seconds[0] >= _FEWEST_TIMES),
        )


def plot(studies: list[Study], path: Path) -> None:
    """[V] figure 9, errors over the standard deviations of the likelihood's estimates, without and with tone."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained", width_ratios=[4, 6], sharey=True)
    for ax, study in zip(axes, studies, strict=True):
        names = study.model.param_names
        errors = (study.params - study.model.params) / study.params[:, 2].std(0)
        for m, method in enumerate(METHODS):
            places = [k + 0.27 * (m - 1) for k in range(len(names))]
            box = error_boxes(ax, errors[:, m], places, COLORS[method], 0.22)
            box["boxes"][0].set_label(method)
        ax.axhline(0, color="#000000", linewidth=0.8, zorder=0)
        ax.set_xticks(range(len(names)), [symbol(name) for name in names])
        ax.set_ylim(-5, 5)
        ax.set_title(" + ".join(process.symbol for process in study.model.processes), fontsize=10)
    axes[0].set_ylabel("error / standard deviation of likelihood")
    axes[1].legend(fontsize=8)
    finish(figure, path)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--samples", type=int, help=f"length of the records; {N_SAMPLES} by default")
    parser.add_argument("--runs", type=int, help=f"records of each model; {N_RUNS} by default")
    options = parser.parse_args()
    n_samples = options.samples or (QUICK_SAMPLES if options.quick else N_SAMPLES)
    n_runs = options.runs or (QUICK_RUNS if options.quick else N_RUNS)
    generator = torch.Generator().manual_seed(options.seed)
    studies = []
    for model in (without_tones(SIMULATIONS[1]), SIMULATIONS[1]):
        studies.append(run_study(model, n_samples, n_runs, generator))
        print_study(studies[-1])
    print_conclusions(studies)
    plot(studies, options.out / _FIGURE)
    figures_written(options.out, _FIGURE)


if __name__ == "__main__":
    main()
