"""Kalibr's `imu.yaml`."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass

import torch

from gyrofuse._base import units
from gyrofuse._base.checks import check_positive
from gyrofuse._base.results import sensor_label
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.noise.model import check_scalar
from gyrofuse.noise.processes import Model


def to_kalibr(
    model: Model | GMWMResult,
    rate: float | None = None,
    unit: str | None = None,
    *,
    topic: str = "/imu0",
    accelerometer: Model | GMWMResult | None = None,
    slow: float = 1.0,
) -> str:
    """Write Kalibr's `imu.yaml`, which knows white noise and a random walk only.

    White noise gives `gyroscope_noise_density` and a random walk `gyroscope_random_walk`, in rad/s/sqrt(Hz) and
    rad/s^2/sqrt(Hz), both of continuous time. An AR(1) behaves like a random walk over times shorter than its
    correlation time and like white noise over longer ones: a slow one adds its innovations to the random walk, a fast
    one its spectral density at frequency 0, `variance / (1 - phi)^2`, to the white noise. For `phi >= 0` this errs on
    the side of more noise: the white noise has at least the wavelet variance of the AR(1) at every level, the random
    walk at least `phi` times it. Variances of several processes add up. Flicker noise counts as the random walk that
    has its Allan deviation at an averaging time of `slow`, a second-order Gauss-Markov process as the smallest random
    walk or white noise whose spectrum is nowhere below its own. Quantisation noise, sinusoids and drifts are left out.
    Comments in the file say of each process what became of it.

    Of a fit of several axes each key is that of the worst one. Kalibr rejects a density of 0: where a fit found none in
    any axis, its largest upper limit stands in the file, and a comment says so; where there is none either, as in a
    model without such a process, the key is left to be filled in.

    Args:
        model: Noise of a gyro: a model with scalar parameters, or a fit of one or several axes.
        rate: Sampling rate, Hz; that of the fit by default.
        unit: Rate unit of the model: deg/s, mdeg/s, deg/h, rad/s, mrad/s or rpm, or another spelling of one; that of
            the fit by default.
        topic: ROS topic of the IMU's messages.
        accelerometer: Model in m/s^2 at the same rate, or a fit; without it its two keys are left to be filled in.
        slow: Correlation time from which on an AR(1) counts as a random walk, s.

    Returns:
        Text of the file.

    Raises:
        ValueError: A parameter is to be estimated or batched, an unknown unit or one of the other quantity, no rate or
            unit, or not an absolute topic name.

    References:
        Kalibr, https://github.com/ethz-asl/kalibr/wiki/yaml-formats and IMU-Noise-Model.
    """
    slow = check_positive("slow", slow)
    gyroscope = _Triad.of("model", model, rate, unit, "rad/s")
    if not isinstance(topic, str) or not re.fullmatch(r"(/[A-Za-z]\w*)+", topic, re.ASCII):
        raise ValueError(f"`topic`: expected an absolute ROS topic name such as '/imu0', got {topic!r}")
    lines = [
        "# IMU noise for Kalibr. Densities are of continuous time, two-sided.",
        f"# An AR1 with a correlation time of {slow:g} s or more counts as a random walk, any other as white noise.",
        f"rostopic: {topic}",
        f"update_rate: {_yaml_number(gyroscope.rate)}  # Hz",
        "",
        f"# Gyroscope, from a model in {gyroscope.unit} per sample:",
        *_kalibr_keys(gyroscope, "gyroscope", slow, ("rad/s/sqrt(Hz)", "rad/s^2/sqrt(Hz)")),
        "",
    ]
    accelerations = ("m/s^2/sqrt(Hz)", "m/s^3/sqrt(Hz)")
    if accelerometer is None:
        lines += [
            "# Accelerometer: Kalibr demands both keys; remove the # and fill in numbers > 0.",
            f"# accelerometer_noise_density:  # {accelerations[0]}",
            f"# accelerometer_random_walk:  # {accelerations[1]}",
        ]
    else:
        rate, unit = (None, None) if isinstance(accelerometer, GMWMResult) else (gyroscope.rate, "m/s^2")
        triad = _Triad.of("accelerometer", accelerometer, rate, unit, "m/s^2")
        lines.append(f"# Accelerometer, from a model in {triad.unit} per sample:")
        lines += _kalibr_keys(triad, "accelerometer", slow, accelerations)
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class _Triad:
    """Sensors that Kalibr takes for alike.

    Attributes:
        names: Name of each sensor.
        models: Model of each sensor, with scalar parameters.
        highest: The same models with each variance of zero at its upper limit; empty where no limits are known.
        rate: Hz.
        unit: Unit of the models.
        factor: Factor from that unit to the one of Kalibr.
        confidence_level: Confidence level of the upper limits.
    """

    names: tuple[str, ...]
    models: tuple[Model, ...]
    highest: tuple[Model, ...]
    rate: float
    unit: str
    factor: float
    confidence_level: float = 0.95

    @classmethod
    def of(cls, name: str, given: Model | GMWMResult, rate: float | None, unit: str | None, target: str) -> _Triad:
        """Of one model or of all sensors of a fit, in the unit that Kalibr has them in."""
        if isinstance(given, GMWMResult):
            rate, unit = (given.rate if rate is None else rate), (unit or given.unit)
        if rate is None or unit is None:
            lacking, such_as = ("rate", "rate=100.0") if rate is None else ("unit", 'unit="deg/s"')
            of_log = ", or to `read_recording` for a log that states none" if isinstance(given, GMWMResult) else ""
            raise ValueError(
                f"`{lacking}`: expected that of `{name}`, which does not say it, got none; give it, such as {such_as}"
                f"{of_log}"
            )
        factor = units.unit_factor(unit, target)
        rate, unit = check_positive("rate", rate), units.canonical_unit(unit)
        if not isinstance(given, GMWMResult):
            check_scalar(name, given)
            return cls(("",), (given,), (), rate, unit, factor)
        params = given.params.flatten(0, -2)
        fitted = params.isfinite().all(-1)
        if not bool(fitted.any()):
            raise ValueError(f"`{name}`: expected a fit, got one in which no sensor could be fitted")
        variance = torch.tensor([key.endswith("variance") for key in given.param_names])
        limits = given.confidence_interval.high.flatten(0, -2)
        limited = torch.where(variance & (params == 0) & limits.isfinite(), limits, params)
        models, highest = (tuple(given.model.with_params(row) for row in rows[fitted]) for rows in (params, limited))
        places = itertools.compress(itertools.product(*map(range, given.params.shape[:-1])), fitted.tolist())
        names = tuple(sensor_label(given.sensors, index, given.axes) for index in places)
        return cls(names, models, highest, rate, unit, factor, given.confidence_level)


def _kalibr_keys(triad: _Triad, sensor: str, slow: float, key_units: tuple[str, str]) -> Iterator[str]:
    """What became of each process, as comments, and the two keys of a sensor."""
    for name, model in zip(triad.names, triad.models, strict=True):
        if len(triad.models) > 1:
            yield f"#  Sensor {name}:"
        for process in model.processes:
            yield f"#   {process!r}: {process._white_and_walk(triad.rate, slow, **process.values).fate}"
    found, limits = (
        [max(own) * triad.factor for own in zip(*(_densities(m, triad.rate, slow) for m in models), strict=True)]
        for models in (triad.models, triad.highest or triad.models)
    )
    worst = " of the worst axis" if len(triad.models) > 1 else ""
    keys = [f"{sensor}_{name}" for name in ("noise_density", "random_walk")]
    for key, density, limit, unit in zip(keys, found, limits, key_units, strict=True):
        if density:
            yield f"{key}: {density:.9e}  # {unit}{worst}"
        elif limit:
            level = f"{100 * triad.confidence_level:g} %"
            yield f"{key}: {limit:.9e}  # {unit}; none was found, this is the upper {level} limit{worst}"
        else:
            yield f"# {key}:  # {unit}; the model has none, and Kalibr demands a number > 0: fill it in"


def _densities(model: Model, rate: float, slow: float) -> tuple[float, float]:
    """Noise density and random walk of continuous time, in the unit of the model."""
    counted = [process._white_and_walk(rate, slow, **process.values) for process in model.processes]
    white, walk = sum(one.white for one in counted), sum(one.walk for one in counted)
    return units.angle_random_walk(white, rate), units.rate_random_walk(walk, rate)


def _yaml_number(value: float) -> str:
    """A number of YAML 1.1, where one with an exponent but without a point is text."""
    text = repr(value)
    return text if "." in text else f"{value:.16e}"
