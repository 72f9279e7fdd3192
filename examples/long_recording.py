"""Fuse a recording that never exists as a whole, with the work shared by processes.

Six gyros with correlated white noise and random walks are made on the fly, block by block: the noise of a block comes
from a generator seeded by its number, and between its ends, which are drawn beforehand, every walk is a bridge. So any
process can make any stretch, always with the same samples, and no process makes what it does not need. Each takes a
stretch of time; `lightning.fabric.Fabric` starts them, and what they add up are sums of products.

    python examples/long_recording.py [--samples 2000000] [--devices 2] [--levels 16] [--check] [--out virtual.npy]
"""

import argparse
import resource
import sys
import time
from pathlib import Path

import torch
from lightning.fabric import Fabric

import gyrofuse as gf

N_SENSORS, RATE, BLOCK = 6, 100.0, 2**16


class Blocks:
    """The recording: `blocks(start, stop)` makes the samples `(sensor, stop - start)`, and counts the time it takes.

    Args:
        n_samples: Length of the whole.
        seed: Of all its noise.
    """

    def __init__(self, n_samples: int, seed: int) -> None:
        self.seed, self.seconds = seed, 0.0
        sensor = torch.arange(N_SENSORS, dtype=torch.float64)
        own = torch.diag(0.02 * (1 + 0.3 * sensor))  # deg/s
        self.mix = own + 0.006 * torch.cos(sensor[:, None] * (1 + sensor))  # correlates the white noise
        self.step = 1e-5 * 2 ** (2 - sensor)[:, None]  # of the walks; those with less white noise wander more
        # Where the walks are at the ends of the blocks: sums of BLOCK steps each.
        sums = torch.randn(N_SENSORS, -(-n_samples // BLOCK), generator=self.generator(0), dtype=torch.float64)
        self.knots = torch.nn.functional.pad(self.step * BLOCK**0.5 * sums.cumsum(-1), (1, 0))
        self.along = torch.arange(1, BLOCK + 1, dtype=torch.float64) / BLOCK

    def generator(self, number: int) -> torch.Generator:
        return torch.Generator().manual_seed(1_000_003 * self.seed + number)

    def block(self, number: int) -> torch.Tensor:
        noise = torch.randn(2, N_SENSORS, BLOCK, generator=self.generator(number + 1), dtype=torch.float64)
        walk = self.step * noise[1].cumsum(-1)
        start, end = self.knots[:, number, None], self.knots[:, number + 1, None]
        walk += start + self.along * (end - start - walk[:, -1:])  # bends the free walk into a bridge
        return walk.addmm_(self.mix, noise[0])

    def __call__(self, start: int, stop: int) -> torch.Tensor:
        began = time.perf_counter()
        first = start // BLOCK
        blocks = [self.block(number) for number in range(first, -(-stop // BLOCK))]
        samples = torch.cat(blocks, -1)[:, start - first * BLOCK : stop - first * BLOCK]
        self.seconds += time.perf_counter() - began
        return samples


def peak_memory() -> float:
    """Most memory that this process ever had, in MB."""
    status = Path("/proc/self/status")
    if status.exists():  # what the other call says begins with what the process had that started this one
        return int(status.read_text().split("VmHWM:")[1].split()[0]) * 1.024e-3
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kilobytes / (1e6 if sys.platform == "darwin" else 1e3)  # macOS counts bytes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=2_000_000, help="of each sensor")
    parser.add_argument("--devices", type=int, default=1, help="processes that share the work")
    parser.add_argument("--levels", type=int, default=16)
    parser.add_argument("--scale-weights", default="long", choices=("flat", "short", "long"))
    parser.add_argument("--chunk", type=int, help="samples read at a time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--check", action="store_true", help="compare with the same in memory, all at once")
    parser.add_argument("--out", type=Path, help="where the virtual gyro goes, a .npy file")
    arguments = parser.parse_args()
    for name in ("samples", "devices", "levels", "chunk"):
        if (value := getattr(arguments, name)) is not None and value < 1:
            parser.error(f"--{name}: expected a whole number >= 1, got {value}")
    if arguments.levels > 62 or arguments.samples < 2**arguments.levels:
        parser.error(
            f"--levels: expected at most {arguments.samples.bit_length() - 1} for {arguments.samples} samples "
            f"(2**levels <= samples), got {arguments.levels}"
        )
    if not 0 <= arguments.seed < 2**31:
        parser.error(f"--seed: expected a whole number from 0 to 2**31 - 1, got {arguments.seed}")
    if arguments.out is not None and (arguments.out.suffix != ".npy" or arguments.out.exists()):
        parser.error(f"--out: expected a new name that ends in .npy, got {arguments.out}")

    fabric = Fabric(accelerator="cpu", devices=arguments.devices, strategy="ddp" if arguments.devices > 1 else "auto")
    fabric.launch()

    source = Blocks(arguments.samples, arguments.seed)
    recording = gf.ChunkedRecording(source, N_SENSORS, arguments.samples, rate=RATE, unit="deg/s")
    before = peak_memory()
    fabric.barrier()
    began = time.perf_counter()
    result = gf.stream_svo(
        recording, arguments.scale_weights, arguments.levels, chunk_samples=arguments.chunk, fabric=fabric
    )
    seconds = time.perf_counter() - began
    # The slowest process and the largest one say what the work takes.
    spent = torch.tensor([source.seconds, peak_memory(), before], dtype=torch.float64)
    making, memory, at_rest = fabric.all_reduce(spent, reduce_op="max").tolist()
    if fabric.is_global_zero:
        print(result)
        values = N_SENSORS * arguments.samples
        rate = f"{values / seconds:.3g} a second"
        print(f"\n{values:.3g} values in {seconds:.2f} s by {fabric.world_size} process(es), {rate};")
        print(f"{making:.2f} s of it went into making them up.")
        print(f"Peak memory of a process {memory:.0f} MB, of which {at_rest:.0f} MB before the first sample.")

    if arguments.out is not None:
        gf.write_virtual(recording, result.weights, arguments.out, chunk_samples=arguments.chunk, fabric=fabric)
        if fabric.is_global_zero:
            print(f"The virtual gyro is in {arguments.out}.")

    if arguments.check and fabric.is_global_zero:
        whole = gf.wavelet_cross_covariance(recording.read(0, arguments.samples), result.n_levels)
        weights = gf.svo_weights(whole, arguments.scale_weights)
        deviation = whole.diagonal(dim1=-2, dim2=-1).sqrt()
        error = (result.wavelet_cross_covariance - whole).abs() / (deviation[:, :, None] * deviation[:, None])
        print(f"In memory, all at once: weights {', '.join(f'{weight:+.5f}' for weight in weights.tolist())}.")
        print(f"Largest difference of a weight {(result.weights - weights).abs().max():.1e},")
        print(f"of the wavelet cross-covariance, over the variances, {error.max():.1e}.")
    fabric.barrier()


if __name__ == "__main__":
    main()
