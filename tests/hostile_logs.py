"""Logs made to hang, crash, fill the memory of or mislead a reader: small files, each with what is expected of it.

`CASES` maps a name to a function that writes the log into a folder and gives its path, or its paths, and to a regular
expression that the error has to match; `None` where the log is to be read.
"""

from __future__ import annotations

import io
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from logs import batches, made_up, regular_stamps, write_dataflash, write_hdf5, write_parquet, write_ros2, write_ulog

Log = Path | list[Path]
CASES: dict[str, tuple[Callable[[Path], Log], str | None]] = {}
MANY = 10**6  # characters: what is done in proportion is done in a second, what is done with the square in hours
GYRO = made_up(1, 200)[0]
TIME = np.arange(200) / 100
MAT_HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49)


def case(expected: str | None) -> Callable[[Callable[[Path], Log]], Callable[[Path], Log]]:
    def add(make: Callable[[Path], Log]) -> Callable[[Path], Log]:
        CASES[make.__name__] = make, expected
        return make

    return add


def csv(folder: Path, head: str, extra: str = "", name: str = "a.csv", time: np.ndarray = TIME) -> Path:
    """A table of time and three axes, with a line above the numbers and one below."""
    rows = [f"{t!r},{x!r},{y!r},{z!r}" for t, x, y, z in zip(time.tolist(), *GYRO.tolist(), strict=True)]
    path = folder / name
    path.write_text("\n".join([head, *rows, extra]) + "\n", encoding="utf-8")
    return path


def npz(folder: Path, **arrays: Any) -> Path:
    np.savez(folder / "a.npz", **arrays)
    return folder / "a.npz"


def npy_header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (63 - (10 + len(text)) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


# --- text -------------------------------------------------------------------------------------------------------------


@case("line 202: expected lines of numbers, found one of more than 131072 characters")
def text_blanks_in_a_line(folder: Path) -> Log:
    return csv(folder, "time,gx,gy,gz", "2.00," + " " * MANY + "1,2,3")


@case("line 1: expected lines of numbers, found one of more than")
def text_without_line_ends(folder: Path) -> Log:
    path = folder / "a.csv"
    path.write_bytes(b"1," * MANY)
    return path


@case(None)
def text_comment_of_letters_and_blanks(folder: Path) -> Log:
    return csv(folder, "# " + "a" * 30_000 + " " * 90_000 + "\ntime,gx,gy,gz")


@case(None)
def text_comment_of_words(folder: Path) -> Log:
    return csv(folder, "# " + "a " * 60_000 + "\ntime,gx,gy,gz")


@case(None)
def text_setting_with_blanks(folder: Path) -> Log:
    return csv(folder, "# fs=1" + " " * 120_000 + "x\ntime,gx,gy,gz")


@case(None)
def text_header_bracket_of_blanks(folder: Path) -> Log:
    return csv(folder, "time,gx,gy,gz (" + " " * 120_000 + "a")


@case(None)
def text_header_of_brackets(folder: Path) -> Log:
    return csv(folder, "time,gx,gy,gz" + "(" * 120_000)


@case("found one of 1e[+]300 s in")
def text_time_far_away(folder: Path) -> Log:
    return csv(folder, "time,gx,gy,gz", "1e300,1,2,3")


@case("found one of 1e[+]308 s in")
def text_times_as_far_apart_as_numbers_go(folder: Path) -> Log:
    return csv(folder, "time,gx,gy,gz\n-1e308,1,2,3", "1e308,1,2,3")


@case(r"found steps of 1e-310 s")
def text_times_too_close(folder: Path) -> Log:
    return csv(folder, "time [s],gx,gy,gz", time=np.arange(200) * 1e-310)


@case("expected devices recorded at the same time")
def text_two_clocks_far_apart(folder: Path) -> Log:
    return [
        csv(folder, "time [s],gx,gy,gz", name="a.csv", time=np.arange(200.0)),
        csv(folder, "time [s],gx,gy,gz", name="b.csv", time=1e15 + np.arange(200)),
    ]


@case("expected rows of numbers, found none")
def text_one_number_among_words(folder: Path) -> Log:
    path = folder / "a.csv"
    path.write_bytes("\ufefffs=100\ngyro_x [deg/s]\n0.000\n--\nNULL\n".encode())
    return path


@case("expected rows of numbers, found none")
def text_preamble_alone(folder: Path) -> Log:
    path = folder / "a.csv"
    path.write_text("a:,1\nb:,2\nc:,3\n")
    return path


@case("expected a log, found a pipe or device")
def text_pipe(folder: Path) -> Log:
    os.mkfifo(folder / "a.csv")
    return folder / "a.csv"


@case("expected a log, found a pipe or device")
def text_device(folder: Path) -> Log:
    (folder / "a.csv").symlink_to("/dev/zero")
    return folder / "a.csv"


@case(None)
def text_many_devices(folder: Path) -> Log:
    names = [f"imu{i}_g{axis}" for i in range(1000) for axis in "xyz"]
    path = folder / "a.csv"
    path.write_text("\n".join([",".join(["t", *names]), *(",".join([f"0.{i}", *["1"] * 3000]) for i in range(10, 14))]))
    return path


# --- NumPy ------------------------------------------------------------------------------------------------------------


@case(None)
def npz_name_of_bracket_and_blanks(folder: Path) -> Log:
    return npz(folder, gyro=GYRO, fs=100.0, **{"x(" + " " * 60_000 + "a": GYRO[0]})


@case(None)
def npz_name_of_digits(folder: Path) -> Log:
    table = np.concatenate([GYRO, GYRO])
    channels = np.array(["gx", "gy", "gz", "ax", "ay", "az"])
    return npz(folder, channels=channels, fs=100.0, **{"1" * 900 + "a": table})


@case("found 6000 different|found several recordings|expected one recording")
def npz_many_tables(folder: Path) -> Log:
    path = folder / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(1500):
            archive.writestr(f"a{i}.npy", npy_header((3, 4)) + np.arange(12.0).tobytes())
            archive.writestr(f"a{i}_t.npy", npy_header((4,)) + np.arange(4.0).tobytes())
        content = io.BytesIO()
        np.save(content, np.array(["gx", "gy", "gz"]))
        archive.writestr("channels.npy", content.getvalue())
    return path


@case(None)
def npz_sensors_that_are_bytes(folder: Path) -> Log:
    return npz(folder, gyro=GYRO, fs=100.0, sensors=np.array([b"\xff", b"b", b"c"]), unit=np.bytes_(b"\xb0/s"))


@case(None)
def npz_sensors_that_are_half_characters(folder: Path) -> Log:
    return npz(folder, gyro=GYRO, fs=100.0, sensors=np.array(["\ud800", "b", "c"]))


@case("expected one of the units deg/s, .*, found '.*udc00' in 1; give one with unit= ")
def npz_unit_that_is_half_a_character(folder: Path) -> Log:
    return npz(folder, gyro=GYRO, fs=100.0, unit=np.array("\udc00"))


@case("`ts_hz` to be the ticks of `ts1` in a second, one number, found 0")
def npz_no_ticks_a_second(folder: Path) -> Log:
    return npz(folder, a1=GYRO, channels=np.array(["gx", "gy", "gz"]), ts1=np.arange(200), ts_hz=0)


@case(r"`ts_hz` to be the ticks of `ts1` in a second, one number, found \[100 200\]")
def npz_several_ticks_a_second(folder: Path) -> Log:
    return npz(folder, a1=GYRO, channels=np.array(["gx", "gy", "gz"]), ts1=np.arange(200), ts_hz=[100, 200])


@case("`ts_hz` to be the ticks of `ts1` in a second, one number, found fast")
def npz_words_for_ticks_a_second(folder: Path) -> Log:
    return npz(folder, a1=GYRO, channels=np.array(["gx", "gy", "gz"]), ts1=np.arange(200), ts_hz="fast")


@case("expected `fs` to be one sampling rate in Hz, found 1e-320")
def npz_rate_below_all_numbers(folder: Path) -> Log:
    return npz(folder, gyro=GYRO, fs=1e-320)


@case("found one of 1e[+]300 s in")
def npz_time_far_away(folder: Path) -> Log:
    return npz(folder, gyro=GYRO, time=np.r_[TIME[:-1], 1e300])


@case(r"at most .* GiB, found `gyro` of 3 x 1000000000000000 numbers")
def npz_that_declares_too_much(folder: Path) -> Log:
    path = folder / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("gyro.npy", npy_header((3, 10**15)) + bytes(1000))
    return path


@case(r"at most .* GiB, found an array of 3 x 1000000000000000 numbers")
def npy_that_declares_too_much(folder: Path) -> Log:
    (folder / "a.npy").write_bytes(npy_header((3, 10**15)) + bytes(1000))
    return folder / "a.npy"


@case("a header of 4294967295 bytes")
def npy_header_of_4_gb(folder: Path) -> Log:
    (folder / "a.npy").write_bytes(b"\x93NUMPY\x02\x00" + b"\xff" * 4 + bytes(1000))
    return folder / "a.npy"


@case("a shape of")
def npy_negative_shape(folder: Path) -> Log:
    (folder / "a.npy").write_bytes(npy_header((-3, -8)) + bytes(1000))
    return folder / "a.npy"


@case("found one that cannot be read")
def npy_cut_short(folder: Path) -> Log:
    (folder / "a.npy").write_bytes(npy_header((3, 1000)) + bytes(1000))
    return folder / "a.npy"


# --- HDF5 and MATLAB --------------------------------------------------------------------------------------------------


@case(r"at most .* GiB, found `gyro` of 3 x 1000000000000 numbers")
def h5_that_declares_too_much(folder: Path) -> Log:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("gyro", shape=(3, 10**12), dtype="f8", chunks=(1, 10**6))
        file.attrs["fs"] = 100.0
    return folder / "a.h5"


@case("those of `gyro` lie in other files")
def h5_numbers_of_another_file(folder: Path) -> Log:
    import h5py

    (folder / "secret").write_bytes(bytes(range(200)) * 3)
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("gyro", shape=(3, 200), dtype="u1", external=[(str(folder / "secret"), 0, 600)])
        file.attrs["fs"] = 100.0
    return folder / "a.h5"


@case("those of `gyro` lie in other files")
def h5_virtual_numbers_of_another_file(folder: Path) -> Log:
    import h5py

    write_hdf5(folder / "b.h5", {"gyro": GYRO})
    layout = h5py.VirtualLayout(shape=GYRO.shape, dtype="f8")
    layout[:] = h5py.VirtualSource(str(folder / "b.h5"), "gyro", shape=GYRO.shape)
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_virtual_dataset("gyro", layout)
        file.attrs["fs"] = 100.0
    return folder / "a.h5"


@case("found no array")
def h5_link_to_another_file(folder: Path) -> Log:
    import h5py

    write_hdf5(folder / "b.h5", {"gyro": GYRO})
    with h5py.File(folder / "a.h5", "w") as file:
        file["gyro"] = h5py.ExternalLink(str(folder / "b.h5"), "/gyro")
        file["loop"] = h5py.SoftLink("/loop")
        file.attrs["fs"] = 100.0
    return folder / "a.h5"


@case(None)
def h5_names_that_are_not_utf8(folder: Path) -> Log:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file[b"imu\xb0/gyro"] = GYRO
        file.attrs["fs"] = 100.0
    return folder / "a.h5"


@case(None)
def h5_groups_in_circles(folder: Path) -> Log:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file["gyro"] = GYRO
        file.attrs["fs"] = 100.0
        inner = file.create_group("a/b/c")
        for i in range(10):
            inner[f"again{i}"] = file["a"]
    return folder / "a.h5"


@case(None)
def h5_cells_of_cells(folder: Path) -> Log:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file["gyro"] = GYRO
        file.attrs["fs"] = 100.0
        last = file.create_dataset("#c0", (10, 1), dtype="u2")
        last.attrs["MATLAB_class"] = np.bytes_("char")
        for i in range(12):
            cells = file.create_dataset("sensors" if i == 11 else f"#d{i}", (10,), dtype=h5py.ref_dtype)
            cells[:] = [last.ref] * 10
            cells.attrs["MATLAB_class"] = np.bytes_("cell")
            last = cells
    return folder / "a.h5"


def mat_cells(depth: int) -> bytes:
    """A MATLAB file of version 5 with cells inside each other."""
    fixed = struct.pack("<IIII", 6, 8, 1, 0) + struct.pack("<IIii", 5, 8, 1, 1) + struct.pack("<II", 1, 0)
    inner = struct.pack("<II", 14, 0)
    sizes = [len(inner) + len(fixed)]
    for _ in range(depth - 1):
        sizes.append(sizes[-1] + 8 + len(fixed))
    return MAT_HEADER + b"".join(struct.pack("<II", 14, size) + fixed for size in reversed(sizes)) + inner


def mat_matrix(kind: int, shape: tuple[int, int]) -> bytes:
    """A MATLAB file of version 5 with one empty variable of large dimensions."""
    head = struct.pack("<IIII", 6, 8, kind, 0) + struct.pack("<IIii", 5, 8, *shape)
    body = head + struct.pack("<HH4s", 1, 4, b"gyro") + struct.pack("<II", 4 if kind == 4 else 9, 0)
    return MAT_HEADER + struct.pack("<II", 14, len(body)) + body


@case("cells or structs more than 64 deep")
def mat_deep_cells(folder: Path) -> Log:
    (folder / "a.mat").write_bytes(mat_cells(100_000))
    return folder / "a.mat"


@case(r"at most .* GiB, found a variable gyro of 1000000 x 1000000")
def mat_cells_without_end(folder: Path) -> Log:
    (folder / "a.mat").write_bytes(mat_matrix(1, (10**6, 10**6)))
    return folder / "a.mat"


@case(r"at most .* GiB, found a variable gyro of 1000000 x 1000000")
def mat_text_without_end(folder: Path) -> Log:
    (folder / "a.mat").write_bytes(mat_matrix(4, (10**6, 10**6)))
    return folder / "a.mat"


# --- Parquet, ULog, bags ----------------------------------------------------------------------------------------------


@case(None)
def parquet_metadata_that_is_not_utf8(folder: Path) -> Log:
    return write_parquet(folder / "a.parquet", {"time": TIME, "gx": GYRO[0]}, {b"\xb5": b"\xff", b"fs": b"100"})  # type: ignore[dict-item]


@case("goes round in circles: a damaged or zero-filled tail")
def ulog_that_leads_back(folder: Path) -> Log:
    head = b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + bytes(8)
    (folder / "a.ulg").write_bytes(head + bytes(11000) + b"\x00\x28\x00" + bytes(100))
    return folder / "a.ulg"


@case("fields in its messages")
def ulog_of_nested_messages(folder: Path) -> Log:
    def message(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    log = b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + bytes(8) + message("B", bytes(40))
    for name, fields in {"a": "float[1000] x;", "b": "a[1000] x;", "sensor_gyro": "b[1000] x;"}.items():
        log += message("F", f"{name}:{fields}".encode())
    (folder / "a.ulg").write_bytes(log + message("A", struct.pack("<BH", 0, 0) + b"sensor_gyro"))
    return folder / "a.ulg"


@case("expected messages sensor_gyro_fifo of 1 to 32 samples with a time between them, found no two sound samples")
def ulog_of_samples_without_end(folder: Path) -> Log:
    messages = [(8000 * k, 255, np.zeros((3, 32))) for k in range(50)]
    topic = ("sensor_gyro_fifo", 0, 1000, 125.0, 1e-3, messages)
    return write_ulog(folder / "a.ulg", made_up(0), regular_stamps(), fifo=[topic])


@case("found messages that cover 1e-31 % of the time, which are read with key=sensor_gyro_fifo")
def ulog_of_samples_at_no_distance(folder: Path) -> Log:
    messages = [(8000 * k, 8, np.zeros((3, 32))) for k in range(2)]
    topic = ("sensor_gyro_fifo", 0, 1000, 1e-30, 1e-3, messages)
    return write_ulog(folder / "a.ulg", made_up(0), regular_stamps(), fifo=[topic])


@case("expected at least two messages of a gyro .*found 1 of ISBH, 1 of ISBD")
def dataflash_of_batches_without_samples(folder: Path) -> Log:
    head, data = batches([(1, 0)], count=65535)[:2]
    return write_dataflash(folder / "a.bin", [head, (*data[:3], 65535, *data[4:])])


@case("expected at least two messages of a gyro .*found none of these messages")
def dataflash_of_declarations(folder: Path) -> Log:
    head = write_dataflash(folder / "a.bin", []).read_bytes()[: 3 + 1]
    kinds = [struct.pack("<B4s16s64s", 3 + n % 250, b"IMU", b"QBfff", b"TimeUS,I,GyrX,GyrY,GyrZ") for n in range(10**5)]
    (folder / "a.bin").write_bytes(b"".join(head[:3] + b"\x0a" + kind for kind in kinds))
    return folder / "a.bin"


@case("expected at least two messages of a gyro .*found none of these messages")
def dataflash_of_magic(folder: Path) -> Log:
    (folder / "a.bin").write_bytes(b"\xa3\x95\x80" + b"\xa3\x95" * MANY)
    return folder / "a.bin"


@case(None)
def dataflash_of_empty_lines(folder: Path) -> Log:
    inertial = [("IMU", 2500 * k, 0, *GYRO[:, k], 0, 0, -9.75, 0, 0, 30, 1, 1, 0, 0) for k in range(100)]
    path = write_dataflash(folder / "a.log", inertial)
    path.write_bytes(path.read_bytes() + b"\n" * 20 * MANY + b"IMU," * MANY)
    return path


@case("expected a log, or a ROS 2 folder with metadata.yaml, found another folder")
def bag_whose_metadata_are_a_pipe(folder: Path) -> Log:
    (folder / "bag").mkdir()
    os.mkfifo(folder / "bag" / "metadata.yaml")
    return folder / "bag"


@case("found a.db3, which is no file")
def bag_whose_messages_are_a_pipe(folder: Path) -> Log:
    write_ros2(folder / "bag", made_up(1, 20), regular_stamps(20))
    (found,) = (folder / "bag").glob("*.db3")
    found.unlink()
    os.mkfifo(folder / "bag" / "a.db3")
    return folder / "bag"


@case("a table 'endless' that is computed")
def bag_with_a_view(folder: Path) -> Log:
    import sqlite3

    write_ros2(folder / "bag", made_up(1, 20), regular_stamps(20))
    (found,) = (folder / "bag").glob("*.db3")
    with sqlite3.connect(found) as database:
        counting = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x FROM c"
        database.execute(f"CREATE VIEW endless AS {counting}")
    return folder / "bag"
