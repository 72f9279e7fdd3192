"""Noise that is heavy-tailed throughout: no two levels, and no isolated outliers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.variance.level_spread import level_lasts
from gyrofuse.mismatch.detectors.variance.random_levels import is_random_level
from gyrofuse.mismatch.likelihoods.laws.heavy_tails import HeavyTails
from gyrofuse.mismatch.likelihoods.laws.outlier_law import clustered
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.regimes.scale_mixture import InnovationsLaw
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.prediction_errors import left_out, scaled_innovations
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class HeavyTailedNoise(InnovationsLaw):
    """`x_t = sum_k psi_k s_{t-k} e_{t-k}`, `s` independent from sample to sample, of a continuous law, mean square one.

    The innovations of the noise are Student's, or a normal plus a Laplace variable: both are normal with a variance
    that is drawn anew for each.

    Attributes:
        freedom: Degrees of freedom of Student's law, `(sensor,)`; 0 where it is none.
        width: Width of the Laplace variable over the standard deviation of the normal one, `(sensor,)`, likewise.
    """

    freedom: OfSensors
    width: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p_value = cls.p_value(comparison)
        if p_value > level:
            return None
        z = left_out(comparison.observed).white[0]
        laws = _laws(comparison.observed)
        own = _simulated_gains(comparison)
        gains = torch.stack([(law.gains(z[i]) - own[i]).sum() for i, law in enumerate(laws)])
        present = 15.0  # nats over normal noise, and over what the simulation has
        heavy = tuple((gains > present).nonzero()[:, 0].tolist())
        if not heavy or clustered(z[list(heavy)]) or any(level_lasts(z[i]) for i in heavy):
            return None
        if is_random_level(comparison, float(gains[list(heavy)].sum())):
            return None
        info, parameters = comparison.info, {}
        for i in heavy:
            reach = math.exp(min(Z * laws[i].log_shape_sd(z[i]), 50.0))
            name = "laplace_width" if laws[i].laplace else "freedom"
            parameters[f"{name}[{i}]"] = Parameter.within(laws[i].shape, reach, "")
        most = max(heavy, key=lambda i: float(gains[i]))
        law = (
            f"those of normal noise and of Laplacian noise {laws[most].shape:.3g} times as wide"
            if laws[most].laplace
            else f"those of Student's law with {laws[most].shape:.3g} degrees of freedom"
        )
        return cls._of(laws, heavy).found(
            f"the noise of {info.named(heavy, 'all sensors')} has heavy tails throughout, {law}"
            f"{f' (sensor {info.sensors[most]})' if len(heavy) > 1 else ''}",
            p_value,
            heavy,
            parameters,
            levels=(1,),
            gain=float(gains[list(heavy)].sum()),
        )

    @classmethod
    def _of(cls, laws: list[HeavyTails], heavy: tuple[int, ...]) -> HeavyTailedNoise:
        numbers = torch.zeros(2, len(laws), dtype=torch.float64)
        for i in heavy:
            numbers[int(laws[i].laplace), i] = laws[i].shape
        return cls(*numbers)

    def fit_without(self, comparison: Comparison, fold: int) -> HeavyTailedNoise:
        keep = estimation_samples(comparison.n_samples, fold)
        rows = left_out(comparison.observed).white[0][:, keep]
        freedom, width = self.freedom.clone(), self.width.clone()
        for i, laplace in self._heavy:
            (width if laplace else freedom)[i] = HeavyTails.of_kind(laplace, rows[i]).shape
        return replace(self, freedom=freedom, width=width)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        scores, own = torch.zeros_like(comparison.recording), _simulated_gains(comparison)
        for i, laplace in self._heavy:
            row = left_out(comparison.observed).white[0, i]
            law = HeavyTails.of_kind(laplace, row, self._shape(i))
            scores[i] = law.gains(row) - own[i]
        return held_out_blocks(scores, fold).sum((0, -1))

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        factors = torch.ones_like(signal)
        for i, laplace in self._heavy:
            factors[..., i, :] = HeavyTails(laplace, self._shape(i), 1.0).factors(signal[..., i, :], generator)
        heavy = ((self.freedom > 0) | (self.width > 0))[:, None]
        return torch.where(heavy, scaled_innovations(signal, factors), signal)

    @property
    def _heavy(self) -> list[tuple[int, bool]]:
        """Sensors that have it, and whether by a Laplace variable."""
        laplace = self.width > 0
        return [(i, bool(laplace[i])) for i in ((self.freedom > 0) | laplace).nonzero()[:, 0].tolist()]

    def _shape(self, sensor: int) -> float:
        return float(torch.maximum(self.freedom, self.width)[sensor])


@derived
def _laws(side: Records) -> list[HeavyTails]:
    """Of the noise of each sensor."""
    return [HeavyTails.fitted(rows.flatten()) for rows in left_out(side).white.movedim(0, 1)]


@derived
def _simulated_gains(comparison: Comparison) -> Tensor:
    """What laws of the simulation gain in the recording, whatever their scale, `(sensor, time)`."""
    pairs = zip(_laws(comparison.reference), left_out(comparison.observed).white[0], strict=True)
    return torch.stack([HeavyTails.of_kind(law.laplace, row, law.shape).gains(row) for law, row in pairs])
