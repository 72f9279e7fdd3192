"""What a power loss or a bad disk does to an unfinished fleet: its files damaged at random, then gone on with.

    python tests/benchmarks/damaged_stores.py [--rounds 300] [--seed 0] [--quick]

Each round damages one to three files of a store with some of its rows: cut short, overwritten with zeros, or one bit
flipped. Then it does what the same command does when started again. Counted is how often the table is that of an
undisturbed run to the last byte; sound work is refused; a run can never finish; numbers are wrong in silence. Exit
status 1 where any of the last three has happened, or where sound work was done again.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
import warnings
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np

from gyrofuse.fleet import Fuse, ResultStore, find_logs
from gyrofuse.fleet.logs import groups_of, identity
from gyrofuse.fleet.run import LogGroups, rows_of
from gyrofuse.fleet.tasks import Row

N_LOGS = 12
PAGE = 4096  # bytes that a file system writes at a time
KINDS = ("cut", "zero tail", "zero page", "flip", "empty", "zeros", "zero head")
TASK = Fuse("long")


@cache
def rows(log: Path) -> list[Row]:
    return rows_of(TASK, LogGroups([[log]], {})[0])


def damaged(content: bytes, kind: str, rng: random.Random) -> bytes:
    """Content of a file after something has happened to it."""
    new, i = bytearray(content), rng.randrange(len(content))
    if kind == "cut":
        return content[:i]
    if kind == "empty":
        return b""
    if kind == "flip":
        new[i] ^= 1 << rng.randrange(8)
        return bytes(new)
    page = PAGE * rng.randrange(max(1, len(content) // PAGE))
    first, last = {
        "zero tail": (i, len(content)),
        "zero page": (page, page + PAGE),
        "zeros": (0, len(content)),
        "zero head": (0, 64),
    }[kind]
    new[first:last] = bytes(len(new[first:last]))
    return bytes(new)


def gone_on_with(path: Path, logs: tuple[Path, ...]) -> tuple[bytes, int]:
    """The table of a run that goes on with what is there, and how many logs it did."""
    store = ResultStore(path, TASK.columns, TASK.settings)
    try:
        store.open()
        left = groups_of(logs, 1, store.done())
        for (log,) in left:
            store.write(rows(log))
        store.finish([identity(log) for log in logs])
    finally:
        store.close()
    return path.read_bytes(), len(left)


def outcome(path: Path, logs: tuple[Path, ...], whole: bytes, rng: random.Random) -> str:
    """Of one round."""
    store = ResultStore(path, TASK.columns, TASK.settings)
    store.open()
    n_done = rng.randint(3, len(logs))
    for log in logs[:n_done]:
        store.write(rows(log))
    store.close()
    hit = rng.sample(sorted(store.parts.iterdir()), rng.randint(1, 3))
    n_hit = sum(file.suffix == ".parquet" for file in hit)
    for file in hit:
        file.write_bytes(damaged(file.read_bytes(), rng.choice(KINDS), rng))
    try:
        table, n_did = gone_on_with(path, logs)
    except FileExistsError:
        return "sound work refused"
    except Exception:
        try:
            table, n_did = gone_on_with(path, logs)
        except Exception:
            return "can never finish"
    if table != whole:
        return "wrong in silence"
    return "sound" if n_did <= len(logs) - n_done + n_hit else "sound work done again"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="30 rounds")
    asked = parser.parse_args()
    rng, draws = random.Random(asked.seed), np.random.default_rng(asked.seed)
    warnings.simplefilter("ignore")  # damage is told of in every round
    with tempfile.TemporaryDirectory() as scratch:
        folder, path = Path(scratch, "logs"), Path(scratch, "r.parquet")
        folder.mkdir()
        for i in range(N_LOGS):
            np.savez(folder / f"{i:02d}.npz", gyro=draws.standard_normal((4, 2000)), fs=100.0, unit="deg/s")
        logs = find_logs(folder)
        whole, _ = gone_on_with(path, logs)
        tally: Counter[str] = Counter()
        for _ in range(30 if asked.quick else asked.rounds):
            path.unlink(missing_ok=True)
            shutil.rmtree(path.with_name(f".{path.name}.parts"), ignore_errors=True)
            tally[outcome(path, logs, whole, rng)] += 1
    print(", ".join(f"{kind}: {count}" for kind, count in tally.most_common()))
    sys.exit(tally.keys() != {"sound"})


if __name__ == "__main__":
    main()
