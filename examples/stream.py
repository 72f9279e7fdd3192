"""Fuse a log that is larger than memory, chunk by chunk, in two passes.

The log is a NumPy file `(sensor, time)` that is mapped, never loaded; without one, the example writes a small one.
Memory holds one chunk and the `2**levels` samples that the longest wavelet looks back on.

    python examples/stream.py [LOG.npy] [--levels 14] [--chunk 1000000] [--out virtual.npy]
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch

import gyrofuse as gf

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("log", nargs="?", type=Path)
parser.add_argument("--levels", type=int, default=14)
parser.add_argument("--chunk", type=int, default=1_000_000)
parser.add_argument("--out", type=Path)
arguments = parser.parse_args()
if arguments.out and arguments.out.exists():
    parser.error(f"{arguments.out} exists already; choose another name")

with tempfile.TemporaryDirectory() as scratch:
    log = arguments.log
    if log is None:
        log = Path(scratch) / "log.npy"
        array = gf.parse_model("WN(variance=1) + RW(variance=1e-6)").simulate(3_000_000, batch=(6,))
        np.save(log, array.numpy())
    signal = np.load(log, mmap_mode="r")  # (sensor, time)
    n_sensors, n_samples = signal.shape
    if n_sensors >= n_samples:
        parser.error(f"{log}: expected (sensor, time), found shape {signal.shape}; transpose it")
    chunks = [slice(start, start + arguments.chunk) for start in range(0, n_samples, arguments.chunk)]

    metric = gf.WaveletCrossCovariance(n_sensors, arguments.levels)
    for chunk in chunks:
        metric.update(torch.from_numpy(np.array(signal[:, chunk], dtype=np.float64)))
    weights = gf.svo_weights(metric.compute(), "long")
    print(f"{n_samples} samples of {n_sensors} gyros in {len(chunks)} chunks; weights {weights.numpy().round(4)}")

    out = arguments.out or Path(scratch) / "virtual.npy"
    virtual = np.lib.format.open_memmap(out, mode="w+", dtype=np.float64, shape=(n_samples,))
    for chunk in chunks:
        virtual[chunk] = weights.numpy() @ signal[:, chunk]
    virtual.flush()
    if arguments.out:
        print(f"The virtual gyro is in {out}.")
