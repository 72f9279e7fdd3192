"""What an effect left out does to the noise parameters of a gyroscope, and what is left of it after repair.

Recordings of the blind proof with an effect that can be taken off them. The noise model is fitted to each as it came,
and again after `report.correct`; both are compared with the noise that was put in. Beside them stand recordings
without an effect, whose error is that of the fit alone. Rows are means over sensors with the effect; `level` is the
wavelet variance of the fitted model over the true one at the level where it is farthest off in the mean.

    python examples/blind_bias.py [--runs N] [--nats L] [--samples T] [--seed S] [--quick]
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

import gyrofuse as gf

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "benchmarks"))

from blind.analyser import noise_models, recording_of, simulation_of
from blind.cases import make_case

KINDS = (
    "vibration_tone",
    "drifting_tone",
    "step",
    "temperature_drift",
    "warm_up_transient",
    "g_sensitivity",
    "quadratic_coupling",
    "scale_factor",
    "spikes_shock",
    "spikes_bus",
)
SHORTEST = 16  # windows of the longest level in a recording


class Errors(NamedTuple):
    """Fitted over true of the sensors with an effect: of variances `(sensor,)`, of wavelet variances, log."""

    white: Tensor
    walk: Tensor
    levels: Tensor  # (sensor, level)


def errors(signal: Tensor, truth: list[gf.Model], sensors: list[int]) -> Errors:
    """Of the models fitted to a signal `(sensor, time)`."""
    n_levels = int(math.log2(signal.shape[-1] / SHORTEST))
    names = truth[0].param_names
    n_relaxators = sum("phi" in name for name in names)
    fit = gf.fit_gmwm(signal[sensors], f"WN + {n_relaxators}*AR1 + RW")
    true = torch.stack([truth[sensor].params for sensor in sensors])
    ratio = {name: fit.params[:, k] / true[:, k] for k, name in enumerate(names)}
    fitted = torch.stack([fit.model.with_params(row).wavelet_variance(n_levels) for row in fit.params])
    expected = torch.stack([truth[sensor].wavelet_variance(n_levels) for sensor in sensors])
    return Errors(ratio["white_noise.variance"], ratio["random_walk.variance"], (fitted / expected).log())


def farthest(several: list[Errors]) -> float:
    """Mean factor of the level that is farthest off."""
    mean = torch.cat([one.levels for one in several]).mean(0)
    return float(mean[mean.abs().argmax()].exp())


def row(kind: str, before: list[Errors], after: list[Errors]) -> str:
    """Factors of the white variance, the walk's, and the worst level, as recorded and corrected."""
    numbers = []
    for several in (before, after):
        numbers += [float(torch.cat([getattr(one, name) for one in several]).median()) for name in ("white", "walk")]
        numbers.append(farthest(several))
    return f"{kind:<22}" + "".join(f"{n:>9.3f}" for n in numbers)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20, help="recordings with each effect")
    parser.add_argument("--nats", type=float, default=1000.0, help="size of the effects, log likelihood ratio")
    parser.add_argument("--samples", type=int, default=65536, help="of each recording")
    parser.add_argument("--seed", type=int, default=1, help="of the first recording")
    parser.add_argument("--quick", action="store_true", help="one short recording with a step")
    options = parser.parse_args()
    kinds: tuple[str | None, ...] = (None, *KINDS)
    if options.quick:
        options.runs, options.samples, kinds = 1, 8192, ("step",)
    print(
        f"{options.runs} recordings each, {options.samples} samples, {options.nats:g} nats; fitted over true, medians"
    )
    print(f"{'':<22}{'as recorded':>27}{'corrected':>27}")
    print(f"{'effect':<22}" + f"{'white':>9}{'walk':>9}{'level':>9}" * 2)
    logs: list[float] = []
    for kind in kinds:
        before, after = [], []
        for seed in range(options.seed, options.seed + options.runs):
            case = make_case(kind or "null", options.nats, seed, n_samples=options.samples)
            recording = recording_of(case.recording)
            truth = noise_models(case.truth["base"])
            sensors = case.truth["effects"][0]["sensors"] if kind else list(range(len(truth)))
            report = gf.diagnose(recording, simulation_of(case.simulation))
            before.append(errors(recording.signal, truth, sensors))
            after.append(errors(report.correct(recording).signal, truth, sensors))
        print(row(kind or "none", before, after), flush=True)
        if kind:
            logs.append(math.log(farthest(before)) / math.log(farthest(after)))
    falls = statistics.median(map(abs, logs))
    print(f"\nBias of the worst level, in logarithms, falls by a median factor of {falls:.1f}")


if __name__ == "__main__":
    main()
