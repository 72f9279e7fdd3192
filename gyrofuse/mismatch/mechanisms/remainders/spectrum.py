"""What is left of the spectra once everything with a name is explained: a repair without physics.

A simulator that is handed back ought to agree with the recording where the catalogue does not reach, too. The remainder
is no finding: tests that asked for it stay in the report as unexplained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

from torch import Tensor

from gyrofuse.mismatch.mechanisms.spectra.spectral import Filter
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.folds import N_JUDGED, estimation_samples
from gyrofuse.mismatch.signals.psd import between_bands, drawn_towards, narrow_bands
from gyrofuse.mismatch.signals.records import Records


@dataclass(frozen=True, eq=False)
class Remainder(Filter):
    """`S_i(f) -> S_i(f) exp(2 g_i(log f))` with `g` linear between the middles of bands, a filter without phase.

    Attributes:
        frequency: Middles of the bands, cycles per sample, `(band,)`.
        log_gain: `g`, `(sensor, band)`.
    """

    name: ClassVar[str] = "remainder"
    identified: ClassVar[bool] = False
    refit_after_others: ClassVar[bool] = True
    remark: ClassVar[str] = (
        "So that the repaired simulation has the recording's spectra all the same, the noise of each sensor passes "
        "a filter that stands for no physics."
    )
    asked_for_by: ClassVar[tuple[str, ...]] = ("spectrum", "shape", "bump")  # names of tests
    frequency: Annotated[Tensor, Dims(("band",))]
    log_gain: Annotated[Tensor, Dims(("sensor", "band"))]

    @classmethod
    def left_over(cls, comparison: Comparison) -> Remainder:
        """What the spectra ask for."""
        return cls._between(comparison.observed, comparison.reference)

    def but_for(self, sensors: Sequence[int]) -> Remainder:
        """The same, with some sensors left as they are."""
        log_gain = self.log_gain.clone()
        log_gain[list(sensors)] = 0.0
        return replace(self, log_gain=log_gain)

    @classmethod
    def _between(cls, observed: Records, reference: Records) -> Remainder:
        """Halves of log ratios of powers: in narrow bands drawn towards those in wide ones, and these towards none.

        By as much as chance explains of the difference (Stein).
        """
        narrow = narrow_bands(observed.bands.n_samples)
        wide = cls(observed.bands.frequency, drawn_towards(*_log_ratio(observed, reference), 0.0) / 2)
        before = wide.response(narrow.frequency).log()
        ratio, chance = _log_ratio(observed.in_bands(narrow), reference.in_bands(narrow))
        plain = 4.0  # times the variance of chance: of many narrow bands some stand out
        return cls(narrow.frequency, drawn_towards(ratio, plain * chance, 2 * before) / 2)

    def response(self, f: Tensor) -> Tensor:
        return between_bands(self.log_gain, self.frequency, f).exp()

    def fit_without(self, comparison: Comparison, fold: int) -> Remainder:
        return self._between(without_fold(comparison, fold), comparison.reference)


def without_fold(comparison: Comparison, fold: int) -> Records:
    """The recording's noise in blocks, without those that a fold holds out."""
    block = comparison.n_samples // N_JUDGED
    kept = comparison.observed.noise[0][:, estimation_samples(comparison.n_samples, fold)]
    return Records(kept.unflatten(-1, (-1, block)).movedim(-2, 0), comparison.bands)


def _log_ratio(observed: Records, reference: Records) -> tuple[Tensor, Tensor]:
    """Log ratio of powers `(sensor, band)`, and its variance by chance `(band,)`, infinite where nothing is seen."""
    ratio = (observed.power.clamp(min=1e-300) / reference.power.clamp(min=1e-300)).log()
    # Blocks are too short for the slowest bands: without a bin there is no power either.
    return ratio, 1 / observed.dof + 1 / reference.dof
