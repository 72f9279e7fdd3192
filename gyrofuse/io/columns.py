"""Names of columns and datasets: what they hold, of which device, on which axis, in which unit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gyrofuse.io.limits import LONGEST_NAME
from gyrofuse.io.stream import Array, Stream
from gyrofuse.units import canonical_unit

AXES = ("x", "y", "z")
TICK = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
WRAP_32_BIT = 2.0**32

# Words of several tokens become one token before a name is split.
_PHRASES = (
    (re.compile(r"(?i)ang(?:ular)?[_ .]?(?:vel(?:ocity)?|rate)s?"), "_gyro_"),
    (re.compile(r"(?i)(?:rotation|body)[_ .]?rates?"), "_gyro_"),
    (re.compile(r"(?<![A-Za-z0-9])w_RS_S(?![A-Za-z0-9])"), "_gyro_"),  # ASL / EuRoC
    (re.compile(r"(?<![A-Za-z0-9])a_RS_S(?![A-Za-z0-9])"), "_acc_"),
    (re.compile(r"(?i)(?:linear[_ .]?accelerations?|specific[_ .]?force)"), "_acc_"),
    (re.compile(r"(?i)magnetic[_ .]?fields?"), "_mag_"),
    (re.compile(r"(?i)sample[_ .]?time[_ .]?fine"), "_sampletimefine_"),
    (re.compile(r"(?i)seconds[_ .]?elapsed"), "_time_s_"),
)
_WORD = re.compile(
    r"(?P<before>[xyz])?"
    r"(?:(?P<gyro>gyroscope|gyros?|gyrs?|omega)|(?P<acceleration>accelerometer|acceleration|accel|acc)"
    r"|(?P<magnetic_field>magnetometer|mag)|(?P<temperature>temperatures?|temp))"
    r"(?P<number>\d*)(?P<after>[xyz])?(?P<last>\d*)",
    re.IGNORECASE,
)
_SHORT = re.compile(r"(?P<word>[gwam])(?P<number>\d*)(?P<axis>[xyz])(?P<last>\d*)", re.IGNORECASE)
_SHORT_KINDS = {"g": "gyro", "w": "gyro", "a": "acceleration", "m": "magnetic_field"}
_TIME = re.compile(r"(?:sampletimefine|timestamps?|times?|stamp|clock|ts|t)(?P<number>\d*)", re.IGNORECASE)
_PLAIN = re.compile(r"(?:s|ch|channel|sensor|signal|imu|device|node)?[_ ]?\d+", re.IGNORECASE)
_CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")

# A name with one of these describes a sensor's data but does not hold them.
_NOT_DATA = frozenset(
    "bias clipping clipped id count counter covariance cov std var variance integral dt delta relative error errors "
    "status samples norm noise scale offset range free movement valid quality".split()
)
_FILLERS = frozenset("raw data value values field buffer calibrated cal uncalibrated msg header sample sensor".split())
_UNIT_TOKENS = {
    "rad": "rad/s",
    "rads": "rad/s",
    "radps": "rad/s",
    "deg": "deg/s",
    "degs": "deg/s",
    "degps": "deg/s",
    "dps": "deg/s",
    "counts": "counts",
    "lsb": "counts",
    "ms2": "m/s^2",
    "mps2": "m/s^2",
    "s2": "m/s^2",
    "celsius": "degC",
    "degc": "degC",
    "kelvin": "K",
}
_UNIT_LEFTOVERS = frozenset({"m", "s", "per", "sec", "g", "c", "k"})
_TIME_TOKENS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "usec", "usecs", "micros", "microsecond", "microseconds", "µs", "μs"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanosec", "nanos", "nanosecond", "nanoseconds"), "ns"),
}


@dataclass(frozen=True)
class Column:
    """What one name says.

    Attributes:
        name: The name as the log has it.
        kind: `"gyro"`, `"acceleration"`, `"magnetic_field"`, `"temperature"`, `"time"`, or `""` for anything else.
        device: What tells this sensor from its siblings (`"imu1"`, `"2"`), `""` where there is nothing.
        axis: `"x"`, `"y"`, `"z"`, or `""`.
        unit: Unit that the name states (`"deg/s"`; for a time `"s"`, `"ms"`, `"us"`, `"ns"`), or `""`.
    """

    name: str
    kind: str = ""
    device: str = ""
    axis: str = ""
    unit: str = ""


def classify_columns(names: Sequence[str]) -> list[Column]:
    """Say of each name what it holds.

    Bare axes (`x`, `y`, `z`) and bare numbers (`1`, `s2`, `sensor_3`) are gyros only where the log names no sensor.
    """
    columns = [_classify(str(name)) for name in names]
    if any(column.kind in ("gyro", "acceleration", "magnetic_field") for column in columns):
        return columns
    return [_classify_bare(column) for column in columns]


def _classify_bare(column: Column) -> Column:
    bare = column.name.strip()
    if bare.lower() in AXES:
        return Column(column.name, "gyro", "", bare.lower())
    return Column(column.name, "gyro", bare) if _PLAIN.fullmatch(bare) else column


def _classify(name: str) -> Column:
    stated, index = "", ""
    text, contents = _without_brackets(name[:LONGEST_NAME])
    for content in contents:
        if content in ("0", "1", "2"):
            index = AXES[int(content)]
        elif not content.isdigit():
            stated = content
    for phrase, word in _PHRASES:
        text = phrase.sub(word, text)
    tokens = [token for token in re.split(r"[^0-9A-Za-zµμ]+", _CAMEL.sub("_", text)) if token]
    lower = [token.lower() for token in tokens]
    if not tokens or not _NOT_DATA.isdisjoint(lower):
        return Column(name)

    kind, axis, time_at, numbers, rest = "", index, None, [], []
    position = 0
    while position < len(tokens):
        token, following = lower[position], lower[position + 1] if position + 1 < len(tokens) else ""
        position += 1
        if match := _WORD.fullmatch(token):
            found = next(k for k in ("gyro", "acceleration", "magnetic_field", "temperature") if match[k] is not None)
            kind = "temperature" if "temperature" in (kind, found) else kind or found
            axis = axis or match["before"] or match["after"] or ""
            numbers += [match["number"], match["last"]]
        elif not kind and (match := _SHORT.fullmatch(token)):
            kind, axis = _SHORT_KINDS[match["word"]], axis or match["axis"]
            numbers += [match["number"], match["last"]]
        elif not kind and token.rstrip("0123456789") in _SHORT_KINDS and following in AXES:
            kind, axis = _SHORT_KINDS[token[0]], axis or following
            numbers.append(token[1:])
            position += 1
        elif time_at is None and (match := _TIME.fullmatch(token)):
            time_at = position - 1
            numbers.append(match["number"])
        elif token in AXES and not axis:
            axis = token
        else:
            rest.append(tokens[position - 1])
    if time_at is not None:
        if kind not in ("", "gyro"):
            return Column(name)
        return _time_column(name, lower[time_at:], stated, rest, numbers)
    if not kind and rest and lower[-1] in ("secs", "sec", "seconds") and len(tokens) == 1:
        return Column(name, "time", unit="s")
    if not kind:
        return Column(name)
    unit = canonical_unit(stated) if stated else next((_UNIT_TOKENS[t] for t in lower if t in _UNIT_TOKENS), "")
    drop = _UNIT_TOKENS.keys() | (_UNIT_LEFTOVERS if unit and not stated else frozenset())
    return Column(name, kind, _device(rest, numbers, drop), axis, unit)


def _without_brackets(name: str) -> tuple[str, list[str]]:
    """A name with `_` in place of what stands in brackets, and what stands there."""
    alike = name.replace("[", "(").replace("]", ")")
    text, contents, begin = "", [], 0
    while (end := alike.find(")", begin)) >= 0:
        opened = alike.find("(", begin, end)
        text += name[begin:opened] + "_" if opened >= 0 else name[begin : end + 1]
        if opened >= 0:
            contents.append(name[opened + 1 : end].strip())
        begin = end + 1
    return text + name[begin:], contents


def _time_column(name: str, tail: list[str], stated: str, rest: list[str], numbers: list[str]) -> Column:
    unit = _TIME_TOKENS.get(stated.lower(), "") or next((_TIME_TOKENS[t] for t in tail[1:] if t in _TIME_TOKENS), "")
    return Column(name, "time", _device(rest, numbers, set(_TIME_TOKENS)), "", unit)


def _device(rest: list[str], numbers: list[str], drop: frozenset[str] | set[str]) -> str:
    kept = [token for token in rest if token.lower() not in _FILLERS and token.lower() not in drop]
    kept += [number for number in numbers if number]
    return "" if [token.lower() for token in kept] == ["imu"] else "_".join(kept)


def time_in_seconds(column: Column, values: NDArray[np.generic]) -> tuple[Array, float | None, str]:
    """Convert a clock column to seconds.

    Where the name states no unit, the unit is the one in which the values are a date between 2001 and 2036, else the
    one in which the rate lies between 5 Hz and 5 kHz; fractional values are seconds.

    Returns:
        Seconds `(time,)`, the period after which the clock wraps (or `None`), and a sentence on what was guessed.
    """
    ticks = np.asarray(values, dtype=np.float64)
    fine = "sampletimefine" in re.sub(r"[^a-z]", "", column.name.lower())
    unit, note = column.unit or ("us" if fine else ""), ""  # SampleTimeFine counts microseconds
    if not unit:
        finite = ticks[np.isfinite(ticks)]
        step = typical_step(finite, either_way=True)
        whole = finite.size > 0 and bool(np.all(finite[:1000] == np.rint(finite[:1000])))
        start = abs(float(finite[0])) if finite.size else 0.0
        dated = [name for name, tick in TICK.items() if 1e9 <= start * tick <= 2.1e9]
        if dated:
            unit = dated[0]
        elif not whole or step < 0.2:
            unit = "s"
        else:
            unit = "ms" if step < 200 else "us" if step < 200e3 else "ns"
        if unit != "s":
            note = f"time column '{column.name}' states no unit: read as {unit} from its median step of {step:g}"
    return ticks * TICK[unit], WRAP_32_BIT * TICK[unit] if fine else None, note


def typical_step(ticks: Array, *, either_way: bool = False) -> float:
    """Median step of a clock, or of the size of its steps, over the readings that are finite; 0 where there is none."""
    with np.errstate(over="ignore", invalid="ignore"):  # damaged readings may be as far apart as float64 reaches
        steps = np.diff(ticks[np.isfinite(ticks)])
        return float(np.median(np.abs(steps) if either_way else steps)) if steps.size else 0.0


def streams_from_columns(
    columns: Mapping[str, NDArray[np.generic]],
    *,
    name: str,
    unit: str = "unknown",
    rate: float | None = None,
    time: Array | None = None,
    notes: Sequence[str] = (),
) -> list[Stream]:
    """Build one stream per device from named one-dimensional columns; none where no column is a gyro's.

    Args:
        columns: Values `(time,)` by column name, in the order of the log.
        name: Name of a device that the columns do not name (the file's stem).
        unit: Unit of gyro columns whose names state none.
        rate: Sampling rate the log states, Hz.
        time: Clock in seconds where it is no column.
        notes: Sentences that go with every stream.
    """
    classified = classify_columns(list(columns))
    by_device: dict[str, list[Column]] = {}
    for column in classified:
        by_device.setdefault(column.device, []).append(column)
    devices = list(dict.fromkeys(column.device for column in classified if column.kind == "gyro"))
    # A logger that keeps the time of sampling beside the time of arrival means the former.
    clocks = [column for column in classified if column.kind == "time"]
    clocks.sort(key=lambda column: "sample" not in column.name.lower())
    clock_of = {column.device: column for column in reversed(clocks)}  # the first of each device
    streams = []
    for device in devices:
        gyro: dict[str, Array] = {}
        units: list[str] = []
        said = list(notes)
        for column in by_device[device]:
            if column.kind == "gyro":
                if column.axis in gyro:
                    said.append(f"column '{column.name}' repeats axis '{column.axis}' and is left out")
                    continue
                gyro[column.axis] = np.asarray(columns[column.name], dtype=np.float64)
                units.append(column.unit)
        # One shared clock or thermometer belongs to no device: the clock serves all, the channel goes with the first.
        own = by_device[device]
        if device == devices[0] and device:
            own = [column for column in classified if column.device in (device, "")]
        clock = clock_of.get(device) or (clocks[0] if clocks and len(devices) == 1 else clock_of.get(""))
        seconds, period = time, None
        if seconds is None and clock is not None:
            seconds, period, guess = time_in_seconds(clock, columns[clock.name])
            said += [guess] if guess else []
        channels, channel_units = _channels(own, columns)
        streams.append(
            Stream(
                name=device or name,
                gyro=gyro,
                unit=next((u for u in units if u), unit),
                time=seconds,
                rate=rate,
                clock_period=period,
                channels=channels,
                channel_units=channel_units,
                notes=tuple(said),
            )
        )
    return streams


def _channels(
    classified: Sequence[Column], columns: Mapping[str, NDArray[np.generic]]
) -> tuple[dict[str, Array], dict[str, str]]:
    channels: dict[str, Array] = {}
    units: dict[str, str] = {}
    for kind in ("temperature", "acceleration", "magnetic_field"):
        found = {column.axis: column for column in classified if column.kind == kind}
        if not found:
            continue
        if set(AXES) <= set(found):
            channels[kind] = np.stack([np.asarray(columns[found[a].name], dtype=np.float64) for a in AXES])
        elif kind == "temperature":
            channels[kind] = np.asarray(columns[next(iter(found.values())).name], dtype=np.float64)
        else:
            continue
        if unit := next(iter(found.values())).unit:
            units[kind] = unit
    return channels, units
