"""Effects that are Gaussian noise of another spectrum: their size is the Kullback-Leibler divergence."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from . import converter, mechanics
from .analog import OVERSAMPLING, bank_spectrum, relaxator_bank
from .bench import SEPARABLE, Bench, Part, quantity, rms
from .likelihood import (
    OutOfReachError,
    ar1_spectrum,
    coefficients,
    comparison,
    divergence,
    expected_power,
    folded,
    grid,
    quadratic_null,
    solve,
    spectral_llr,
    within,
)
from .traps import Trap, beyond_its_twin

Array = NDArray[np.float64]
NARROW = ("drifting_tone", "resonance")
MOST_QUIETER = 1e3  # in variance: of gyroscopes that cost ten thousand times as much


def _fine_grid(bench: Bench) -> Array:
    return np.arange(bench.steps + 1) / (2 * bench.steps)


def coloured(
    bench: Bench, mechanism: str, nats: float, after: Array, sensors: tuple[int, ...], each: Array, **truth: Any
) -> Part:
    """Gaussian noise of the spectrum `after` instead of the base's, worth `each` (sensor,) nats."""
    return Part(
        mechanism,
        nats,
        sensors,
        lambda recording: spectral_llr(recording, after, bench.spectrum),
        oracle_nats=float(divergence(after, bench.spectrum).sum()),
        oracle_null=quadratic_null(after / bench.spectrum),
        sensor_nats=tuple(float(each[i]) for i in sensors),
        **truth,
    )


def added(bench: Bench, mechanism: str, nats: float, unit: Array, *, broad: bool = False) -> tuple[Part, float]:
    """Noise of spectrum v `unit` (sensor, frequency) added to the base, at the v whose divergence is `nats`; and v.

    What is narrow stands out beside its own neighbourhood; of what is `broad` only a comparison with the simulation
    tells.
    """
    share = bench.share if broad else math.inf
    reference = float((bench.spectrum / np.maximum(unit.max(axis=0), 1e-300)).min())

    def expected(size: float) -> float:
        return float(comparison(bench.spectrum + size * unit, bench.spectrum, share).sum())

    size = solve(nats, expected, 1e-9 * reference, 1e6 * reference)
    after = bench.spectrum + size * unit
    each = comparison(after, bench.spectrum, share)
    sensors = tuple(int(i) for i in np.flatnonzero(unit.sum(axis=1) > 0))
    look_alikes: tuple[str, ...] = ("parameter_shift",) if bench.looks_like_parameters(after) else ()
    if mechanism in NARROW and (after / bench.spectrum).max() < 2:  # its envelope drowns in the noise of its band
        look_alikes += tuple(name for name in NARROW if name != mechanism)
    return coloured(bench, mechanism, nats, after, sensors, each, look_alikes=look_alikes), size


def resonance(bench: Bench, nats: float) -> Part:
    """A structure that rings in noise, at each sensor with a gain and a drive of its own."""
    sensors = bench.some_sensors(2)
    f, quality = bench.rng.uniform(0.06, 0.4) * bench.rate, math.exp(bench.rng.uniform(math.log(8), math.log(60)))
    gains = bench.gains(sensors, signed=False)
    nu = f / bench.step_rate
    unit = folded(mechanics.resonator_spectrum(_fine_grid(bench), nu, quality), OVERSAMPLING)[1:-1]
    part, size = added(bench, "resonance", nats, gains[:, None] ** 2 * unit)
    signal = np.zeros((bench.n_sensors, bench.n))
    for i in sensors:
        ringing = mechanics.resonator(bench.steps, nu, quality, bench.rng)
        signal[i] = math.sqrt(size) * gains[i] * bench.sampled(ringing)
    sd = math.sqrt(size) * gains[list(sensors)] * abs(np.sinc(f / bench.rate))
    return replace(
        part,
        signal=signal,
        frequency_hz=f,
        parameters={
            "frequency": quantity(f, "Hz"),
            "quality": quantity(quality, ""),
            "amplitude": quantity(rms(sd), "deg/s", sd),  # standard deviation after the converter
        },
    )


def power_law(bench: Bench, nats: float, *, mechanism: str = "flicker", exponent: float = 1.0) -> Part:
    """1/f^exponent noise by a bank of relaxators, from a quarter of a sample to a tenth of the recording."""
    sensors = bench.some_sensors(2)
    gains = bench.gains(sensors, signed=False)
    taus = np.geomspace(OVERSAMPLING / 4, bench.steps / 10, 2 * int(math.log10(4 * bench.n)) + 1)
    variances = taus ** (exponent - 1) / np.sum(taus ** (exponent - 1))
    unit = expected_power(folded(bank_spectrum(_fine_grid(bench), taus, variances), OVERSAMPLING))
    part, size = added(bench, mechanism, nats, gains[:, None] ** 2 * unit, broad=True)
    signal = np.zeros((bench.n_sensors, bench.n))
    for i in sensors:
        signal[i] = math.sqrt(size) * gains[i] * bench.sampled(relaxator_bank(bench.steps, taus, variances, bench.rng))
    # one more relaxator may stand for it, and for other exponents flicker noise may
    after = bench.spectrum + size * gains[:, None] ** 2 * unit
    f = grid(bench.n)
    corners = [ar1_spectrum(f, math.exp(-1 / tau), 1.0) * (1 - math.exp(-1 / tau)) ** 2 for tau in
               np.geomspace(10, bench.n / 10, 3)]  # fmt: skip
    alone = [np.broadcast_to(corner, after.shape) * bench.base.white[:, None] / after for corner in corners]
    twin = np.broadcast_to(1 / f, after.shape) * bench.base.white[:, None] / after
    own = [component / after for component in bench.components]
    look_alikes = set(part.look_alikes)
    if any(bench.distinct(after, [*own, extra]) < SEPARABLE for extra in alone):
        look_alikes.add("parameter_shift")
    if mechanism != "flicker" and bench.distinct(after, [*own, twin]) < SEPARABLE:
        look_alikes.add("flicker")
    middle = (f > 10 / bench.n) & (f < 0.1)
    level = math.sqrt(2 * size * float(np.mean((unit * f**exponent)[middle]))) * gains[list(sensors)]
    return replace(
        part,
        signal=signal,
        look_alikes=tuple(sorted(look_alikes)),
        parameters={
            # for 1/f noise its standard deviation in each factor e of frequency
            "level": quantity(rms(level), "deg/s", level),
        },
    )


def quantization_noise(bench: Bench, nats: float) -> Part:
    """Quantisation noise of an integrated angle: the first difference of white noise."""
    sensors = bench.some_sensors(2)
    gains = bench.gains(sensors, signed=False)
    unit = 4 * np.sin(np.pi * grid(bench.n)) ** 2
    part, size = added(bench, "quantization_noise", nats, gains[:, None] ** 2 * unit, broad=True)
    signal = np.zeros((bench.n_sensors, bench.n))
    for i in sensors:
        signal[i] = math.sqrt(size) * gains[i] * np.diff(bench.rng.standard_normal(bench.n + 1))
    angle = math.sqrt(size) * gains[list(sensors)] / bench.rate
    return replace(part, signal=signal, parameters={"angle": quantity(rms(angle), "deg", angle)})


def random_telegraph(
    bench: Bench, nats: float, *, dwell_share: float | None = None, asymmetries: tuple[float, float] = (0.6, 1.6)
) -> Part:
    """A trap in one to three sensors; `asymmetries` bound the square root of the ratio of its dwells.

    The oracle knows the spectrum, not that there are two levels: a lower bound, which they exceed by some nats.
    """
    sensors = bench.some_sensors(1, 3)
    traps = []
    for _ in sensors:
        switches = math.exp(bench.rng.uniform(math.log(50), math.log(150))) if dwell_share is None else 1 / dwell_share
        asymmetry = bench.rng.uniform(*asymmetries)
        traps.append(Trap(bench.n / switches * asymmetry, bench.n / switches / asymmetry))
    gains = bench.gains(sensors, signed=False) * bench.sigma
    unit, signal = np.zeros_like(bench.spectrum), np.zeros((bench.n_sensors, bench.n))
    for i, trap in zip(sensors, traps, strict=True):
        unit[i] = gains[i] ** 2 * trap.spectrum(grid(bench.n))
    part, size = added(bench, "random_telegraph", nats, unit, broad=True)
    beyond = 0.0
    for i, trap in zip(sensors, traps, strict=True):
        gains[i] *= math.sqrt(size)
        fine = Trap(OVERSAMPLING * trap.up, OVERSAMPLING * trap.down)
        signal[i] = gains[i] * (bench.sampled(fine.path(bench.steps, bench.rng)) - 0.5)
        beyond += beyond_its_twin(bench.base, i, bench.n, trap, float(gains[i]), bench.rng)
    up, down = np.array(traps).T / bench.rate
    half = gains[list(sensors)] / 2
    return replace(
        part,
        signal=signal,
        look_alikes=("parameter_shift",) if beyond < SEPARABLE else (),
        parameters={
            "half_step": quantity(rms(half), "deg/s", half),
            "dwell_up": quantity(rms(up), "s", up),
            "dwell_down": quantity(rms(down), "s", down),
        },
    )


def common_mode(bench: Bench, nats: float) -> Part:
    """White noise of one supply in several sensors; each keeps the level that the simulator expects.

    That sensors of a simulation have nothing in common is told by as many samples as it has: the nats are those of
    the comparison, `1/2 sum [(1 + s) log|(R + s S)/(1 + s)| - log|R| - s log|S|]`, with the matrices `R` and `S`.
    """
    sensors = bench.some_sensors(3, shared=True)
    gains = bench.gains(sensors, signed=False) * bench.sigma
    log_before = np.log(bench.spectrum).sum(axis=0)

    def law(share: float, own: Array) -> tuple[Array, Array]:
        """Independent part (sensor, frequency) and log determinant of the cross-spectral matrix, per frequency."""
        alone = bench.spectrum - share * own[:, None] ** 2
        return alone, np.log(alone).sum(axis=0) + np.log1p(share * (own[:, None] ** 2 / alone).sum(axis=0))

    def divergence_of(share: float, own: Array) -> float:
        return float((log_before - law(share, own)[1]).sum() / 2)

    def expected(share: float, own: Array = gains) -> float:
        if math.isinf(bench.share):
            return divergence_of(share, own)
        # of both together it is that of a smaller share
        return (1 + bench.share) * -divergence_of(share / (1 + bench.share), own) + divergence_of(share, own)

    share = solve(nats, expected, 1e-7, 0.6)
    alone, logdet = law(share, gains)
    without = [expected(share, np.where(np.arange(bench.n_sensors) == i, 0.0, gains)) for i in sensors]

    def llr(recording: Array) -> float:
        x = coefficients(recording)
        projected = (gains[:, None] * x / alone).sum(axis=0)
        capacity = 1 + share * (gains[:, None] ** 2 / alone).sum(axis=0)
        quadratic = (x**2 / bench.spectrum - x**2 / alone).sum(axis=0) + share * projected**2 / capacity
        return float((quadratic + log_before - logdet).sum() / 2)

    supply = bench.sampled(math.sqrt(OVERSAMPLING) * bench.rng.standard_normal(bench.steps))
    level = math.sqrt(share) * gains
    sparse = slice(None, None, 16)  # the spectra are smooth: one frequency of 16 gives the law of the ratio
    whitened = level / np.sqrt(bench.spectrum[:, sparse]).T  # (frequency, sensor)
    inside = whitened[:, :, None] * whitened[:, None, :]
    inside[:, np.arange(bench.n_sensors), np.arange(bench.n_sensors)] = 1.0
    null = quadratic_null(np.linalg.eigvalsh(inside))
    return Part(
        "common_mode",
        nats,
        sensors,
        llr,
        oracle_nats=divergence_of(share, gains),
        oracle_null=(16 * null[0], 16 * null[1], 16 * null[2]),
        signal=level[:, None] * supply,
        base=replace(bench.base, white=bench.base.white - level**2),
        sensor_nats=tuple(nats - others for others in without),
        parameters={"gain": quantity(rms(level[list(sensors)]), "deg/s", level[list(sensors)])},
    )


def cross_talk(bench: Bench, nats: float) -> Part:
    """Some sensors have parts of the signals of one or two others, before the converter.

    The nats are those of the comparison of matrices, as of `common_mode`.
    """
    p = bench.n_sensors
    if p < 2:
        raise OutOfReachError("expected two sensors or more for cross-talk, got one")
    sensors = bench.some_sensors(1)
    unit = np.zeros((p, p))
    for i in sensors:
        others = [j for j in range(p) if j != i]
        for j in bench.rng.choice(others, min(int(bench.rng.integers(1, 3)), p - 1), replace=False):
            # A part of a sensor with ten times the noise shows ten times as much.
            unit[i, j] = bench.rng.uniform(0.5, 1.0) * bench.rng.choice([-1, 1]) * bench.sigma[i] / bench.sigma[j]
    sparse = bench.spectrum[:, ::16]  # smooth: one frequency of 16 tells
    root = np.sqrt(sparse).T  # (frequency, sensor)

    def matrices(size: float, rows: Array | float = 1.0) -> Array:
        """Cross-spectra over those of the base, `(frequency, sensor, sensor)`."""
        mixed = (np.eye(p) + size * np.reshape(rows, (-1, 1)) * unit) * root[:, None, :] / root[:, :, None]
        return np.asarray(mixed @ mixed.transpose(0, 2, 1))

    def divergence_of(made: Array) -> float:
        return float(8 * (np.trace(made, axis1=1, axis2=2) - p - np.linalg.slogdet(made)[1]).sum())

    def expected(size: float, rows: Array | float = 1.0) -> float:
        made = matrices(size, rows)
        if math.isinf(bench.share):
            return divergence_of(made)
        both = (made + bench.share * np.eye(p)) / (1 + bench.share)
        return float(8 * ((1 + bench.share) * np.linalg.slogdet(both)[1] - np.linalg.slogdet(made)[1]).sum())

    size = solve(nats, expected, 1e-5, 0.6)
    mixing = size * unit
    without = [expected(size, np.arange(p) != i) for i in sensors]
    volume = bench.spectrum.shape[1] * float(np.linalg.slogdet(np.eye(p) + mixing)[1])

    def llr(recording: Array) -> float:
        x = coefficients(recording)
        unmixed = np.linalg.solve(np.eye(p) + mixing, x)
        return float(((x**2 - unmixed**2) / bench.spectrum).sum() / 2) - volume

    null = quadratic_null(np.linalg.eigvalsh(matrices(size)))
    part = {f"part_of_{j + 1}": mixing[list(sensors), j] for j in range(p) if mixing[:, j].any()}
    return Part(
        "cross_talk",
        nats,
        sensors,
        llr,
        oracle_nats=divergence_of(matrices(size)),
        oracle_null=(16 * null[0], 16 * null[1], 16 * null[2]),
        analog=lambda analog: analog + mixing @ analog,
        sensor_nats=tuple(nats - others for others in without),
        look_alikes=("common_mode",) if _beyond_one_source(matrices(size)) < SEPARABLE else (),
        parameters={name: quantity(rms(values), "", values) for name, values in part.items()},
    )


def _beyond_one_source(made: Array) -> float:
    """Nats of cross-spectra over a base's `(frequency, sensor, sensor)`, each for 16, that no white source explains.

    In place of the likeliest gains, those that least squares has.
    """
    p = made.shape[1]
    coherence = made / np.sqrt(np.einsum("fii->fi", made)[:, :, None] * np.einsum("fii->fi", made)[:, None, :])
    pairs = np.triu_indices(p, 1)
    wanted = coherence[:, pairs[0], pairs[1]]
    level = 1 / np.sqrt(
        np.einsum("fii->fi", made)
    )  # of white noise over the whole: the base is white above its corners

    def left(gains: Array) -> Array:
        return (wanted - (gains * level)[:, pairs[0]] * (gains * level)[:, pairs[1]]).ravel()

    values, vectors = np.linalg.eigh(coherence.mean(0) - np.eye(p))
    start = vectors[:, -1] * math.sqrt(max(values[-1], 1e-6))
    return float(8 * np.square(least_squares(left, start).fun).sum())


def low_pass(bench: Bench, nats: float) -> Part:
    """A second-order filter in the sensor, before the converter."""
    sensors = bench.some_sensors(2)
    chosen = np.isin(np.arange(bench.n_sensors), sensors)[:, None]
    nu = _fine_grid(bench)

    def after(corner: float) -> Array:
        passed = folded(OVERSAMPLING * converter.low_pass_gain(nu, corner), OVERSAMPLING)[1:-1]
        return bench.spectrum - chosen * bench.base.white[:, None] * (1 - passed)

    def worth(inverse: float) -> Array:
        return comparison(after(1 / inverse), bench.spectrum, bench.share)

    inverse = solve(nats, lambda x: float(worth(x).sum()), 1 / 0.49, 1 / 0.004)
    corner = 1 / inverse
    spectrum = after(corner)

    def filtered(analog: Array) -> Array:
        return np.where(chosen, converter.low_pass(analog, corner), analog)

    return coloured(
        bench,
        "low_pass",
        nats,
        spectrum,
        sensors,
        worth(inverse),
        analog=filtered,
        look_alikes=("parameter_shift",) if bench.looks_like_parameters(spectrum) else (),
        frequency_hz=corner * bench.step_rate,
        parameters={"corner": quantity(corner * bench.step_rate, "Hz")},
    )


def notch(bench: Bench, nats: float) -> Part:
    """A filter before the converter that takes a band out."""
    sensors = bench.some_sensors(2)
    chosen = np.isin(np.arange(bench.n_sensors), sensors)[:, None]
    nu, centre = _fine_grid(bench), float(bench.rng.uniform(0.05, 0.35))
    width = centre * float(bench.rng.uniform(0.15, 0.6))
    in_fine_samples = centre / OVERSAMPLING, width / OVERSAMPLING

    def after(depth: float) -> Array:
        passed = folded(OVERSAMPLING * converter.notch_gain(nu, *in_fine_samples, depth), OVERSAMPLING)[1:-1]
        return bench.spectrum - chosen * bench.base.white[:, None] * (1 - passed)

    def worth(depth: float) -> Array:
        return comparison(after(depth), bench.spectrum, bench.share)

    depth = solve(nats, lambda x: float(worth(x).sum()), 1e-3, 0.95)
    return coloured(
        bench,
        "notch",
        nats,
        after(depth),
        sensors,
        worth(depth),
        analog=lambda analog: np.where(chosen, converter.notch(analog, *in_fine_samples, depth), analog),
        frequency_hz=centre * bench.rate,
        parameters={
            "centre": quantity(centre * bench.rate, "Hz"),
            "width": quantity(width * bench.rate, "Hz"),
            "depth": quantity(-20 * math.log10(1 - depth), "dB"),
        },
    )


def parameter_shift(bench: Bench, nats: float, *, only: str | None = None) -> Part:
    """The same physics with other numbers; `only` one of "white", "ar1", "walk", or "gain": all of one sensor alike."""
    sensors = bench.some_sensors(1, 1) if only == "gain" else bench.some_sensors(2)
    chosen = np.isin(np.arange(bench.n_sensors), sensors)
    names = ["white", "ar1", "walk"]
    weights = bench.rng.uniform(0.3, 1, 3) * bench.rng.choice([-1, 1], 3)
    if only == "gain":
        weights = np.full(3, bench.rng.choice([-1.0, 1.0]))
    elif only:
        weights = np.array([float(name == only) for name in names]) * (-1 if only == "white" else 1)

    def shifted(size: float) -> tuple[Array, Array, Array]:
        white, ar1, walk = np.exp(size * weights[:, None] * chosen)
        return bench.base.white * white, bench.base.variance * ar1[:, None], bench.base.walk * walk

    def base(size: float) -> Part:
        white, variance, walk = shifted(size)
        changed = replace(bench.base, white=white, variance=variance, walk=walk)
        spectrum = changed.spectrum(bench.n)
        each = comparison(spectrum, bench.spectrum, bench.share)
        factors = dict(zip(names, np.exp(size * weights), strict=True))
        return coloured(
            bench,
            "parameter_shift",
            float(each.sum()),
            spectrum,
            sensors,
            each,
            base=changed,
            parameters={f"{name}_factor": quantity(factor, "") for name, factor in factors.items()},
        )

    size = solve(nats, lambda size: base(size).nats, 1e-5, 14.0)
    within("white noise that is less by a factor", math.exp(-size * weights[0]), MOST_QUIETER, "")
    return base(size)


def sensor_gain(bench: Bench, nats: float) -> Part:
    """One factor on all that a sensor gives; other numbers of all its processes, by that factor, are the same."""
    part = parameter_shift(bench, nats, only="gain")
    factor = math.sqrt(part.parameters["white_factor"]["value"])
    gain = quantity(factor, "", np.array([factor]))
    return replace(part, mechanism="sensor_gain", look_alikes=("parameter_shift",), parameters={"gain": gain})
