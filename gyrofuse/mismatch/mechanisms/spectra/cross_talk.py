"""Cross-talk: what a sensor has of the signals of others."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD, NEW_TERM_NATS
from gyrofuse.mismatch.detectors.spectra.pooled_coherence import common_source
from gyrofuse.mismatch.likelihoods.declared import declared
from gyrofuse.mismatch.likelihoods.spectra.coherence import coherence_of, connected, smooth_coherence
from gyrofuse.mismatch.likelihoods.spectra.data import block_spectra, reference_noise
from gyrofuse.mismatch.likelihoods.spectra.mixing import Mixing, mixing_of, of_known_powers
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Rival
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import leading_shape
from gyrofuse.mismatch.mechanisms.spectra.spectral import Spectral
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, in_fold, sd_of_sum
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class CrossTalk(Spectral):
    """`x_i -> x_i + sum_j m_ij x_j`: cross-talk of lines and converters, cross-axis sensitivity.

    Sensors share, in phase and at all frequencies alike, what others have of their own. A source in common is one more
    signal: it makes as many gains as there are sensors, and has one spectrum, whatever theirs are.

    Attributes:
        mixing: `m`, of the row's sensor what it has of the column's, `(sensor, sensor)`; zeros on the diagonal.
    """

    name: ClassVar[str] = "cross_talk"
    rivals: ClassVar[tuple[str, ...]] = ("common_mode",)
    separated_by: ClassVar[str] = "a known motion of one axis"
    mixing: Annotated[Tensor, Dims(("sensor", "sensor"))]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        source = common_source(comparison)
        if source is None or source.p_value > level:
            return None
        found = _whole_mixing(comparison)
        effect = cls(found.matrix)
        if found.worth < NEW_TERM_NATS or (source_first := _source_instead(comparison, effect)) is None:
            return None
        info, parameters = comparison.info, {}
        rows, columns = found.free.nonzero(as_tuple=True)
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True):
            m, reach = float(found.matrix[i, j]), Z * float(found.sd[i, j])
            parameters[f"part_of_{j + 1}[{i}]"] = Parameter.around(m, reach, "")
        told = (found.matrix.abs() > Z * found.sd) & found.free
        sensors = tuple((told | (found.free & ~told & ~told.mT)).any(-1).nonzero()[:, 0].tolist())
        return effect.found(
            f"cross-talk that the simulation does not have, in {info.named(sensors, 'all sensors')}: "
            + _largest(found.matrix, told, info),
            source.p_value,
            sensors,
            parameters,
            alternatives=source_first.names,
            gain=min(max(found.gain, source_first.least), source_first.most),
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        if comparison.n_sensors < 2:
            return None
        found = _whole_mixing(comparison)
        return Rival(cls(found.matrix), found.worth) if bool(found.free.any()) else None

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return signal + self.mixing.to(signal) @ signal

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        mixed = (torch.eye(len(self.mixing), dtype=self.mixing.dtype) + self.mixing).to(matrices.dtype)
        return mixed @ matrices @ mixed.mT

    def factor(self, base: NoiseSpectrum, f: Tensor) -> Tensor:
        power = base.spectrum(f)
        return 1 + self.mixing.square() @ power / power

    def fit_without(self, comparison: Comparison, fold: int) -> CrossTalk:
        found = _mixing(comparison, ~in_fold(N_JUDGED, fold), self.mixing != 0)
        return replace(self, mixing=found.matrix)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.coherence(ax, comparison, sensor, self.mixing[sensor].abs() + self.mixing[:, sensor].abs())


def _largest(mixing: Tensor, told: Tensor, info: RecordingInfo) -> str:
    """What is said of the largest entry, or of the largest pair where spectra do not tell which has the other's."""
    p = len(mixing)
    if bool(told.any()):
        i, j = divmod(int((mixing.abs() * told).argmax()), p)
        return (
            f"sensor {info.sensors[i]} has {100 * float(mixing[i, j]):.3g} % of the signal of sensor {info.sensors[j]}"
        )
    i, j = divmod(int((mixing + mixing.mT).abs().argmax()), p)
    return (
        f"sensors {info.sensors[i]} and {info.sensors[j]} have {100 * float(mixing[i, j] + mixing[j, i]):.3g} % of "
        "each other's signals, of spectra too much alike to tell which has how much"
    )


class _SourceInstead(NamedTuple):
    """What a source in common, which is simpler, leaves to be said of cross-talk.

    Attributes:
        names: Of the source, where it does as well on blocks held out.
        least, most: Nats that cross-talk then counts, so that the likelier of both is tried first.
    """

    names: tuple[str, ...] = ()
    least: float = -math.inf
    most: float = math.inf


def _source_instead(comparison: Comparison, mixing: CrossTalk) -> _SourceInstead | None:
    """None where a source in common does better."""
    best = leading_shape(comparison)
    if best is None or not best.term.coherent:
        return _SourceInstead()
    source = next((made for kind in declared(Spectral) if (made := kind.from_term(best.term, comparison))), None)
    if source is None:
        return None
    # Elsewhere something else may mix sensors, or be a source: one name competes with one.
    same = connected(mixing.mixing != 0)[best.term.free.any(0)].any(0)
    beside = replace(mixing, mixing=mixing.mixing * same)
    own, other = (_held_out(one, comparison) for one in (beside, replace(source, company=best.company)))
    more, chance = float((own - other).sum()), max(2 * sd_of_sum(own - other), NATS_AS_GOOD)
    if more < -chance:
        return None
    if more > chance:
        return _SourceInstead(least=best.gain + 1)
    return _SourceInstead((source.name,), most=best.gain - 1)


def _held_out(effect: Spectral, comparison: Comparison) -> Tensor:
    """Scores of all blocks, `(block,)`, each with the numbers of the others."""
    return torch.cat(
        [effect.fit_without(comparison, fold).held_out_scores(comparison, fold) for fold in range(N_FOLDS)]
    )


@derived
def _whole_mixing(comparison: Comparison) -> Mixing:
    """That of the whole recording.

    Where spectra are alike, which of two has the other's signal shows in the powers: one has more than the simulation.
    """
    whole, most_pairs = torch.ones(N_JUDGED, dtype=torch.bool), 4
    found = _mixing(comparison, whole)
    pairs = (found.free & found.free.mT).triu().nonzero().tolist()
    if not pairs or len(pairs) > most_pairs:
        return found
    for i, j in pairs:
        ways = [found]
        for row, column in ((i, j), (j, i)):
            free = found.free.clone()
            free[row, column] = False
            ways.append(_mixing(comparison, whole, free))
        scores = [_held_out(CrossTalk(way.matrix), comparison) for way in ways]
        best = max(range(len(ways)), key=lambda k: float(scores[k].sum()))
        leads = [scores[best] - other for k, other in enumerate(scores) if k != best]
        if all(float(lead.sum()) > max(2 * sd_of_sum(lead), NATS_AS_GOOD) for lead in leads):
            found = ways[best]
    return found


def _mixing(comparison: Comparison, blocks: Tensor, free: Tensor | None = None) -> Mixing:
    """That of some of the recording's blocks."""
    both, p = block_spectra(comparison), comparison.n_sensors
    matrices, dof = both.observed.mean(blocks)
    known = dof >= 2 * p  # of fewer ordinates a matrix may be singular
    source = common_source(comparison)
    if source is None or source.independent:
        shared = torch.eye(p, dtype=matrices.dtype).expand_as(matrices)
    else:
        simulated, ordinates = both.reference.mean(torch.ones(N_FOLDS, dtype=torch.bool))
        shared = smooth_coherence(coherence_of(simulated), ordinates)
        dof = dof * ordinates / (dof + ordinates).clamp(min=1e-300)
    power = reference_noise(comparison).spectrum(both.bands.frequency)  # (sensor, band)
    size = power.mT.sqrt()
    unmixed = shared * (size[:, :, None] * size[:, None, :])
    seen = matrices[known], dof[known], shared[known]
    return of_known_powers(mixing_of(*seen, free), *seen, unmixed[known], fewer=free is None)
