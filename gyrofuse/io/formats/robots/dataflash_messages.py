"""Messages of ArduPilot logs, by the declarations that stand in the logs themselves.

A binary log is a row of messages, each with two magic bytes and its type in front. Messages of type 128 (`FMT`) declare
the others: length, name, one letter for the type of each field, names of fields. A text log has one message a line,
`IMU, 1000, 0, ...`, and the same declarations (AP_Logger/LogStructure.h, AP_InertialSensor/LogStructure.h).
"""

from __future__ import annotations

import re
from array import array
from dataclasses import dataclass, field

import numpy as np

from gyrofuse.io.limits import Allowance, decoded
from gyrofuse.io.streams import Array

MAGIC = b"\xa3\x95"
FMT = 128  # type of the message that declares the others
_FMT_DTYPE = np.dtype([("type", "u1"), ("length", "u1"), ("name", "S4"), ("format", "S16"), ("columns", "S64")])
BATCH = 32  # samples of a message ISBD, by its declaration in ArduPilot
_DTYPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "a": ("<i2", (BATCH,)),
    **{letter: (kind, ()) for letter, kind in zip("bBhHiIqQ", "i1 u1 <i2 <u2 <i4 <u4 <i8 <u8".split(), strict=True)},
    **{letter: (kind, ()) for letter, kind in zip("gfdnNZM", "<f2 <f4 <f8 S4 S16 S64 u1".split(), strict=True)},
    # Fixed-point numbers: no field that is read is one.
    **dict.fromkeys("cC", ("<i2", ())),
    **dict.fromkeys("eEL", ("<i4", ())),
}
# Messages that are read, and their fields.
_READ = frozenset("IMU IMU2 IMU3 GYR GYR1 GYR2 GYR3 ACC ACC1 ACC2 ACC3 ISBH ISBD".split())
_FIELDS = frozenset("GyrX GyrY GyrZ AccX AccY AccZ TimeUS TimeMS SampleUS I T Temp".split())
BATCH_FIELDS = frozenset("N type instance mul smp_cnt SampleUS smp_rate seqno x y z".split())
# Lines that are read, of up to 4096 bytes: a line with all fields of the longest message has some 700.
_LINE = re.compile(rb"^(FMT|IMU[23]?|GYR[123]?|ACC[123]?|ISB[HD])[ \t]{0,9},([^\n]{0,4096})", re.MULTILINE)
_TEXTS = "nNZ"

# Fields of one kind of message by name, `(n,)` or `(n, 32)`; "" is the position in the log at which a message begins.
Table = dict[str, Array]


@dataclass(eq=False)
class _Kind:
    """A kind of message as its FMT declares it, with the positions and, of a text log, the values of its messages."""

    name: str
    letters: str
    columns: tuple[str, ...]
    starts: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    @property
    def declared(self) -> tuple[str, str, tuple[str, ...]]:
        """Content of the FMT."""
        return self.name, self.letters, self.columns

    @property
    def fields(self) -> list[int]:
        """Positions of the fields that are read."""
        wanted = BATCH_FIELDS if self.name in ("ISBH", "ISBD") else _FIELDS
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


def read_binary(content: bytes, allowance: Allowance) -> tuple[dict[str, Table], list[str]]:
    """Read the messages of a binary log.

    Args:
        content: The log.
        allowance: Memory that the messages may take.

    Returns:
        Tables by name of message, and notes on damage.
    """
    lengths, kinds = [0] * 256, dict[int, _Kind]()
    lengths[FMT] = _FMT_DTYPE.itemsize + 3
    read: list[_Kind] = []
    starts: dict[int, array[int]] = {}
    at, last, skipped, end = 0, 0, 0, len(content)
    while 0 <= at <= end - 3:
        number = content[at + 2]
        length = lengths[number]
        if not length or at + length > end or content[at : at + 2] != MAGIC:
            at = content.find(MAGIC, at + 1)
            continue
        if number == FMT:
            declared = np.frombuffer(content, _FMT_DTYPE, 1, at + 3)[0]
            name, letters, columns = (decoded(bytes(declared[part])) for part in ("name", "format", "columns"))
            kind, described = _Kind(name, letters, tuple(columns.split(","))), int(declared["type"])
            old = kinds.get(described)
            # A log may declare a kind several times in the same words.
            if described != FMT and (old is None or old.declared != kind.declared):
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
    if end - last > 256:  # bytes: a message has at most 255, and a sound log may end with the rest of a page
        notes.append(f"the last {end - last} bytes are no message: the log was cut off, or its end is damaged")
    octets = np.frombuffer(content, np.uint8)
    tables: dict[str, Table] = {}
    for kind in _most(read, notes):
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


def read_text(content: bytes, allowance: Allowance) -> tuple[dict[str, Table], list[str]]:
    """Read the messages of a text log.

    Args:
        content: The log.
        allowance: Memory that the messages may take.

    Returns:
        Tables by name of message, and notes on damage.
    """
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
    tables: dict[str, Table] = {}
    for kind in _most(read, notes):
        rows = np.frombuffer(kind.values, np.float64).reshape(len(kind.starts), len(kind.fields))
        columns = {kind.columns[i]: rows[:, n].copy() for n, i in enumerate(kind.fields)}
        tables[kind.name] = {"": np.array(kind.starts, np.float64), **columns}
    # Mission Planner writes the arrays of a batch as numbers of 16 bits or of 8, depending on the system it runs on.
    if tables.pop("ISBD", None) is not None:
        notes.append("batches (ISBD) are not read from a text log, whose arrays are not to be relied on; give the .bin")
    return tables, notes


def _number(cell: bytes) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _most(kinds: list[_Kind], notes: list[str]) -> list[_Kind]:
    """The kind with most messages of each name: a log that was joined from several may declare a name repeatedly."""
    chosen: dict[str, _Kind] = {}
    for kind in kinds:
        if len(kind.starts) > (len(chosen[kind.name].starts) if kind.name in chosen else 0):
            chosen[kind.name] = kind
    for name, kind in chosen.items():
        left = sum(len(other.starts) for other in kinds if other.name == name and other is not kind)
        if left:
            notes.append(f"{left} messages {name} declare other fields than most and were left out")
    return list(chosen.values())
