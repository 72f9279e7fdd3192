"""`gyrofuse fuse` on logs of every format, made up and real."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Run
from logs import (
    made_up,
    regular_stamps,
    write_hdf5,
    write_mat5,
    write_mat73,
    write_parquet,
    write_ros1,
    write_ros2,
    write_ulog,
)

import gyrofuse as gf


def logs_of_every_format(folder: Path) -> dict[str, list[Path]]:
    """One array of two devices at rest, in every format that is read."""
    gyro, stamps = made_up(n_samples=300), regular_stamps(300)
    devices = {f"imu{i}": {"gyro": rates} for i, rates in enumerate(gyro)}
    columns = {f"imu{i}_g{axis}": rates[k] for i, rates in enumerate(gyro) for k, axis in enumerate("xyz")}
    table = np.column_stack([np.arange(300) / 100, *columns.values()])
    for name, delimiter in (("a.csv", ","), ("a.tsv", "\t")):
        header = delimiter.join(["time_s", *columns])
        np.savetxt(folder / name, table, delimiter=delimiter, header=header, comments="", fmt="%.17g")
    np.savez(folder / "a.npz", gyro=gyro.transpose(1, 0, 2), fs=100.0)
    mcap = write_ros2(folder / "mcap", gyro, stamps, mcap=True)
    return {
        "npz": [folder / "a.npz"],
        "csv": [folder / "a.csv"],
        "tsv": [folder / "a.tsv"],
        "parquet": [write_parquet(folder / "a.parquet", {"time_s": table[:, 0], **columns})],
        "mat v5": [write_mat5(folder / "5.mat", devices | {"fs": 100.0})],
        "mat v7.3": [write_mat73(folder / "73.mat", devices | {"fs": np.array([[100.0]])})],
        "hdf5": [write_hdf5(folder / "a.h5", devices, fs=100.0)],
        "ulog": [write_ulog(folder / "a.ulg", gyro, stamps)],
        "ros 1": [write_ros1(folder / "a.bag", gyro, stamps)],
        "ros 2": [write_ros2(folder / "ros2", gyro, stamps)],
        "mcap folder": [mcap],
        "mcap file": [next(mcap.glob("*.mcap"))],
    }


def test_every_format_gives_the_same_virtual_gyro(run: Run, tmp_path: Path):
    rates = torch.from_numpy(made_up(n_samples=300)[:, 2])
    expected = gf.fit_svo(rates).weights
    for name, paths in logs_of_every_format(tmp_path).items():
        done = run("fuse", *paths, "--axis", "z", "--json", "result.json", "--force")
        assert done.status == 0, f"{name}: {done.err}"
        weights = json.loads((tmp_path / "result.json").read_text())["weights"]
        np.testing.assert_allclose(weights, expected, rtol=1e-5, err_msg=name)  # the ULog holds float32


BOARD = ["mimu4444_8imu.npz", "--key", "exp1", "--axis", "x", "--mounting", "mounting.json", "--rest", "0:20"]


@pytest.mark.parametrize("arguments", [["xsensdot10_static.npz"], BOARD], ids=["units", "board"])
def test_arrays_are_fused(run: Run, tmp_path: Path, data: Path, arguments: list[str]):
    check_fused(run, tmp_path, data, arguments)


def test_real_logs(run: Run, tmp_path: Path, shared: Path, subtests: pytest.Subtests):
    for arguments in (
        ["xsensdot4_quadrotor.npz", "--axis", "z"],
        ["raw/xsens_dot1_flight.csv", "raw/xsens_dot2_flight.csv", "--axis", "z"],
    ):
        with subtests.test(log=arguments[0]):
            check_fused(run, tmp_path, shared / "data", [*arguments, "--force"])


def check_fused(run: Run, tmp_path: Path, data: Path, arguments: list[str]) -> None:
    back = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]
    (tmp_path / "mounting.json").write_text(json.dumps({str(i): back for i in (2, 4, 6, 8)}))
    files = [str(data / a) if a.endswith((".npz", ".csv")) else a for a in arguments]
    done = run("fuse", *files, "--json", "result.json", "--out", "virtual.npz")
    assert done.status == 0, done.err
    weights = np.array(json.loads((tmp_path / "result.json").read_text())["weights"])
    np.testing.assert_allclose(weights.sum(-1), 1, rtol=1e-9)
    virtual = gf.read_recording(tmp_path / "virtual.npz").signal
    assert virtual.isfinite().double().mean() > 0.97  # all but the samples that a sensor lacks


SINGLE_DEVICES = [
    "px4_sample.ulg",
    "px4_sample_log_small.ulg",
    "broad_24_tapping.mat",
    "broad_24_tapping.hdf5",
    "mpu6050_gyroscope_v73.mat",
]


def test_single_devices_have_axes_and_cannot_be_fused(run: Run, shared: Path, subtests: pytest.Subtests):
    for log in SINGLE_DEVICES:
        with subtests.test(log=log):
            check_single_device(run, shared / "data" / "raw" / log)


def test_a_single_device_has_axes_and_cannot_be_fused(run: Run, made: Path):
    check_single_device(run, made / "adis16405_rec1.npz")


def check_single_device(run: Run, path: Path) -> None:
    log = path.name
    done = run("info", path, "--json", f"{log}.json")
    assert done.status == 0, done.err
    done = run("fuse", path)
    assert (done.status, done.err) == (
        2,
        f"error: {log}: expected several devices to fuse, found one with the axes x, y, z; give the logs of all "
        "devices of the array\n",
    )
