"""Fit a noise model to a recording with wild samples, by the classic and by the robust wavelet variance.

The recording is any file that `gyrofuse.read_recording` knows; without one, white noise and a random walk are simulated
with a spike of 50 standard deviations in one sample of 20 000. Where the two wavelet variances differ at short levels
there are outliers; where the robust fit's J test refuses the model, they are too many for the longer levels.

    python examples/robust_fit.py [LOG] [--model "WN + RW"] [--efficiency 0.6] [--out robust_fit.png]
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import torch

import gyrofuse as gf

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("log", nargs="?", type=Path)
parser.add_argument("--model", default="WN + RW")
parser.add_argument("--efficiency", type=float, default=0.6)
parser.add_argument("--levels", type=int)
parser.add_argument("--out", type=Path, default=Path("robust_fit.png"))
arguments = parser.parse_args()
arguments.out.parent.mkdir(parents=True, exist_ok=True)

if arguments.log is None:
    truth = gf.parse_model("WN(variance=1) + RW(variance=1e-6)")
    generator = torch.Generator().manual_seed(0)
    signal = truth.simulate(500_000, batch=(1,), generator=generator)
    spikes = 50 * (torch.rand(signal.shape, generator=generator) < 1 / 20_000)
    recording = gf.Recording(signal + spikes, rate=100.0)
    print(f"simulated: {truth}, {int((spikes > 0).sum())} spikes in {signal.shape[-1]} samples\n")
else:
    recording = gf.read_recording(arguments.log).axes_as_sensors()
    if recording.axes:  # of several devices
        recording = recording.select(axis=recording.axes[0])

options = {"model": arguments.model, "n_levels": arguments.levels}
classic = gf.fit_gmwm(recording, **options)
robust = gf.fit_gmwm(recording, efficiency=arguments.efficiency, **options)

time_unit = "seconds" if recording.rate else "samples"
print(f"{time_unit:>14}  {'classic WV':>12}  {'robust WV':>12}  ratio   (sensor {recording.sensors[0]})")
pairs = zip(classic.wavelet_variance[:, 0].tolist(), robust.wavelet_variance[:, 0].tolist(), strict=False)
for level, (mean_square, bounded) in enumerate(pairs):
    time = 2**level / (recording.rate or 1)
    print(f"{time:>14g}  {mean_square:>12.5g}  {bounded:>12.5g}  {mean_square / bounded:5.3f}")

print(f"\n{'parameter':<24}{'classic':>12}  {'95 % interval':^27}{'robust':>12}  {'95 % interval':^27}")
for k, name in enumerate(classic.param_names):
    columns = []
    for fit in (classic, robust):
        value, low, high = (t[0, k].item() for t in (fit.params, *fit.confidence_interval))
        columns.append(f"{value:>12.5g}  [{low:>11.5g}, {high:>11.5g}]  ")
    print(f"{name:<24}{''.join(columns)}")
print(f"{'J test, p':<24}{classic.p_value[0].item():>12.2g}{robust.p_value[0].item():>41.2g}")

figure, axes = plt.subplots(1, 2, figsize=(11, 4.5))
for ax, fit in zip(axes, (classic, robust), strict=True):
    fit.plot(ax=ax)
    ax.set_title("classic" if fit.efficiency == 1 else f"robust, efficiency {fit.efficiency:g}", loc="left")
lows, highs = zip(*(ax.get_ylim() for ax in axes), strict=True)
for ax in axes:
    ax.set_ylim(min(lows), max(highs))
figure.tight_layout()
figure.savefig(arguments.out, dpi=120)
print(f"\nThe figure is in {arguments.out}.")
