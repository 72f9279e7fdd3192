"""What several recordings of a device have in common: causes of the device, of a session, or of one recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeGuard

from scipy import stats

from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.stats.limits import Z, variance_of, weighted_mean
from gyrofuse.mismatch.stats.multiplicity import sidak_level

Scope = Literal["device", "session", "recording"]


@dataclass(frozen=True)
class CommonParameter:
    """A number of a cause in all recordings that have it.

    Attributes:
        value: Mean weighted by the inverse variances, and those that it scatters by from recording to recording.
        low: Lower 95 % limit of the mean.
        high: Upper limit.
        unit: Unit.
        between_sd: Standard deviation from recording to recording beyond what limits explain; 0 where there is none.
        p_value: For being the same in all of them.
        by_recording: Estimates in the recordings that have it.
    """

    value: float
    low: float
    high: float
    unit: str
    between_sd: float
    p_value: float
    by_recording: tuple[Parameter, ...]

    @classmethod
    def of(cls, entries: Sequence[Parameter]) -> CommonParameter:
        """Combine estimates: the variance from recording to recording by moments (DerSimonian and Laird, 1986).

        Args:
            entries: Estimates with finite limits, two or more.
        """
        values = [entry.value for entry in entries]
        variances = [variance_of(entry.low, entry.high) for entry in entries]
        mean, total = weighted_mean(values, variances)
        q = sum((value - mean) ** 2 / variance for value, variance in zip(values, variances, strict=True))
        dof = len(values) - 1
        scale = total - sum(variance**-2 for variance in variances) / total
        between = max(q - dof, 0.0) / scale if scale > 0 else 0.0
        mean, total = weighted_mean(values, [variance + between for variance in variances])
        reach = Z / math.sqrt(total)
        return cls(
            mean,
            mean - reach,
            mean + reach,
            entries[0].unit,
            math.sqrt(between),
            float(stats.chi2.sf(q, dof)),
            tuple(entries),
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        plain = {name: getattr(self, name) for name in ("value", "low", "high", "unit", "between_sd", "p_value")}
        return {**plain, "by_recording": [entry._asdict() for entry in self.by_recording]}


@dataclass(frozen=True)
class Cause:
    """One cause in several recordings.

    Attributes:
        mechanism: Name of the physics.
        scope: `"device"` where all recordings have it with the same numbers; `"session"` where its numbers are drawn
            anew for each recording, or some have it and some not; `"recording"` where it happened in one of them.
        findings: Findings by the position of their recording.
        parameters: Numbers that two recordings or more have limits of.
        n_recordings: Number of recordings.
    """

    mechanism: str
    scope: Scope
    findings: dict[int, Finding]
    n_recordings: int
    parameters: dict[str, CommonParameter] = field(default_factory=dict)

    @property
    def clearest(self) -> Finding:
        """The finding with the smallest p value, of those the one that explains most."""
        return min(self.findings.values(), key=lambda f: (f.p_value, -f.gain))

    @property
    def varying(self) -> list[str]:
        """Names of the numbers that differ from recording to recording by more than chance."""
        unlike = 0.01  # p value for all numbers of a cause together
        level = sidak_level(unlike, max(len(self.parameters), 1))
        return [name for name, entry in self.parameters.items() if entry.p_value < level]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        return {
            "mechanism": self.mechanism,
            "scope": self.scope,
            "recordings": sorted(self.findings),
            "varying": self.varying,
            "parameters": {name: entry.to_dict() for name, entry in self.parameters.items()},
        }


def causes_of(findings: Sequence[Sequence[Finding]]) -> tuple[Cause, ...]:
    """Findings of several recordings put together where they are one cause, those of the device first.

    Args:
        findings: Of each recording, in order.
    """
    groups: list[dict[int, Finding]] = []
    for place, own in enumerate(findings):
        for finding in own:
            fitting = [group for group in groups if place not in group and _same(finding, group)]
            if fitting:
                min(fitting, key=lambda group: _distance(finding, group))[place] = finding
            else:
                groups.append({place: finding})
    causes = [_cause(group, len(findings)) for group in groups]
    order = ("device", "session", "recording")
    return tuple(sorted(causes, key=lambda cause: order.index(cause.scope)))


def _same(finding: Finding, group: dict[int, Finding]) -> bool:
    """Whether a finding may be what others are in other recordings."""
    other = next(iter(group.values()))
    if finding.effect.happened_once or other.effect.happened_once:
        return False  # times in two recordings have nothing to do with each other
    if finding.mechanism not in (other.mechanism, *other.alternatives) and other.mechanism not in finding.alternatives:
        return False
    if not {*finding.sensors} & {*other.sensors} and finding.sensors and other.sensors:
        return False
    moved = 0.05  # relative distance of lines of two recordings that may be one line
    return finding.channel == other.channel and _distance(finding, group) < moved


def _distance(finding: Finding, group: dict[int, Finding]) -> float:
    """Relative distance of frequencies; 0 of what has none."""
    other = next(iter(group.values()))
    if not finding.frequency_hz or not other.frequency_hz or finding.effect.broad or other.effect.broad:
        return 0.0
    return abs(math.log(finding.frequency_hz / other.frequency_hz))


def _cause(group: dict[int, Finding], n_recordings: int) -> Cause:
    first = next(iter(group.values()))
    entries = {name: [finding.parameters.get(name) for finding in group.values()] for name in first.parameters}
    known = {name: [entry for entry in several if _limited(entry)] for name, several in entries.items()}
    usable = {name: several for name, several in known.items() if len(several) == len(group) > 1}
    common = {name: CommonParameter.of(several) for name, several in usable.items()}
    names = [finding.mechanism for finding in group.values()]
    mechanism = max(dict.fromkeys(names), key=names.count)
    found = Cause(mechanism, "device", group, n_recordings, common)
    if len(group) == 1 and n_recordings > 1:
        return Cause(mechanism, "recording", group, n_recordings, common)
    if len(group) < n_recordings or found.varying:
        return Cause(mechanism, "session", group, n_recordings, common)
    return found


def _limited(entry: Parameter | None) -> TypeGuard[Parameter]:
    """Whether there is an estimate with finite limits."""
    return entry is not None and math.isfinite(entry.high - entry.low) and entry.high > entry.low
