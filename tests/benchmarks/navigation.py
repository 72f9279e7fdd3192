"""Whether the navigation filter claims the errors that it makes, and what flights cost in time and memory.

    python tests/benchmarks/navigation.py [--flights 500] [--quick]

Flights with errors of the very model that the filter is told: normalised squared errors of attitude, velocity,
position and the sensors' states (NEES), of every state alone, and of innovations (NIS), averaged over the flights,
against their 95 % bands.
Averages at neighbouring times go together, so that a share of 95 % is what is expected, not what is had exactly.
"""

from __future__ import annotations

import argparse
import math
import resource
import time

import torch
from scipy import stats

import gyrofuse as gf
from gyrofuse.navigation import Gnss, InitialUncertainty, UnitErrors, flight, run_filter

DEGREE = math.pi / 180
RATE = 100.0
NAMES = ("attitude", "velocity", "position", "sensors")
STATES = [f"{what} {axis}" for what in ("attitude", "velocity", "position") for axis in ("north", "east", "down")]
STATES += [f"gyro {axis}, {what}" for axis in "xyz" for what in ("AR1", "RW")] + [
    f"accelerometer {axis}, RW" for axis in "xyz"
]


def unit() -> UnitErrors:
    """Of a good MEMS unit: with one as bad as that of the paper errors leave what is linear during the outage."""
    gyro = (
        gf.WhiteNoise((0.02 * DEGREE) ** 2) + gf.AR1(0.999, (5e-5 * DEGREE) ** 2) + gf.RandomWalk((2e-6 * DEGREE) ** 2)
    )
    return UnitErrors(gyro, gf.WhiteNoise(0.01**2) + gf.RandomWalk(1e-6**2), RATE)


def told(name: str, values: torch.Tensor, n_flights: int, size: int) -> None:
    """Share of times at which the mean over flights is inside its band, and the mean over everything."""
    low, high = (limit / n_flights for limit in stats.chi2.interval(0.95, n_flights * size))
    mean = values.mean(-1)
    inside = ((mean > low) & (mean < high)).double().mean()
    print(
        f"{name:<22}  {size:>2} states  mean {float(mean.mean()) / size:.3f} of what is expected; inside the 95 % band "
        f"[{low / size:.3f}, {high / size:.3f}] at {100 * float(inside):.1f} % of the times; "
        f"{float(mean.min()) / size:.3f} to {float(mean.max()) / size:.3f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=500)
    parser.add_argument("--quick", action="store_true")
    asked = parser.parse_args()
    n = 30 if asked.quick else asked.flights
    trajectory, errors = flight(), unit()
    drawn = errors.simulate(round(trajectory.duration * RATE), n, torch.Generator().manual_seed(0), with_states=True)
    start = time.perf_counter()
    initial = InitialUncertainty(attitude=(0.1 * DEGREE, 0.1 * DEGREE, 0.5 * DEGREE))
    out = run_filter(
        trajectory, drawn, errors, gnss=Gnss(), initial_uncertainty=initial, generator=torch.Generator().manual_seed(1)
    )
    seconds = time.perf_counter() - start
    for k, (name, size) in enumerate(zip(NAMES, out.sizes, strict=True)):
        told(name, out.nees[..., k], n, size)
    for k, name in enumerate(STATES):
        told(name, (out.error[..., k] / out.sd[..., k]).square(), n, 1)
    told("innovation", out.nis, n, 3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{n} flights of {trajectory.duration:g} s at {RATE:g} Hz: {seconds:.1f} s, peak {peak:.0f} MiB")


if __name__ == "__main__":
    main()
