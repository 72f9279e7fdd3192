"""ArduPilot dataflash logs, binary `.bin` and text `.log`: each instance of IMU, GYR, ACC or a batch is a device."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gyrofuse.io.formats.columns import AXES, CHANNELS, OTHER, or_else
from gyrofuse.io.formats.robots.dataflash_messages import BATCH_FIELDS, FMT, MAGIC, Table, read_binary, read_text
from gyrofuse.io.limits import Allowance, enumerated, is_rate
from gyrofuse.io.resample import at_samples
from gyrofuse.io.streams import Array, RecordingError, Stream

# Messages by source: those of one sensor, whose name may end in its number.
_NAMES = {
    "IMU": ("IMU", "IMU2", "IMU3"),
    "GYR": ("GYR", "GYR1", "GYR2", "GYR3"),
    "ACC": ("ACC", "ACC1", "ACC2", "ACC3"),
    "ISBH": ("ISBH",),
}
_KEY = re.compile(r"(IMU|GYR|ACC|ISBH)(?:\[(\d{1,3})\])?")
_BATCH = 32  # samples of a message ISBD
# Microseconds since the controller was switched on, 31 years, beyond which a time is damage.
_FARTHEST = 1e15


@dataclass(frozen=True)
class _Sensor:
    """What differs between gyros and accelerometers.

    Attributes:
        word: What it is called.
        one: That with its article.
        raw: Messages of raw samples.
        fields: Of these and of IMU, along x, y, z.
        batch: `type` of a batch of them.
        unit: Of all of these.
    """

    word: str
    one: str
    raw: str
    fields: tuple[str, str, str]
    batch: int
    unit: str

    @property
    def sources(self) -> tuple[str, str, str]:
        """Messages that hold them, the preferred ones first."""
        return self.raw, "IMU", "ISBH"

    def asked(self, key: str) -> tuple[str, int | None] | None:
        """The source that `key` names and the instance of it, if any."""
        found = _KEY.fullmatch(key)
        if found is None or found[1] not in self.sources:
            return None
        return found[1], None if found[2] is None else int(found[2])


_SENSORS = {
    "rate": _Sensor("gyro", "a gyro", "GYR", ("GyrX", "GyrY", "GyrZ"), 1, "rad/s"),
    "acceleration": _Sensor("accelerometer", "an accelerometer", "ACC", ("AccX", "AccY", "AccZ"), 0, "m/s^2"),
}


def read(path: Path, *, key: str | None = None, quantity: str = "rate", max_bytes: float | None = None) -> list[Stream]:
    """Read the gyros or accelerometers of an ArduPilot log in rad/s or m/s^2, one stream per instance.

    Raw samples (`GYR`, `ACC`) are preferred to those of the main loop (`IMU`), and both to batches (`ISBH`, `ISBD`).
    The batches of a log are bursts of one sensor after the other, so that no two sensors were sampled together and no
    burst goes on in the next: what is read of them is the longest run of one sensor without a gap.

    Args:
        path: The file; whether it is binary or text is told by its content.
        key: `"IMU"`, `"GYR"` (`"ACC"`) or `"ISBH"`, or one instance of it, `"ISBH[1]"`; `None` chooses.
        quantity: `"rate"` or `"acceleration"`: the sensors to read.
        max_bytes: Memory that the log may take; by default a quarter of what there is.

    Raises:
        RecordingError: Not an ArduPilot log, without the quantity or source asked for, or too large.
    """
    allowance = Allowance(path, max_bytes)
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
    return _chosen(path, tables, notes, key, quantity, allowance)


def _chosen(
    path: Path, tables: Mapping[str, Table], notes: list[str], key: str | None, quantity: str, allowance: Allowance
) -> list[Stream]:
    """The streams of the source that `key` names, or of the first one there is."""
    sensor, other = _SENSORS[quantity], _SENSORS[OTHER[quantity]]
    raw, imu, batch = sensor.sources
    if key is not None and sensor.asked(key) is None:
        advice = or_else({OTHER[quantity]} if other.asked(key) else (), quantity, "name one of these")
        raise RecordingError(
            f"{path}: expected `key` {raw}, {imu} or {batch}, or an instance of one, {imu}[0], got {key!r}; {advice}"
        )
    there = [source for source in sensor.sources if any(name in tables for name in _NAMES[source])]
    for source in there:
        streams = _read_source(source, tables, notes, key, quantity, allowance)
        if streams:
            others = [other for other in there if other != source]
            also = [f"{' and '.join(others)} of the same log not read; choose with key="] if others and not key else []
            return [replace(stream, notes=(*stream.notes, *notes, *also)) for stream in streams]
    named = "" if key is None else f" named by `key` {key!r}"
    found = enumerated(f"{len(table[''])} of {name}" for name, table in tables.items()) or "none of these messages"
    said = f" ({'; '.join(notes)})" if notes else ""
    kinds = (
        {OTHER[quantity]}
        if any(_read_source(source, tables, [], key, OTHER[quantity], allowance) for source in other.sources)
        else ()
    )
    advice = or_else(kinds, quantity, "log them (LOG_BITMASK), choose another `key`, or download the log again")
    raise RecordingError(
        f"{path}: expected at least two messages of {sensor.one} ({imu}, {raw}, or {batch} with ISBD){named}, found "
        f"{found}{said}; {advice}"
    )


def _read_source(
    source: str, tables: Mapping[str, Table], notes: list[str], key: str | None, quantity: str, allowance: Allowance
) -> list[Stream]:
    """The streams of one source, where `key` does not name another: of batches the longest."""
    asked = _SENSORS[quantity].asked(key) if key is not None else (source, None)
    if asked is None or asked[0] != source:
        return []
    batch = source == "ISBH"
    streams = _batch(tables, quantity, allowance) if batch else _instances(source, tables, quantity, notes)
    if asked[1] is not None:
        streams = [stream for stream in streams if stream.name == f"{source}[{asked[1]}]"]
    return [max(streams, key=lambda stream: stream.n_samples)] if batch and streams else streams


def _instances(source: str, tables: Mapping[str, Table], quantity: str, notes: list[str]) -> list[Stream]:
    """The sensors of messages IMU, GYR or ACC, with the other quantity and temperatures."""
    sensor, other = _SENSORS[quantity], _SENSORS[OTHER[quantity]]
    raw = source != "IMU"
    own = _by_instance(tables, _NAMES[source], sensor.fields, notes)
    beside = _by_instance(tables, _NAMES[other.raw], other.fields, notes) if raw else own
    warmths = _by_instance(tables, _NAMES["IMU"], sensor.fields, notes) if raw else own
    streams = []
    for instance, table in sorted(own.items()):
        channels: dict[str, Array] = {}
        units: dict[str, str] = {}
        said = []
        second, warmth = beside.get(instance, {}), warmths.get(instance, {})
        if set(other.fields) <= second.keys():
            name, values = CHANNELS[OTHER[quantity]], np.stack([second[field] for field in other.fields])
            channels[name], note = at_samples(table["time"], second["time"], values, name)
            units[name] = other.unit
            said += [note] if note else []
        warm = next((warmth[name] for name in ("T", "Temp") if name in warmth), None)
        if warm is not None and np.any(warm != 0):  # a controller without thermometer writes zeros
            channels["temperature"], note = at_samples(table["time"], warmth["time"], warm, "temperature")
            units["temperature"] = "degC"
            said += [note] if note else []
        streams.append(
            Stream(
                name=f"{source}[{instance}]",
                signal={axis: table[name] for axis, name in zip(AXES, sensor.fields, strict=True)},
                unit=sensor.unit,
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
        # `I` of a log of today; before 2020 each sensor had a message of its own, IMU, IMU2, GYR1, GYR2
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
    """When each sample was measured, in seconds, or else when it was logged."""
    if np.any(table.get("SampleUS", 0.0)):
        return table["SampleUS"] * 1e-6
    if "TimeUS" in table:
        return table["TimeUS"] * 1e-6
    return table["TimeMS"] * 1e-3 if "TimeMS" in table else None


def _batch(tables: Mapping[str, Table], quantity: str, allowance: Allowance) -> list[Stream]:
    """The longest run without a gap of each sensor that was sampled in batches."""
    sensor = _SENSORS[quantity]
    heads, data = tables.get("ISBH", {}), tables.get("ISBD", {})
    if not (BATCH_FIELDS - {"seqno", "x", "y", "z"} <= heads.keys() and {"N", "seqno", "x", "y", "z"} <= data.keys()):
        return []
    if data["x"].ndim != 2:
        return []
    # A message of data belongs to the last header before it, whose number it bears.
    owner = np.searchsorted(heads[""], data[""]) - 1
    begin = _BATCH * data["seqno"]
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
        allowance.take("samples of batches", (int(mine.sum()), _BATCH * 8))
        batch = owner[mine][:, None]
        number = begin[mine][:, None] + np.arange(_BATCH)
        inside = number < heads["smp_cnt"][batch]
        time = (heads["SampleUS"][batch] * 1e-6 + number / rate[batch])[inside]
        # The sampler multiplies rates in rad/s and accelerations in m/s^2 by `mul` to whole numbers.
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
            f"batches that are apart in time ({enumerated(_counted(heads, read, sensor.word))}): read is the longest "
            f"run of this {sensor.word} without a gap, {run.stop - run.start} samples from {time[run][0]:.6g} s, at "
            f"the rate that the log states ({rates[run][0]:.6g} Hz)"
        )
        damage = (
            f"{bad} batches of {sensor.word}s have senseless headers or numbers of samples and were left out: damage"
        )
        streams.append(
            Stream(
                name=f"ISBH[{instance}]",
                signal=dict(zip(AXES, values[:, run], strict=True)),
                unit=sensor.unit,
                time=time[run],
                rate=float(rates[run][0]),
                notes=(note, damage) if bad else (note,),
            )
        )
    return streams


def _counted(heads: Table, read: NDArray[np.bool_], word: str) -> list[str]:
    instances, counts = np.unique(heads["instance"][read], return_counts=True)
    return [f"{count} of {word} {instance:.0f}" for instance, count in zip(instances, counts, strict=True)]
