"""What sensors share once everything with a name is explained: a repair without physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.remainders.spectrum import without_fold
from gyrofuse.mismatch.mechanisms.spectra.spectral import Spectral
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.filters import mixed
from gyrofuse.mismatch.signals.folds import spectral_gains
from gyrofuse.mismatch.signals.psd import between_bands, drawn_towards, narrow_bands
from gyrofuse.mismatch.signals.records import Records


@dataclass(frozen=True, eq=False)
class CoherenceRemainder(Spectral):
    """`S(f) -> D (R_1^1/2 R_0^-1/2) D^-1 S (..)^H`: the sensors' coherences become `R_1(f)` in place of `R_0(f)`.

    Each sensor keeps its power; `D` are the roots of powers. Between the middles of bands matrices are interpolated.

    Attributes:
        frequency: Middles of the bands, cycles per sample, `(band,)`.
        level: Roots of the sensors' powers, `(sensor, band)`.
        before, after: Coherence matrices, complex, `(band, sensor, sensor)`.
    """

    name: ClassVar[str] = "coherence_remainder"
    identified: ClassVar[bool] = False
    refit_after_others: ClassVar[bool] = True
    remark: ClassVar[str] = (
        "So that the sensors of the repaired simulation share what those of the recording share, they are mixed in a "
        "way that stands for no physics."
    )
    asked_for_by: ClassVar[tuple[str, ...]] = ("coherence", "common")  # names of tests
    frequency: Annotated[Tensor, Dims(("band",))]
    level: Annotated[Tensor, Dims(("sensor", "band"))]
    before: Annotated[Tensor, Dims(("band", "sensor", "sensor"), complex=True)]
    after: Annotated[Tensor, Dims(("band", "sensor", "sensor"), complex=True)]

    @classmethod
    def left_over(cls, comparison: Comparison) -> CoherenceRemainder:
        """What the coherences ask for."""
        return cls._between(comparison.observed, comparison.reference)

    def but_for(self, sensors: Sequence[int]) -> CoherenceRemainder:
        """The same, with some sensors left as they are."""
        after = self.after.clone()
        for i in sensors:
            after[:, i], after[:, :, i] = self.before[:, i], self.before[:, :, i]
        return replace(self, after=_positive(after))

    @classmethod
    def _between(cls, observed: Records, reference: Records) -> CoherenceRemainder:
        """Coherences in narrow bands drawn towards those in wide ones, and these towards none.

        By as much as chance explains of the difference (Stein).
        """
        narrow = narrow_bands(observed.bands.n_samples)
        seen, simulated = observed.in_bands(narrow), reference.in_bands(narrow)
        before, after = (
            _shrunk(wide, fine, narrow.frequency) for wide, fine in ((reference, simulated), (observed, seen))
        )
        return cls(narrow.frequency, simulated.power.clamp(min=1e-300).sqrt(), _positive(before), _positive(after))

    def factor(self, base: object, f: Tensor) -> Tensor:
        return torch.ones(len(self.level), len(f), dtype=torch.float64)

    def mixing(self, f: Tensor) -> Tensor:
        """Complex gains `(frequency, sensor, sensor)` at `f` cycles per sample."""
        turn = _root(self.after) @ torch.linalg.inv(_root(self.before))  # (band, sensor, sensor)
        size = self.level.mT
        return _at(turn * (size[:, :, None] / size[:, None, :]), self.frequency, f)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return mixed(signal, self.mixing)

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        mixing = self.mixing(f)
        return mixing @ matrices.to(mixing.dtype) @ mixing.mH

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        after, before = (partial(self._with_powers, matrices) for matrices in (self.after, self.before))
        return spectral_gains(comparison, comparison.recording, after, fold, before)

    def _with_powers(self, coherence: Tensor, matrices: Tensor, f: Tensor) -> Tensor:
        """Cross-spectra `(frequency, sensor, sensor)` of coherences `(band, ...)` and the powers of matrices."""
        size = matrices.diagonal(dim1=-2, dim2=-1).sqrt()
        return _at(coherence, self.frequency, f) * size[:, :, None] * size[:, None, :].conj()

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.coherence(ax, comparison, sensor, (self.after - self.before)[:, sensor].abs().mean(0))

    def fit_without(self, comparison: Comparison, fold: int) -> CoherenceRemainder:
        return self._between(without_fold(comparison, fold), comparison.reference)


def _shrunk(wide: Records, fine: Records, f: Tensor) -> Tensor:
    """Coherence matrices of the same records in fine bands, which have their middles at `f`."""
    eye = torch.eye(wide.signal.shape[-2], dtype=torch.complex128)
    plain = 4.0  # times the mean square of chance: of many narrow bands and pairs some stand out
    coarse = drawn_towards(wide.coherence, 1 / wide.dof[:, None, None], eye)
    middle = _at(coarse, wide.bands.frequency, f)
    return drawn_towards(fine.coherence, plain / fine.dof[:, None, None], middle)


def _at(matrices: Tensor, frequency: Tensor, f: Tensor) -> Tensor:
    """Matrices `(band, sensor, sensor)` of bands at frequencies between their middles, `(frequency, ...)`."""
    return between_bands(matrices.movedim(0, -1), frequency, f).movedim(-1, 0)


def _positive(matrices: Tensor) -> Tensor:
    """The nearest coherence matrices that are positive, with ones on their diagonals."""
    least = 1e-3  # eigenvalue: what is less is not known
    values, vectors = torch.linalg.eigh((matrices + matrices.mH) / 2)
    made = (vectors * values.clamp(min=least)[..., None, :]) @ vectors.mH
    size = made.diagonal(dim1=-2, dim2=-1).real.sqrt()
    return made / (size[..., :, None] * size[..., None, :])


def _root(matrices: Tensor) -> Tensor:
    """Hermitian roots."""
    values, vectors = torch.linalg.eigh(matrices)
    return (vectors * values.clamp(min=0).sqrt()[..., None, :]) @ vectors.mH
