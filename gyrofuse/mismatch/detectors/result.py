"""The result of a test of recording against simulation."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from gyrofuse._base.deprecation import RenamedAttribute


@dataclass(frozen=True)
class TestResult:
    """p value of one test over all frequencies, times and sensors that it searched, and where the smallest one lies.

    Attributes:
        test: Name of the test.
        p_value: Of the most extreme frequency, time or sensors, corrected for the search.
        words: Plain English description of what was found there.
        sensors: Positions of the sensors concerned.
        levels: Wavelet levels concerned, from 1.
        frequency_hz: Frequency of the most extreme place, where it has one.
        time_s: Time of the most extreme place, s after the first sample.
        channel: Auxiliary channel concerned.
    """

    __test__: ClassVar[bool] = False  # no test of pytest's
    test: str
    p_value: float
    words: str
    sensors: tuple[int, ...] = ()
    levels: tuple[int, ...] = ()
    frequency_hz: float | None = None
    time_s: float | None = None
    channel: str | None = None
    witness = RenamedAttribute("test")

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON; `witness` is the name that `test` had in release 0.1."""
        numbers = {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}
        return {"witness": self.test, **numbers}
