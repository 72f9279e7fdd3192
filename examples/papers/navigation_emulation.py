"""What tones left out of a noise model cost in the air: Voirol et al., section 5 and figures 7 and 8.

(i) Records of the sensor on the rotating table (table 5), an AR1, a random walk and two tones, are simulated; (ii) each
is fitted without tones and with them, and of the latter the tones are dropped; (iii) errors of the AR1 and the random
walk alone are put on a flight of 235 s, whose satellites are away from 160 to 210 s; (iv) a filter that is told the one
fit and a filter that is told the other estimate the flight. The paper's ratio of mean position errors peaks at 1.1789.

The paper does not say what flight it is, nor what satellites and accelerometers err by, nor the unit of table 5. Here:
the library's flight, deg/s, positions of 1 to 1.5 m and fair accelerometers; the same fits are flown with other
assumptions beside them, and with filters that know of no random walk: more than that a fit without tones cannot lose.
The paper has 500 records of 2 879 999 samples; fits and flights take half an hour and 3 GB.

    python examples/papers/navigation_emulation.py [--samples T] [--runs N] [--quick] [--out FOLDER] [--seed N]
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from _gmwm_study import N_EMULATION, N_RUNS, without_tones
from _svo_study import arguments, conclusion, figures_written, finish
from gmwm_misspecification import emulation, fit_both

import gyrofuse as gf
from gyrofuse.navigation import Emulation, Gnss, InitialUncertainty, Trajectory, compare_filters, flight
from gyrofuse.navigation.plots import plot_ratio_over_time

QUICK_SAMPLES, QUICK_RUNS = 2**15, 8
RATE, QUICK_RATE = 100.0, 20.0
PAPER_PEAK = 1.1789
_FLIGHT, _RATIO = "navigation_flight.png", "navigation_ratio.png"
# m/s^2, of a sample at 100 Hz
_FAIR, _GOOD = "WN(variance=1e-4) + RW(variance=1e-11)", "WN(variance=1e-8)"
WELL_ALIGNED = InitialUncertainty(attitude=(math.radians(0.05), math.radians(0.05), math.radians(0.2)))


def in_rad(params: torch.Tensor, basic: gf.Model) -> gf.Model:
    """Models of single flights, from parameters `(flight, parameter)` in deg/s."""
    return basic.with_params(params).scaled(math.pi / 180)


def straight() -> Trajectory:
    """Level and straight at 20 m/s, which tells a filter least of its attitude."""
    time = torch.arange(0, 236, 5, dtype=torch.float64)
    place = torch.tensor([20.0, 0.0, 0.0], dtype=torch.float64) * time[:, None]
    return Trajectory(time, place + torch.tensor([0.0, 0.0, -100.0], dtype=torch.float64))


@dataclass(frozen=True)
class Case:
    """What the paper leaves unsaid."""

    name: str
    accelerometer: str = _FAIR
    gnss: Gnss | None = None
    trajectory: Trajectory | None = None
    without_walk: bool = False

    def flown(self, told: list[gf.Model], truth: gf.Model, rate: float, seed: int) -> Emulation:
        """Flights with filters that are told the fits without tones and with them."""
        wrong, right = told
        if self.without_walk:
            params = wrong.params.clone()
            params[:, wrong.param_names.index("random_walk.variance")] = 0
            wrong = wrong.with_params(params)
        return compare_filters(
            wrong,
            right,
            truth=truth,
            accelerometer=gf.parse_model(self.accelerometer),
            rate=rate,
            gnss=self.gnss,
            trajectory=self.trajectory,
            initial_uncertainty=WELL_ALIGNED,
            n_flights=len(wrong.params),
            generator=torch.Generator().manual_seed(seed),
        )


CASES = (
    Case("fair accelerometers, positions of 1 to 1.5 m"),
    Case("the same, straight and level", trajectory=straight()),
    Case("hardly any error of accelerometers", _GOOD),
    Case("the same, positions of 0.1 m", _GOOD, Gnss(sd=(0.1, 0.1, 0.1))),
    Case("the same, positions of 5 m", _GOOD, Gnss(sd=(5.0, 5.0, 7.5))),
    Case("as the first, no random walk told", without_walk=True),
)


def plot_flight(path: Path) -> None:
    """[V] figure 7."""
    trajectory = flight()
    t = torch.linspace(0, trajectory.duration, 500, dtype=torch.float64)
    north, east, down = trajectory.at(t).position.unbind(-1)
    away = (t >= 160) & (t <= 210)
    figure, (plan, profile) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for ax, x, y in ((plan, east, north), (profile, t, -down)):
        ax.plot(x, y, color="#0072b2")
        ax.plot(x[away], y[away], color="#e69f00", linewidth=3, label="no satellites")
    plan.set(xlabel="east (m)", ylabel="north (m)", aspect="equal")
    profile.set(xlabel="time (s)", ylabel="height (m)")
    profile.legend(frameon=False)
    finish(figure, path)


def plot_ratios(studies: dict[str, Emulation], path: Path) -> None:
    """[V] figure 8, one panel for each set of assumptions."""
    figure, axes = plt.subplots(len(studies), 1, figsize=(8, 2.7 * len(studies)), sharex=True, layout="constrained")
    for ax, (name, study) in zip([axes] if len(studies) == 1 else axes, studies.items(), strict=True):
        plot_ratio_over_time(study.time, study.ratio, study.interval, outage=study.outage, ax=ax)
        ax.set_title(name, loc="left", fontsize=9, pad=22)  # above the legend
    finish(figure, path)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--samples", type=int, help=f"length of the records; {N_EMULATION} by default")
    parser.add_argument("--runs", type=int, help=f"records, and flights; {N_RUNS} by default")
    asked = parser.parse_args()
    n_samples = asked.samples or (QUICK_SAMPLES if asked.quick else N_EMULATION)
    n_runs = asked.runs or (QUICK_RUNS if asked.quick else N_RUNS)
    rate = QUICK_RATE if asked.quick else RATE
    model = emulation(n_samples)
    basic = without_tones(model)
    both = fit_both(model, n_samples, n_runs, torch.Generator().manual_seed(asked.seed))
    n = len(basic.param_names)
    told = [in_rad(fit.params[:, :n], basic) for fit in both]
    truth = basic.scaled(math.pi / 180)
    print(f"{n_runs} records of {n_samples} samples; medians of the basic model's parameters, deg/s per sample")
    print(f"{'':>22}  {'truth':>11}  {'without tones':>13}  {'with tones':>11}")
    for k, name in enumerate(basic.param_names):
        values = [fit.params[:, k].median().item() for fit in both]
        print(f"{name:>22}  {basic.params[k].item():>11.5g}  {values[0]:>13.5g}  {values[1]:>11.5g}")
    studies: dict[str, Emulation] = {}
    head = "position error without tones over that with tones"
    print(f"\n{head:<50}  {'peak':>7}  {'95 % interval':>17}  {'at (s)':>7}")
    for case in CASES[:1] if asked.quick else CASES:
        name = case.name
        studies[name] = case.flown(told, truth, rate, asked.seed)
        when, ratio, low, high = studies[name].peak
        print(f"{name:<50}  {ratio:>7.4f}  [{low:>6.4f}, {high:>6.4f}]  {when:>7.5g}", flush=True)
    print("\nThe paper's conclusions (section 5, figure 8)")
    first = next(iter(studies.values()))
    away = (first.time > 160) & (first.time <= 210)
    for name, study in studies.items():
        above = (study.ratio[~away] > 1).double().mean().item()
        conclusion(
            "fig 8",
            f"the ratio is almost always above one while there are satellites ({name})",
            f"above one at {100 * above:.0f} % of the times",
            above > 0.9,
        )
        _, ratio, low, high = study.peak
        conclusion(
            "fig 8",
            f"it rises in the outage, to {PAPER_PEAK} ({name})",
            f"peak {ratio:.4f}, 95 % interval {low:.4f} to {high:.4f}",
            1 < low <= PAPER_PEAK <= high,
        )
    plot_flight(asked.out / _FLIGHT)
    plot_ratios(studies, asked.out / _RATIO)
    figures_written(asked.out, _FLIGHT, _RATIO)


if __name__ == "__main__":
    main()
