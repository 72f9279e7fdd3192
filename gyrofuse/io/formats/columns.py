"""Names of columns and datasets: the quantity, device, axis and unit that they state."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gyrofuse._base.units import UNITS, canonical_unit
from gyrofuse.io.limits import LONGEST_NAME, enumerated
from gyrofuse.io.quantities import ACCELERATION, RATE, Quantity
from gyrofuse.io.streams import RecordingError

AXES = ("x", "y", "z")
# Name of the auxiliary channel of each kind of column.
CHANNELS = {
    "temperature": "temperature",
    ACCELERATION.name: ACCELERATION.channel,
    "magnetic_field": "magnetic_field",
    RATE.name: RATE.channel,
}

# Phrases of several words, each replaced by one word before a name is split into words.
_PHRASES = (
    (re.compile(r"(?i)ang(?:ular)?[_ .]?(?:vel(?:ocity)?|rate)s?"), "_gyro_"),
    (re.compile(r"(?i)(?:rotation|body)[_ .]?rates?"), "_gyro_"),
    (re.compile(r"(?<![A-Za-z0-9])w_RS_S(?![A-Za-z0-9])"), "_gyro_"),  # ASL / EuRoC
    (re.compile(r"(?<![A-Za-z0-9])a_RS_S(?![A-Za-z0-9])"), "_acc_"),
    (re.compile(r"(?i)(?:linear[_ .]?accelerations?|specific[_ .]?force)"), "_acc_"),
    (re.compile(r"(?i)magnetic[_ .]?fields?"), "_mag_"),
    (re.compile(r"(?i)sample[_ .]?time[_ .]?fine"), "_sampletimefine_"),
    (re.compile(r"(?i)seconds[_ .]?elapsed"), "_time_s_"),
    (re.compile(r"(?<![A-Za-z0-9])As(?=_?[XYZ](?![A-Za-z]))"), "_gyro_"),  # WitMotion's AsX: angular speed
)
_WORD = re.compile(
    r"(?P<before>[xyz])?"
    r"(?:(?P<rate>gyroscope|gyroskop|gyros?|gyrs?|omega|drehrate)"
    r"|(?P<acceleration>accelerometer|acceleration|beschleunigung|accel|accl|acc)"
    r"|(?P<magnetic_field>magnetometer|magn|mag)|(?P<temperature>temperatures?|temperatur|temp))"
    r"(?P<number>\d*)(?P<after>[xyz])?(?P<last>\d*)",
    re.IGNORECASE,
)
_SHORT = re.compile(r"(?P<word>[gwam])(?P<number>\d*)(?P<axis>[xyz])(?P<last>\d*)", re.IGNORECASE)
_SHORT_KINDS = {"g": "rate", "w": "rate", "a": "acceleration", "m": "magnetic_field"}
_TIME = re.compile(
    r"(?:sampletimefine|timestamps?|times?|stamp|clock|zeit|zeitstempel|uhrzeit|tow|ts|t)(?P<number>\d*)", re.IGNORECASE
)
_PLAIN = re.compile(r"(?:s|ch|channel|sensor|signal|imu|device|node)?[_ ]?\d+", re.IGNORECASE)
_CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")

# Words of columns that describe the data of a sensor and do not hold them.
_NOT_DATA = frozenset(
    "bias clipping clipped coarse id count counter covariance cov std var variance integral dt delta relative error "
    "errors status samples norm noise scale offset range free movement valid quality".split()
)
_FILLERS = frozenset("raw data value values field buffer calibrated cal uncalibrated msg header sample sensor".split())
_UNIT_TOKENS = {
    token: unit
    for unit, tokens in {
        "rad/s": "rad rads radps",
        "mrad/s": "mrad mrads",
        "deg/s": "deg degs degps dps",
        "mdeg/s": "mdeg mdps",
        "deg/h": "dph degh",
        "rpm": "rpm",
        "counts": "counts lsb",
        "m/s^2": "ms2 mps2 s2",
        "mg": "mg",
        "ug": "ug",
        "degC": "celsius degc",
        "K": "kelvin",
    }.items()
    for token in tokens.split()
}
# Letters that are a unit only at the end of the name of a quantity: `acc_x_g`, `temp_c`.
_LAST_LETTERS = {("acceleration", "g"): "g", ("temperature", "c"): "degC", ("temperature", "k"): "K"}
_HOURS = frozenset(("h", "hr", "hour"))
_UNIT_LEFTOVERS = frozenset({"m", "s", "per", "sec", "g", "c", "k"}) | _HOURS
_TIME_TOKENS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "usec", "usecs", "micros", "microsecond", "microseconds", "µs", "μs"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanosec", "nanos", "nanosecond", "nanoseconds"), "ns"),
}
# Units of time that alone, or with some of the words below, are the name of a clock: `nsec`, `gps seconds`.
_CLOCK_UNITS = frozenset(unit for unit in _TIME_TOKENS if len(unit) > 2 and unit != "second")
_CLOCK_WORDS = frozenset("gps utc unix epoch system elapsed tv of week".split())
_RATE_WORDS = frozenset(("rate", "rates"))
_FLIGHT_MECHANICS = {"p": "x", "q": "y", "r": "z"}


@dataclass(frozen=True)
class Column:
    """Meaning of the name of a column.

    Attributes:
        name: The name as the log has it.
        kind: `"rate"`, `"acceleration"`, `"magnetic_field"`, `"temperature"`, `"time"`, or `""` for anything else.
        device: Part of the name that distinguishes this sensor from others (`"imu1"`, `"2"`), or `""`.
        axis: `"x"`, `"y"`, `"z"`, or `""`.
        unit: Unit that the name states (`"deg/s"`; for a time `"s"`, `"ms"`, `"us"`, `"ns"`), or `""`.
    """

    name: str
    kind: str = ""
    device: str = ""
    axis: str = ""
    unit: str = ""


def classify_columns(names: Sequence[str], quantity: Quantity = RATE) -> list[Column]:
    """Find out from each name what the column holds.

    Bare axes (`x`, `y`, `z`) and bare numbers (`1`, `s2`, `sensor_3`) are taken for `quantity`, and only where the log
    names no sensor; `p`, `q` and `r`, the rates of flight mechanics, are rates where the log names no other gyro.

    Args:
        names: Names of all columns of the log.
        quantity: The quantity that is read.
    """
    columns = [_classify(str(name)) for name in names]
    kinds = {column.kind for column in columns}
    if "rate" not in kinds and _FLIGHT_MECHANICS.keys() <= {bare_name(column.name) for column in columns}:
        return [_classify_body_rate(column) for column in columns]
    if not kinds.isdisjoint(("rate", "acceleration", "magnetic_field")):
        return columns
    return [_classify_bare(column, quantity) for column in columns]


def renamed(path: Path, names: Sequence[str], wanted: Mapping[str, str]) -> dict[str, str]:
    """Names that columns are to have, by their names in the log.

    Args:
        path: The log.
        names: Names of its columns.
        wanted: Columns of the log by the names that they should have, `{"gyro_x": "u3", "time": "t"}`.

    Raises:
        RecordingError: No such column.
    """
    absent = [column for column in wanted.values() if column not in names]
    if absent:
        raise RecordingError(
            f"{path}: expected a column {absent[0]!r} (`columns`, --map), found {enumerated(names)}; name one of these"
        )
    return {column: name for name, column in wanted.items()}


def check_columns(wanted: Mapping[str, str]) -> None:
    """Check the argument `columns` of `read_recording`.

    Args:
        wanted: Columns of the log by the names that they should have.

    Raises:
        ValueError: A name that `classify_columns` does not recognise, or a column with two names.
    """
    for name in wanted:
        if not _classify(str(name)).kind:
            raise ValueError(
                f"`columns`: expected names such as gyro_x, acc_z [g], temperature or time, got {name!r}; use one"
            )
    columns = list(wanted.values())
    twice = next((column for column in columns if columns.count(column) > 1), None)
    if twice is not None:
        raise ValueError(f"`columns`: expected each column once, got {twice!r} twice; give it one name")


def is_unit(text: str) -> bool:
    """Whether a text is a unit of rate, acceleration, temperature, magnetic field or time."""
    return canonical_unit(text) in UNITS or text.strip().lower() in _TIME_TOKENS


def bare_name(name: str) -> str:
    """The name in small letters, without its brackets and their content."""
    return _without_brackets(name[:LONGEST_NAME])[0].strip(" _").lower()


def _classify_body_rate(column: Column) -> Column:
    axis = _FLIGHT_MECHANICS.get(bare_name(column.name))
    if axis is None:
        return column
    stated = _without_brackets(column.name)[1]
    return Column(column.name, "rate", "", axis, canonical_unit(stated[-1]) if stated else "")


def _classify_bare(column: Column, quantity: Quantity) -> Column:
    bare = column.name.strip()
    if bare.lower() in AXES:
        return Column(column.name, quantity.name, "", bare.lower())
    return Column(column.name, quantity.name, bare) if _PLAIN.fullmatch(bare) else column


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
    if not tokens or not _NOT_DATA.isdisjoint(token.rstrip("0123456789") for token in lower):
        return Column(name)

    kind, axis, time_at, numbers, rest = "", index, None, [], []
    position = 0
    while position < len(tokens):
        token, following = lower[position], lower[position + 1] if position + 1 < len(tokens) else ""
        position += 1
        if match := _WORD.fullmatch(token):
            found = next(k for k in ("rate", "acceleration", "magnetic_field", "temperature") if match[k] is not None)
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
        if kind not in ("", "rate"):
            return Column(name)
        if canonical_unit(stated) in ("degC", "K"):  # T [degC]
            return Column(name, "temperature", unit=canonical_unit(stated))
        return _time_column(name, lower[time_at:], stated, rest, numbers)
    words = [token.lower() for token in rest]
    if not kind and not axis and lower[-1] in _CLOCK_UNITS and _CLOCK_WORDS.issuperset(words[:-1]):
        return Column(name, "time", unit=_TIME_TOKENS[lower[-1]])
    unit = _unit_of(kind, lower, stated)
    drop = _UNIT_TOKENS.keys() | (_UNIT_LEFTOVERS if unit and not stated else frozenset())
    if not kind and axis and not _RATE_WORDS.isdisjoint(words):
        rest = [token for token in rest if token.lower() not in _RATE_WORDS]
        if all(_PLAIN.fullmatch(token) or token.lower() in _FILLERS | drop for token in rest):
            kind, unit = "rate", _unit_of("rate", lower, stated)
    if not kind:
        return Column(name)
    return Column(name, kind, _device(rest, numbers, drop), axis, unit)


def _unit_of(kind: str, tokens: Sequence[str], stated: str) -> str:
    """Unit of a column that is no clock, from the brackets or from the words of its name."""
    if stated:
        # In the name of a magnetic field G is a gauss, not the acceleration of gravity.
        unit = canonical_unit(stated)
        return stated if kind == "magnetic_field" and unit in ("g", "mg", "ug") else unit
    at = next((i for i, token in enumerate(tokens) if token in _UNIT_TOKENS), None)
    if at is None:
        return _LAST_LETTERS.get((kind, tokens[-1]), "")
    unit = _UNIT_TOKENS[tokens[at]]
    if unit == "deg/s" and not _HOURS.isdisjoint(tokens[at + 1 :]):
        return "deg/h"
    return unit


def _without_brackets(name: str) -> tuple[str, list[str]]:
    """A name with `_` in place of each pair of brackets, and the contents of the brackets."""
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
