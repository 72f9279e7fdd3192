"""ArduPilot dataflash logs, binary `.bin` and text `.log`: each instance of IMU, GYR, ACC or a batch is a device."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gyrofuse.io.align import at_samples
from gyrofuse.io.formats.columns import AXES
from gyrofuse.io.formats.request import Request
from gyrofuse.io.formats.robots.dataflash_messages import BATCH, BATCH_FIELDS, FMT, MAGIC, Table, read_binary, read_text
from gyrofuse.io.limits import Allowance, enumerated, is_rate
from gyrofuse.io.quantities import ACCELERATION, RATE, Quantity
from gyrofuse.io.streams import Array, RecordingError, Stream

# Names of the messages of each source; a name may end in the number of the sensor.
_NAMES = {
    "IMU": ("IMU", "IMU2", "IMU3"),
    "GYR": ("GYR", "GYR1", "GYR2", "GYR3"),
    "ACC": ("ACC", "ACC1", "ACC2", "ACC3"),
    "ISBH": ("ISBH",),
}
_KEY = re.compile(r"(IMU|GYR|ACC|ISBH)(?:\[(\d{1,3})\])?")
# Time in microseconds since the controller was switched on, 31 years, beyond which a message is damaged.
_FARTHEST = 1e15


@dataclass(frozen=True)
class _Sensor:
    """The messages of a quantity.

    Attributes:
        quantity: The quantity.
        raw: Name of messages of raw samples.
        fields: Fields of messages of raw samples and of IMU, along x, y, z.
        batch: `type` of a batch.
    """

    quantity: Quantity
    raw: str
    fields: tuple[str, str, str]
    batch: int

    @property
    def sources(self) -> tuple[str, str, str]:
        """Messages of the quantity, the preferred ones first."""
        return self.raw, "IMU", "ISBH"

    def named(self, key: str) -> tuple[str, int | None] | None:
        """The source that `key` names and its instance, if any."""
        found = _KEY.fullmatch(key)
        if found is None or found[1] not in self.sources:
            return None
        return found[1], None if found[2] is None else int(found[2])


_SENSORS = {
    RATE: _Sensor(RATE, "GYR", ("GyrX", "GyrY", "GyrZ"), batch=1),
    ACCELERATION: _Sensor(ACCELERATION, "ACC", ("AccX", "AccY", "AccZ"), batch=0),
}


def read(request: Request) -> list[Stream]:
    """Read the gyros or accelerometers of an ArduPilot log in rad/s or m/s^2, one stream per instance.

    Raw samples (`GYR`, `ACC`) are preferred to those of the main loop (`IMU`), and both to batches (`ISBH`, `ISBD`).
    The batches of a log are bursts of one sensor after the other: no two sensors are sampled together, and no burst
    continues in the next. Of batches the longest run of one sensor without a gap is read.

    Args:
        request: The file, whose content shows whether it is binary or text, and the part of it to read. Its `key` is
            `"IMU"`, `"GYR"` (`"ACC"`) or `"ISBH"`, or one instance of it, `"ISBH[1]"`; `None` chooses.

    Raises:
        RecordingError: Not an ArduPilot log, without the quantity or source asked for, or too large.
    """
    path = request.path
    allowance = request.allowance()
    allowance.take("messages", (-(-path.stat().st_size // 8),))
    content = path.read_bytes()
    if MAGIC + bytes([FMT]) in content:
        tables, notes = read_binary(content, allowance)
    elif content.startswith(b"FMT,") or b"\nFMT," in content:
        tables, notes = read_text(content, allowance)
    else:
        raise RecordingError(
            f"{path}: expected an ArduPilot dataflash log, binary or text, found no message FMT, which declares the "
            "others; download the log from the vehicle again, and rename a text file of columns to .txt"
        )
    return _chosen(request, tables, notes, allowance)


def _chosen(request: Request, tables: Mapping[str, Table], notes: list[str], allowance: Allowance) -> list[Stream]:
    """The streams of the source that `key` names, or of the first source that the log has."""
    path, key, quantity = request.path, request.key, request.quantity
    sensor, other = _SENSORS[quantity], _SENSORS[quantity.other]
    raw, imu, batch = sensor.sources
    if key is not None and sensor.named(key) is None:
        advice = quantity.advice({quantity.other.name} if other.named(key) else (), "name one of these")
        raise RecordingError(
            f"{path}: expected `key` {raw}, {imu} or {batch}, or an instance of one, {imu}[0], got {key!r}; {advice}"
        )
    there = [source for source in sensor.sources if any(name in tables for name in _NAMES[source])]
    for source in there:
        streams = _read_source(source, tables, notes, key, sensor, allowance)
        if streams:
            others = [name for name in there if name != source]
            also = [f"{' and '.join(others)} of the same log not read; choose with key="] if others and not key else []
            return [replace(stream, notes=(*stream.notes, *notes, *also)) for stream in streams]
    named = "" if key is None else f" named by `key` {key!r}"
    found = enumerated(f"{len(table[''])} of {name}" for name, table in tables.items()) or "none of these messages"
    said = f" ({'; '.join(notes)})" if notes else ""
    has_other = any(_read_source(source, tables, [], key, other, allowance) for source in other.sources)
    advice = quantity.advice(
        {quantity.other.name} if has_other else (),
        "log them (LOG_BITMASK), choose another `key`, or download the log again",
    )
    raise RecordingError(
        f"{path}: expected at least two messages of {quantity.a_sensor} ({imu}, {raw}, or {batch} with ISBD){named}, "
        f"found {found}{said}; {advice}"
    )


def _read_source(
    source: str, tables: Mapping[str, Table], notes: list[str], key: str | None, sensor: _Sensor, allowance: Allowance
) -> list[Stream]:
    """The streams of one source, none where `key` names another; of batches the longest stream."""
    named = sensor.named(key) if key is not None else (source, None)
    if named is None or named[0] != source:
        return []
    batch = source == "ISBH"
    streams = _batch(tables, sensor, allowance) if batch else _instances(source, tables, sensor, notes)
    if named[1] is not None:
        streams = [stream for stream in streams if stream.name == f"{source}[{named[1]}]"]
    return [max(streams, key=lambda stream: stream.n_samples)] if batch and streams else streams


def _instances(source: str, tables: Mapping[str, Table], sensor: _Sensor, notes: list[str]) -> list[Stream]:
    """The sensors of messages IMU, GYR or ACC, with the other quantity and temperatures."""
    other = _SENSORS[sensor.quantity.other]
    raw = source != "IMU"
    own = _by_instance(tables, _NAMES[source], sensor.fields, notes)
    beside = _by_instance(tables, _NAMES[other.raw], other.fields, notes) if raw else own
    thermometers = _by_instance(tables, _NAMES["IMU"], sensor.fields, notes) if raw else own
    streams = []
    for instance, table in sorted(own.items()):
        channels: dict[str, Array] = {}
        units: dict[str, str] = {}
        said = []
        second, thermometer = beside.get(instance, {}), thermometers.get(instance, {})
        if set(other.fields) <= second.keys():
            name, values = other.quantity.channel, np.stack([second[field] for field in other.fields])
            channels[name], note = at_samples(table["time"], second["time"], values, name)
            units[name] = other.quantity.unit
            said += [note] if note else []
        degrees = next((thermometer[name] for name in ("T", "Temp") if name in thermometer), None)
        if degrees is not None and np.any(degrees != 0):  # a controller without thermometer writes zeros
            channels["temperature"], note = at_samples(table["time"], thermometer["time"], degrees, "temperature")
            units["temperature"] = "degC"
            said += [note] if note else []
        streams.append(
            Stream(
                name=f"{source}[{instance}]",
                signal={axis: table[name] for axis, name in zip(AXES, sensor.fields, strict=True)},
                unit=sensor.quantity.unit,
                time=table["time"],
                channels=channels,
                channel_units=units,
                notes=tuple(said),
            )
        )
    return streams


def _by_instance(
    tables: Mapping[str, Table], names: tuple[str, ...], needed: tuple[str, ...], notes: list[str]
) -> dict[int, Table]:
    """Messages by the number of their sensor, with `time` in seconds; those of one sensor are in order of the log."""
    found: dict[int, Table] = {}
    for name in names:
        table = tables.get(name, {})
        if not set(needed) <= table.keys():
            continue
        time = _time(table)
        if time is None:
            continue
        # The number is in `I`; before 2020 each sensor had a message of its own, IMU, IMU2, GYR1, GYR2.
        number = max(int(name[3:] or 1) - 1, 0)
        numbers = table.get("I", np.full(time.size, float(number)))
        sound = (np.abs(time) < _FARTHEST * 1e-6) & np.isfinite(numbers)
        if lost := int((~sound).sum()):
            notes.append(f"{lost} messages {name} with an impossible time or instance were left out")
        for instance in np.unique(numbers[sound]).astype(int).tolist():
            rows = sound & (numbers == instance)
            if rows.sum() < 2:
                notes.append(f"a single message {name} of instance {instance} was left out")
            elif instance not in found:
                found[instance] = {"time": time[rows], **{field: values[rows] for field, values in table.items()}}
    return found


def _time(table: Table) -> Array | None:
    """Time in seconds at which each sample was measured, or else at which it was logged."""
    if np.any(table.get("SampleUS", 0.0)):
        return table["SampleUS"] * 1e-6
    if "TimeUS" in table:
        return table["TimeUS"] * 1e-6
    return table["TimeMS"] * 1e-3 if "TimeMS" in table else None


def _batch(tables: Mapping[str, Table], sensor: _Sensor, allowance: Allowance) -> list[Stream]:
    """The longest run without a gap of each sensor that was sampled in batches."""
    word = sensor.quantity.sensor
    heads, data = tables.get("ISBH", {}), tables.get("ISBD", {})
    if not (BATCH_FIELDS - {"seqno", "x", "y", "z"} <= heads.keys() and {"N", "seqno", "x", "y", "z"} <= data.keys()):
        return []
    if data["x"].ndim != 2:
        return []
    # A message of data belongs to the last header before it, whose number it bears.
    owner = np.searchsorted(heads[""], data[""]) - 1
    begin = BATCH * data["seqno"]
    fits = (owner >= 0) & (heads["N"][owner] == data["N"])
    wanted = heads["type"] == sensor.batch
    rate = np.where([is_rate(value) for value in heads["smp_rate"].tolist()], heads["smp_rate"], np.nan)
    sound = (heads["mul"] > 0) & (heads["smp_cnt"] > 0) & np.isfinite(rate) & (heads["SampleUS"] < _FARTHEST)
    beyond = np.unique(owner[fits & (begin >= heads["smp_cnt"][owner])])
    sound[beyond] = False  # sampled with other than 32 samples a message, or damaged
    used = fits & wanted[owner] & sound[owner]
    bad = int((wanted & ~sound).sum())
    streams, read = [], wanted & sound
    for instance in np.unique(heads["instance"][read]).astype(int).tolist():
        mine = used & (heads["instance"][owner] == instance)
        allowance.take("samples of batches", (int(mine.sum()), BATCH * 8))
        batch = owner[mine][:, None]
        number = begin[mine][:, None] + np.arange(BATCH)
        inside = number < heads["smp_cnt"][batch]
        time = (heads["SampleUS"][batch] * 1e-6 + number / rate[batch])[inside]
        # The sampler multiplies rates in rad/s and accelerations in m/s^2 by `mul` and rounds them.
        values = np.stack([(data[axis][mine] / heads["mul"][batch])[inside] for axis in AXES])
        order = np.argsort(time, kind="stable")
        rates = np.broadcast_to(rate[batch], number.shape)[inside][order]
        time, values = time[order], values[:, order]
        if time.size < 2:
            continue
        ends = np.flatnonzero(np.abs(np.diff(time) * rates[1:] - 1) > 0.5) + 1
        bounds = np.concatenate([[0], ends, [time.size]])
        longest = int(np.argmax(np.diff(bounds)))
        run = slice(bounds[longest], bounds[longest + 1])
        note = (
            f"batches that are apart in time ({enumerated(_counted(heads, read, word))}): read is the longest "
            f"run of this {word} without a gap, {run.stop - run.start} samples from {time[run][0]:.6g} s, at "
            f"the rate that the log states ({rates[run][0]:.6g} Hz)"
        )
        damage = f"{bad} batches of {word}s have senseless headers or numbers of samples and were left out: damage"
        streams.append(
            Stream(
                name=f"ISBH[{instance}]",
                signal=dict(zip(AXES, values[:, run], strict=True)),
                unit=sensor.quantity.unit,
                time=time[run],
                rate=float(rates[run][0]),
                notes=(note, damage) if bad else (note,),
            )
        )
    return streams


def _counted(heads: Table, read: NDArray[np.bool_], word: str) -> list[str]:
    instances, counts = np.unique(heads["instance"][read], return_counts=True)
    return [f"{count} of {word} {instance:.0f}" for instance, count in zip(instances, counts, strict=True)]
