"""Small recordings in the layout of the public ones: what tests of those see in a clone that has no others.

Counts, units, orientations, gaps and saturation are as in the instruments' files; noise and motion are drawn.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import gyrofuse as gf

FRONT_OF_BACK = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_GYRO_FIRST, _ACCELEROMETER_FIRST = ["gx", "gy", "gz", "ax", "ay", "az"], ["ax", "ay", "az", "gx", "gy", "gz"]


def make_recordings(folder: Path) -> None:
    """Write all files into an existing folder."""
    for number in (1, 2, 3):
        np.savez(folder / f"adis16405_rec{number}.npz", **_single_unit_at_rest(number))
    np.savez(folder / "mimu4444_8imu.npz", **_board_of_eight())
    np.savez(folder / "xsensdot10_static.npz", **_ten_units_at_rest())
    np.savez(folder / "mtig_contaminated_gx.npz", gyro_x=_contaminated())


def _drawn(model: gf.Model, shape: tuple[int, ...], seed: int) -> NDArray[np.float64]:
    return model.simulate(shape[-1], batch=shape[:-1], generator=torch.Generator().manual_seed(seed)).numpy()


def _single_unit_at_rest(number: int) -> dict[str, object]:
    """Six axes in counts of 16 bits, whose slow noise forgets faster in every further recording."""
    model = gf.WhiteNoise(16.0) + gf.AR1((0.9, 0.99, 0.999)[number - 1], 0.05) + gf.RandomWalk(1e-5)
    return {
        "counts": np.round(_drawn(model, (6, 50_000), number)).astype(np.int16),
        "channels": _GYRO_FIRST,
        "scale": [0.05] * 3 + [0.00333] * 3,
        "units": ["deg/s"] * 3 + ["g"] * 3,
        "fs": 100.0,
    }


def _board_of_eight() -> dict[str, object]:
    """Five sessions: 20 orientations at rest, a turn by hand beyond the full scale; every other unit at the back."""
    made: dict[str, object] = {"channels": _ACCELEROMETER_FIRST, "fs": 62.5, "ts_hz": 64e6}
    made |= {"scale": [2.0**-11] * 3 + [1 / 16.4] * 3, "units": ["g"] * 3 + ["deg/s"] * 3}
    for session in range(1, 6):
        rest, turn = np.zeros(1400), 3000 * np.sin(np.pi * np.arange(100) / 100)  # counts
        motion = np.concatenate([rest, turn] * 20 + [60_000 * np.sin(np.arange(1500) / 40)])
        rate = motion * np.array([[0.6], [-0.5], [0.62]])  # (axis, time), of the board's front
        orientation = np.repeat(np.random.default_rng(session).uniform(-1, 1, (20, 3)), 1500, axis=0)
        force = np.concatenate([2048 * orientation, np.zeros((1500, 3))]).T
        both = np.stack([force, rate])  # (kind, axis, time)
        units = [both if unit % 2 == 0 else np.einsum("ab,kbt->kat", FRONT_OF_BACK, both) for unit in range(8)]
        noise = _drawn(gf.WhiteNoise(9.0) + gf.RandomWalk(1e-4), (8, 6, len(motion)), 10 + session)
        counts = np.stack(units).reshape(8, 6, -1) + noise * np.linspace(0.8, 1.6, 8)[:, None, None]
        made[f"exp{session}"] = counts.round().clip(-32768, 32767).astype(np.int16).transpose(2, 0, 1)
        made[f"ts{session}"] = np.arange(len(motion), dtype=np.int64) * 1_024_000 % 2**32
    return made


def _ten_units_at_rest() -> dict[str, object]:
    """Ten units, quieter ones with larger random walks, one row of one of them never finite."""
    data = np.linspace(0.05, 0.1, 10)[:, None, None] * _drawn(gf.WhiteNoise(1.0), (10, 6, 14_000), 31)
    data += np.geomspace(4e-3, 2e-4, 10)[:, None, None] * _drawn(gf.RandomWalk(1.0), (10, 6, 14_000), 41)
    data = data.astype(np.float32)
    data[0, :, -1] = np.nan
    return {"data": data, "channels": _GYRO_FIRST, "units": ["deg/s"] * 3 + ["m/s^2"] * 3, "fs": 120.0}


def _contaminated() -> NDArray[np.float32]:
    """White noise and a random walk, one sample of 2000 far off: together as much variance as the white noise."""
    n, rng = 400_000, np.random.default_rng(41)
    noise = _drawn(gf.WhiteNoise(1e-4) + gf.RandomWalk(1e-7), (n,), 42)
    far_off = (rng.random(n) < 1 / 2000) * rng.standard_normal(n) * 0.47
    return (noise + far_off).astype(np.float32)
