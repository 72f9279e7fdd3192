"""The answer of a diagnosis of a whole board: causes, and each group of sensors by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from gyrofuse._base.results import cleaned, p_words, readable
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.reporting.text import capital, judged_words, parameter_words, typeset
from gyrofuse.mismatch.several.board_causes import BoardCause, Member
from gyrofuse.mismatch.several.several_reports import SeveralReports, listed_words, picture


@dataclass(frozen=True, eq=False)
class BoardReport(SeveralReports):
    """What simulations of a board's gyros and accelerometers left out, each cause once.

    Attributes:
        causes: Findings of all groups, put together where they are one cause; what explains most first.
    """

    template: ClassVar[str] = "board.html.j2"
    kind: ClassVar[str] = "group"
    causes: tuple[BoardCause, ...]

    @property
    def models(self) -> dict[str, RepairedModel]:
        """Repaired simulation of each group, by its name."""
        return {name: report.model for name, report in self.by_name.items()}

    def where(self, cause: BoardCause) -> str:
        """The sensors of a cause by their names."""
        parts = []
        for group, which in cause.sensors.items():
            names = self.by_name[group].comparison.info.sensors
            every = len(which) == len(names)
            parts.append(f"{group}: {'all sensors' if every else listed_words([names[i] for i in which])}")
        return "; ".join(parts)

    def summary(self) -> str:
        """The verdict, and the causes with their sensors and numbers."""
        first, *others = self.sentences()
        lines = [f"{first}."]
        for k, cause in enumerate(self.causes, 1):
            likely = p_words(cause.clearest.finding.p_value)
            lines.append(f"{k}. {cause.mechanism}, in {self.where(cause)} ({likely})")
            lines += [f"   {member.group}: {member.finding.sentence}" for member in cause.members]
            for member in cause.members:
                for name, entry in member.finding.parameters.items():
                    words = f"{member.group}, {parameter_words(name, member.comparison.info.sensors)}"
                    lines.append(
                        f"   {words:<32} {entry.value:>12.6g} {entry.unit}  ({entry.low:.6g} to {entry.high:.6g})"
                    )
                lines += _matrix_lines(member.finding, member.comparison.info.sensors)
        for name, report in self.by_name.items():
            h = report.held_out
            others.append(f"{name}: discrepancy {h.before:.2f} before and {h.after:.2f} after repair on data held out")
            others += [f"{name}: {words}" for words in judged_words(report)]
        return "\n".join([*lines, *(f"{line}." for line in others)])

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        return cleaned(
            {
                "mismatch": self.mismatch,
                "p_value": self.p_value,
                "causes": [cause.to_dict() for cause in self.causes],
                "groups": {name: report.to_dict() for name, report in self.by_name.items()},
            }
        )

    def models_to_dict(self) -> dict[str, Any]:
        """The repaired simulations, ready for JSON."""
        return {"groups": {name: model.to_dict() for name, model in self.models.items()}}

    def parts(self) -> list[dict[str, Any]]:
        """What the page shows of each cause."""
        return [self._part(cause) for cause in self.causes]

    def _part(self, cause: BoardCause) -> dict[str, Any]:
        """What the page shows of one cause."""
        return {
            "name": readable(cause.mechanism),
            "where": self.where(cause),
            "short": f"in {self.where(cause)}; where it is clearest, {typeset(cause.clearest.finding.sentence)}",
            "members": [_member(member) for member in cause.members],
        }


def _member(member: Member) -> dict[str, Any]:
    info = member.comparison.info
    return {
        "group": member.group,
        "sentence": typeset(capital(member.finding.sentence)),
        "picture": picture(member.finding),
        "parameters": [
            {"name": parameter_words(name, info.sensors), "entry": entry}
            for name, entry in member.finding.parameters.items()
        ],
        "matrix": "\n".join(_matrix_lines(member.finding, info.sensors)),
    }


def _matrix_lines(finding: Finding, sensors: Sequence[str]) -> list[str]:
    """Gains of the axes of each device on the three rows of a channel, where it has three: a 3 x 3 matrix."""
    if not finding.effect.follows or finding.effect.amplitudes.shape[1:] != (3,):
        return []
    lines = ["   gains on the rows of the channel:"]
    return lines + [
        f"   {name:<12}" + "".join(f"{value:>12.4g}" for value in row)
        for name, row in zip(sensors, finding.effect.amplitudes.tolist(), strict=True)
    ]
