"""What spectra say of a simulation whose numbers were fitted: a component missing, other numbers, or neither."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from gyrofuse._base.results import p_words
from gyrofuse.mismatch.detectors.spectra.band_tests import spectrum_test
from gyrofuse.mismatch.detectors.spectra.shape_scan import FittedScans, fitted_scans
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.multiplicity import sidak

Kind = Literal["component_missing", "other_numbers", "undecided", "within_uncertainty", "agrees"]

KNOWN = (
    "The model's numbers are taken as known exactly; where they were estimated, diagnose the fit itself, or say from "
    "how many samples they are (fitted_samples)."
)
_WORDS: dict[Kind, str] = {
    "component_missing": "differ by what no numbers of its processes can make: a component is missing",
    "other_numbers": "differ as other numbers of the same processes would make them, by more than estimates scatter",
    "undecided": "differ by more than estimates scatter; whether by other numbers or by a component is not decided",
    "within_uncertainty": "differ by more than chance would if these were exact, and by no more than estimates scatter",
    "agrees": "agree",
}


@dataclass(frozen=True)
class FitVerdict:
    """Of the spectra, before a repair of them.

    Attributes:
        kind: What they say.
        n_samples: Of each sensor, that the model was fitted to.
        exact: p value of shapes of a difference as if the numbers were known.
        beside: p value of shapes of a difference by more than errors of the numbers: the two below together.
        outside: p value of what no numbers of the model's processes could make.
        parameters: p value of the numbers that would suit the recording (chi-square).
    """

    kind: Kind
    n_samples: int
    exact: float
    beside: float
    outside: float
    parameters: float

    @property
    def words(self) -> str:
        """In sentences."""
        p = {"component_missing": self.outside, "other_numbers": self.parameters, "within_uncertainty": self.exact}
        p_value = f" ({p_words(p[self.kind])})" if self.kind in p else ""
        return (
            f"The model was fitted to {self.n_samples} samples, and spectra are compared beside what its numbers may "
            f"be off: they {_WORDS[self.kind]}{p_value}."
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        p_values = {name: getattr(self, name) for name in ("exact", "beside", "outside", "parameters")}
        return {"verdict": self.kind, "n_samples": self.n_samples, "p_values": p_values}


def fit_verdict(comparison: Comparison, level: float) -> FitVerdict | None:
    """What spectra say of a fitted model; None of samples and of models whose numbers are known.

    Args:
        comparison: Recording and simulation.
        level: Largest p value of one test that is a mismatch.
    """
    uncertainty, scans = comparison.reference.uncertainty, fitted_scans(comparison)
    if uncertainty is None or scans is None:
        return None
    return FitVerdict(
        kind=_kind(comparison, scans, level),
        n_samples=uncertainty.n_samples,
        exact=scans.exact.p_value,
        beside=scans.p_value,
        outside=scans.outside.p_value,
        parameters=scans.parameters,
    )


def _kind(comparison: Comparison, scans: FittedScans, level: float) -> Kind:
    if sidak(scans.outside.p_value, 2) <= level:
        return "component_missing"
    if sidak(scans.parameters, 2) <= level:
        return "other_numbers"
    if spectrum_test(comparison).p_value <= level:
        return "undecided"
    exact = replace(comparison, reference=replace(comparison.reference, uncertainty=None))
    if min(scans.exact.p_value, spectrum_test(exact).p_value) <= level:
        return "within_uncertainty"
    return "agrees"
