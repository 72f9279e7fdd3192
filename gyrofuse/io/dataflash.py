"""ArduPilot dataflash logs, binary `.bin` and text `.log`: each instance of IMU, GYR or a batch sampler is a device.

A binary log is a row of messages, each with two magic bytes and its type in front. Messages of type 128 (`FMT`) declare
the others: length, name, one letter for the type of each field, names of fields. A text log has one message a line,
`IMU, 1000, 0, ...`, and the same declarations (AP_Logger/LogStructure.h, AP_InertialSensor/LogStructure.h).
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gyrofuse.io.columns import AXES
from gyrofuse.io.limits import Allowance, decoded, enumerated, is_rate
from gyrofuse.io.resample import at_samples
from gyrofuse.io.stream import Array, RecordingError, Stream

_MAGIC = b"\xa3\x95"
_FMT = 128
_FMT_DTYPE = np.dtype([("type", "u1"), ("length", "u1"), ("name", "S4"), ("format", "S16"), ("columns", "S64")])
_DTYPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "a": ("<i2", (32,)),
    **{letter: (kind, ()) for letter, kind in zip("bBhHiIqQ", "i1 u1 <i2 <u2 <i4 <u4 <i8 <u8".split(), strict=True)},
    **{letter: (kind, ()) for letter, kind in zip("gfdnNZM", "<f2 <f4 <f8 S4 S16 S64 u1".split(), strict=True)},
    # Fixed-point numbers: no field that is read is one.
    **dict.fromkeys("cC", ("<i2", ())),
    **dict.fromkeys("eEL", ("<i4", ())),
}
# Messages by source: those of one gyro, whose name may end in its number.
_NAMES = {"IMU": ("IMU", "IMU2", "IMU3"), "GYR": ("GYR", "GYR1", "GYR2", "GYR3"), "ISBH": ("ISBH",)}
_ACCELERATIONS = {"IMU": _NAMES["IMU"], "GYR": ("ACC", "ACC1", "ACC2", "ACC3")}
_READ = frozenset((*_NAMES["IMU"], *_NAMES["GYR"], *_ACCELERATIONS["GYR"], "ISBH", "ISBD"))
_RATES, _FORCES = ("GyrX", "GyrY", "GyrZ"), ("AccX", "AccY", "AccZ")
_FIELDS = frozenset((*_RATES, *_FORCES, "TimeUS", "TimeMS", "SampleUS", "I", "T", "Temp"))
_BATCH_FIELDS = frozenset("N type instance mul smp_cnt SampleUS smp_rate seqno x y z".split())
_BATCH = 32  # samples of a message ISBD
_GYRO_BATCH = 1  # `type` of a batch of rates; 0 are accelerations
# Microseconds since the controller was switched on, 31 years, beyond which a time is damage.
_FARTHEST = 1e15
# A message is at most 255 bytes long: this much at the end of a log is one that was cut off, or the rest of a page.
_CUT_OFF = 256
# Lines that are read, up to 4096 bytes: one with all fields of the longest message has some 700.
_LINE = re.compile(rb"^(FMT|IMU[23]?|GYR[123]?|ACC[123]?|ISB[HD])[ \t]{0,9},([^\n]{0,4096})", re.MULTILINE)
_KEY = re.compile(r"(IMU|GYR|ISBH)(?:\[(\d{1,3})\])?")

_TEXTS = "nNZ"

# Fields of one kind of message by name, `(n,)` or `(n, 32)`; "" is where in the log each message begins.
_Table = dict[str, Array]


def read(path: Path, *, key: str | None = None, quantity: str = "rate", max_bytes: float | None = None) -> list[Stream]:
    """Read the gyros of an ArduPilot log in rad/s, one stream per instance.

    Raw samples (`GYR`) are preferred to those of the main loop (`IMU`), and both to batches (`ISBH`, `ISBD`). The
    batches of a log are bursts of one sensor after the other, so that no two gyros were sampled together and no burst
    goes on in the next: what is read of them is the longest run of one gyro without a gap.

    Args:
        path: The file; whether it is binary or text is told by its content.
        key: `"IMU"`, `"GYR"` or `"ISBH"`, or one instance of it, `"ISBH[1]"`; `None` chooses.
        max_bytes: Memory that the log may take; by default a quarter of what there is.

    Raises:
        RecordingError: Not an ArduPilot log, without gyro data or the source asked for, or too large.
    """
    allowance = Allowance(path, max_bytes)
    allowance.take("messages", (-(-path.stat().st_size // 8),))
    content = path.read_bytes()
    if _MAGIC + bytes([_FMT]) in content:
        tables, notes = _binary(content, allowance)
    elif content.startswith(b"FMT,") or b"\nFMT," in content:
        tables, notes = _text(content, allowance)
    else:
        raise RecordingError(
            f"{path}: expected an ArduPilot dataflash log, binary or text, found no message FMT, which declares the "
            "others; download the log from the vehicle again, and rename a text file of columns to .txt"
        )
    return _chosen(path, tables, notes, key, allowance)


def _chosen(
    path: Path, tables: Mapping[str, _Table], notes: list[str], key: str | None, allowance: Allowance
) -> list[Stream]:
    """The streams of the source that `key` names, or of the first one there is."""
    asked = _KEY.fullmatch(key) if key is not None else None
    if key is not None and asked is None:
        raise RecordingError(f"{path}: expected `key` IMU, GYR or ISBH, or an instance of one, IMU[0], got {key!r}")
    there = [source for source in ("GYR", "IMU", "ISBH") if any(name in tables for name in _NAMES[source])]
    wanted = [asked[1]] if asked else there
    for source in (source for source in there if source in wanted):
        streams = _batch(tables, allowance) if source == "ISBH" else _instances(source, tables, notes)
        if asked and asked[2] is not None:
            streams = [stream for stream in streams if stream.name == f"{source}[{int(asked[2])}]"]
        if source == "ISBH" and streams:
            streams = [max(streams, key=lambda stream: stream.n_samples)]
        if streams:
            others = [other for other in there if other != source]
            also = [f"{' and '.join(others)} of the same log not read; choose with key="] if others and not key else []
            return [replace(stream, notes=(*stream.notes, *notes, *also)) for stream in streams]
    named = "" if key is None else f" named by `key` {key!r}"
    found = enumerated(f"{len(table[''])} of {name}" for name, table in tables.items()) or "none of these messages"
    said = f" ({'; '.join(notes)})" if notes else ""
    raise RecordingError(
        f"{path}: expected at least two messages of a gyro (IMU, GYR, or ISBH with ISBD){named}, found {found}{said}; "
        "log them (LOG_BITMASK), choose another `key`, or download the log again"
    )


# --- Messages ---------------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Kind:
    """A kind of message as its FMT declares it, and where its messages begin or what they hold."""

    name: str
    letters: str
    columns: tuple[str, ...]
    starts: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    @property
    def declared(self) -> tuple[str, str, tuple[str, ...]]:
        """What the FMT says."""
        return self.name, self.letters, self.columns

    @property
    def fields(self) -> list[int]:
        """Positions of the fields that are read."""
        wanted = _BATCH_FIELDS if self.name in ("ISBH", "ISBD") else _FIELDS
        return [i for i, column in enumerate(self.columns) if column in wanted]

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Layout of a message behind its header."""
        return np.dtype([(f"f{i}", *_DTYPES[letter]) for i, letter in enumerate(self.letters)])

    @property
    def is_sound(self) -> bool:
        """Whether every field has a name of its own and a known type."""
        known = 0 < len(self.letters) == len(self.columns) == len({*self.columns})
        return known and set(self.letters) <= _DTYPES.keys()


def _binary(content: bytes, allowance: Allowance) -> tuple[dict[str, _Table], list[str]]:
    """The messages of a binary log that are read, and what is wrong with it."""
    lengths, kinds = [0] * 256, dict[int, _Kind]()
    lengths[_FMT] = _FMT_DTYPE.itemsize + 3
    read: list[_Kind] = []
    starts: dict[int, array[int]] = {}
    at, last, skipped, end = 0, 0, 0, len(content)
    while 0 <= at <= end - 3:
        number = content[at + 2]
        length = lengths[number]
        if not length or at + length > end or content[at : at + 2] != _MAGIC:
            at = content.find(_MAGIC, at + 1)
            continue
        if number == _FMT:
            declared = np.frombuffer(content, _FMT_DTYPE, 1, at + 3)[0]
            name, letters, columns = (decoded(bytes(declared[part])) for part in ("name", "format", "columns"))
            kind, described = _Kind(name, letters, tuple(columns.split(","))), int(declared["type"])
            old = kinds.get(described)
            # A log declares its kinds once, or again and again in the same words.
            if described != _FMT and (old is None or old.declared != kind.declared):
                sound = kind.is_sound and kind.dtype.itemsize + 3 == declared["length"]
                allowance.take("declarations", (_FMT_DTYPE.itemsize,))
                kinds[described], lengths[described] = kind, int(declared["length"]) if sound else 0
                starts.pop(described, None)
                if sound and name in _READ:
                    read.append(kind)
                    starts[described] = kind.starts
        elif number in starts:
            starts[number].append(at)
        skipped, at = skipped + at - last, at + length
        last = at
    notes = [f"{skipped} bytes between messages are none and were skipped: damage"] if skipped else []
    if end - last > _CUT_OFF:
        notes.append(f"the last {end - last} bytes are no message: the log was cut off, or its end is damaged")
    octets = np.frombuffer(content, np.uint8)
    tables: dict[str, _Table] = {}
    for kind in _most(read, lambda kind: len(kind.starts), notes):
        begin = np.frombuffer(kind.starts, np.int64)
        dtype = kind.dtype
        allowance.take(f"messages {kind.name}", (begin.size, dtype.itemsize // 8 + 1))
        rows = np.lib.stride_tricks.sliding_window_view(octets, dtype.itemsize)[begin + 3].view(dtype)[:, 0]
        table = {"": begin.astype(np.float64)}
        for i in kind.fields:
            if kind.letters[i] not in _TEXTS:
                allowance.take(f"numbers of {kind.name}", rows[f"f{i}"].shape)
                with np.errstate(invalid="ignore"):  # damage may make a number that is none in a way NumPy reports
                    table[kind.columns[i]] = rows[f"f{i}"].astype(np.float64)
        tables[kind.name] = table
    return tables, notes


def _text(content: bytes, allowance: Allowance) -> tuple[dict[str, _Table], list[str]]:
    """The messages of a text log that are read, and what is wrong with it."""
    kinds, read = dict[str, _Kind](), list[_Kind]()
    bad = 0
    for found in _LINE.finditer(content):
        name, rest = found[1].decode("ascii"), found[2]
        if name == "FMT":
            cells = [cell.strip() for cell in decoded(rest).split(",")]
            if len(cells) > 4 and cells[2] in _READ:
                kind, old = _Kind(cells[2], cells[3], tuple(cells[4:])), kinds.get(cells[2])
                if kind.is_sound and (old is None or old.declared != kind.declared):
                    allowance.take("declarations", (len(rest),))
                    kinds[kind.name] = kind
                    read.append(kind)
        elif name in kinds:
            kind = kinds[name]
            values = rest.split(b",")
            if len(values) != len(kind.columns):
                bad += 1
                continue
            allowance.take(f"messages {name}", (len(kind.fields) + 1,))
            kind.starts.append(found.start())
            for i in kind.fields:
                kind.values.append(_number(values[i]))
    notes = [f"{bad} lines have more or fewer fields than declared and were left out: damage"] if bad else []
    tables: dict[str, _Table] = {}
    for kind in _most(read, lambda kind: len(kind.starts), notes):
        rows = np.frombuffer(kind.values, np.float64).reshape(len(kind.starts), len(kind.fields))
        columns = {kind.columns[i]: rows[:, n].copy() for n, i in enumerate(kind.fields)}
        tables[kind.name] = {"": np.array(kind.starts, np.float64), **columns}
    # What Mission Planner writes for the arrays of a batch depends on what it runs on: numbers of 16 bits or of 8.
    if tables.pop("ISBD", None) is not None:
        notes.append("batches (ISBD) are not read from a text log, whose arrays are not to be relied on; give the .bin")
    return tables, notes


def _number(cell: bytes) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _most(kinds: list[_Kind], count: Callable[[_Kind], int], notes: list[str]) -> list[_Kind]:
    """Of the kinds of one name, which a log that was put together from several may have, the one with most messages."""
    chosen: dict[str, _Kind] = {}
    for kind in kinds:
        if count(kind) > (count(chosen[kind.name]) if kind.name in chosen else 0):
            chosen[kind.name] = kind
    for name, kind in chosen.items():
        left = sum(count(other) for other in kinds if other.name == name) - count(kind)
        if left:
            notes.append(f"{left} messages {name} declare other fields than most and were left out")
    return list(chosen.values())


# --- Streams ----------------------------------------------------------------------------------------------------------


def _instances(source: str, tables: Mapping[str, _Table], notes: list[str]) -> list[Stream]:
    """The gyros of messages IMU or GYR, with accelerations and temperatures."""
    gyros = _by_instance(tables, _NAMES[source], _RATES, notes)
    forces = gyros if source == "IMU" else _by_instance(tables, _ACCELERATIONS[source], _FORCES, notes)
    warmths = gyros if source == "IMU" else _by_instance(tables, _NAMES["IMU"], _RATES, notes)
    streams = []
    for instance, table in sorted(gyros.items()):
        channels: dict[str, Array] = {}
        said = []
        force, warmth = forces.get(instance, {}), warmths.get(instance, {})
        if set(_FORCES) <= force.keys():
            values = np.stack([force[name] for name in _FORCES])
            channels["acceleration"], note = at_samples(table["time"], force["time"], values, "acceleration")
            said += [note] if note else []
        warm = next((warmth[name] for name in ("T", "Temp") if name in warmth), None)
        if warm is not None and np.any(warm != 0):  # a controller without thermometer writes zeros
            channels["temperature"], note = at_samples(table["time"], warmth["time"], warm, "temperature")
            said += [note] if note else []
        streams.append(
            Stream(
                name=f"{source}[{instance}]",
                gyro={axis: table[name] for axis, name in zip(AXES, _RATES, strict=True)},
                unit="rad/s",
                time=table["time"],
                channels=channels,
                channel_units={name: {"acceleration": "m/s^2", "temperature": "degC"}[name] for name in channels},
                notes=tuple(said),
            )
        )
    return streams


def _by_instance(
    tables: Mapping[str, _Table], names: tuple[str, ...], needed: tuple[str, ...], notes: list[str]
) -> dict[int, _Table]:
    """Messages by the number of their sensor, with `time` in seconds; those of one sensor are in order of the log."""
    found: dict[int, _Table] = {}
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


def _time(table: _Table) -> Array | None:
    """When each sample was measured, in seconds, or else when it was logged."""
    if np.any(table.get("SampleUS", 0.0)):
        return table["SampleUS"] * 1e-6
    if "TimeUS" in table:
        return table["TimeUS"] * 1e-6
    return table["TimeMS"] * 1e-3 if "TimeMS" in table else None


def _batch(tables: Mapping[str, _Table], allowance: Allowance) -> list[Stream]:
    """The longest run without a gap of each gyro that was sampled in batches."""
    heads, data = tables.get("ISBH", {}), tables.get("ISBD", {})
    if not (_BATCH_FIELDS - {"seqno", "x", "y", "z"} <= heads.keys() and {"N", "seqno", "x", "y", "z"} <= data.keys()):
        return []
    if data["x"].ndim != 2:
        return []
    # A message of data belongs to the last header before it, whose number it bears.
    owner = np.searchsorted(heads[""], data[""]) - 1
    begin = _BATCH * data["seqno"]
    fits = (owner >= 0) & (heads["N"][owner] == data["N"])
    gyro = heads["type"] == _GYRO_BATCH
    rate = np.where([is_rate(value) for value in heads["smp_rate"].tolist()], heads["smp_rate"], np.nan)
    sound = (heads["mul"] > 0) & (heads["smp_cnt"] > 0) & np.isfinite(rate) & (heads["SampleUS"] < _FARTHEST)
    beyond = np.unique(owner[fits & (begin >= heads["smp_cnt"][owner])])
    sound[beyond] = False  # sampled with other than 32 samples a message, or damaged
    used = fits & gyro[owner] & sound[owner]
    bad = int((gyro & ~sound).sum())
    streams, of_gyro = [], gyro & sound
    for instance in np.unique(heads["instance"][of_gyro]).astype(int).tolist():
        mine = used & (heads["instance"][owner] == instance)
        allowance.take("samples of batches", (int(mine.sum()), _BATCH * 8))
        batch = owner[mine][:, None]
        number = begin[mine][:, None] + np.arange(_BATCH)
        inside = number < heads["smp_cnt"][batch]
        time = (heads["SampleUS"][batch] * 1e-6 + number / rate[batch])[inside]
        # The sampler multiplies rates in rad/s by `mul` to whole numbers.
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
            f"batches that are apart in time ({enumerated(_counted(heads, of_gyro))}): read is the longest run of this "
            f"gyro without a gap, {run.stop - run.start} samples from {time[run][0]:.6g} s, at the rate that the log "
            f"states ({rates[run][0]:.6g} Hz)"
        )
        damage = f"{bad} batches of gyros have senseless headers or numbers of samples and were left out: damage"
        streams.append(
            Stream(
                name=f"ISBH[{instance}]",
                gyro=dict(zip(AXES, values[:, run], strict=True)),
                unit="rad/s",
                time=time[run],
                rate=float(rates[run][0]),
                notes=(note, damage) if bad else (note,),
            )
        )
    return streams


def _counted(heads: _Table, of_gyro: NDArray[np.bool_]) -> list[str]:
    instances, counts = np.unique(heads["instance"][of_gyro], return_counts=True)
    return [f"{count} of gyro {instance:.0f}" for instance, count in zip(instances, counts, strict=True)]
