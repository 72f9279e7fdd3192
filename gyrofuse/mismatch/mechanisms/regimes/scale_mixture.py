"""Noise of two levels, sample by sample: a converter with two gains, contacts, interference that hits at random."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from scipy import special
from torch import Tensor

from gyrofuse.mismatch.detectors.variance.haar_kurtosis import jump_test
from gyrofuse.mismatch.detectors.variance.level_spread import level_lasts
from gyrofuse.mismatch.detectors.variance.normality import gaussian_sensors
from gyrofuse.mismatch.detectors.variance.outliers import spike_p_value
from gyrofuse.mismatch.detectors.variance.random_levels import is_random_level
from gyrofuse.mismatch.likelihoods.laws.heavy_tails import heavy_tailed
from gyrofuse.mismatch.likelihoods.laws.two_levels import TwoLevels
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.prediction_errors import left_out, scaled_innovations
from gyrofuse.mismatch.stats.limits import Z


class InnovationsLaw(Mechanism):
    """Innovations of noise that are no normal ones, though independent from sample to sample."""

    name: ClassVar[str] = "scale_mixture"
    likelihood: ClassVar[str] = "innovations"
    rivals: ClassVar[tuple[str, ...]] = ("variance_change", "nonlinearity")
    separated_by: ClassVar[str] = "a longer recording, or the converter's raw words"

    @staticmethod
    def p_value(comparison: Comparison) -> float:
        """Of outliers, or of jumps, that the simulation does not have."""
        return min(2 * min(spike_p_value(comparison), jump_test(comparison).p_value), 1.0)

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        built = super().apply_to_reference(comparison, generator)
        return replace(built, reference=replace(built.reference, gaussian=False))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.tails(ax, comparison, sensor)


@dataclass(frozen=True, eq=False)
class ScaleMixture(InnovationsLaw):
    """`x_t = sum_k psi_k s_{t-k} e_{t-k}`, `s` independent from sample to sample, of two values, with mean square one.

    The innovations `e` of the noise are larger by `ratio` with the probability `share`. The spectrum stays as it is,
    which tells it from more noise; hits do not lie together, which tells it from episodes; they are too many, and of
    sizes from zero on, for isolated outliers.

    Attributes:
        share: Probability of the larger level, `(sensor,)`; 0 where there is one level.
        ratio: Of the larger standard deviation to the smaller one, `(sensor,)`.
    """

    share: OfSensors
    ratio: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p_value = cls.p_value(comparison)
        if p_value > level:
            return None
        z = left_out(comparison.observed).white[0]
        laws = [TwoLevels.fitted(row) for row in z]
        gains = [
            float((law.gains(row) - own).sum())
            for law, row, own in zip(laws, z, _simulated_gains(comparison), strict=True)
        ]
        rare = 0.03  # rarer ones are isolated outliers
        better, present = 10.0, 15.0  # nats over another heavy-tailed law, and over normal noise
        hit = tuple(
            i
            for i, (law, gain) in enumerate(zip(laws, gains, strict=True))
            if gain > present and rare < law.share < 1 - rare and gain > heavy_tailed(z[i][law.within(z[i])]) + better
        )
        gain = sum(gains[i] for i in hit)
        if not hit or any(level_lasts(z[i]) for i in hit) or is_random_level(comparison, gain):
            return None
        info, parameters = comparison.info, {}
        share, ratio = torch.zeros(2, comparison.n_sensors, dtype=torch.float64)
        for i in hit:
            law = laws[i]
            share[i], ratio[i] = law.share, law.large / law.small
            odds_sd, ratio_sd = law.standard_deviations(z[i])
            odds = math.log(law.share / (1 - law.share))
            low, high = (100 * float(special.expit(odds + sign * Z * odds_sd)) for sign in (-1, 1))
            parameters[f"share[{i}]"] = Parameter(100 * law.share, low, high, "%")
            reach = math.exp(min(Z * ratio_sd, 50.0))
            value = float(ratio[i])
            parameters[f"ratio[{i}]"] = Parameter.within(value, reach, "")
        largest = max(hit, key=lambda i: gains[i])
        return cls(share, torch.where(ratio > 0, ratio, 1.0)).found(
            f"the noise of {info.named(hit, 'all sensors')} has two levels, sample by sample: "
            f"{100 * laws[largest].share:.3g} % of the samples are {float(ratio[largest]):.3g} times as loud as others"
            f"{f' (sensor {info.sensors[largest]})' if len(hit) > 1 else ''}",
            p_value,
            hit,
            parameters,
            levels=(1,),
            gain=gain,
        )

    def fit_without(self, comparison: Comparison, fold: int) -> ScaleMixture:
        keep = estimation_samples(comparison.n_samples, fold)
        laws = [TwoLevels.fitted(row[keep]) for row in left_out(comparison.observed).white[0]]
        has = self.share > 0
        share, ratio = (
            torch.tensor(values, dtype=torch.float64)
            for values in ([law.share for law in laws], [law.large / law.small for law in laws])
        )
        return replace(self, share=torch.where(has, share, 0.0), ratio=torch.where(has, ratio, 1.0))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        rows, own = [], _simulated_gains(comparison)
        for i, row in enumerate(left_out(comparison.observed).white[0]):
            share, ratio = float(self.share[i]), float(self.ratio[i])
            small = float(row.square().mean().sqrt()) / math.sqrt(1 - share + share * ratio**2)
            law = TwoLevels(share, small, ratio * small)
            rows.append(law.gains(row) - own[i] if share else torch.zeros_like(row))
        return held_out_blocks(torch.stack(rows), fold).sum((0, -1))

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        hit = torch.rand(signal.shape, generator=generator, dtype=torch.float64) < self.share[:, None]
        scale = (1 - self.share + self.share * self.ratio.square()).rsqrt()[:, None]
        factors = scale * torch.where(hit, self.ratio[:, None], 1.0)
        return torch.where((self.share > 0)[:, None], scaled_innovations(signal, factors), signal)


@derived
def _simulated_gains(comparison: Comparison) -> Tensor:
    """What laws of the simulation gain in the recording `(sensor, time)`: what else was found may make such values."""
    gains = torch.zeros_like(comparison.recording)
    for i, row in enumerate(left_out(comparison.observed).white[0]):
        if not bool(gaussian_sensors(comparison.reference)[i]):
            law = TwoLevels.fitted(left_out(comparison.reference).white[:, i].flatten())
            gains[i] = law.scaled_to(row[law.within(row)]).gains(row)
    return gains
