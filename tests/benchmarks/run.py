"""Speed and memory of the wavelet cross-covariance, beside what one would write instead.

    python tests/benchmarks/run.py [--quick]

Every figure is the median of several runs, taken in turn with what it is compared with, so that a machine whose speed
drifts does not decide. Peers that are not installed (PyWavelets, ptwt) are left out and said so.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

import gyrofuse as gf

sys.path.insert(0, str(Path(__file__).parent))
from peers import blocked_numpy_variance, blocked_numpy_wccv, conv1d_wccv, gram_products, ptwt_wccv, pywavelets_wccv


def side_by_side(runs: int, **calls: Callable[[], object]) -> dict[str, float]:
    """Median seconds of each call, the calls taken in turn."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(runs + 1):  # the first round warms up
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(values[1:]) for name, values in seconds.items()}


def array(n_sensors: int, n_samples: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(n_sensors, n_samples, dtype=torch.float64, generator=generator)


def wccv_table(quick: bool) -> list[list[str]]:
    """The array that people ask for: 12 sensors, 4 million samples, 20 levels."""
    n_samples = 400_000 if quick else 4_000_000
    n_levels = 17 if quick else 20
    signal = array(12, n_samples)
    values = signal.numpy()
    cores = torch.get_num_threads()
    times = side_by_side(
        2 if quick else 5,
        gyrofuse=lambda: gf.wavelet_cross_covariance(signal, n_levels),
        limit=lambda: gram_products(12, n_samples, n_levels),
        numpy=lambda: blocked_numpy_wccv(values, n_levels),
    )
    times["limit"] /= cores
    rows = [
        ["gyrofuse", times["gyrofuse"]],
        [f"limit: bare Gram products on one core / {cores} cores", times["limit"]],
        ["NumPy in cache-sized blocks", times["numpy"]],
    ]
    rows.append(["torch conv1d, whole array", side_by_side(1, call=lambda: conv1d_wccv(signal, n_levels))["call"]])
    return [
        [
            f"WCCV 12 x {n_samples:,}, {n_levels} levels: {name}",
            f"{seconds:.3f} s",
            f"{seconds / times['gyrofuse']:.2f}",
        ]
        for name, seconds in rows
    ]


def wavelet_packages_table() -> list[list[str]]:
    """A short array, for packages whose transforms are circular and keep every coefficient."""
    signal = array(6, 2**16)
    values = signal.numpy()
    calls: dict[str, Callable[[], object]] = {"gyrofuse": lambda: gf.wavelet_cross_covariance(signal, 16)}
    if importlib.util.find_spec("ptwt"):
        calls["ptwt swt"] = lambda: ptwt_wccv(signal, 16)
    if importlib.util.find_spec("pywt"):
        calls["PyWavelets swt"] = lambda: pywavelets_wccv(values, 16)
    times = side_by_side(2, **calls)
    return [
        [f"WCCV 6 x {2**16:,}, 16 levels: {name}", f"{seconds:.3f} s", f"{seconds / times['gyrofuse']:.2f}"]
        for name, seconds in times.items()
    ]


def variance_table(quick: bool) -> list[list[str]]:
    """One long series."""
    n_samples = 1_000_000 if quick else 10_000_000
    signal = array(1, n_samples)
    values = signal[0].numpy()
    n_levels = n_samples.bit_length() - 1
    times = side_by_side(
        2 if quick else 5,
        gyrofuse=lambda: gf.wavelet_variance(signal, n_levels),
        numpy=lambda: blocked_numpy_variance(values, n_levels),
    )
    return [
        [f"WV 1 x {n_samples:,}, {n_levels} levels: {name}", f"{seconds:.3f} s", f"{seconds / times['gyrofuse']:.2f}"]
        for name, seconds in (("gyrofuse", times["gyrofuse"]), ("NumPy in cache-sized blocks", times["numpy"]))
    ]


def scaling_table(quick: bool) -> list[list[str]]:
    """Seconds per sample, sensor and level as each grows alone."""
    base = {"n_samples": 2**17 if quick else 2**20, "n_sensors": 6, "n_levels": 15}
    sweeps = {
        "n_samples": [base["n_samples"] * k for k in (1, 2, 4)],
        "n_sensors": [2, 6, 12, 24],
        "n_levels": [5, 10, 15],
    }
    rows = []
    for name, sizes in sweeps.items():
        for size in sizes:
            case = base | {name: size}
            signal = array(case["n_sensors"], case["n_samples"])
            seconds = side_by_side(
                1 if quick else 3, call=lambda s=signal, c=case: gf.wavelet_cross_covariance(s, c["n_levels"])
            )
            work = case["n_samples"] * case["n_sensors"] * case["n_levels"]
            rows.append(
                [
                    f"WCCV {case['n_sensors']} x {case['n_samples']:,}, {case['n_levels']} levels",
                    f"{seconds['call']:.3f} s",
                    f"{1e9 * seconds['call'] / work:.2f} ns",
                ]
            )
    return rows


_MEMORY = """
import sys, torch, gyrofuse as gf
how, n_sensors, n_samples, n_levels = sys.argv[1], *map(int, sys.argv[2:])
def peak():  # of this process alone; the peak that getrusage tells includes that of the process it came from
    line = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1024
gf.wavelet_cross_covariance(torch.randn(n_sensors, 4096, dtype=torch.float64))
metric = gf.WaveletCrossCovariance(n_sensors, n_levels)
if how == "one-shot":
    signal = torch.zeros(n_sensors, n_samples, dtype=torch.float64).normal_()
    before = peak()
    gf.wavelet_cross_covariance(signal, n_levels)
else:
    chunk = torch.zeros(n_sensors, 100_000, dtype=torch.float64).normal_()
    before = peak()
    for _ in range(n_samples // 100_000):
        metric.update(chunk)
    metric.compute()
print((peak() - before) / 2**20)
"""


def memory_table(quick: bool) -> list[list[str]]:
    """Peak resident memory beyond the data, each in a process of its own (Linux)."""
    if not Path("/proc/self/status").exists():
        return []
    n_samples = 1_000_000 if quick else 4_000_000
    cases = [
        ("one-shot", 12, n_samples, 18 if quick else 20),
        ("one-shot", 12, n_samples, n_samples.bit_length() - 1),
        ("streaming", 12, n_samples, 16),
        ("streaming", 12, 4 * n_samples, 16),
    ]
    rows = []
    for how, n_sensors, length, n_levels in cases:
        arguments = [sys.executable, "-c", _MEMORY, how, str(n_sensors), str(length), str(n_levels)]
        extra = float(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)
        data = n_sensors * length * 8 / 2**20
        rows.append(
            [f"memory, {how}: {n_sensors} x {length:,}, {n_levels} levels", f"{extra:.0f} MiB", f"{extra / data:.2f}"]
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the size, fewer runs")
    arguments = parser.parse_args()
    tables = {
        "| what | time | over gyrofuse |": [
            *wccv_table(arguments.quick),
            *variance_table(arguments.quick),
            *wavelet_packages_table(),
        ],
        "| scaling | time | per sample, sensor and level |": scaling_table(arguments.quick),
        "| memory beyond the data | peak | over the data |": memory_table(arguments.quick),
    }
    print(f"torch {torch.__version__}, numpy {np.__version__}, {torch.get_num_threads()} threads, float64\n")
    for header, rows in tables.items():
        print(header, "|---|---|---|", *("| " + " | ".join(row) + " |" for row in rows), sep="\n", end="\n\n")


if __name__ == "__main__":
    main()
