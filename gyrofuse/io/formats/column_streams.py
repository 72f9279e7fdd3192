"""From named columns to streams: which columns belong to one device, its clock in seconds, its channels."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gyrofuse._base.units import SECONDS_PER
from gyrofuse.io.formats.columns import AXES, CHANNELS, Column, bare_name, classify_columns
from gyrofuse.io.quantities import QUANTITY, RATE, Quantity
from gyrofuse.io.streams import Array, Stream
from gyrofuse.io.timestamps import COUNTER_32_BIT, DAY

# SampleTimeFine of Xsens counts the day in ticks of 10 kHz on an MTi (MTi Low-Level Communication Protocol),
# microseconds in 32 bits on a DOT (Xsens DOT User Manual). Seconds per tick, and the period of the clock by that.
_MTI_TICK, _DOT_TICK = 1e-4, SECONDS_PER["us"]
_FINE_PERIODS = {_MTI_TICK: DAY, _DOT_TICK: COUNTER_32_BIT * _DOT_TICK}


def time_in_seconds(
    column: Column, values: NDArray[np.generic], rate: float | None = None
) -> tuple[Array, float | None, str]:
    """Convert a clock column to seconds.

    Where the name states no unit, it is the unit that fits the sampling rate that the log states, else the unit in
    which the values are a date between 2001 and 2036, else the unit in which the rate lies between 5 Hz and 5 kHz;
    fractional values are seconds.

    Args:
        column: Meaning of the column's name.
        values: Readings `(time,)` in the unit of the clock.
        rate: Sampling rate in Hz that the log states.

    Returns:
        Seconds `(time,)`, the period after which the clock wraps (or `None`), and a sentence on the guess, if any.
    """
    ticks = np.asarray(values, dtype=np.float64)
    if not column.unit and "sampletimefine" in re.sub(r"[^a-z]", "", column.name.lower()):
        return _fine_time_in_seconds(column, ticks, rate)
    unit, note, certain = column.unit, "", False
    if not unit:
        finite = ticks[np.isfinite(ticks)]
        step = typical_step(finite, either_way=True)
        whole = finite.size > 0 and bool(np.all(finite[:1000] == np.rint(finite[:1000])))
        start = abs(float(finite[0])) if finite.size else 0.0
        dated = [name for name, tick in SECONDS_PER.items() if 1e9 <= start * tick <= 2.1e9]
        reason = f"from its median step of {step:g}"
        if rate is not None and step > 0:
            unit = min(SECONDS_PER, key=lambda name: abs(math.log(step) + math.log(SECONDS_PER[name] * rate)))
            reason += f" and the stated {rate:g} Hz"
            certain = (
                abs(step * SECONDS_PER[unit] * rate - 1) < 0.01
            )  # clocks of loggers are right to far better than 1 %
        elif dated:
            unit, reason = dated[0], "in which its readings are dates"
        elif not whole or step < 0.2:
            unit = "s"
        else:
            unit = "ms" if step < 200 else "us" if step < 200e3 else "ns"
        if not certain:
            note = f"time column '{column.name}' states no unit: read as {unit} {reason}"
    return ticks * SECONDS_PER[unit], None, note


def _fine_time_in_seconds(column: Column, ticks: Array, rate: float | None) -> tuple[Array, float | None, str]:
    """Seconds of a SampleTimeFine, whose tick depends on the device."""
    step = typical_step(ticks, either_way=True)
    if rate is not None and step > 0:
        tick = min(_FINE_PERIODS, key=lambda seconds: abs(math.log(step * seconds) + math.log(rate)))
        reason = f"a step of {step:g} is nearest to the stated {rate:g} Hz then"
    else:
        # A DOT gives at most 120 Hz, 8333 microseconds; an MTi with 8000 ticks between samples would give 1.25 Hz.
        tick, other = (_DOT_TICK, _MTI_TICK) if step >= 8000 else (_MTI_TICK, _DOT_TICK)
        reason = f"a step of {step:g} would be a rate of {1 / max(step * other, other):.3g} Hz otherwise"
    what = "microseconds, as an Xsens DOT" if tick == _DOT_TICK else "ticks of 10 kHz, as an Xsens MTi"
    return ticks * tick, _FINE_PERIODS[tick], f"time column '{column.name}' is read as {what} counts them: {reason}"


def typical_step(ticks: Array, *, either_way: bool = False) -> float:
    """Median step between the finite readings of a clock, 0 where there is none.

    Args:
        ticks: Readings `(time,)`.
        either_way: Whether a step back counts by its size.
    """
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
    clock_period: float | None = None,
    notes: Sequence[str] = (),
    quantity: Quantity = RATE,
) -> list[Stream]:
    """Build one stream per device from named one-dimensional columns; none where no column is of the quantity.

    Args:
        columns: Values `(time,)` by column name, in the order of the log.
        name: Name of a device that the columns do not name (the file's stem).
        unit: Unit of columns of the quantity whose names state none.
        rate: Sampling rate in Hz that the log states.
        time: Clock `(time,)` in seconds where it is no column.
        clock_period: Seconds after which the clock wraps, where the log says so (times of day).
        notes: Sentences for the notes of every stream.
        quantity: The quantity that is read; the other one is a channel.
    """
    columns, joined = _joined_clocks(columns)
    classified = classify_columns(list(columns), quantity)
    by_device: dict[str, list[Column]] = {}
    for column in classified:
        by_device.setdefault(column.device, []).append(column)
    devices = list(dict.fromkeys(column.device for column in classified if column.kind == quantity.name))
    clocks = [column for column in classified if column.kind == "time"]
    empty = dict.fromkeys(column.name for column in clocks if not np.isfinite(columns[column.name]).any())
    clocks = sorted((column for column in clocks if column.name not in empty), key=_remoteness)
    clock_of = {column.device: column for column in reversed(clocks)}  # for each device the clock nearest to the sample
    notes = [
        *notes,
        *joined,
        *(f"time column '{name}' holds no reading and is left out" for name in empty),
        *_guessed_names(classified, quantity, name),
    ]
    streams = []
    for device in devices:
        signal: dict[str, Array] = {}
        units: list[str] = []
        said = list(notes)
        for column in by_device[device]:
            if column.kind == quantity.name:
                if column.axis in signal:
                    said.append(f"column '{column.name}' repeats axis '{column.axis}' and is left out")
                    continue
                signal[column.axis] = np.asarray(columns[column.name], dtype=np.float64)
                units.append(column.unit)
        # One shared clock or thermometer belongs to no device: the clock serves all, the channel goes with the first.
        own = by_device[device]
        if device == devices[0] and device:
            own = [column for column in classified if column.device in (device, "")]
        clock = clock_of.get(device) or (clocks[0] if clocks and len(devices) == 1 else clock_of.get(""))
        seconds, period = time, clock_period
        if seconds is None and clock is not None:
            seconds, wraps, guess = time_in_seconds(clock, columns[clock.name], rate)
            period = wraps or clock_period
            said += [guess] if guess else []
        channels, channel_units = _channels(own, columns, quantity)
        streams.append(
            Stream(
                name=device or name,
                signal=signal,
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


def _remoteness(clock: Column) -> int:
    """Rank of a clock, 0 for one that is read with the sample: a logger may store the time of arrival as well."""
    name = clock.name.lower()
    return 0 if "sample" in name else 1 if "header" in name else 2


def _guessed_names(columns: Sequence[Column], quantity: Quantity, log: str) -> list[str]:
    """Note on columns whose names were guessed to be sensors.

    Args:
        columns: All columns of the log.
        quantity: The quantity that is read.
        log: Name of the log.
    """
    names = [column.name for column in columns if column.kind == quantity.name]
    bare = [name for name in names if bare_name(name) in ("p", "q", "r")]
    if bare:
        return [f"columns {', '.join(bare)} are read as the rates about x, y, z, as flight mechanics names them"]
    bare = [name for name in names if bare_name(name) in AXES]
    if not bare:
        return []
    other = classify_columns([log], quantity)[0].kind in {*QUANTITY, "magnetic_field"} - {quantity.name}
    but = f", though the log is called {log}" if other else ""
    return [f"columns {', '.join(bare)} name no sensor and are read as {quantity.a_sensor}'s{but}"]


def _joined_clocks(
    columns: Mapping[str, NDArray[np.generic]],
) -> tuple[Mapping[str, NDArray[np.generic]], list[str]]:
    """Join clocks that are split into whole seconds and a fraction; return the columns and notes on the joined ones."""
    clocks = [column for column in classify_columns(list(columns)) if column.kind == "time"]
    whole = {_without_unit(column.name): column for column in clocks if column.unit == "s"}
    joined = dict(columns)
    notes = []
    for part in clocks:
        seconds = whole.get(_without_unit(part.name))
        if part.unit not in ("ms", "us", "ns") or seconds is None or seconds.name not in joined:
            continue
        count = np.asarray(columns[seconds.name], dtype=np.float64)
        fraction = np.asarray(columns[part.name], dtype=np.float64) * SECONDS_PER[part.unit]
        with np.errstate(invalid="ignore"):  # NaN
            if np.any(count != np.rint(count)) or np.any((fraction < 0) | (fraction >= 1)):
                continue
        name = f"{_without_unit(part.name).strip('_ .')} [s]"
        if classify_columns([name])[0].kind != "time":
            name = f"time {name}"
        joined[name] = count + fraction
        del joined[seconds.name], joined[part.name]
        notes.append(f"columns '{seconds.name}' and '{part.name}' are read as one clock: seconds and {part.unit}")
    return joined, notes


def _without_unit(name: str) -> str:
    """The name of a clock without its unit: the same for `stamp.sec` and `stamp.nanosec`."""
    return re.sub(r"(?:nano|micro|milli|[num])?sec(?:ond)?s?(?![a-z])", "", bare_name(name))


def _channels(
    classified: Sequence[Column], columns: Mapping[str, NDArray[np.generic]], quantity: Quantity
) -> tuple[dict[str, Array], dict[str, str]]:
    channels: dict[str, Array] = {}
    units: dict[str, str] = {}
    for kind, name in CHANNELS.items():
        if kind == quantity.name:
            continue
        found = {column.axis: column for column in classified if column.kind == kind}
        if not found:
            continue
        if set(AXES) <= set(found):
            channels[name] = np.stack([np.asarray(columns[found[a].name], dtype=np.float64) for a in AXES])
        elif kind == "temperature":
            channels[name] = np.asarray(columns[next(iter(found.values())).name], dtype=np.float64)
        else:
            continue
        if unit := next(iter(found.values())).unit:
            units[name] = unit
    return channels, units
