"""Parity test: detection and isolation of faulty sensors of an array.

The test compares the energy of every sensor's difference from the optimal fusion of the others (`residuals`) at every
level in a window with that of a nominal reference: an excess is a fault, and the sensor with the largest excess is
isolated. A stuck sensor has too small a wavelet variance of its own, which motion could only raise. The kind of fault
follows from the shape of the difference (`classify`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.deprecation import renamed_arguments
from gyrofuse.fusion.faults.classify import kinds_of
from gyrofuse.fusion.faults.reference import ParityReference, check_window, stationary_reference
from gyrofuse.fusion.faults.residuals import Energies, chunks_of, energies_of, parity_matrix, window_products
from gyrofuse.fusion.faults.result import ParityResult
from gyrofuse.fusion.result import SVOResult
from gyrofuse.io.recording import Recording
from gyrofuse.io.signals import as_recording
from gyrofuse.wavelets.intervals import equivalent_dof


@renamed_arguments(before="history", gain_tolerance="scale_factor_tolerance")
def parity_test(
    signal: Tensor | Recording,
    reference: ParityReference | SVOResult,
    *,
    window: int | None = None,
    history: Tensor | Recording | None = None,
    false_alarm: float = 0.01,
    scale_factor_tolerance: float = 0.0,
) -> ParityResult:
    """Test an array, at rest or moving, for stuck-at faults, biases, drifts, noise changes and inverted signs.

    Each window is tested by itself: energies of every sensor's difference from the others at every level against F
    quantiles, with conservative degrees of freedom, the variation of the noise power in the reference added, and
    Bonferroni's correction for sensors and levels. In a nominal array of Gaussian noise the probability that a window
    raises an alarm is at most `false_alarm`; heavier tails are covered as far as windows of the reference show them. A
    faulty sensor is left out and the others are tested again. Of two sensors a fault is detected, but not isolated.

    Wavelets reach back: a window is compared with the samples before it, as far as the longest level. A bias shows
    while its step is within reach, so `history` should hold the nominal samples that precede the signal. A bias from
    the start on is not detected, nor is an inverted sign at rest of a sensor without bias.

    Args:
        signal: `(..., sensor, time)` or a `Recording`; NaN = missing sample. A last window that is not full is left
            out, and a sensor that lacks more than half of a window is not tested in it.
        reference: `fit_parity_reference` of a nominal stretch; or `fit_svo` of one, whose noise is then taken to be
            stationary and Gaussian: with heavy tails or varying power the false-alarm rate is larger than stated.
        window: Samples of a window; by default that of the reference, or the whole signal.
        history: `(..., sensor, time)`, samples that precede the signal.
        false_alarm: Probability of an alarm in a window of a nominal array, over all sensors, scales and kinds.
        scale_factor_tolerance: Relative difference of scale factors, 0.01 say, that is no fault while the array turns.

    Returns:
        The result, batched over `(..., window)`, with the sensors and windows that could not be tested.

    Raises:
        TypeError: `signal` or `history` is neither a floating point tensor nor a `Recording`, or `reference` is neither
            a `ParityReference` nor an `SVOResult`.
        ValueError: Shapes that do not fit, a window longer than the signal, numbers out of range, or so many missing
            samples that no window could be tested.

    Example:
        >>> reference = fit_parity_reference(calibration, window=512)
        >>> print(parity_test(signal, reference, history=calibration))
    """
    known_as = as_recording(signal)
    values = known_as.values
    if not isinstance(reference, ParityReference | SVOResult):
        raise TypeError(
            f"`reference`: expected a ParityReference or an SVOResult, got {type(reference).__name__}; "
            "fit one to a stretch without faults with fit_parity_reference(signal, window)"
        )
    known = reference.window if isinstance(reference, ParityReference) else 0
    window = check_window((known or values.shape[-1]) if window is None else window, values.shape[-1], "signal")
    nominal = reference if isinstance(reference, ParityReference) else _stationary(reference, window)
    _check_shape(values, nominal)
    for name, value in (("false_alarm", false_alarm), ("scale_factor_tolerance", scale_factor_tolerance)):
        if not 0 <= value < 1:
            raise ValueError(f"`{name}`: expected a number from 0 to 1 such as 0.01, got {value!r}")
    parts = [
        _test(chunk, nominal, window, false_alarm, scale_factor_tolerance)
        for chunk in chunks_of(values, window, nominal.n_levels, _history(values, history))
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
        sensors=known_as.sensors if isinstance(signal, Recording) else nominal.sensors,
        axes=known_as.axes,
        rate=known_as.rate,
        unit=known_as.unit,
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
    """One tail of the test for each window, level and sensor, `(..., window, level, sensor)`.

    Attributes:
        ratio: Variance in units of its nominal value.
        p: Its p-value.
        evidence: Log likelihood ratio, which ranks cases whose p-values are 0 to rounding.
    """

    ratio: Tensor
    p: Tensor
    evidence: Tensor


def _test(
    chunk: Tensor, reference: ParityReference, window: int, false_alarm: float, scale_factor_tolerance: float
) -> _Columns:
    """Isolate one sensor of each window, leave it out and test again, until no more are found."""
    products = window_products(chunk, window, reference.n_levels)
    # Long wavelets reach back beyond a window, of which half of the samples are required all the same.
    gamma, live = reference.wavelet_cross_covariance, products.live & _present(chunk, window, products.live)
    columns, n_tests = None, torch.ones_like(live[..., 0], dtype=torch.float64)
    for _ in reference.sensors:
        matrix, weights = parity_matrix(gamma, live)
        energies = energies_of(products, matrix, weights, reference.own_variance, scale_factor_tolerance)
        loud, quiet = _loud(energies, reference, live), _quiet(energies, reference, live)
        if columns is None:
            n_tests = loud.p.isfinite().sum((-2, -1)) + quiet.p.isfinite().sum((-2, -1))
            n_tests = n_tests.clamp(min=1).double()
        p_loud, p_quiet = (_adjusted(side.p, n_tests) for side in (loud, quiet))  # (..., window, level, sensor)
        p_values = torch.minimum(p_loud, p_quiet).amin(-2)
        if columns is None:
            columns = _nothing(p_values, loud.p.isfinite().any(-2))
        columns = columns._replace(p_values=torch.where(live, p_values, columns.p_values))
        # Of two sensors only a stuck one can be isolated.
        stuck = p_quiet.amin(-2) < false_alarm
        isolable = live & (p_values < false_alarm) & ((live.sum(-1, keepdim=True) > 2) | stuck)
        if not bool(isolable.any()):
            break
        evidence_loud = torch.where(p_loud < false_alarm, loud.evidence, -1.0)
        evidence_quiet = torch.where(p_quiet < false_alarm, quiet.evidence, -1.0)
        evidence = torch.where(isolable, torch.maximum(evidence_loud, evidence_quiet).amax(-2), -1.0)
        isolated = torch.zeros_like(live).scatter_(-1, evidence.argmax(-1, keepdim=True), True) & isolable
        level = torch.where(stuck, evidence_quiet.argmax(-2), evidence_loud.argmax(-2))
        ratio = torch.where(stuck.unsqueeze(-2), quiet.ratio, loud.ratio).gather(-2, level.unsqueeze(-2)).squeeze(-2)
        kind, size = kinds_of(chunk, window, isolated, level, gamma, matrix, stuck)
        columns = columns._replace(
            faulty=columns.faulty | isolated,
            kind=torch.where(isolated, kind, columns.kind),
            level=torch.where(isolated, level, columns.level),
            statistic=torch.where(isolated, ratio, columns.statistic),
            size=torch.where(isolated, size, columns.size),
        )
        live = live & ~isolated
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

    `e_i` is the residual of a regression on the p - 2 parities of the others: these use up as many of the reference's
    observations, and errors of the coefficients add to a new residual, as in Hotelling's T^2.
    """
    dof = reference.dof[..., None, :, None]  # (..., 1, level, 1)
    left = dof - (live.sum(-1) - 2).clamp(min=0)[..., None, None]
    ratio = energies.parity * (left / dof) / (1 + energies.rest / dof)
    tested = (energies.counts > 0).unsqueeze(-1) & (live.sum(-1, keepdim=True) > 1).unsqueeze(-1)
    return _side(
        "sf", ratio, _observed(energies), left, reference.power_variance, reference, tested & live.unsqueeze(-2)
    )


def _quiet(energies: Energies, reference: ParityReference, live: Tensor) -> _Side:
    """Too little energy of a sensor itself."""
    observed, dof = _observed(energies), reference.dof[..., None, :, None]
    # The variance of fewer than 8 observations may be small by chance.
    tested = (observed >= 8) & live.unsqueeze(-2)
    return _side("cdf", energies.own, observed, dof, reference.own_power_variance, reference, tested)


def _observed(energies: Energies) -> Tensor:
    """Independent observations of each window, `(..., window, level, 1)`."""
    return equivalent_dof(energies.counts).unsqueeze(-1)


def _side(
    tail: str,
    ratio: Tensor,
    observed: Tensor,
    dof: Tensor,
    power_variance: Tensor,
    reference: ParityReference,
    tested: Tensor,
) -> _Side:
    """P-value of a variance ratio in a nominal array.

    An F law with degrees of freedom `eta` such that `2/eta` is the relative variance of a variance, including the
    variation of the noise power. A varying power has longer tails, and its variation is known from few windows: where
    it varies more than sampling, the logarithm of the ratio is compared with Student's t as well, and the larger
    p-value counts.
    """
    from scipy import stats

    power_variance, n_windows = power_variance.unsqueeze(-3), reference.n_windows[..., None, :, None]
    above, below = 2 / observed + power_variance, 2 / dof + power_variance / n_windows  # relative variances
    deviation = torch.log1p(above + below).sqrt()
    score = ratio.clamp(min=1e-300).log() / deviation + deviation / 2
    chances = []
    for law, *arguments in ((stats.f, ratio, 2 / above, 2 / below), (stats.t, score, (n_windows - 1).clamp(min=1))):
        chance = getattr(law, tail)(*(value.cpu().numpy() for value in arguments))
        chances.append(torch.as_tensor(chance).to(ratio))
    chance = torch.where(power_variance > 2 / observed, torch.maximum(*chances), chances[0])
    evidence = (ratio - 1 - ratio.clamp(min=1e-300).log()) / above
    return _Side(ratio, torch.where(tested, chance, torch.nan), evidence)


def _stationary(result: SVOResult, window: int) -> ParityReference:
    return stationary_reference(result.wavelet_cross_covariance, result.dof, result.sensors, window, name="reference")


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


def _history(values: Tensor, history: Tensor | Recording | None) -> Tensor | None:
    """Samples before the signal, of its batch shape."""
    if history is None:
        return None
    earlier = as_recording(history, "history").values
    if earlier.shape[:-1] != values.shape[:-1]:
        raise ValueError(
            f"`history`: expected the shape {tuple(values.shape[:-1])} of the signal but for time, "
            f"got {tuple(earlier.shape[:-1])}"
        )
    return earlier.to(values)
