"""From a logged gyro array to one virtual gyro.

python examples/fuse_log.py LOG [LOG ...] [--axis z] [--out virtual.npz]
"""

import argparse

import gyrofuse as gf

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("log", nargs="+", help="recording at rest, any format gyrofuse reads; several files are one array")
parser.add_argument("--axis", choices=["x", "y", "z"], help="fuse this axis alone")
parser.add_argument("--out", default="virtual.npz", help="where the virtual gyro goes")
parser.add_argument("--force", action="store_true", help="replace an existing file")
arguments = parser.parse_args()

recording = gf.read_recording(arguments.log, axis=arguments.axis)
print(recording, "\n")

result = gf.fit_svo(recording, scale_weights="long")
print(result)

virtual = result.virtual(recording)  # (time,), or (axis, time) when the log holds several axes
fused = gf.Recording(virtual.unsqueeze(-2), rate=recording.rate, unit=recording.unit, axes=recording.axes)
fused.save(arguments.out, force=arguments.force)
print(f"\nThe virtual gyro is in {arguments.out}.")
