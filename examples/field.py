"""A day in the field: sensors drop out, return with another offset, saturate, and one of them goes wrong.

Six gyros are fitted at rest. A stream with all of that is then fused chunk by chunk, without a step in the output, and
watched by a parity test that names the sensor at fault, which is left out from then on.

    python examples/field.py [--hours 0.5] [--plot field.png]
"""

import argparse

import torch

import gyrofuse as gf
from gyrofuse.fusion.faults.parity import parity_test
from gyrofuse.fusion.faults.reference import fit_parity_reference
from gyrofuse.fusion.live import LiveSVO
from gyrofuse.io.saturation import find_saturation, mask_saturated

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--hours", type=float, default=0.5, help="length of the stream")
parser.add_argument("--plot", help="where a figure of it goes")
arguments = parser.parse_args()

rate, window = 50.0, 500
n_samples = max(int(arguments.hours * 3600 * rate) // window, 40) * window
generator = torch.Generator().manual_seed(0)
noise = gf.ArrayModel(
    [
        (gf.WhiteNoise(0.01), torch.eye(6)),
        (gf.RandomWalk(1e-8), torch.diag(torch.tensor([1.0, 2.0, 4.0, 8.0, 8.0, 16.0]))),
    ]
)
offsets = torch.randn(6, 1, generator=generator, dtype=torch.float64)  # deg/s
everything = noise.simulate(60_000 + n_samples, generator=generator) + offsets
calibration, stream = everything[:, :60_000], everything[:, 60_000:]

# The stream: a motion that all sensors feel, and what happens to some of them.
time = torch.arange(n_samples, dtype=torch.float64) / rate
motion = 20 * torch.sin(2 * torch.pi * time / 7) + torch.where((time % 120) < 10, 40.0, 0.0)
stream = stream + motion
away = slice(n_samples // 5, 2 * n_samples // 5)
stream[1, away] = torch.nan
stream[1, away.stop :] += 0.5  # back with another offset
stream[2] = stream[2].clamp(-55, 55)  # less range than the motion takes
lost = torch.rand(stream.shape, generator=generator) < 0.005
stream = torch.where(lost, torch.nan, stream)  # packets
onset = 7 * n_samples // 10
stream[4, onset:] *= -1

full_scale = find_saturation(stream)
print("Full scale found (deg/s):", ", ".join(f"{value:g}" for value in full_scale.tolist()))
stream = mask_saturated(stream, full_scale)

live = LiveSVO("long")
live.fit(calibration)
reference = fit_parity_reference(calibration, window)
live(calibration)  # the stream follows the calibration: its offsets are known from there
print(live)

faulty = torch.zeros(6, dtype=torch.bool)
history, virtual = calibration[:, -16 * window :], []
for chunk in stream.split(20 * window, dim=-1):
    watched = torch.where(faulty[:, None], torch.nan, chunk)
    result = parity_test(watched, reference, history=history, false_alarm=1e-4)
    for fault in result.faults:
        start = sum(len(part) for part in virtual) / rate + fault.start / rate
        print(f"{start:8.1f} s: {fault.sentence}")
    faulty |= result.faulty.any(0)
    watched = torch.where(faulty[:, None], torch.nan, chunk)
    history = torch.cat([history, watched], -1)[:, -16 * window :]
    virtual.append(live(watched))

error = torch.cat(virtual) - motion
middle = error.reshape(-1, window).mean(-1)
print(f"Left out: {', '.join(str(i + 1) for i in faulty.nonzero().flatten().tolist()) or 'none'}")
print(f"Noise of the virtual gyro {error.std():.4f} deg/s; its largest step between means of 10 s")
print(f"is {middle.diff().abs().max():.4f} deg/s")
plain = torch.nanmean(stream, 0) - motion
steps = plain.reshape(-1, window).nanmean(-1).diff().abs()
print(f"That of the mean of whatever is there: {steps.max():.4f} deg/s")

if arguments.plot:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
    ax.plot(time[::window], plain.reshape(-1, window).nanmean(-1), color="#d55e00", label="mean of whatever is there")
    ax.plot(time[::window], middle, color="#0072b2", label="live SVO")
    ax.set(xlabel="time (s)", ylabel="error, means of 10 s (deg/s)")
    ax.legend()
    figure.savefig(arguments.plot, dpi=120)
    print(f"The figure is in {arguments.plot}.")
