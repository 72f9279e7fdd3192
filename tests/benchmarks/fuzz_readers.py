"""Damaged and hostile logs of every format: none may hang, crash, or be refused without its name.

    python tests/benchmarks/fuzz_readers.py [--quick] [--inputs N] [--seed S] [--keep FOLDER]

The inputs are sound logs with their bytes changed at random, sound formats with senseless content, and the logs of
`tests/hostile_logs.py`, as they are and with their bytes changed. Each is read by `read_recording`, and by
`open_recording` where that reads the format, in a process of its own with a limit in time and in memory. Counted are

- read: a recording came out, and its summary and JSON as well;
- refused: a `RecordingError` or `OSError` that names the file;
- nameless: an error that does not name the file, or of another kind;
- crash: the process ended without a word; hang: it did not end in time.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import shutil
import struct
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

# Before torch is loaded: processes are forked, which threads do not survive.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import gyrofuse as gf
from gyrofuse.io.streams import RecordingError

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import logs
from hostile_logs import CASES

SECONDS, BYTES = 20, 6 * 2**30
FAILURES = ("nameless", "crash", "hang")
WORDS = [
    "nan",
    "inf",
    "1e999",
    "-1e308",
    "1e-320",
    "",
    " ",
    "0x1p3",
    "1_000",
    "1.234,56",
    "12:00:01",
    "--",
    "NULL",
    '"',
]
WORDS += ['"a,b"', "\u0661", "\x1b[31m", "=1+1", "9" * 400, "\u2212 1", "#", "\xa0", "(" * 40, "\x00", "\x0b", "\u2028"]
NAMES = [
    "gyro",
    "gyro_x",
    "gx",
    "gy",
    "g1",
    "time",
    "t",
    "t_us",
    "ts",
    "ts_hz",
    "fs",
    "rate",
    "unit",
    "sensors",
    "axes",
]
NAMES += [
    "channels",
    "scale",
    "temperature",
    "imu1/gyro",
    "imu1/fs",
    "a1",
    "a1_t_us",
    "x",
    "1",
    "\u00fcnit",
    "gx [deg/s]",
]


def sound_logs(folder: Path) -> list[Path]:
    """One or two small logs of each format."""
    gyro, stamps = logs.made_up(2, 80), logs.regular_stamps(80)
    rows, time = gyro.reshape(6, 80), np.arange(80) / 100
    columns = {"time": time, **{f"imu{i}_g{axis}": gyro[i, k] for i in range(2) for k, axis in enumerate("xyz")}}
    np.savez(folder / "plain.npz", gyro=rows, fs=100.0, unit="deg/s", sensors=list("abcdef"), temperature=time)
    np.savez_compressed(
        folder / "table.npz", a1=rows, channels=["gx", "gy", "gz", "ax", "ay", "az"], a1_t_us=time * 1e6
    )
    np.save(folder / "plain.npy", rows)
    table = np.vstack([*columns.values()]).T
    np.savetxt(folder / "comma.csv", table, delimiter=",", header=",".join(columns), comments="")
    np.savetxt(folder / "blank.txt", table, header=" ".join(columns) + "\nfs = 100, unit: deg/s")
    lines = (folder / "comma.csv").read_text().splitlines()
    quoted = ["\t".join(f'"{cell}"'.replace(".", ",") for cell in line.split(",")) for line in lines]
    (folder / "quoted.tsv").write_text("\n".join(quoted))
    logs.write_parquet(folder / "plain.parquet", columns, {"fs": "100", "unit": "deg/s"})
    logs.write_hdf5(folder / "groups.h5", {f"imu{i}": {"gyro": gyro[i], "t": time} for i in range(2)}, fs=100.0)
    logs.write_mat73(folder / "new.mat", {"gyro": gyro[0], "fs": 100.0, "unit": "rad/s"})
    logs.write_mat5(folder / "old.mat", {"imu": {"gyr": gyro[0], "fs": 100.0, "names": np.array(["a", 1.0], object)}})
    logs.write_ulog(folder / "plain.ulg", gyro, stamps)
    blocks = [(8000 * k, 8, np.full((3, 32), k)) for k in range(1, 40)]
    fifos = [(f"sensor_{kind}_fifo", 0, 1000, 1000.0, 1e-3, blocks) for kind in ("gyro", "accel")]
    logs.write_ulog(folder / "fifo.ulg", gyro, stamps, fifo=fifos)
    inertial = [
        ("IMU", 2500 * k, i, *gyro[i, :, k], 0, 0, -9.75, 0, 0, 30, 1, 1, 0, 0) for k in range(80) for i in (0, 1)
    ]
    logs.write_dataflash(folder / "plain.bin", inertial)
    logs.write_dataflash(folder / "plain.log", inertial)
    logs.write_dataflash(folder / "batches.bin", logs.batches())
    logs.write_ros1(folder / "plain.bag", gyro, stamps)
    for mcap in (False, True):
        bag = logs.write_ros2(folder / f"ros2_{mcap}", gyro, stamps, mcap=mcap)
        (file,) = [path for path in Path(bag).iterdir() if path.suffix in (".db3", ".mcap")]
        shutil.copy(file, folder / f"plain{file.suffix}")
    split = [("/gyro", logs.IMU, stamps, rows.T), ("/accel", logs.IMU, stamps[::3], rows.T[::3] * [[0, 0, 0, 1, 1, 1]])]
    split.append(("/warm", "sensor_msgs/msg/Temperature", stamps[::7], rows[:1, ::7].T))
    for suffix in (".bag", ".db3", ".mcap"):
        logs.write_topics(folder / f"split{suffix}", split)
    return sorted(path for path in folder.iterdir() if path.is_file())


def changed(content: bytes, rng: np.random.Generator) -> bytes:
    """The bytes of a file with one to four things done to them, at the start and the end more often than between."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        n = len(data)
        if n < 16:
            return bytes(data)
        at = int(rng.choice([rng.integers(n), rng.integers(min(n, 600)), max(n - 600, 0) + rng.integers(min(n, 600))]))
        what = rng.integers(7)
        if what == 0:
            data[at] ^= 1 << int(rng.integers(8))
        elif what == 1:
            data[at : at + int(rng.integers(1, 64))] = rng.bytes(int(rng.integers(64)))
        elif what == 2:
            del data[at:]
        elif what == 3:
            del data[at : at + int(rng.integers(1, 200))]
        elif what == 4:
            data[at:at] = data[: int(rng.integers(1, 300))]
        elif what == 5:
            data[at : at + 8] = struct.pack(
                "<Q", int(rng.choice(np.array([0, 2**63 - 1, 2**63, 2**64 - 1], np.uint64)))
            )
        else:
            data[at : at + 4] = struct.pack("<I", int(rng.choice([14, 2**16, 10**9, 2**31 - 1, 2**31, 2**32 - 1])))
    return bytes(data)


def senseless(rng: np.random.Generator, n: int) -> Any:
    """An array, a number or a text that may stand under any name."""
    t = np.arange(n)
    choices: list[Any] = [rng.standard_normal(n), t / 100, t * 1e4, t[::-1] / 100.0, np.zeros(n), np.full(n, np.nan)]
    choices += [
        np.r_[t[:-1] / 100, 1e300],
        np.r_[-1e308, t[1:]],
        rng.choice([-1e308, 1e308], (n, 4)),
        t.astype(complex),
    ]
    choices += [t.astype(np.float16), np.full(n, 2**63, np.uint64), t % 2 == 0, rng.standard_normal((3, n)), "deg/s"]
    choices += [
        rng.standard_normal((3, 2, n)),
        np.array([WORDS[i % len(WORDS)] for i in t]),
        100.0,
        0.0,
        np.inf,
        1e-320,
    ]
    choices += [b"\xff", np.array([1, 2]), 2**62, 1j, "\ud800", np.array(["a", "a"]), np.array([b"\xff", b"b", b"c"])]
    return choices[rng.integers(len(choices))]


def composed(path: Path, rng: np.random.Generator) -> bool:
    """Write a sound file of senseless content; whether the format takes it."""
    n = int(rng.choice([2, 3, 60, 300]))
    content = {NAMES[rng.integers(len(NAMES))]: senseless(rng, n) for _ in range(rng.integers(1, 6))}
    if rng.random() < 0.7:  # sound but for the rest
        content |= {"gyro": rng.standard_normal((3, n)), "fs": 100.0}
    try:
        if path.suffix == ".npz":
            np.savez(path, **content)
        elif path.suffix in (".csv", ".tsv", ".txt"):
            between = {".csv": str(rng.choice([",", ";", ", "])), ".tsv": "\t", ".txt": " "}[path.suffix]
            lines = [between.join(["time", *(str(name) for name in content)])]
            for i in range(n):
                cells = [f"{i / 100}", *(f"{x:.6g}" for x in rng.standard_normal(len(content)))]
                if rng.random() < 0.05:
                    cells[rng.integers(len(cells))] = WORDS[rng.integers(len(WORDS))]
                lines.append(between.join(cells))
            encoding = str(rng.choice(["utf-8", "utf-16", "latin-1", "utf-32"], p=[0.7, 0.1, 0.1, 0.1]))
            path.write_bytes(str(rng.choice(["\n", "\r\n", "\r"])).join(lines).encode(encoding, "replace"))
        elif path.suffix == ".parquet":
            flat = {name: np.resize(np.asarray(value), n) for name, value in content.items()}
            logs.write_parquet(path, flat, {b"fs": b"100", b"\xff": b"\xff"} if rng.random() < 0.5 else None)  # type: ignore[dict-item]
        elif path.suffix == ".h5":
            logs.write_hdf5(path, {name.replace("/", "_"): value for name, value in content.items()})
        elif path.suffix == ".mat":
            logs.write_mat5(path, {name: {"v": value} for name, value in content.items() if name.isidentifier()})
        else:
            return False
    except Exception:  # what a format cannot hold is no input
        return False
    return True


def inputs(folder: Path, n_inputs: int, rng: np.random.Generator) -> Iterator[tuple[str, Path | list[Path]]]:
    """Kinds of log with their paths, each of which may be overwritten afterwards."""
    for name, (make, _) in CASES.items():
        place = folder / name
        place.mkdir()
        yield f"hostile {name.partition('_')[0]}", make(place)
    (folder / "sound").mkdir()
    small = [p for p in folder.glob("*/a.*") if p.is_file() and p.stat().st_size < 2**20]
    sound = sound_logs(folder / "sound")
    for path in sound:
        yield f"sound {path.suffix}", path
    starts = sound * 3 + sorted(small)
    for number in range(n_inputs):
        start = starts[number % len(starts)]
        path = folder / f"input{start.suffix}"
        path.unlink(missing_ok=True)
        if number % 3 or not composed(path, rng):
            path.write_bytes(changed(start.read_bytes(), rng))
        yield start.suffix, path


def _read_for(log: Path | list[Path], path: Path, quantity: str) -> tuple[str, str]:
    """How the reading of a log for one quantity ended, and what was said."""
    try:
        recording = gf.read_recording(log, rate=100.0 if path.suffix == ".npy" else None, quantity=quantity)
        (str(recording) + json.dumps(recording.to_dict(), allow_nan=False)).encode()
    except (RecordingError, OSError) as error:
        return ("refused" if path.name in str(error) else "nameless"), str(error)
    except BaseException as error:
        return "nameless", f"{type(error).__name__}: {error}"
    return "read", ""


def read(log: Path | list[Path], answer: Connection) -> None:
    """Read a log for both quantities as this process's last deed, and send how it ended."""
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    path = log[0] if isinstance(log, list) else log
    ends = [_read_for(log, path, quantity) for quantity in ("rate", "acceleration")]
    # nameless where either is, else read where either is
    ended, said = min(ends, key=lambda end: ("nameless", "read", "refused").index(end[0]))
    if ended != "nameless" and path.suffix in (".npy", ".npz", ".h5", ".parquet"):
        try:
            gf.open_recording(path).read(0, 2)
        except (RecordingError, OSError) as error:
            if path.name not in str(error):
                ended, said = "nameless", f"open_recording: {error}"
        except BaseException as error:
            ended, said = "nameless", f"open_recording: {type(error).__name__}: {error}"
    answer.send((ended, said))


def outcome(log: Path | list[Path]) -> tuple[str, str]:
    """How the reading of a log ended, and what was said."""
    here, there = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=read, args=(log, there))
    process.start()
    there.close()
    try:
        return here.recv() if here.poll(SECONDS) else ("hang", f"over {SECONDS} s")
    except EOFError:
        process.join()
        return "crash", f"exit status {process.exitcode}"
    finally:
        process.kill()
        process.join()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="200 inputs beside the hostile ones, not 20,000")
    parser.add_argument("--inputs", type=int, help="number of inputs beside the hostile ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for the logs that failed")
    options = parser.parse_args()
    n_inputs = options.inputs if options.inputs is not None else 200 if options.quick else 20_000
    counts: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for number, (kind, log) in enumerate(inputs(Path(folder), n_inputs, np.random.default_rng(options.seed))):
            ended, said = outcome(log)
            counts[kind, ended] += 1
            if ended in FAILURES:
                print(f"{ended}: {kind}, input {number}: {said[:300]}", flush=True)
                if options.keep and isinstance(log, Path) and log.is_file():
                    options.keep.mkdir(exist_ok=True)
                    shutil.copy(log, options.keep / f"{options.seed}_{number}{log.suffix}")
    ends = ("read", "refused", *FAILURES)
    print(f"{'seed ' + str(options.seed):16}" + "".join(f"{end:>10}" for end in ends))
    for kind in [*dict.fromkeys(kind for kind, _ in counts), "all"]:
        row = [sum(n for (k, e), n in counts.items() if e == end and kind in (k, "all")) for end in ends]
        print(f"{kind:16}" + "".join(f"{n:10}" for n in row))
    # Of the processes that read, with what they share with this one.
    most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(f"largest memory of an input: {most:.2f} GiB")
    return int(any(ended in FAILURES for _, ended in counts))


if __name__ == "__main__":
    sys.exit(main())
