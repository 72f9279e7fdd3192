"""Spectral mechanisms in the place of another finding, and what happened once where slow noise was found."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.scans import MOST_STEPS, slow_analysis, steps_one_by_one
from gyrofuse.mismatch.likelihoods.spectra.common_sources import Common
from gyrofuse.mismatch.likelihoods.spectra.components import Term
from gyrofuse.mismatch.likelihoods.spectra.fit import fit
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect
from gyrofuse.mismatch.mechanisms.slow.step import Step
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import compared
from gyrofuse.mismatch.signals.comparison import Comparison

_NATS_PER_NUMBER = 2.0  # for each free number of a sensor
_POSSIBLE, _NATS_BEHIND = 0.1, 5.0  # p value of an event, and nats by which it may score less than the noise


def fit_alone(
    comparison: Comparison, sensors: Sequence[int], start: Callable[[Ratios], Term | None]
) -> tuple[Term, float] | None:
    """Fit one spectral component in some sensors, with no other beside it.

    Args:
        comparison: Recording and simulation.
        sensors: Positions of the sensors; a common source keeps its own.
        start: Function of the spectra that gives the component where its fit starts, or None.

    Returns:
        The component, and its log likelihood ratio less `_NATS_PER_NUMBER` nats for each number; None without one.
    """
    data = compared(comparison)
    term = start(data) if data.n_ordinates else None
    if term is None:
        return None
    own = torch.zeros(comparison.n_sensors, dtype=torch.bool)
    own[list(sensors)] = True
    free = term.free if isinstance(term, Common) else term.free & own
    if not bool(free.any()):
        return None
    found = fit(data, [term.only(free)], rounds=8)  # a rival starts at its likeliest grid point
    return found.terms[0], found.gain - _NATS_PER_NUMBER * len(found.information)


def happened_instead(
    comparison: Comparison, finding: Finding, beside: Sequence[Finding], walks: Tensor | None
) -> tuple[str, ...]:
    """Names of events that score as much as a finding of more noise does: a step is red noise as well.

    So are several steps; and what happened more than once in its sensors by the findings `beside` is like a walk.

    Args:
        comparison: Recording and simulation with all findings explained but this one.
        finding: Finding of more noise.
        beside: All other findings.
        walks: Gains of the random walks that the noise may stand for, `(source, sensor)`; None for fast noise.
    """
    scans = slow_analysis(comparison).scans
    once = [s.family.name for s in scans if s.p_value < _POSSIBLE and s.gain > finding.gain - _NATS_BEHIND]
    if walks is None:
        return tuple(dict.fromkeys(once))
    happened = [
        f.mechanism
        for f in beside
        if f.effect.happened_once and isinstance(f.effect, SlowEffect) and set(f.sensors) & set(finding.sensors)
    ]
    again = [name for name in happened if happened.count(name) > 1]
    noise = max(finding.gain, _score_of_walks(comparison, walks))
    steps = [Step.name] if _score_of_steps(comparison, finding) > noise - _NATS_BEHIND else []
    return tuple(dict.fromkeys((*once, *again, *steps)))


def walks_of(comparison: Comparison, finding: Finding) -> Tensor:
    """Gains `(source, sensor)` of one random walk in each sensor of a finding."""
    return torch.eye(comparison.n_sensors, dtype=torch.float64)[list(finding.sensors)]


def _score_of_walks(comparison: Comparison, gains: Tensor) -> float:
    """Log likelihood ratio of random walks with gains `(source, sensor)`, nats, in the ordinates that show steps."""
    analysis = slow_analysis(comparison)
    weighted = gains[:, :, None] / analysis.noise.own  # (source, sensor, ordinate)
    walk = analysis.noise.parts[0, -1]
    variance = torch.logspace(-3, 6, 200, dtype=torch.float64)[:, None, None]  # over the simulation's
    # Variance of a source over that of the noise, and its power over the noise: (variance, source, ordinate).
    over = variance * ((gains[:, :, None] * weighted).sum(1) * walk)
    power = variance * ((weighted * analysis.y).sum(1).square() * walk)
    return float((((power / (1 + over) - over.log1p()).sum(-1) / 2).amax(0) - 1).sum())


def _score_of_steps(comparison: Comparison, finding: Finding) -> float:
    """Log likelihood ratio of several steps in a finding's sensors, nats, less what their onsets and sizes cost."""
    score, gram = (products[list(finding.sensors)] for products in slow_analysis(comparison).of_steps)
    cost = math.log(score.shape[-1]) + len(score)
    _, _, squares = steps_one_by_one(score, gram, 2 * cost, MOST_STEPS)
    return sum(squares) / 2 - cost * len(squares)
