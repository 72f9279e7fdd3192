"""The level of the noise: whether it changes, by itself or compared with that of the simulation."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.episodes import episodes_of
from gyrofuse.mismatch.evidence import Evidence, corrected, ratio_p_value, surpassing
from gyrofuse.mismatch.impulses import left_out
from gyrofuse.mismatch.level_scan import LevelScan, Reference, other_level, scanned_levels
from gyrofuse.mismatch.modulation import Modulation, strongest_modulation
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.side import Side

_NOTHING = 0.05  # p value of what need not be compared
LEVEL_CUT = 9.0  # squares: an outlier is no change of level
_BLOCK = 128
_BURST = 15  # lags
_CHANGES = 1.62  # range of a stationary CUSUM that one in ten exceeds
_ANOTHER = 0.01  # p value of a level that the simulation does not have
_UNSTEADY = 1e-4  # p value of a simulation's level that changes


class Levels(NamedTuple):
    """What the simulation's level tells of the recording's.

    Attributes:
        reference: The simulation's level.
        scan: For a stretch of the recording that has another level than the rest and the simulation.
        throughout: Log of the mean likelihood ratio of another level throughout, nats.
        p_value: Of the scan, where a stretch is likelier than another level throughout; else 1.
    """

    reference: Reference
    scan: LevelScan
    throughout: float
    p_value: float


def _squares(white: Tensor) -> Tensor:
    """`min(e^2, 9)` of whitened records `(..., sensor, time)`, and last of all their sum over the sensors."""
    squares = white.square().clamp(max=LEVEL_CUT)
    return torch.cat([squares, _standardised(squares).sum(-2, keepdim=True)], -2)


def _ranges(squares: Tensor) -> Tensor:
    """Range of the CUSUM of `(..., time)` in blocks over its sd: Kuiper's, of a Brownian bridge."""
    blocks = squares[..., : squares.shape[-1] // _BLOCK * _BLOCK].unflatten(-1, (-1, _BLOCK)).mean(-1)
    # From first differences, which bursts raise; chance must not lower it below that of independent samples.
    sd = (blocks.diff(dim=-1).square().mean(-1) / 2).sqrt().maximum(squares.std(-1) / math.sqrt(_BLOCK))
    path = (blocks - blocks.mean(-1, keepdim=True)).cumsum(-1)
    return (path.amax(-1) - path.amin(-1)) / (sd * math.sqrt(blocks.shape[-1]))


def _kuiper_p(reach: float) -> float:
    """Of a Brownian bridge's range, `2 sum (4 j^2 x^2 - 1) exp(-2 j^2 x^2)`."""
    if reach < 0.6:
        return 1.0
    terms = [(4 * (j * reach) ** 2 - 1) * math.exp(-2 * (j * reach) ** 2) for j in range(1, 40)]
    return min(max(2 * sum(terms), 0.0), 1.0)


@remembered
def _scanned(side: Side) -> LevelScan:
    """Scan of all the records, in which the level would change at the same times."""
    return scanned_levels(left_out(side).white.flatten(0, 1).square().clamp(max=LEVEL_CUT))


def _divided(case: Case) -> bool:
    """Whether the simulation's own levels are taken off the recording."""
    return case.simulated.signal.shape[-1] == case.n_samples and _scanned(case.simulated).p_value < _UNSTEADY


def level_profile(case: Case) -> Tensor:
    """Variance of the noise that the simulation gives each sample, `(sensor, time)`, or 1 where it is steady."""
    profile = torch.ones(case.n_sensors, 1, dtype=torch.float64)
    white = left_out(case.simulated).white
    if not _divided(case):
        return profile
    found = episodes_of(white.flatten(0, 1), torch.zeros(white[..., 0].numel() + 1, dtype=torch.float64))
    if found is None:
        return profile
    factor = found.factor.view(white.shape[:-1]).log().mean(0).exp()
    return torch.where(found.inside(case.n_samples), factor[:, None], 1.0)


@remembered
def levelled(case: Case) -> Tensor:
    """Whitened recording `(sensor, time)` over the noise level that the simulation has there."""
    return left_out(case.recorded).white[0] / level_profile(case).sqrt()


@remembered
def variance_p_values(case: Case) -> Tensor:
    """p values that the noise level changes, in each sensor and in all together, `(sensor + 1,)`.

    Once for episodes, from the range of the CUSUM, once for bursts, from the autocorrelation of the squares.
    """
    squares, other = _squares(levelled(case)), _squares(left_out(case.simulated).white)
    wander = (_ranges(other).amax(0) / _CHANGES).clamp(min=1.0)
    heavy = (_clustering(other[0]) - 2.5).clamp(min=0)
    if _divided(case):
        wander, heavy = torch.ones_like(wander), torch.zeros_like(heavy)
    episodes = torch.tensor([_kuiper_p(float(r)) for r in _ranges(squares) / wander], dtype=torch.float64)
    bursts = torch.special.ndtr(heavy - _clustering(squares))
    both = torch.minimum(episodes, bursts)
    return 1 - (1 - both).square()


@remembered
def compared_levels(case: Case) -> Levels | None:
    """The level of the recording beside that of the simulation; None where that has none that is steady."""
    reference, own = _reference(case), _scanned(case.simulated).p_value
    if reference is None or own < _UNSTEADY:
        return None
    scan = scanned_levels(levelled(case).square().clamp(max=LEVEL_CUT), reference)
    throughout = other_level(case.n_samples, reference)
    p_value = surpassing(ratio_p_value(scan.log_ratio), own) if scan.log_ratio > throughout else 1.0
    return Levels(reference, scan, throughout, p_value)


def level_between(case: Case, inside: Tensor) -> Reference | None:
    """The simulation's level, where the recording has it outside of episodes `(time,)`; None where it has another."""
    compared = compared_levels(case)
    if compared is None or bool(inside.all()):
        return None
    squares = levelled(case).square().clamp(max=LEVEL_CUT)
    outside = squares[:, ~inside].mean(-1) / squares.mean(-1)
    z = (outside / compared.reference.level).log() / math.sqrt(2 / int((~inside).sum()) + 2 / compared.reference.worth)
    agrees = torch.special.gammaincc(torch.tensor(len(z) / 2, dtype=z.dtype), z.square().sum() / 2)
    return compared.reference if float(agrees) > _ANOTHER else None


def _reference(case: Case) -> Reference | None:
    """The simulation's level over that of the recording: of their spectra, on average over all frequencies."""
    recorded, simulated = case.recorded, case.simulated
    both = (recorded.dof > 0) & (simulated.dof > 0)
    worth = recorded.dof * both
    if not bool(both.any()):
        return None
    ratio = _log_power(simulated.power, simulated.dof) - _log_power(recorded.power, recorded.dof)
    level = (torch.where(both, ratio, 0.0) @ worth / worth.sum()).exp()
    return Reference(level, simulated.n_records * simulated.signal.shape[-1])


def _log_power(power: Tensor, dof: Tensor) -> Tensor:
    """Unbiased logarithms of densities `(sensor, band)` that come from so many ordinates `(band,)`."""
    dof = dof.clamp(min=1e-3)
    return power.log() - torch.digamma(dof) + dof.log()


def variance_p_value(case: Case) -> float:
    """p value that the noise level changes anywhere: in one sensor or all, or by little in several.

    The latter once within the recording, and once from the simulation's level for a while.
    """
    each = variance_p_values(case)
    p_value = corrected(float(each.min()), len(each))
    several = scanned_levels(levelled(case).square().clamp(max=LEVEL_CUT)).p_value
    if not _divided(case):
        several = surpassing(several, _scanned(case.simulated).p_value)
    compared = compared_levels(case)
    return corrected(min(p_value, several, 1.0 if compared is None else compared.p_value), 3)


@remembered
def modulation(case: Case) -> Modulation:
    """The most conspicuous modulation of the noise level that the simulation does not have."""
    found = strongest_modulation(levelled(case).square().clamp(max=LEVEL_CUT))
    if found.p_value > _NOTHING:
        return found
    profile = level_profile(case)
    white = left_out(case.simulated).white / (profile if _divided(case) else 1.0) ** 0.5
    other = min(strongest_modulation(record.square().clamp(max=LEVEL_CUT)).p_value for record in white)
    return found._replace(p_value=surpassing(found.p_value, other))


def _standardised(values: Tensor) -> Tensor:
    return (values - values.mean(-1, keepdim=True)) / values.std(-1, keepdim=True)


def _clustering(squares: Tensor) -> Tensor:
    """Standard normal sum of the autocorrelations of `(..., time)` at short lags."""
    x = _standardised(squares)
    n = x.shape[-1]
    lags = [torch.linalg.vecdot(x[..., lag:], x[..., :-lag]) for lag in range(1, _BURST + 1)]
    return torch.stack(lags).sum(0) / math.sqrt(n * _BURST)


def variance_witness(case: Case) -> Evidence:
    """Changes of the noise level within the recording: once, in bursts, slowly or with a period."""
    changed, wave = variance_p_value(case), modulation(case)
    p_value = corrected(min(changed, wave.p_value), 2)
    if wave.p_value < changed:
        high = wave.high * case.scene.rate
        how = f"with a frequency of {high:.5g} Hz" if wave.period else f"more slowly than {high:.3g} Hz"
        return Evidence(
            "variance",
            p_value,
            f"a noise level that goes up and down {how} in {case.scene.named(wave.sensors, 'all sensors')}",
            sensors=wave.sensors,
            levels=(1,),
            frequency_hz=high if wave.period else None,
        )
    p_values = variance_p_values(case)
    worst = int(p_values.argmin())
    every = worst == case.n_sensors
    squares = levelled(case).square().clamp(max=LEVEL_CUT)
    blocks = avg_pool1d(squares.mean(0, keepdim=True) if every else squares[worst : worst + 1], _BLOCK)[0]
    path = (blocks - blocks.mean()).cumsum(-1)
    onset = min(int(path.argmin()), int(path.argmax())) + 1
    where = "all sensors together" if every else f"sensor {case.scene.sensors[worst]}"
    return Evidence(
        "variance",
        p_value,
        f"a noise level that changes in {where}",
        sensors=tuple(range(case.n_sensors)) if every else (worst,),
        levels=(1,),
        time_s=onset * _BLOCK / case.scene.rate,
    )
