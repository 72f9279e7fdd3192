"""What reports on several recordings, or several groups of sensors, have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from gyrofuse._base.page import image, render
from gyrofuse._base.results import p_words, readable
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.reporting.plots import plot_recordings
from gyrofuse.mismatch.reporting.report import MismatchReport
from gyrofuse.mismatch.reporting.text import capital

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class SeveralReports:
    """Diagnoses side by side; a subclass puts their findings together.

    Attributes:
        names: Of the recordings, or of the groups of sensors.
        reports: Diagnosis of each.
        p_value: Of agreement of all with the simulation.
    """

    kind: ClassVar[str]
    template: ClassVar[str]
    names: tuple[str, ...]
    reports: tuple[MismatchReport, ...]
    p_value: float

    @property
    def by_name(self) -> dict[str, MismatchReport]:
        """Reports by the names of what they are of."""
        return dict(zip(self.names, self.reports, strict=True))

    @property
    def mismatch(self) -> bool:
        """Whether any differs from the simulation."""
        return any(report.mismatch for report in self.reports)

    def sentences(self) -> list[str]:
        """The verdict, and what is unexplained where."""
        every = f"All {len(self.names)} {self.kind}s"
        differ = [name for name, report in self.by_name.items() if report.mismatch]
        if not differ:
            return [f"{every} agree with the simulation (p = {self.p_value:.2g})"]
        which = every if len(differ) == len(self.names) else f"Of the {self.kind}s {listed_words(differ)}"
        lines = [f"{which} differ{'' if len(differ) > 1 else 's'} from the simulation ({p_words(self.p_value)})"]
        for name, report in self.by_name.items():
            if report.unexplained:
                tests = ", ".join(readable(entry.test) for entry in report.unexplained)
                lines.append(f"Unexplained in {self.kind} {name}, as seen by: {tests}")
        return lines

    def summary(self) -> str:
        """The verdict and the causes."""
        raise NotImplementedError

    def __str__(self) -> str:
        return self.summary()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the discrepancy of each, before and after its repair, on blocks held out.

        Args:
            ax: Where to draw; new axes by default.

        Returns:
            The axes.
        """
        ends = [(report.held_out.before, report.held_out.after) for report in self.reports]
        return plot_recordings(self.names, ends, ax=ax)

    def parts(self) -> list[dict[str, Any]]:
        """What the page shows of each cause."""
        raise NotImplementedError

    def to_html(
        self, path: str | Path, *, title: str = "What simulations leave out", remarks: Sequence[str] = ()
    ) -> None:
        """Write the report as one HTML page that needs no other file, no network and no script.

        Args:
            path: Where to; an existing file is replaced.
            title: Heading of the page.
            remarks: Sentences shown below the verdict.
        """

        def draw(figure: Figure) -> None:
            self.plot(figure.subplots())

        page = render(
            Path(__file__).parent / self.template,
            title=title,
            report=self,
            remarks=remarks,
            verdict=[f"{capital(words)}." for words in self.sentences()],
            course=image(7.0, 0.9 + 0.3 * len(self.names), draw),
            causes=self.parts(),
        )
        Path(path).write_text(page, encoding="utf-8")


def picture(finding: Finding) -> str:
    """The evidence of a finding as the source of an `img`."""

    def draw(figure: Figure) -> None:
        figure.set_layout_engine("constrained")
        finding.plot(list(figure.subplots(2, 1)))

    return image(7.0, 5.2, draw)


def listed_words(names: Sequence[str]) -> str:
    """Names in a sentence: `a, b and c`."""
    return ", ".join(names[:-1]) + (" and " if len(names) > 1 else "") + names[-1]
