"""SVO as a layer in a DataLoader pipeline over a batch of arrays.

Sixty-four arrays of six gyros, each with noise of its own, pass through one `nn.Sequential` that maps signals to
optimal weights; the same modules fuse them. Everything is batched, differentiable and runs where the data are.

    python examples/pipeline.py [--arrays 64] [--samples 16384]
"""

import argparse

import torch
from torch.utils.data import DataLoader, TensorDataset

import gyrofuse as gf

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--arrays", type=int, default=64)
parser.add_argument("--samples", type=int, default=16_384)
arguments = parser.parse_args()

device = "cuda" if torch.cuda.is_available() else "cpu"
generator = torch.Generator().manual_seed(0)
n_sensors, n_levels = 6, 10

# Every sensor of every array has white noise and a random walk of its own size.
white = torch.rand(arguments.arrays, n_sensors, generator=generator, dtype=torch.float64) + 0.5
walk = 1e-3 * torch.rand(arguments.arrays, n_sensors, generator=generator, dtype=torch.float64)
noise = gf.WhiteNoise(white) + gf.RandomWalk(walk)
arrays = noise.simulate(arguments.samples, generator=generator)  # (array, sensor, time)

to_weights = torch.nn.Sequential(
    gf.HaarFilterBank(n_levels),  # coefficients per level
    gf.CrossCovariance(),  # (array, level, sensor, sensor)
    gf.SVOWeights("long"),  # (array, sensor)
).to(device)

gains = []
for (batch,) in DataLoader(TensorDataset(arrays), batch_size=16):
    signal = batch.to(device)
    weights = to_weights(signal)
    virtual = torch.einsum("as,ast->at", weights, signal)  # (array, time)
    both = torch.stack([virtual, signal.mean(-2)], dim=-2)
    fused, mean = gf.wavelet_variance(both, n_levels)[..., -1, :].unbind(-1)  # at the longest scale
    gains.append((fused / mean).sqrt().cpu())

gain = torch.cat(gains)
print(f"{arguments.arrays} arrays of {n_sensors} gyros, {arguments.samples} samples each, on {device}")
print(f"Allan deviation of the virtual gyro over that of the plain mean at {2 ** (n_levels - 1)} samples:")
print(f"median {gain.median():.3f}, best {gain.min():.3f}, worst {gain.max():.3f}")
