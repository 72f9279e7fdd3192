"""What a diagnosis found, as data."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

from torch import Tensor

from gyrofuse._base.checks import same_rate
from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse._base.results import cleaned
from gyrofuse.fusion.weights.svo import ScaleWeights
from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.fit_verdict import FitVerdict
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.reporting.benefit import Benefit, benefit
from gyrofuse.mismatch.reporting.figures_data import VarianceComparison, compared_variances
from gyrofuse.mismatch.reporting.judge import Judged
from gyrofuse.mismatch.selection.held_out import HeldOut
from gyrofuse.mismatch.signals.comparison import Comparison

_Signal = TypeVar("_Signal", Recording, Tensor)


@dataclass(frozen=True, eq=False)
class Outcome:
    """The data of a `MismatchReport`, where each entry is described; pages and summaries need no more."""

    mismatch: bool
    p_value: float
    findings: tuple[Finding, ...]
    unexplained: tuple[TestResult, ...]
    held_out: HeldOut
    model: RepairedModel
    evidence: tuple[TestResult, ...]
    evidence_after: tuple[TestResult, ...]
    recording: Tensor
    comparison: Comparison
    repaired: Comparison
    judged: Judged | None = None
    fit: FitVerdict | None = None
    notes: tuple[str, ...] = ()
    case = RenamedAttribute("comparison")

    def correct(self, recording: _Signal) -> _Signal:
        """The recording that was diagnosed, or one that runs along with it, without what can be taken off it.

        What has a place in time (a tone's phase, a step) counts from the first sample.

        Args:
            recording: `(sensor, time)` in the unit of the diagnosis, or a recording with its unit and channels.

        Returns:
            The same kind, of the same dtype.

        Raises:
            ValueError: Other sensors than those of the diagnosis, or another sampling rate.
        """
        info = self.model.info
        signal = recording.axes_as_sensors().signal if isinstance(recording, Recording) else recording
        if signal.ndim < 2 or signal.shape[-2] != len(info.sensors):
            raise ValueError(
                f"`recording`: expected (sensor, time) with the {len(info.sensors)} sensors of the diagnosis, got "
                f"shape {tuple(signal.shape)}; correct the recording that was diagnosed"
            )
        if not isinstance(recording, Recording):
            return self.model.correct(signal.double()).to(signal.dtype)
        if info.unit != "unknown" and not same_rate(recording.rate, info.rate):  # samples alone have no rate
            raise ValueError(
                f"`recording`: expected the {info.rate:g} Hz of the diagnosis, got {recording.rate:g} Hz; correct the "
                "recording that was diagnosed"
            )
        other_unit = recording.unit != info.unit and "unknown" not in (recording.unit, info.unit)
        converted = recording.to(info.unit) if other_unit else recording
        own = replace(self.model, info=replace(info, channels={**info.channels, **recording.channels}))
        made = own.correct(converted.axes_as_sensors().signal.double()).to(signal.dtype)
        corrected = replace(converted, signal=made.view_as(converted.signal))
        return corrected.to(recording.unit) if other_unit else corrected

    def benefit(self, scale_weights: ScaleWeights = "long") -> Benefit:
        """Fuse the recording before and after correction: what the virtual gyro gains by it.

        Args:
            scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.

        Raises:
            SingularCovarianceError: Sensors that are copies of each other have no best weights.
        """
        return benefit(self.recording, self.model.correct(self.recording), scale_weights)

    @cached_property
    def variances(self) -> list[VarianceComparison]:
        """Wavelet variances of recording and simulation, as they came and after the repair."""
        return compared_variances(self.comparison, self.repaired)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        return cleaned(
            {
                "mismatch": self.mismatch,
                "p_value": self.p_value,
                "findings": [finding.to_dict() for finding in self.findings],
                "unexplained": [entry.to_dict() for entry in self.unexplained],
                "evidence": [entry.to_dict() for entry in self.evidence],
                "evidence_after": [entry.to_dict() for entry in self.evidence_after],
                "held_out": self.held_out.to_dict(),
                "judged": None if self.judged is None else self.judged.to_dict(),
                "fit": None if self.fit is None else self.fit.to_dict(),
                "notes": list(self.notes),
                "model": self.model.to_dict(),
            }
        )
