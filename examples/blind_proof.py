"""A blind proof of the diagnosis: does it find what it was not told, and keep quiet where nothing is missing?

Recordings are made from physics by a generator that knows nothing of the library; the truth is sealed, its SHA-256
printed; every case is diagnosed with what a user would have; answers are frozen; then a judge opens the truth and
counts, with binomial intervals. The folder receives all of it, and curves of detection against the size of effects.
`--data` adds effects put into real recordings at rest, of a folder with `adis16405_rec1.npz` to `3`. `--wide` draws
for each case one to sixteen sensors, 50 to 2000 Hz, a length up to T, and whether one, some or all sensors have the
effect; the groups `form`, `common_noise`, `fitted` and `misfit` have forms that no equation of the catalogue has, noise
that is not Gaussian alike on both sides, and noise models fitted to earlier records. `--quick` has a few small cases of
each mechanism.

    python examples/blind_proof.py [--per-kind N] [--nulls N] [--nats L [L ...]] [--group G [G ...]] [--samples T]
        [--wide] [--seed S] [--workers W] [--data FOLDER] [--quick] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import json
import secrets
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "benchmarks"))

from blind.analyser import analyse
from blind.cases import NATS
from blind.curves import draw_curves
from blind.field import FILES
from blind.kinds import GROUPS, WIDER
from blind.trial import plan_trial, run_trial


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--per-kind", type=int, default=25, help="cases of each kind and size")
    parser.add_argument("--nulls", type=int, default=50, help="cases of each kind without an effect")
    parser.add_argument("--nats", type=float, nargs="+", default=list(NATS), help="sizes, log likelihood ratios")
    parser.add_argument(
        "--group",
        nargs="+",
        choices=[*GROUPS, *WIDER, "real"],
        help=f"of cases; {', '.join(GROUPS)} by default, real ones with --data",
    )
    parser.add_argument("--wide", action="store_true", help="sensors, rates, lengths and reach drawn case by case")
    parser.add_argument("--samples", type=int, default=65536, help="of each recording")
    parser.add_argument("--seed", type=int, help="drawn, and printed, by default")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--data", type=Path, help="folder with real recordings")
    parser.add_argument("--quick", action="store_true", help="a small proof, in minutes")
    parser.add_argument("--out", type=Path, default=Path("blind_proof"), help="folder of what is written")
    options = parser.parse_args()
    if options.quick:
        options.per_kind, options.nulls, options.nats, options.samples = 1, 1, [100.0], 16384
        options.group = options.group or ["mechanism", "null"]
    groups = options.group or [*GROUPS, *(["real"] if options.data else [])]
    if "real" in groups and not (options.data and all((options.data / name).is_file() for name in FILES)):
        parser.error(f"--data: expected a folder with {', '.join(FILES)}, got {options.data}")
    seed = secrets.randbits(64) if options.seed is None else options.seed
    plan = plan_trial(options.per_kind, options.nulls, tuple(options.nats), seed=seed, groups=groups, wide=options.wide)
    print(f"{len(plan)} cases of {options.samples} samples, seed {seed}", flush=True)
    with ProcessPoolExecutor(options.workers, initializer=partial(torch.set_num_threads, 1)) as pool:
        over = partial(pool.map, chunksize=1)
        verdict = run_trial(plan, analyse, options.out, n_samples=options.samples, over=over, data=options.data)
    digests = json.loads((options.out / "digests.json").read_text())
    print(f"truth   {digests['truth']}\nanswers {digests['answers']}\n")
    print(verdict)
    if draw_curves(verdict, options.out / "curves.png"):
        print(f"\nFigure: {options.out / 'curves.png'}")


if __name__ == "__main__":
    main()
