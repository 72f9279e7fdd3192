"""Text files of known loggers, whose columns mean more than their names say.

Each dialect is recognised by marks of its own. Its columns get names that `gyrofuse.io.formats.columns` understands,
with their units, and a note says what was decided. Sources: Xsens, MT Low-Level Communication Protocol and Xsens DOT
User Manual; Analog Devices, ADIS16470/ADIS16490 data sheets (output registers); Betaflight, `blackbox.c` and the CSV
export of Blackbox Explorer; ROS, `sensor_msgs/Imu` and REP 103 (units); VectorNav, VN-100 User Manual (uncompensated
measurements).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

from gyrofuse.io.formats.columns import AXES, bare_name, classify_columns
from gyrofuse.io.limits import is_rate
from gyrofuse.io.streams import Array

_Columns = dict[str, Array]
_WORD = 65_536  # number of values of a 16-bit register, and of the packet counter of Xsens
# Columns that a dialect needs although they have no name of a sensor or clock, in small letters.
NEEDED = frozenset({"packetcounter"})

# Fields of a sensor_msgs/Imu with their components; a covariance has nine.
_FIELDS = {"orientation": (*AXES, "w"), "angular_velocity": AXES, "linear_acceleration": AXES}
_IMU = tuple(
    name
    for field, parts in _FIELDS.items()
    for name in (*(f"{field}.{part}" for part in parts), *(f"{field}_covariance{i}" for i in range(9)))
)
_STAMP = ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id")


def names_of_message(rows: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Names of the cells of a sensor_msgs/Imu, as `ros2 topic echo --csv` prints it without a header.

    Args:
        rows: Cells of some lines.

    Returns:
        One name for each cell, none where the lines are no such messages.
    """
    widths = {len(row) for row in rows}
    if widths == {len(_IMU)}:
        stamped = False
    elif widths == {len(_STAMP) + len(_IMU)}:
        stamped = True
    else:
        return ()
    for row in rows:
        try:
            stamp = [float(cell) for cell in row[:2]] if stamped else [0.0, 0.0]
            values = np.array([float(cell) for cell in row[len(_STAMP) if stamped else 0 :]])
        except ValueError:
            return ()
        covariances = (values[start : start + 9].reshape(3, 3) for start in (4, 16, 28))
        length = float(values[:4] @ values[:4])  # of the quaternion, which is zero where there is no attitude
        unlike = not (abs(length - 1) < 1e-2 or length == 0) or not all(np.allclose(c, c.T) for c in covariances)
        if unlike or not 0 <= stamp[1] < 1e9 or any(part != np.rint(part) for part in stamp):
            return ()
    return (*(_STAMP if stamped else ()), *_IMU)


def translate(columns: _Columns, names: Sequence[str], settings: Mapping[str, str]) -> tuple[_Columns, list[str]]:
    """Give the columns of a known dialect names that `gyrofuse.io.formats.columns` understands.

    Args:
        columns: Values `(time,)` of the columns that were read, by name.
        names: Names of all columns of the file.
        settings: Settings in comments and the preamble, by name.

    Returns:
        Values by their new names, and notes.
    """
    notes: list[str] = []
    for dialect in (_ros, _xsens, _adis, _betaflight, _vectornav):
        columns, said = dialect(columns, names, settings)
        notes += said
    return columns, notes


def _ros(columns: _Columns, names: Sequence[str], settings: Mapping[str, str]) -> tuple[_Columns, list[str]]:
    """Columns of a sensor_msgs/Imu, recognised by its covariances."""
    whole = {name.lower().removeprefix("field.").rstrip("0123456789_") for name in names}
    if not {"angular_velocity_covariance", "angular_velocity.x"} <= whole:
        return columns, []
    named = {}
    for name, values in columns.items():
        unit = {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2"}.get(name.lower().split(".")[-2:][0], "")
        named[f"{name} [{unit}]" if unit else name] = values
    if list(named) == list(columns):
        return columns, []
    return named, ["the columns are a sensor_msgs/Imu, whose rates are rad/s and accelerations m/s^2"]


def _xsens(columns: _Columns, names: Sequence[str], settings: Mapping[str, str]) -> tuple[_Columns, list[str]]:
    """Units of Xsens, which the file does not state: rad/s of an MTi or MTw, deg/s of a DOT."""
    if not {"packetcounter", "sampletimefine"} & {name.lower() for name in names}:
        return columns, []
    stated = {name.lower(): value for name, value in settings.items()}
    columns, notes = _placed_by_packets(columns, stated.get("update rate") or stated.get("outputrate") or "")
    if "devicetag" in stated:
        unit, who = "deg/s", "an Xsens DOT, whose rates are deg/s"
    elif "mt manager version" in stated or ("update rate" in stated and "firmware version" in stated):
        unit, who = "rad/s", "MT Manager of Xsens, whose rates are rad/s unless its settings were changed"
    else:
        return columns, notes
    units = {"gyr": unit, "acc": "m/s^2"}
    named = {
        f"{name} [{units[name[:3].lower()]}]" if name.lower()[:4] in ("gyr_", "acc_") else name: values
        for name, values in columns.items()
    }
    if list(named) != list(columns):
        notes = [f"the file states no unit; its comments are those of {who}", *notes]
    return named, notes


def _placed_by_packets(columns: _Columns, rate: str) -> tuple[_Columns, list[str]]:
    """Columns with a clock made of the packet counter where there is no other."""
    counter = next((name for name in columns if name.lower() == "packetcounter"), None)
    clocks = [column.name for column in classify_columns(list(columns)) if column.kind == "time"]
    hertz = float(rate) if rate.replace(".", "", 1).isdigit() else 0.0
    if counter is None or any(np.isfinite(columns[name]).any() for name in clocks) or not is_rate(hertz):
        return columns, []
    wrapped = np.diff(columns[counter], prepend=columns[counter][:1]) < -_WORD // 2
    seconds = (columns[counter] + _WORD * np.cumsum(wrapped)) / hertz
    kept = {name: values for name, values in columns.items() if name != counter}
    note = f"there is no clock: samples are placed by {counter} at the stated {hertz:g} Hz"
    return {**kept, "packet time [s]": seconds}, [note]


def _adis(columns: _Columns, names: Sequence[str], settings: Mapping[str, str]) -> tuple[_Columns, list[str]]:
    """Output registers of an ADIS164xx: OUT and LOW together are one number of 32 bits in two's complement."""
    registers = {name.strip().upper(): name for name in columns}
    pairs = {high: high.removesuffix("OUT") + "LOW" for high in registers if high.endswith(("GYRO_OUT", "ACCL_OUT"))}
    if not any(high.endswith("GYRO_OUT") for high in pairs):
        return columns, []
    joined, rounded = [], []
    result: _Columns = {}
    for name, values in columns.items():
        register = name.strip().upper()
        if register in pairs.values():
            continue
        low = registers.get(pairs.get(register, ""))
        if register in pairs and _are_words(values) and (low is None or _are_words(columns[low])):
            counts = _signed(values)
            if low is not None:
                counts = counts * _WORD + columns[low] % _WORD
                joined.append(name)
            result[f"{register.removesuffix('_OUT')} [counts]"] = counts
        elif register == "TEMP_OUT" and _are_words(values):
            result["TEMP [counts]"] = _signed(values)
        else:
            rounded += [low] if low is not None else []
            result[name] = values
    notes = []
    if joined:
        notes.append(
            f"registers {joined[0]} to {joined[-1]} and their LOW words are read as one number of 32 bits each, "
            "OUT * 65536 + LOW in two's complement, in counts"
        )
    if rounded:
        notes.append(f"columns {', '.join(rounded)} are left out: beside them are no whole numbers of 16 bits")
    return result, notes


def _are_words(values: Array) -> bool:
    """Whether values are whole numbers of 16 bits, with or without a sign."""
    finite = values[np.isfinite(values)]
    return bool(np.all(finite == np.rint(finite)) and np.all((finite >= -_WORD // 2) & (finite < _WORD)))


def _signed(words: Array) -> Array:
    """Words of 16 bits in two's complement, written with or without their sign."""
    return np.where(words >= _WORD // 2, words - _WORD, words)


def _betaflight(columns: _Columns, names: Sequence[str], settings: Mapping[str, str]) -> tuple[_Columns, list[str]]:
    """A flight log of Betaflight, INAV or Cleanflight, decoded to CSV."""
    if "loopiteration" not in {bare_name(name) for name in names}:
        return columns, []
    notes = []
    families = {family: [name for name in columns if name.startswith(family)] for family in ("gyroADC", "gyroUnfilt")}
    taken = "gyroUnfilt" if families["gyroUnfilt"] else "gyroADC"
    left = families["gyroADC"] if taken == "gyroUnfilt" else []
    if left:
        notes.append(
            "gyroUnfilt, the gyro before the filters of the flight controller, is taken and gyroADC, behind them, is "
            "left out; key= (--key ADC) reads that one"
        )
    elif families["gyroADC"]:
        notes.append("gyroADC is the gyro behind the filters of the flight controller: its noise is not the sensor's")
    unit, factor, said = _scale_of_gyro(settings)
    notes += said if families[taken] else []
    one = settings.get("acc_1G", "")
    gravity = float(one) if one.isdigit() and len(one) < 10 and int(one) else 0.0
    result: _Columns = {}
    for name, values in columns.items():
        axis = name.partition("[")[2][:1]
        if name in left:
            continue
        if name.startswith(taken) and axis.isdigit():
            result[f"gyro[{axis}] ({unit})" if unit and "(" not in name else f"gyro{name[len(taken) :]}"] = (
                values * factor if "(" not in name else values
            )
        elif name.startswith("accSmooth") and axis.isdigit():
            if "(" in name:
                result[f"acc{name.removeprefix('accSmooth')}"] = values
            else:
                result[f"acc[{axis}] ({'g' if gravity else 'counts'})"] = values / gravity if gravity else values
        else:
            result["time (us)" if name == "time" else name] = values
    return result, notes


def _vectornav(columns: _Columns, names: Sequence[str], settings: Mapping[str, str]) -> tuple[_Columns, list[str]]:
    """Measurements before and after the filter on board, which are of one gyro."""
    before = {name for name in columns if name.lower().startswith("uncomp")}
    behind = {name for name in columns if name.lower().startswith(("gyro", "angularrate", "acc", "mag"))} - before
    if not any("gyro" in name.lower() or "rate" in name.lower() for name in before):
        return columns, []
    left = [name for name in behind if not name.lower().startswith("uncomp")]
    result = {name[6:] if name in before else name: v for name, v in columns.items() if name not in left}
    if not any(name.lower().startswith(("gyro", "angularrate")) for name in left):
        return result, []
    return result, [
        "measurements named UnComp, without the corrections of the filter on board, are taken, and those with them are "
        "left out"
    ]


def _scale_of_gyro(settings: Mapping[str, str]) -> tuple[str, float, list[str]]:
    """Unit of the logged rates, the factor that converts them to it, and notes."""
    try:
        (scale,) = struct.unpack(">f", int(settings.get("gyro_scale", ""), 16).to_bytes(4, "big"))
    except (ValueError, OverflowError):
        return "deg/s", 1.0, ["rates are read as deg/s, in which Betaflight and INAV log; the file does not say"]
    if scale != 1.0:
        said = f"gyro_scale is {scale:g}, not the 1 of logs in deg/s: the unit of the rates is not known"
        return "", 1.0, [said]
    if settings.get("blackbox_high_resolution") == "1":
        return "deg/s", 0.1, ["blackbox_high_resolution is on: rates are logged in tenths of deg/s"]
    return "deg/s", 1.0, []
