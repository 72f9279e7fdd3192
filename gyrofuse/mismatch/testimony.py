"""All witnesses together."""

from __future__ import annotations

from collections.abc import Callable

from gyrofuse.mismatch.bumps import bump_witness
from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.channels import channel_witness
from gyrofuse.mismatch.clocks import clock_witness
from gyrofuse.mismatch.evidence import Evidence, corrected
from gyrofuse.mismatch.hysteresis import hysteresis_witness
from gyrofuse.mismatch.impulses import jump_witness, spike_witness
from gyrofuse.mismatch.marginals import marginal_witness
from gyrofuse.mismatch.noise_level import variance_witness
from gyrofuse.mismatch.pooled import common_witness
from gyrofuse.mismatch.shape_scan import shape_witness
from gyrofuse.mismatch.slow_scans import slow_witness
from gyrofuse.mismatch.sweeps import sweep_witness
from gyrofuse.mismatch.witnesses import coherence_witness, line_witness, spectrum_witness

WITNESSES: tuple[Callable[[Case], Evidence], ...] = (
    marginal_witness,
    spike_witness,
    channel_witness,
    line_witness,
    sweep_witness,
    clock_witness,
    jump_witness,
    slow_witness,
    hysteresis_witness,
    variance_witness,
    spectrum_witness,
    shape_witness,
    bump_witness,
    coherence_witness,
    common_witness,
)


def testimony(
    case: Case,
    progress: Callable[[str, float], None] = lambda _what, _share: None,  # noqa: PT028 (this is no test)
) -> tuple[Evidence, ...]:
    """What every witness says; `progress` is told which is asked next, and the share of them that were."""
    evidence = []
    for number, witness in enumerate(WITNESSES):
        progress(witness.__name__.replace("_", " "), number / len(WITNESSES))
        evidence.append(witness(case))
    return tuple(evidence)


def combined(evidence: tuple[Evidence, ...]) -> float:
    """p value of all witnesses together: that of the most extreme, for having asked so many."""
    return corrected(min(e.p_value for e in evidence), len(evidence))
