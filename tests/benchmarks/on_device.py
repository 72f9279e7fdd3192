"""What a CUDA device makes of the heavy parts, beside the processor of the same machine.

    python tests/benchmarks/on_device.py [--quick] [--only WCCV]

Seconds are medians of several runs, of long fits one, the device waited for at both ends; "off by" is the largest
difference from the processor's result, over the largest value of it.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor, nn

import gyrofuse as gf

Call = Callable[[Tensor], Tensor]


def seconds_of(call: Call, signal: Tensor, runs: int) -> tuple[float, Tensor]:
    """Median seconds, and the result."""
    spent = []
    for _ in range(runs + 1):  # the first warms up
        torch.cuda.synchronize()
        start = time.perf_counter()
        result = call(signal)
        torch.cuda.synchronize()
        spent.append(time.perf_counter() - start)
    return statistics.median(spent[1:] or spent), result


def fitted(model: str, signal: Tensor) -> Tensor:
    """The wavelet variance of the fitted models, which is settled where parameters may trade places."""
    return gf.fit_gmwm(signal, model).fitted_wavelet_variance


def cases(quick: bool) -> Iterator[tuple[str, Call, Tensor, int]]:
    """Name, call, signal and number of runs of each."""
    generator = torch.Generator().manual_seed(0)

    def noise(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
        return torch.randn(*shape, dtype=dtype, generator=generator)

    n = 10**6 if quick else 10**7
    for dtype in (torch.float64, torch.float32):
        signal = noise(12, n, dtype=dtype)
        yield f"WCCV 12 x {n:,}, 19 levels, {dtype}", lambda x: gf.wavelet_cross_covariance(x, 19), signal, 3
    layers = nn.Sequential(gf.HaarFilterBank(10), gf.CrossCovariance(), gf.SVOWeights("long"))
    yield f"filter bank, covariances, weights of 64 arrays 6 x {n // 100:,}", layers, noise(64, 6, n // 100), 3
    batch = 32 if quick else 256
    walk = 1e-3 * noise(batch, 4, 20_000).cumsum(-1)
    signal = noise(batch, 4, 20_000) + walk
    for model in ("WN + RW", "WN + AR1 + RW"):
        fit = partial(fitted, model)
        yield f"GMWM {model} of {4 * batch} sensors of 20,000", fit, signal, 1
    length = 20_000 if quick else 2**17
    apart = noise(6, length) + 0.1 * torch.sin(0.3 * torch.arange(length, dtype=torch.float64))
    alike = noise(6, length)

    def judged(recording: Tensor) -> Tensor:
        found = gf.diagnose(recording, alike.to(recording), rate=100.0)
        return torch.tensor([found.p_value, len(found.findings)], dtype=torch.float64)

    yield f"diagnose 6 x {length:,}, a tone", judged, apart, 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the size")
    parser.add_argument("--only", default="", help="cases whose name has this")
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("no CUDA device is to be had here")
    print(f"torch {torch.__version__}, {torch.cuda.get_device_name()}, {torch.get_num_threads()} threads\n")
    print("| what | processor | device | ratio | off by |\n|---|---|---|---|---|", flush=True)
    for name, call, signal, runs in cases(arguments.quick):
        if arguments.only not in name:
            continue
        here, wanted = seconds_of(call, signal, runs)
        if isinstance(call, nn.Module):
            call.cuda()
        there, got = seconds_of(call, signal.cuda(), runs)
        off = (got.detach().cpu().double() - wanted.detach().double()).abs().max() / wanted.detach().abs().max()
        print(f"| {name} | {here:.3f} s | {there:.3f} s | {here / there:.1f} | {float(off):.1e} |", flush=True)


if __name__ == "__main__":
    main()
