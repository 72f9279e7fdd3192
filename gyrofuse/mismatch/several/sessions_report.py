"""The answer of a diagnosis of several recordings: causes with their scope, and each recording by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from gyrofuse._base.results import cleaned, readable
from gyrofuse.mismatch.repair.session_model import SessionModel
from gyrofuse.mismatch.reporting.judge import Judged
from gyrofuse.mismatch.reporting.text import capital, judge_words, parameter_words, typeset
from gyrofuse.mismatch.several.recurrence import Cause, CommonParameter
from gyrofuse.mismatch.several.several_reports import SeveralReports, listed_words, picture

_WHOSE = {"device": "the device's", "session": "the session's", "recording": "of one recording"}


@dataclass(frozen=True, eq=False)
class SessionsReport(SeveralReports):
    """What several recordings of a device have that a simulation left out, and to what each cause belongs.

    Attributes:
        causes: Findings of all, put together where they are one cause; the device's first.
        model: The repaired simulation; it draws sessions.
        judged: How far simulations are from another recording, where one was given; `repeatability` is the mean of
            those of the recordings.
    """

    causes: tuple[Cause, ...]
    model: SessionModel
    judged: Judged | None = None

    template: ClassVar[str] = "sessions.html.j2"
    kind: ClassVar[str] = "recording"

    def sentences(self) -> list[str]:
        """The verdict, what is unexplained in which recording, and what the other recording says of it."""
        lines = super().sentences()
        return lines if self.judged is None else [*lines, *judge_words(self.judged, self.mismatch)]

    def cause_sentence(self, cause: Cause) -> str:
        """Whose a cause is, in which recordings, and which of its numbers differ between them."""
        have = [self.names[k] for k in sorted(cause.findings)]
        where = (
            f"in all {len(self.names)} recordings"
            if len(have) == len(self.names)
            else f"in recording {listed_words(have)}"
        )
        if cause.scope == "recording":
            return f"{where}: {cause.clearest.sentence}"
        same = (
            "with the same numbers"
            if not cause.varying
            else f"with another {listed_words(self._words(cause.varying))} each"
        )
        return f"{where}, {same}; where it is clearest, {cause.clearest.sentence}"

    def summary(self) -> str:
        """The verdict, and the causes with whose they are and their numbers."""
        first, *others = self.sentences()
        lines = [f"{first}."]
        for k, cause in enumerate(self.causes, 1):
            lines.append(f"{k}. {cause.mechanism}, {_WHOSE[cause.scope]}, {self.cause_sentence(cause)}")
            for name, entry in cause.parameters.items():
                words = parameter_words(name, self.model.models[0].info.sensors)
                lines.append(f"   {words:<24} {entry.value:>12.6g} {entry.unit}  {_between(entry)}")
        return "\n".join([*lines, *(f"{line}." for line in others)])

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        return cleaned(
            {
                "mismatch": self.mismatch,
                "p_value": self.p_value,
                "names": list(self.names),
                "causes": [cause.to_dict() for cause in self.causes],
                "recordings": [report.to_dict() for report in self.reports],
                "judged": None if self.judged is None else self.judged.to_dict(),
                "model": self.model.to_dict(),
            }
        )

    def parts(self) -> list[dict[str, Any]]:
        """What the page shows of each cause."""
        return [self._part(cause) for cause in self.causes]

    def _part(self, cause: Cause) -> dict[str, Any]:
        """What the page shows of one cause."""
        return {
            "name": readable(cause.mechanism),
            "whose": _WHOSE[cause.scope],
            "sentence": typeset(capital(self.cause_sentence(cause))),
            "short": f"{_WHOSE[cause.scope]}, {typeset(self.cause_sentence(cause))}",
            "recordings": [self.names[k] for k in cause.findings],
            "picture": picture(cause.clearest),
            "parameters": [
                {
                    "name": parameter_words(name, self.model.models[0].info.sensors),
                    "unit": entry.unit,
                    "estimates": [one.value for one in entry.by_recording],
                    "entry": entry,
                    "between": _between(entry),
                }
                for name, entry in cause.parameters.items()
            ],
        }

    def _words(self, names: Sequence[str]) -> list[str]:
        """Parameters without their sensors, each once."""
        return list(dict.fromkeys(readable(name.split("[")[0]) for name in names))


def _between(entry: CommonParameter) -> str:
    """Limits of the mean, and what it scatters by from recording to recording."""
    scatter = f", scatters by {entry.between_sd:.3g} from recording to recording" if entry.between_sd else ""
    return f"({entry.low:.6g} to {entry.high:.6g}{scatter})"
