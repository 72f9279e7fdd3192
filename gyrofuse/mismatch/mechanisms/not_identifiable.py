"""What is seen but cannot be named: mechanisms that explain the same recording equally well."""

from __future__ import annotations

from dataclasses import replace

from gyrofuse._base.results import readable
from gyrofuse.mismatch.mechanisms.mechanism import Finding

NOT_IDENTIFIABLE = "not_identifiable"


def not_identifiable(finding: Finding, seen: str) -> Finding:
    """The finding without its name, which is one among its alternatives, where the data cannot prefer any.

    The effect stays, since the rivals have the same: the repair does not depend on the name.

    Args:
        finding: With alternatives.
        seen: What is there whatever its name, the beginning of a sentence.
    """
    rivals = (finding.mechanism, *finding.alternatives)
    words = ", ".join(map(readable, rivals[:-1]))
    return replace(
        finding,
        mechanism=NOT_IDENTIFIABLE,
        alternatives=rivals,
        sentence=f"{seen}; {words} and {readable(rivals[-1])} explain it equally well",
    )
