"""What was found in a log: nothing is repaired without saying so."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Note:
    """One finding about a recording.

    Attributes:
        kind: `gaps`, `repeats`, `jitter`, `drift`, `wraps`, `clock`, `non_finite`, `startup`, `offset`, `cut`,
            `unit` or `reader`.
        stream: Device or file it is about; empty when about all.
        sentence: The finding in words, with numbers and units.
        numbers: The same numbers by name.
    """

    kind: str
    stream: str
    sentence: str
    numbers: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.stream}: {self.sentence}" if self.stream else self.sentence

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "kind": self.kind,
            "stream": self.stream,
            "sentence": self.sentence,
            "numbers": self.numbers,
        }


class Notebook:
    """Collects the notes about one stream."""

    def __init__(self, stream: str) -> None:
        self.stream = stream
        self.notes: list[Note] = []

    def add(self, kind: str, sentence: str, **numbers: float) -> None:
        """Note a finding with its numbers."""
        plain = {name: float(value) for name, value in numbers.items()}
        self.notes.append(Note(kind, self.stream, sentence, plain))
