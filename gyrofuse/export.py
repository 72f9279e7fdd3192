"""Files for the next tool: Kalibr's `imu.yaml`, and a C header with a Kalman filter's matrices."""

from __future__ import annotations

import re
from collections.abc import Iterator

from torch import Tensor

from gyrofuse import units
from gyrofuse._checks import check_positive
from gyrofuse.processes import (
    AR1,
    Drift,
    Model,
    QuantizationNoise,
    RandomWalk,
    Sinusoid,
    WhiteNoise,
)
from gyrofuse.state_space import state_space

_C_KEYWORDS = set(
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while".split()
)


def to_kalibr(
    model: Model,
    rate: float,
    unit: str,
    *,
    topic: str = "/imu0",
    accelerometer: Model | None = None,
    slow: float = 1.0,
) -> str:
    """Write Kalibr's `imu.yaml`, which knows white noise and a random walk only.

    White noise gives `gyroscope_noise_density` and a random walk `gyroscope_random_walk`, in rad/s/sqrt(Hz) and
    rad/s^2/sqrt(Hz), both of continuous time. An AR(1) looks like a random walk over times shorter than its
    correlation time and like white noise over longer ones: a slow one adds its innovations to the random walk, a fast
    one its spectral density at frequency 0, `variance / (1 - phi)^2`, to the white noise. For `phi >= 0` this errs on
    the side of more noise: the white noise has at least the wavelet variance of the AR(1) at every level, the random
    walk too but for a share of `1 - phi`. Variances of several processes add up. Quantisation noise, tones and drifts
    are left out. Comments in the file say of each process what became of it.

    Args:
        model: Of a gyro, with scalar parameters; Kalibr takes one for all three axes.
        rate: Sampling rate, Hz.
        unit: Rate unit of the model: deg/s, mdeg/s, deg/h, rad/s, mrad/s or rpm, or another spelling of one.
        topic: ROS topic of the IMU's messages.
        accelerometer: Model in m/s^2 at the same rate; without it its two keys are left to be filled in.
        slow: Correlation time from which on an AR(1) counts as a random walk, s.

    Returns:
        Text of the file. Kalibr rejects a density of 0, which is what a model without it gets: fill it in then.

    Raises:
        ValueError: A parameter is to be estimated or batched, an unknown unit, or not an absolute topic name.

    References:
        Kalibr, https://github.com/ethz-asl/kalibr/wiki/yaml-formats and IMU-Noise-Model.
    """
    rate, slow = check_positive("rate", rate), check_positive("slow", slow)
    radians = units.rate_unit_factor(unit, "rad/s")
    unit = units.canonical_unit(unit)
    if not isinstance(topic, str) or not re.fullmatch(r"(/[A-Za-z]\w*)+", topic, re.ASCII):
        raise ValueError(f"`topic`: expected an absolute ROS topic name such as '/imu0', got {topic!r}")
    lines = [
        "# IMU noise for Kalibr. Densities are of continuous time, two-sided.",
        f"# An AR1 with a correlation time of {slow:g} s or more counts as a random walk, any other as white noise.",
        f"rostopic: {topic}",
        f"update_rate: {_yaml_number(rate)}  # Hz",
        "",
        f"# Gyroscope, from a model in {unit} per sample:",
        *_kalibr_keys("model", model, "gyroscope", rate, slow, radians, ("rad/s/sqrt(Hz)", "rad/s^2/sqrt(Hz)")),
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
        lines.append("# Accelerometer, from a model in m/s^2 per sample:")
        lines += _kalibr_keys("accelerometer", accelerometer, "accelerometer", rate, slow, 1.0, accelerations)
    return "\n".join(lines) + "\n"


def _kalibr_keys(
    name: str, model: Model, sensor: str, rate: float, slow: float, factor: float, key_units: tuple[str, str]
) -> Iterator[str]:
    """What became of each process, as comments, and the two keys of a sensor."""
    _check_scalar(name, model)
    white = walk = 0.0  # variances per sample, of the samples and of the increments
    for process in model.processes:
        first, *more = process.params.tolist()
        if isinstance(process, WhiteNoise):
            white += first
            fate = "in the noise density"
        elif isinstance(process, RandomWalk):
            walk += first
            fate = "in the random walk"
        elif isinstance(process, AR1):
            time = units.correlation_time(first, rate) if first > 0 else None
            fate = "no correlation time" if time is None else f"correlation time {time:.4g} s"
            if time is not None and time >= slow:
                walk += more[0]
                fate += ", its innovations in the random walk"
            else:
                white += more[0] / (1 - first) ** 2
                fate += ", its density at frequency 0 in the noise density"
        elif isinstance(process, QuantizationNoise):
            fate = "left out; it has no density at frequency 0"
        elif isinstance(process, Sinusoid):
            fate = f"left out; a tone of {units.tone_frequency(more[0], rate):.6g} Hz"
        elif isinstance(process, Drift):
            fate = "left out; a ramp is not noise"
        else:
            fate = "left out; Kalibr has no such noise"
        yield f"#   {process!r}: {fate}"
    densities = (units.angle_random_walk(white, rate) * factor, units.rate_random_walk(walk, rate) * factor)
    for key, density, unit in zip(("noise_density", "random_walk"), densities, key_units, strict=True):
        remark = "" if density else "; the model has none, and Kalibr demands a number > 0: fill it in"
        yield f"{sensor}_{key}: {density:.9e}  # {unit}{remark}"


def _yaml_number(value: float) -> str:
    """A number of YAML 1.1, where one with an exponent but without a point is text."""
    text = repr(value)
    return text if "." in text else f"{value:.16e}"


def to_c_header(model: Model, rate: float, unit: str, name: str = "imu_noise") -> str:
    """Write the state space of a model as a C99 header of constants.

    It defines `NAME_N_STATES`, `NAME_RATE_HZ` and the arrays `name_F`, `name_Q`, `name_H`, `name_R`, `name_x0` and
    `name_P0` with the matrices of `StateSpace`, to the last digit; of white noise alone `name_R` only, as it has no
    states.

    Args:
        model: With scalar parameters.
        rate: Sampling rate, Hz.
        unit: Rate unit of the model, which the numbers keep: deg/s, mdeg/s, deg/h, rad/s, mrad/s or rpm.
        name: Prefix of everything defined, a C identifier.

    Raises:
        ValueError: A parameter is to be estimated or batched, an unknown unit, or `name` is not an identifier.
    """
    units.rate_unit_factor(unit)
    unit = units.canonical_unit(unit)
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII) or name in _C_KEYWORDS:
        raise ValueError(f"`name`: expected a C identifier that starts with a letter, got {name!r}")
    _check_scalar("model", model)
    system = state_space(model, rate)
    capital = name.upper()
    guard = f"{capital}_H_INCLUDED"
    lines = [
        f"/* Noise of a rate sensor in {unit}, one step per sample at {system.rate:g} Hz:",
        *(f"   {process!r}" for process in model.processes),
        "",
        "   x_k = F x_(k-1) + w_k,  w_k ~ N(0, Q)",
        "   y_k = H x_k + v_k,      v_k ~ N(0, R),  k = 1, 2, ..",
        "   x_0 ~ N(x0, P0), one step before the first sample",
        "",
        *(f"   state {i}: {state}, {_state_unit(state, unit)}" for i, state in enumerate(system.states)),
        "*/",
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
        f"#define {capital}_N_STATES {len(system.states)}",
        f"#define {capital}_RATE_HZ {system.rate!r}",
        "",
    ]
    matrices = {
        "F": (system.F, "transition over one sample"),
        "Q": (system.Q, f"covariance of w, ({unit})^2"),
        "H": (system.H, "what the signal sees of the state"),
        "R": (system.R, f"variance of v, ({unit})^2"),
        "x0": (system.x0, "mean of x_0, in the units of the states"),
        "P0": (system.P0, f"covariance of x_0, ({unit})^2"),
    }
    for key, (matrix, meaning) in matrices.items():
        if matrix.numel():
            size = "".join(f"[{n}]" for n in matrix.shape)
            lines += [f"/* {meaning} */", f"static const double {name}_{key}{size} = {_braces(matrix)};", ""]
    return "\n".join([*lines, f"#endif /* {guard} */"]) + "\n"


def _state_unit(state: str, unit: str) -> str:
    return f"{unit} per sample" if state.endswith(".slope") else unit


def _braces(values: Tensor) -> str:
    """Initialiser of an array; numbers read back the same."""
    if values.ndim == 1:
        return "{" + ", ".join(map(repr, values.tolist())) + "}"
    return "{\n    " + ",\n    ".join(_braces(row) for row in values) + "\n}"


def _check_scalar(name: str, model: Model) -> None:
    """Raise when it is no model, or one of a batch."""
    if not isinstance(model, Model):
        raise TypeError(
            f"`{name}`: expected a model, got {type(model).__name__} {model!r}; a formula has no values: fit it"
        )
    if model.params.ndim > 1:
        raise ValueError(
            f"`{name}`: expected scalar parameters, got a batch of shape {tuple(model.params.shape[:-1])}; "
            "pick one item with model.with_params(model.params[i])"
        )
