"""An array under vibration in the air: three ways of fusing it, and a filter tuned with and without what was left out.

Six gyros on each axis share a vibration at 11.3 Hz, each by its own amount, and have noise of their own. A recording on
the ground gives the weights of three virtual gyros (plain mean, SVO, multi-scale). Another one, in which they do not
flatter themselves, gives a noise model of each, white noise, an AR1 and a random walk. `gyrofuse.diagnose` compares the
plain mean with its model and finds the tone. The array's noise is then fitted with a tone, and
`gyrofuse.fitting.virtual_noise` says what each virtual gyro makes of it. Flights of 235 s, satellites away from 160 to
210 s, are estimated with the error of every virtual gyro and either tuning.

    python examples/vibration_flight.py [--flights 40] [--rate 100] [--quick] [--figure flight.png]
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch

import gyrofuse as gf
from gyrofuse.fitting import virtual_noise
from gyrofuse.navigation import Gnss, InitialUncertainty, Trajectory, UnitErrors, flight, run_filter
from gyrofuse.navigation.sensors import Axes, ErrorSamples

N_SENSORS, TONE_HZ = 6, 11.3
DEGREE = math.pi / 180
WHITE = torch.tensor([0.10, 0.12, 0.15, 0.10, 0.20, 0.14], dtype=torch.float64)  # deg/s at 100 Hz
SLOW = torch.tensor([6e-4, 1.5e-3, 5e-4, 2e-3, 8e-4, 1e-3], dtype=torch.float64)  # deg/s, sd of an AR1's steps
WALK = torch.tensor([4e-5, 1e-5, 6e-5, 1e-5, 3e-5, 2e-5], dtype=torch.float64)  # deg/s per step
TONE = torch.tensor([0.10, 0.14, -0.06, 0.12, 0.04, 0.09], dtype=torch.float64)  # deg/s
ACCELEROMETER = "WN(variance=1e-4) + RW(variance=1e-11)"
INITIAL = InitialUncertainty(attitude=(0.1 * DEGREE, 0.1 * DEGREE, 0.5 * DEGREE))


def array(n_samples: int, batch: tuple[int, ...], rate: float, generator: torch.Generator) -> torch.Tensor:
    """Errors of arrays, deg/s, `(..., sensor, time)`."""
    noise = gf.WhiteNoise(WHITE.square() * rate / 100) + gf.AR1(torch.full_like(SLOW, 0.998), SLOW.square())
    signal = (noise + gf.RandomWalk(WALK.square())).simulate(n_samples, batch=batch, generator=generator)
    phase = 2 * math.pi * torch.rand(*batch, 1, 1, generator=generator, dtype=torch.float64)
    t = torch.arange(n_samples, dtype=torch.float64) / rate
    return signal + TONE[:, None] * torch.sin(2 * math.pi * TONE_HZ * t + phase)


def fitted(virtual: torch.Tensor, rate: float) -> gf.Model:
    """Noise model of a virtual gyro's recording `(time,)`, fitted to it as it is."""
    found = gf.fit_gmwm(gf.Recording(virtual[None], rate=rate, unit="deg/s"), "WN + AR1 + RW").model
    return found.with_params(found.params[0])


def array_model(bench: torch.Tensor, rate: float) -> tuple[gf.ArrayModel, str]:
    """Noise of the sensors with the tones that a diagnosis of their plain mean finds, and those in words."""
    mean = bench.mean(-2)
    report = gf.diagnose(gf.Recording(mean[None], rate=rate, unit="deg/s"), fitted(mean, rate))
    tones = [f"{f.frequency_hz:.4g} Hz" for f in report.findings if f.mechanism == "vibration_tone"]
    model = gf.fit_array_gmwm(bench, " + ".join(["WN + AR1 + RW", *["SIN"] * len(tones)])).model
    return model, f"by the array, tone at {', '.join(tones)}" if tones else "by the array"


def errors_of(fused: torch.Tensor, accelerometer: Axes) -> ErrorSamples:
    """Errors of a unit from those of its virtual gyros, deg/s, `(flight, 3, time)`."""
    samples = fused.transpose(-1, -2) * DEGREE
    return ErrorSamples(Axes(samples, samples.new_full((*samples.shape, 0), torch.nan)), accelerometer)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--rate", type=float, default=100.0, help="of the unit, Hz; above 30")
    parser.add_argument("--quick", action="store_true", help="a small study")
    parser.add_argument("--figure", type=Path, help="draw position errors over time, .png")
    asked = parser.parse_args()
    rate, n_flights = (32.0, 6) if asked.quick else (asked.rate, asked.flights)
    if rate <= 30 or n_flights < 1:
        parser.error("expected a rate above 30 Hz and at least one flight")
    generator = torch.Generator().manual_seed(0)
    trajectory, away = flight(), (160.0, 210.0)
    if asked.quick:
        trajectory, away = Trajectory(trajectory.time[:8], trajectory.position[:8]), (60.0, 100.0)
    n_samples = round(trajectory.duration * rate)
    ground, bench = (array(2**15 if asked.quick else 2**18, (), rate, generator) for _ in range(2))
    aloft = array(n_samples, (n_flights, 3), rate, generator)
    accelerometer = (
        UnitErrors(gf.WhiteNoise(1.0), gf.parse_model(ACCELEROMETER), rate)
        .simulate(n_samples, n_flights, generator)
        .accelerometer
    )
    svo, bands = gf.fit_svo(ground, "long", covariance="none"), gf.fit_multiscale(ground, "long")
    noise, words = array_model(bench, rate)
    equal = torch.full((N_SENSORS,), 1 / N_SENSORS, dtype=torch.float64)
    virtual = {
        "plain mean": (equal, bench.mean(-2), aloft.mean(-2)),
        "SVO": (svo.weights, svo.virtual(bench), svo.virtual(aloft)),
        "multi-scale": (bands.weights, bands.virtual(bench), bands.virtual(aloft)),
    }
    print(
        f"{n_flights} flights of {trajectory.duration:g} s at {rate:g} Hz; root mean square at the end of the outage,"
    )
    print("NEES: squared errors of position and attitude there in units of the claimed covariance, 1 where it is right")
    print(
        f"{'virtual gyro':<14}{'filter tuned':<32}{'position (m)':>14}{'claimed (m)':>13}{'attitude (deg)':>16}"
        f"{'NEES':>7}{'':>7}"
    )
    courses = {}
    for name, (weights, resting, flying) in virtual.items():
        for tuning, model in (
            ("by its recording", fitted(resting, rate)),
            (words, virtual_noise(weights, noise).model),
        ):
            told = UnitErrors(model.scaled(DEGREE), gf.parse_model(ACCELEROMETER), rate)
            own = torch.Generator().manual_seed(1)
            drawn = errors_of(flying, accelerometer)
            out = run_filter(
                trajectory, drawn, told, gnss=Gnss(outage=away), initial_uncertainty=INITIAL, generator=own
            )
            end = int((out.time - away[1]).abs().argmin())
            position, attitude = (v.square().sum(-1).mean(-1).sqrt() for v in (out.position, out.attitude))
            claimed = out.sd[end, :, 6:9].square().sum(-1).mean().sqrt()
            nees = out.nees[end].mean(0) / torch.tensor(out.sizes)
            courses[f"{name}, {tuning}"] = out.time, position
            print(
                f"{name:<14}{tuning:<32}{float(position[end]):>14.3g}{float(claimed):>13.3g}"
                f"{float(attitude[end]) / DEGREE:>16.3g}{float(nees[2]):>7.2f}{float(nees[0]):>7.2f}",
                flush=True,
            )
    if asked.figure:
        import matplotlib.pyplot as plt

        figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
        for k, (label, (time, position)) in enumerate(courses.items()):
            style = {"color": ("#969696", "#e69f00", "#0072b2")[k // 2], "linestyle": ("-", "--")[k % 2]}
            ax.plot(time, position, label=label, **style)
        ax.axvspan(*away, color="#ececec", zorder=0)
        ax.set(xlabel="time (s)", ylabel="position error, root mean square (m)", yscale="log")
        ax.legend(fontsize=8, frameon=False)
        figure.savefig(asked.figure, dpi=150)
        print(f"Figure: {asked.figure}")


if __name__ == "__main__":
    main()
