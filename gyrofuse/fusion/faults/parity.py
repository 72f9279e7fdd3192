"""Parity test: which sensor of an array disagrees with the others, since when and how.

The test compares the energy of every sensor's difference from the optimal fusion of the others (`parity_energy`) at
every level in a window with that of a healthy reference: more of it is a fault, and the sensor whose own difference has
most too much is the one at fault. A sensor that is stuck shows in its own wavelet variance, which motion can only add
to. What kind of fault it is, `fault_kinds` tells from its shape.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.checks import check_signal
from gyrofuse.fusion.faults.classify import kinds_of
from gyrofuse.fusion.faults.reference import ParityReference, check_window, stationary_reference
from gyrofuse.fusion.faults.residuals import Energies, chunks_of, energies_of, parity_matrix, window_products
from gyrofuse.fusion.faults.result import ParityResult
from gyrofuse.fusion.result import SVOResult
from gyrofuse.io.recording import Recording
from gyrofuse.wavelets.equivalent_dof import degrees_of_freedom

# Observations of a window below which its variance can be small by chance alone.
_FEWEST_QUIET = 8


def parity_test(
    signal: Tensor | Recording,
    reference: ParityReference | SVOResult,
    *,
    window: int | None = None,
    before: Tensor | Recording | None = None,
    false_alarm: float = 0.01,
    gain_tolerance: float = 0.0,
) -> ParityResult:
    """Test an array, at rest or moving, for sensors that are frozen, biased, drifting, noisier or sign-flipped.

    Each window is tested by itself: energies of every sensor's difference from the others at every level against F
    quantiles, with degrees of freedom on the safe side, the spread of the reference added, and Bonferroni's correction
    for sensors and levels. In a healthy array of Gaussian noise the chance that a window raises an alarm is
    `false_alarm` at most; what heavier tails add, the spread of the reference alone knows. A sensor found faulty is
    left out and the others are tested again. Two sensors show that they disagree, but not who is wrong.

    Wavelets look back: a window is compared with what came before it, as far as the longest level reaches. A bias
    shows while that holds its step, so `before` should be the healthy samples that precede the signal; a bias that was
    there from the start is not seen, nor is a turned sign at rest of a sensor without bias.

    Args:
        signal: `(..., sensor, time)` or a `Recording`; NaN = missing sample. A last window that is not full is left
            out, and a sensor that lacks more than half of a window is not tested in it.
        reference: `fit_parity` of a healthy stretch; or a fit of one, whose noise is then taken to be stationary and
            Gaussian: under heavy tails or a power that wanders healthy windows raise more alarms than stated.
        window: Samples of a window; by default that of the reference, or the whole signal.
        before: `(..., sensor, time)`, what precedes the signal.
        false_alarm: Probability of an alarm in a window of a healthy array, over all sensors, scales and kinds.
        gain_tolerance: By how much scale factors may differ, 0.01 say, without being a fault while the array turns.

    Returns:
        The result, batched over `(..., window)`. It names the sensors and windows that could not be tested.

    Raises:
        TypeError: `signal` or `before` is neither a floating point tensor nor a `Recording`, or `reference` is neither
            a `ParityReference` nor an `SVOResult`.
        ValueError: Shapes that do not fit, a window longer than the signal, numbers out of range, or so many missing
            samples that no window could be tested.

    Example:
        >>> healthy = fit_parity(calibration, window=512)
        >>> print(parity_test(signal, healthy, before=calibration))
    """
    of = signal if isinstance(signal, Recording) else None
    values = signal.signal if isinstance(signal, Recording) else signal
    check_signal("signal", values)
    if not isinstance(reference, ParityReference | SVOResult):
        raise TypeError(
            f"`reference`: expected a ParityReference or an SVOResult, got {type(reference).__name__}; "
            "learn one from a healthy stretch with fit_parity(healthy, window)"
        )
    known = reference.window if isinstance(reference, ParityReference) else 0
    window = check_window((known or values.shape[-1]) if window is None else window, values.shape[-1], "signal")
    healthy = reference if isinstance(reference, ParityReference) else _stationary(reference, window)
    _check_shape(values, healthy)
    for name, value in (("false_alarm", false_alarm), ("gain_tolerance", gain_tolerance)):
        if not 0 <= value < 1:
            raise ValueError(f"`{name}`: expected a number from 0 to 1 such as 0.01, got {value!r}")
    parts = [
        _test(chunk, healthy, window, false_alarm, gain_tolerance)
        for chunk in chunks_of(values, window, healthy.n_levels, _history(values, before))
    ]
    columns = _Columns(*(torch.cat(column, values.ndim - 2) for column in zip(*parts, strict=True)))
    if not bool(columns.tested.any()):
        missing = 100 * (~values.isfinite()).double().mean().item()
        raise ValueError(
            f"`signal`: expected a window of {window} samples that two sensors have at least half of, found none "
            f"({missing:.3g} % of all samples are missing); record with fewer losses or leave sensors out"
        )
    return ParityResult(
        **columns._asdict(),
        window=window,
        false_alarm=false_alarm,
        sensors=of.sensors if of else healthy.sensors,
        axes=of.axes if of else (),
        rate=of.rate if of else None,
        unit=of.unit if of and of.unit != "unknown" else None,
    )


class _Columns(NamedTuple):
    """Columns of the result, `(..., window, sensor)` each and `p_value` `(..., window)`."""

    faulty: Tensor
    kind: Tensor
    level: Tensor
    statistic: Tensor
    size: Tensor
    p_values: Tensor
    p_value: Tensor
    tested: Tensor


class _Side(NamedTuple):
    """Of each window, level and sensor: a variance in units of what it should be, how likely one as far off is, and the
    log likelihood ratio, which orders what p-values of 0 cannot.
    """

    ratio: Tensor
    p: Tensor
    evidence: Tensor


def _test(
    chunk: Tensor, reference: ParityReference, window: int, false_alarm: float, gain_tolerance: float
) -> _Columns:
    """Name one sensor of each window, leave it out and look again, until no more are found."""
    products = window_products(chunk, window, reference.n_levels)
    # Long wavelets look back beyond a window, whose own samples have to be there all the same.
    gamma, live = reference.wavelet_cross_covariance, products.live & _present(chunk, window, products.live)
    columns, n_tests = None, torch.ones_like(live[..., 0], dtype=torch.float64)
    for _ in reference.sensors:
        matrix, weights = parity_matrix(gamma, live)
        energies = energies_of(products, gamma, matrix, weights, reference.own_variance, gain_tolerance)
        loud, quiet = _loud(energies, reference, live), _quiet(energies, reference, live)
        if columns is None:
            n_tests = loud.p.isfinite().sum((-2, -1)) + quiet.p.isfinite().sum((-2, -1))
            n_tests = n_tests.clamp(min=1).double()
        p_loud, p_quiet = (_adjusted(side.p, n_tests) for side in (loud, quiet))  # (..., window, level, sensor)
        p_values = torch.minimum(p_loud, p_quiet).amin(-2)
        if columns is None:
            columns = _nothing(p_values, loud.p.isfinite().any(-2))
        columns = columns._replace(p_values=torch.where(live, p_values, columns.p_values))
        # Of two sensors either may be the one that is off; only one that is stuck gives itself away.
        stuck = p_quiet.amin(-2) < false_alarm
        nameable = live & (p_values < false_alarm) & ((live.sum(-1, keepdim=True) > 2) | stuck)
        if not bool(nameable.any()):
            break
        evidence_loud = torch.where(p_loud < false_alarm, loud.evidence, -1.0)
        evidence_quiet = torch.where(p_quiet < false_alarm, quiet.evidence, -1.0)
        evidence = torch.where(nameable, torch.maximum(evidence_loud, evidence_quiet).amax(-2), -1.0)
        named = torch.zeros_like(live).scatter_(-1, evidence.argmax(-1, keepdim=True), True) & nameable
        level = torch.where(stuck, evidence_quiet.argmax(-2), evidence_loud.argmax(-2))
        ratio = torch.where(stuck.unsqueeze(-2), quiet.ratio, loud.ratio).gather(-2, level.unsqueeze(-2)).squeeze(-2)
        kind, size = kinds_of(chunk, window, named, level, gamma, matrix, stuck)
        columns = columns._replace(
            faulty=columns.faulty | named,
            kind=torch.where(named, kind, columns.kind),
            level=torch.where(named, level, columns.level),
            statistic=torch.where(named, ratio, columns.statistic),
            size=torch.where(named, size, columns.size),
        )
        live = live & ~named
    assert columns is not None
    return columns


def _present(chunk: Tensor, window: int, live: Tensor) -> Tensor:
    """Sensors `(..., window, sensor)` that have half of the samples of a window at least."""
    finite = chunk[..., chunk.shape[-1] - window * live.shape[-2] :].isfinite().unflatten(-1, (-1, window))
    return (2 * finite.sum(-1) >= window).mT


def _nothing(p_values: Tensor, tested: Tensor) -> _Columns:
    none, unknown = torch.full_like(tested, -1, dtype=torch.int64), torch.full_like(p_values, torch.nan)
    return _Columns(torch.zeros_like(tested), none, none, unknown, unknown, p_values, p_values.amin(-1), tested)


def _adjusted(p: Tensor, n_tests: Tensor) -> Tensor:
    """Bonferroni's correction; 1 where nothing was tested."""
    return (p * n_tests[..., None, None]).nan_to_num(1.0).clamp(max=1.0)


def _loud(energies: Energies, reference: ParityReference, live: Tensor) -> _Side:
    """Too much energy of a difference.

    `e_i` is the residual of a regression on the p - 2 parities of the others: that many of the reference's observations
    are spent, and a new one varies by what the coefficients are off as well, as in Hotelling's T^2.
    """
    degrees = reference.degrees_of_freedom[..., None, :, None]  # (..., 1, level, 1)
    left = degrees - (live.sum(-1) - 2).clamp(min=0)[..., None, None]
    ratio = energies.parity * (left / degrees) / (1 + energies.rest / degrees)
    tested = (energies.counts > 0).unsqueeze(-1) & (live.sum(-1, keepdim=True) > 1).unsqueeze(-1)
    return _side("sf", ratio, _observed(energies), left, reference.spread, reference, tested & live.unsqueeze(-2))


def _quiet(energies: Energies, reference: ParityReference, live: Tensor) -> _Side:
    """Too little energy of a sensor itself."""
    observed, degrees = _observed(energies), reference.degrees_of_freedom[..., None, :, None]
    tested = (observed >= _FEWEST_QUIET) & live.unsqueeze(-2)
    return _side("cdf", energies.own, observed, degrees, reference.own_spread, reference, tested)


def _observed(energies: Energies) -> Tensor:
    """Independent observations of each window, `(..., window, level, 1)`."""
    return degrees_of_freedom(energies.counts).unsqueeze(-1)


def _side(
    tail: str,
    ratio: Tensor,
    observed: Tensor,
    degrees: Tensor,
    spread: Tensor,
    reference: ParityReference,
    tested: Tensor,
) -> _Side:
    """Chance of a variance ratio in a healthy array.

    An F law, whose degrees of freedom the spread lowers: `2/eta` is the relative variance of a variance. Powers that
    themselves vary have longer tails, and how far they vary is known from some windows only: where they do, the
    logarithm of the ratio is held against Student's t as well, and the larger chance counts.
    """
    from scipy import stats

    spread, n_windows = spread.unsqueeze(-3), reference.n_windows[..., None, :, None]
    above, below = 2 / observed + spread, 2 / degrees + spread / n_windows  # relative variances
    deviation = torch.log1p(above + below).sqrt()
    score = ratio.clamp(min=1e-300).log() / deviation + deviation / 2
    chances = []
    for law, *arguments in ((stats.f, ratio, 2 / above, 2 / below), (stats.t, score, (n_windows - 1).clamp(min=1))):
        chance = getattr(law, tail)(*(value.cpu().numpy() for value in arguments))
        chances.append(torch.as_tensor(chance).to(ratio))
    chance = torch.where(spread > 2 / observed, torch.maximum(*chances), chances[0])
    evidence = (ratio - 1 - ratio.clamp(min=1e-300).log()) / above
    return _Side(ratio, torch.where(tested, chance, torch.nan), evidence)


def _stationary(result: SVOResult, window: int) -> ParityReference:
    return stationary_reference(
        result.wavelet_cross_covariance, result.degrees_of_freedom, result.sensors, window, name="reference"
    )


def _check_shape(values: Tensor, reference: ParityReference) -> None:
    n_sensors, batch = len(reference.sensors), reference.wavelet_cross_covariance.shape[:-3]
    if values.shape[-2] != n_sensors:
        raise ValueError(
            f"`signal`: expected (..., sensor, time) with the {n_sensors} sensors of the reference, "
            f"got shape {tuple(values.shape)}"
        )
    if batch != values.shape[values.ndim - 2 - len(batch) : -2]:
        raise ValueError(
            f"`signal`: expected the batch shape {tuple(batch)} of the reference, got {tuple(values.shape[:-2])}"
        )


def _history(values: Tensor, before: Tensor | Recording | None) -> Tensor | None:
    """Samples before the signal, of its batch shape."""
    if before is None:
        return None
    history: Any = before.signal if isinstance(before, Recording) else before
    check_signal("before", history)
    if history.shape[:-1] != values.shape[:-1]:
        raise ValueError(
            f"`before`: expected the shape {tuple(values.shape[:-1])} of the signal but for time, "
            f"got {tuple(history.shape[:-1])}"
        )
    return history.to(values)
