"""Findings of the groups of sensors of a board, gyros and accelerometers, put together where they are one cause."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.limits import variance_of, weighted_mean


class GroupFindings(NamedTuple):
    """What was found in one group of sensors.

    Attributes:
        findings: Findings in order.
        comparison: Recording and simulation as they came.
    """

    findings: tuple[Finding, ...]
    comparison: Comparison


class Member(NamedTuple):
    """A finding of a group."""

    group: str
    finding: Finding
    comparison: Comparison


@dataclass(frozen=True)
class BoardCause:
    """One cause in one or several groups of sensors.

    Attributes:
        members: Findings of the groups.
    """

    members: tuple[Member, ...]

    @property
    def mechanism(self) -> str:
        """Name of the physics, that of its clearest finding."""
        return self.clearest.finding.mechanism

    @property
    def clearest(self) -> Member:
        """The finding with the smallest p value, of those the one that explains most."""
        return min(self.members, key=lambda member: (member.finding.p_value, -member.finding.gain))

    @property
    def sensors(self) -> dict[str, tuple[int, ...]]:
        """Positions of the sensors that have it, by group."""
        found: dict[str, set[int]] = {}
        for member in self.members:
            found.setdefault(member.group, set()).update(member.finding.sensors)
        return {group: tuple(sorted(which)) for group, which in found.items()}

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        return {
            "mechanism": self.mechanism,
            "sensors": {group: list(which) for group, which in self.sensors.items()},
            "findings": [{"group": member.group, **member.finding.to_dict()} for member in self.members],
        }


def board_causes(groups: Mapping[str, GroupFindings]) -> tuple[BoardCause, ...]:
    """Causes in the order of what they explain: findings that belong together, directly or through a third one.

    Args:
        groups: What was found in each group, by its name.
    """
    members = [Member(name, f, group.comparison) for name, group in groups.items() for f in group.findings]
    label = list(range(len(members)))
    for i, j in itertools.combinations(range(len(members)), 2):
        if _one_cause(members[i], members[j]):
            label = [label[i] if other == label[j] else other for other in label]
    together = [tuple(m for m, own in zip(members, label, strict=True) if own == one) for one in dict.fromkeys(label)]
    causes = map(BoardCause, together)
    return tuple(sorted(causes, key=lambda cause: -sum(member.finding.gain for member in cause.members)))


def _one_cause(a: Member, b: Member) -> bool:
    """Whether two findings are one cause: the same line, the same physics at one time or on one channel.

    Physics of the sensor alone, such as rounding, is one cause only where numbers that do not have the unit of the
    signal agree within three standard deviations: a filter's corner, a clock's rate.
    """
    widths = [m.finding.effect.line_width(m.finding.parameters, m.comparison) for m in (a, b)]
    if a.finding.frequency_hz is not None and b.finding.frequency_hz is not None and None not in widths:
        apart = abs(a.finding.frequency_hz - b.finding.frequency_hz)
        return apart <= sum(width or 0.0 for width in widths)
    names = [{m.finding.mechanism, *m.finding.alternatives} for m in (a, b)]
    if a.finding.mechanism not in names[1] and b.finding.mechanism not in names[0]:
        return False
    if a.finding.channel is not None or b.finding.channel is not None:
        return a.finding.channel == b.finding.channel
    if a.finding.time_s is not None and b.finding.time_s is not None:
        return abs(a.finding.time_s - b.finding.time_s) <= sum(_block_s(m.comparison) for m in (a, b))
    if a.group == b.group:
        return False
    own, theirs = _pooled(a), _pooled(b)
    shared = own.keys() & theirs.keys()
    return bool(shared) and all(
        abs(own[name].value - theirs[name].value) < 3 * math.hypot(own[name].sd, theirs[name].sd) for name in shared
    )


def _block_s(comparison: Comparison) -> float:
    """Length of one of the blocks of a record, s."""
    return comparison.block / comparison.info.rate


class _Pooled(NamedTuple):
    """Mean of a number over the sensors that have it, and its standard deviation."""

    value: float
    sd: float


def _pooled(member: Member) -> dict[tuple[str, str], _Pooled]:
    """Numbers of a finding that do not have the unit of the signal, by name and unit."""
    numbers: dict[tuple[str, str], list[Parameter]] = {}
    for name, entry in member.finding.parameters.items():
        if member.comparison.info.measure not in entry.unit and 0 < entry.high - entry.low < math.inf:
            numbers.setdefault((name.split("[")[0], entry.unit), []).append(entry)
    pooled = {}
    for key, entries in numbers.items():
        variances = [variance_of(entry.low, entry.high) for entry in entries]
        mean, total = weighted_mean([entry.value for entry in entries], variances)
        pooled[key] = _Pooled(mean, 1 / math.sqrt(total))
    return pooled
