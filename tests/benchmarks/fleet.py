"""Fleets of logs: kills, two processes against one, and what time and memory cost.

    python tests/benchmarks/fleet.py kills [--runs 20] [--devices 1]
    python tests/benchmarks/fleet.py throughput [--logs 200] [--samples 400000]
    python tests/benchmarks/fleet.py cost [--quick]

`kills` stops a run with SIGKILL at random moments until it is through, and compares its table with that of a run left
alone. `throughput` times one process and two, one thread each, in turn. `cost` fits seconds and bytes of a log to its
length, its sensors and its levels, and checks the fit on logs ten times larger than any that it was fitted to.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import nnls

import gyrofuse as gf
from gyrofuse.fleet import ResultStore

SECONDS = "a log = a + b T p J + c T p (p + 1) J + d T p"  # T samples, p sensors, J levels


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "gyrofuse", "fleet", *map(str, arguments)]


def environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1"}


def write_logs(folder: Path, n_logs: int, n_samples: int, n_sensors: int = 6) -> None:
    """Arrays of white noise and random walks, every log with its own."""
    noise = gf.parse_model("WN(variance=1) + RW(variance=1e-5)")
    for i in range(n_logs):
        generator = torch.Generator().manual_seed(i)
        signal = noise.simulate(n_samples, batch=(n_sensors,), generator=generator)
        gf.Recording(signal, rate=100.0, unit="deg/s").save(folder / f"{i:05d}.npz")


def timed(folder: Path, out: Path, devices: int) -> float:
    """Seconds of a whole run."""
    out.unlink(missing_ok=True)
    start = time.perf_counter()
    subprocess.run(
        command(folder, "--out", out, "--devices", devices), check=True, env=environment(), stdout=subprocess.DEVNULL
    )
    return time.perf_counter() - start


def kills(runs: int, devices: int, n_logs: int, n_samples: int) -> None:
    """Kill a run at random moments."""
    with tempfile.TemporaryDirectory() as scratch:
        folder, whole, out = Path(scratch, "logs"), Path(scratch, "whole.parquet"), Path(scratch, "r.parquet")
        folder.mkdir()
        write_logs(folder, n_logs, n_samples)
        usual = timed(folder, whole, devices)
        moments, killed = random.Random(0), 0
        while killed < runs:
            out.unlink(missing_ok=True)
            while not out.exists():
                with subprocess.Popen(
                    command(folder, "--out", out, "--devices", devices),
                    env=environment(),
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                ) as process:
                    try:
                        process.wait(moments.uniform(0.3, 1.1) * usual if killed < runs else None)
                    except subprocess.TimeoutExpired:
                        os.kill(process.pid, signal.SIGKILL)
                        killed += 1
            same = out.read_bytes() == whole.read_bytes()
            print(f"{killed} kills so far; the table equals that of an undisturbed run: {same}", flush=True)
            if not same:
                sys.exit(1)


def paced(folder: Path, out: Path, devices: int, n_logs: int) -> tuple[float, float]:
    """Seconds of a whole run, and logs a second between the first tenth of them and the last."""
    out.unlink(missing_ok=True)
    store = ResultStore(out, {}, {})
    first, last = n_logs // 10, n_logs - n_logs // 10
    reached: dict[int, tuple[float, int]] = {}
    start = time.perf_counter()
    with subprocess.Popen(
        command(folder, "--out", out, "--devices", devices), env=environment(), stdout=subprocess.DEVNULL
    ) as process:
        while process.poll() is None:
            done = store.n_parts
            for mark in (first, last):
                if done >= mark:
                    reached.setdefault(mark, (time.perf_counter(), done))
            time.sleep(0.1)
    (t0, n0), (t1, n1) = reached[first], reached[last]
    return time.perf_counter() - start, (n1 - n0) / (t1 - t0)


def throughput(n_logs: int, n_samples: int, rounds: int) -> None:
    """One process against two, in turn."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, "logs")
        folder.mkdir()
        write_logs(folder, n_logs, n_samples)
        outs = {devices: Path(scratch, f"{devices}.parquet") for devices in (1, 2)}
        found: dict[int, list[tuple[float, float]]] = {1: [], 2: []}
        for _ in range(rounds):
            for devices, out in outs.items():
                found[devices].append(paced(folder, out, devices, n_logs))
                print(
                    f"{devices} process(es): {found[devices][-1][0]:.1f} s, {found[devices][-1][1]:.2f} logs/s",
                    flush=True,
                )
        same = outs[1].read_bytes() == outs[2].read_bytes()
    whole, pace = ({d: float(np.median([r[k] for r in runs])) for d, runs in found.items()} for k in (0, 1))
    print(
        f"{n_logs} logs of 6 x {n_samples}: two processes have {pace[2] / pace[1]:.2f} times the throughput of one once"
    )
    print(f"they have begun; with starting and ending {whole[1] / whole[2]:.2f} ({whole[1]:.1f} s, {whole[2]:.1f} s)")
    print(f"tables equal to the last bit: {same}")


def in_time(n_samples: float, n_sensors: float, n_levels: float) -> list[float]:
    """What the seconds of a log grow with."""
    size = n_samples * n_sensors
    return [1.0, size * n_levels, size * (n_sensors + 1) * n_levels, size]


def in_memory(n_samples: float, n_sensors: float, n_levels: float) -> list[float]:
    """What its bytes grow with."""
    return [1.0, n_samples * n_sensors]


def measured(n_samples: int, n_sensors: int, n_levels: int, runs: int) -> tuple[float, float]:
    """Seconds of one log, median, and bytes of resident memory that it adds, in a process of its own."""
    script = (
        "import sys, time, torch, gyrofuse as gf\n"
        "T, p, J, runs = map(int, sys.argv[1:])\n"
        "torch.set_num_threads(1)\n"
        "gf.fit_svo(torch.randn(p, 4096, dtype=torch.float64))\n"
        "def resident(which):\n"
        "    return int(open('/proc/self/status').read().split(which)[1].split()[0]) * 1024\n"
        "open('/proc/self/clear_refs', 'w').write('5')\n"  # the peak so far, of the imports, does not count
        "before = resident('VmRSS:')\n"
        "x = torch.randn(p, T, dtype=torch.float64)\n"
        "times = []\n"
        "for _ in range(runs):\n"
        "    start = time.perf_counter()\n"
        "    gf.fit_svo(x, n_levels=J)\n"
        "    times.append(time.perf_counter() - start)\n"
        "print(sorted(times)[len(times) // 2], resident('VmHWM:') - before)\n"
    )
    sizes = map(str, (n_samples, n_sensors, n_levels, runs))
    run = subprocess.run(
        [sys.executable, "-c", script, *sizes], check=True, capture_output=True, text=True, env=environment()
    )
    seconds, extra = map(float, run.stdout.split())
    return seconds, extra


def cost(quick: bool) -> None:
    """Fit the cost of a log, check it on a larger one, and carry it to a million logs."""
    base = 20_000 if quick else 100_000
    sizes = [(base, 6, 10), (base, 12, 10), (base, 6, 14), (4 * base, 6, 10), (4 * base, 3, 14), (10 * base, 6, 14)]
    if not quick:
        sizes += [(2 * base, 24, 12), (10 * base, 3, 10), (base, 3, 12), (4 * base, 12, 14)]
    check = (100 * base if not quick else 40 * base, 6, 14)
    found = {size: measured(*size, runs=5) for size in sizes}
    seconds, extra = measured(*check, runs=1)
    models = {}
    # Memory that was there before, of the imports, hides what a short log takes.
    kinds = (("seconds", in_time, 1.0, 0.0, seconds), ("MiB", in_memory, 2.0**20, 4.0, extra))
    for k, (what, features, unit, least, reached) in enumerate(kinds):
        values = np.array([found[size][k] for size in sizes]) / unit
        table = np.array([features(*size) for size in sizes])
        seen = values > least
        models[what] = nnls(table[seen] / values[seen, None], np.ones(seen.sum()))[0]  # relative errors count alike
        for size, own, said in zip(sizes, values, table @ models[what], strict=True):
            print(f"{what:>8}  T {size[0]:>9} p {size[1]:>2} J {size[2]:>2}: measured {own:9.4g}, model {said:9.4g}")
        said = float(np.array(features(*check)) @ models[what])
        size = f"{what:>8}  T {check[0]:>9} p {check[1]:>2} J {check[2]:>2}"
        print(f"{size}: measured {reached / unit:9.4g}, model {said:9.4g}   not fitted to")
    hour = 360_000, 6, 14  # at 100 Hz
    one, memory = (float(np.array(f(*hour)) @ models[what]) for what, f, *_ in kinds)
    hours = 1e6 * one / 3600 / 64
    print(
        f"an hour of 6 gyros at 100 Hz: {one:.3g} s, {memory:.3g} MiB; a million of them on 64 processes: {hours:.3g} h"
    )
    print(f"({SECONDS})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("kills", "throughput", "cost"))
    parser.add_argument("--runs", type=int, default=20, help="kills")
    parser.add_argument("--devices", type=int, default=1, help="processes of a run that is killed")
    parser.add_argument("--logs", type=int, default=200)
    parser.add_argument("--samples", type=int, default=400_000)
    parser.add_argument("--rounds", type=int, default=3, help="runs of each, in turn")
    parser.add_argument("--quick", action="store_true")
    asked = parser.parse_args()
    if asked.what == "kills":
        kills(asked.runs, asked.devices, min(asked.logs, 40), min(asked.samples, 100_000))
    elif asked.what == "throughput":
        throughput(asked.logs, asked.samples, asked.rounds)
    else:
        cost(asked.quick)
    print(f"peak of this script itself: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


if __name__ == "__main__":
    main()
