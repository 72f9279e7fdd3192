"""The answer of a diagnosis of several recordings: causes with their scope, and each recording by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gyrofuse._base.page import image, render
from gyrofuse._base.results import cleaned, p_words, readable
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.repair.session_model import SessionModel
from gyrofuse.mismatch.reporting.judge import Judged
from gyrofuse.mismatch.reporting.plots import plot_recordings
from gyrofuse.mismatch.reporting.report import MismatchReport
from gyrofuse.mismatch.reporting.text import capital, judge_words, parameter_words
from gyrofuse.mismatch.selection.recurrence import Cause, CommonParameter

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WHOSE = {"device": "the device's", "session": "the session's", "recording": "of one recording"}


@dataclass(frozen=True, eq=False)
class SessionsReport:
    """What several recordings of a device have that a simulation left out, and to what each cause belongs.

    Attributes:
        names: Of the recordings.
        reports: Diagnosis of each recording.
        causes: Findings of all, put together where they are one cause; the device's first.
        p_value: Of agreement of all recordings with the simulation.
        model: The repaired simulation; it draws sessions.
        judged: How far simulations are from another recording, where one was given; `repeatability` is the mean of
            those of the recordings.
    """

    names: tuple[str, ...]
    reports: tuple[MismatchReport, ...]
    causes: tuple[Cause, ...]
    p_value: float
    model: SessionModel
    judged: Judged | None = None

    @property
    def mismatch(self) -> bool:
        """Whether any recording differs from the simulation."""
        return any(report.mismatch for report in self.reports)

    def sentences(self) -> list[str]:
        """The verdict, what the other recording says of it, and what is unexplained in which recording."""
        if not self.mismatch:
            lines = [f"All {len(self.names)} recordings agree with the simulation (p = {self.p_value:.2g})"]
        else:
            differ = [name for name, report in zip(self.names, self.reports, strict=True) if report.mismatch]
            which = (
                f"All {len(differ)} recordings"
                if len(differ) == len(self.names)
                else f"Of the recordings {_and(differ)}"
            )
            lines = [f"{which} differ{'' if len(differ) > 1 else 's'} from the simulation ({p_words(self.p_value)})"]
        for name, report in zip(self.names, self.reports, strict=True):
            if report.unexplained:
                tests = ", ".join(readable(entry.test) for entry in report.unexplained)
                lines.append(f"Unexplained in recording {name}, as seen by: {tests}")
        if self.judged is not None:
            lines += judge_words(self.judged, self.mismatch)
        return lines

    def cause_sentence(self, cause: Cause) -> str:
        """Whose a cause is, in which recordings, and which of its numbers differ between them."""
        have = [self.names[k] for k in sorted(cause.findings)]
        where = f"in all {len(self.names)} recordings" if len(have) == len(self.names) else f"in recording {_and(have)}"
        if cause.scope == "recording":
            return f"{where}: {cause.clearest.sentence}"
        same = "with the same numbers" if not cause.varying else f"with another {_and(self._words(cause.varying))} each"
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

    def __str__(self) -> str:
        return self.summary()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the discrepancy of each recording, before and after its repair, on blocks held out.

        Args:
            ax: Where to draw; new axes by default.

        Returns:
            The axes.
        """
        ends = [(report.held_out.before, report.held_out.after) for report in self.reports]
        return plot_recordings(self.names, ends, ax=ax)

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

    def to_html(
        self, path: str | Path, *, title: str = "Recordings and simulation", remarks: Sequence[str] = ()
    ) -> None:
        """Write the report as one HTML page that needs no other file, no network and no script.

        Args:
            path: Where to; an existing file is replaced.
            title: Heading of the page.
            remarks: Sentences shown below the verdict.
        """
        page = render(
            Path(__file__).parent / "sessions.html.j2",
            title=title,
            report=self,
            remarks=remarks,
            verdict=[capital(words) for words in self.sentences()],
            course=image(7.0, 0.9 + 0.3 * len(self.names), self._draw_course),
            causes=[self._part(cause) for cause in self.causes],
        )
        Path(path).write_text(page, encoding="utf-8")

    def _draw_course(self, figure: Figure) -> None:
        self.plot(figure.subplots())

    def _part(self, cause: Cause) -> dict[str, Any]:
        """What the page shows of one cause."""
        return {
            "name": readable(cause.mechanism),
            "whose": _WHOSE[cause.scope],
            "sentence": capital(self.cause_sentence(cause)).replace("->", "→"),
            "recordings": [self.names[k] for k in cause.findings],
            "picture": image(7.0, 5.2, _draw, cause.clearest),
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


def _draw(figure: Figure, finding: Finding) -> None:
    figure.set_layout_engine("constrained")
    finding.plot(list(figure.subplots(2, 1)))


def _between(entry: CommonParameter) -> str:
    """Limits of the mean, and what it scatters by from recording to recording."""
    scatter = f", scatters by {entry.between_sd:.3g} from recording to recording" if entry.between_sd else ""
    return f"({entry.low:.6g} to {entry.high:.6g}{scatter})"


def _and(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + (" and " if len(names) > 1 else "") + names[-1]
