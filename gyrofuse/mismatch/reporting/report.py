"""The answer of a diagnosis: its summary, figure and page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gyrofuse._base.results import p_words
from gyrofuse.mismatch.reporting.outcome import Outcome
from gyrofuse.mismatch.reporting.page import mismatch_page
from gyrofuse.mismatch.reporting.plots import plot_map
from gyrofuse.mismatch.reporting.text import (
    complete_words,
    family_words,
    fused_words,
    judged_words,
    nats,
    otherwise_words,
    paired_words,
    parameter_words,
    share_words,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class MismatchReport(Outcome):
    """Where recording and simulation differ, what the simulation left out, and how much better the repair fits.

    Attributes:
        mismatch: Whether they differ at all.
        p_value: Of agreement, for the whole recording.
        findings: Differences with names, in the order in which they were found.
        unexplained: Results of tests that still see a difference after the repair.
        held_out: Agreement on data not used for the repair.
        model: The repaired simulation; it simulates.
        evidence: Results of all tests before the repair.
        evidence_after: Results of all tests after it.
        recording: As it came, `(sensor, time)`.
        comparison: Recording and simulation; of a repaired one, its noise, and the recording without its effects.
        repaired: The recording without what can be taken off it, and the simulation with all else.
        judged: How far the simulation, the repaired one and the recording are from another recording, where one was
            given.
        fit: What spectra say beside the uncertainty of a fitted model; None where the simulation is none.
        notes: Sentences on what is not at rest, and on what the simulation's numbers are taken for.
    """

    def summary(self) -> str:
        """The verdict in sentences, then the numbers."""
        if not self.mismatch:
            agree = f"Recording and simulation agree (p = {self.p_value:.2g})."
            return "\n".join([agree, *self.notes, *judged_words(self)])
        lines = [f"Recording and simulation differ ({p_words(self.p_value)})."]
        for i, finding in enumerate(self.findings, 1):
            gain = "" if finding.held_out_gain is None else f"; {finding.held_out_gain:+.1f} nats on data held out"
            lines.append(f"{i}. {finding.mechanism}: {finding.sentence} ({p_words(finding.p_value)}{gain})")
            lines += [f"   {words}" for words in (otherwise_words(finding),) if words]
            if finding.gain_without is not None and len(self.findings) > 1:
                lines.append(f"   without it held-out data are predicted worse by {nats(finding.gain_without)} nats")
            for name, entry in finding.parameters.items():
                words = parameter_words(name, self.comparison.info.sensors)
                lines.append(f"   {words:<24} {entry.value:>12.6g} {entry.unit}  ({entry.low:.6g} to {entry.high:.6g})")
        lines += complete_words(self)
        lines += [f"unexplained, {e.test}: {e.words} ({p_words(e.p_value)})" for e in self.unexplained]
        h = self.held_out
        lines.append(
            f"On data held out: discrepancy {h.before:.2f} before and {h.after:.2f} after repair (1 = noise alone), "
            f"{paired_words(h)}log score: {family_words(h)}; a classifier tells the two apart with an area under the "
            f"curve of {h.auc_before:.2f} before and {h.auc_after:.2f} after (0.5 = guessing)"
        )
        lines += [*self.notes, *judged_words(self), *share_words(self), *fused_words(self)]
        foot = "Nats, held out, discrepancy, area under a curve: explained at the foot of the page (to_html, --report)."
        return "\n".join([*lines, foot])

    def __str__(self) -> str:
        return self.summary()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw where recording and simulation differ: sensors over averaging times, in standard deviations.

        Args:
            ax: Where to draw; new axes by default.

        Returns:
            The axes.
        """
        info = self.comparison.info
        return plot_map(self.variances[0].z, rate=info.rate, names=info.sensors, ax=ax)

    def to_html(
        self, path: str | Path, *, title: str = "Recording and simulation", remarks: Sequence[str] = ()
    ) -> None:
        """Write the report as one HTML page that needs no other file, no network and no script.

        Args:
            path: Where to; an existing file is replaced.
            title: Heading of the page.
            remarks: Sentences shown below the verdict.
        """
        Path(path).write_text(mismatch_page(self, title=title, remarks=remarks), encoding="utf-8")
