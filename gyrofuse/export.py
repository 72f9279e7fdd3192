"""Handing a noise model to the next tool: Kalibr's `imu.yaml`, a state space for a Kalman filter, a C header."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse import units
from gyrofuse._checks import check_floating, check_positive
from gyrofuse.processes import (
    AR1,
    Drift,
    Model,
    Process,
    QuantizationNoise,
    RandomWalk,
    Sinusoid,
    WhiteNoise,
)

_LARGEST_BLOCK = 256  # samples that one step of the likelihood takes together
_C_KEYWORDS = set(
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while".split()
)


@dataclass(frozen=True, eq=False)
class StateSpace:
    """A noise model as a linear system with independent noises, one step per sample.

        x_k = F x_{k-1} + w_k,  w_k ~ N(0, Q)
        y_k = H x_k + v_k,      v_k ~ N(0, R),  k = 1..T

    `x_0`, one step before the first sample, has mean `x0` and covariance `P0`: that of the stationary law where there
    is one, 0 for a random walk, which starts from 0 as in `Model.simulate`; to let a filter find an unknown turn-on
    bias, enlarge it. First and second moments of `y` are those of the model. A tone of random phase is not Gaussian:
    here it has a random amplitude too, with the same autocovariance.

    Attributes:
        F: `(..., state, state)`.
        Q: `(..., state, state)`, signal^2 (per sample^2 for the slope of a drift).
        H: `(..., 1, state)`.
        R: `(..., 1, 1)`, signal^2.
        x0: `(..., state)`; other than 0 for a drift only.
        P0: `(..., state, state)`.
        states: Names of the states, such as `ar1_1` and `sinusoid_1.sine`.
        rate: Steps per second, Hz.
    """

    F: Tensor
    Q: Tensor
    H: Tensor
    R: Tensor
    x0: Tensor
    P0: Tensor
    states: tuple[str, ...]
    rate: float

    def kalman_log_likelihood(self, signal: Tensor) -> Tensor:
        """Exact Gaussian log-likelihood of recordings, in nats, differentiable in the model and the signal.

        The Kalman filter takes many samples in one step: they are one observation of the state before them, whose
        noise has the same covariance in each step and is whitened once. This is exact whether or not the filter has a
        steady state, which tones keep it from.

        Args:
            signal: `(..., time)`, without missing samples; its leading dimensions broadcast with the model's.

        Returns:
            `(...)`, float64; NaN for a model with NaN parameters.

        Raises:
            TypeError: `signal` is not a floating point tensor.
            ValueError: `signal` is empty or has missing samples, or the model has no noise that would give it a
                density, as a tone alone.

        References:
            Anderson and Moore, Optimal Filtering, chapter 5.
        """
        check_floating("signal", signal)
        if signal.ndim == 0 or signal.shape[-1] == 0:
            raise ValueError(f"`signal`: expected (..., time) with samples, got shape {tuple(signal.shape)}")
        if not bool(signal.isfinite().all()):
            raise ValueError(
                "`signal`: expected finite samples, got some that are missing or infinite; fill or cut them out first"
            )
        n_samples = signal.shape[-1]
        # as many samples in a step as steps, while a step's covariance is cheap to factor
        length = min(math.isqrt(n_samples - 1) + 1, _LARGEST_BLOCK)
        block = self._block(length)
        y = pad(signal.double(), (0, -n_samples % length)).unflatten(-1, (-1, length))  # (..., block, time)
        # What comes after the end does not reach back: whitening is causal.
        whitened = torch.linalg.solve_triangular(block.root.mT, y, upper=True, left=False)
        log_root = block.root.diagonal(dim1=-2, dim2=-1).log()
        mean, covariance = self.x0[..., None], self.P0  # (..., state, 1), (..., state, state)
        eye = torch.eye(len(self.states), dtype=torch.float64, device=self.F.device)
        misfits, determinants = [], []
        for start, z in zip(range(0, n_samples, length), whitened.unbind(-2), strict=True):
            rows = min(length, n_samples - start)
            observe = block.observe[..., :rows, :]
            innovation = z[..., :rows, None] - observe @ mean
            # Their covariance is I + O P O'; by the matrix inversion lemma only the state's dimension is inverted.
            told = observe.mT @ innovation
            ratio = eye + covariance @ (observe.mT @ observe)
            after = torch.linalg.solve(ratio, covariance)  # of x_0, given the block
            learnt = after @ told
            misfits.append((innovation.square().sum(-2) - (told * learnt).sum(-2))[..., 0])
            determinants.append(ratio)
            if rows == length:
                mean = block.advance @ mean + block.decorrelated @ learnt + block.shared @ innovation
                covariance = block.decorrelated @ after @ block.decorrelated.mT + block.rest
                covariance = (covariance + covariance.mT) / 2
        misfit = torch.stack(misfits, -1).sum(-1)
        spread = torch.logdet(torch.stack(determinants, -3)).sum(-1)
        for rows in {length, n_samples % length} - {0}:
            times = n_samples // length if rows == length else 1
            spread = spread + 2 * times * log_root[..., :rows].sum(-1)
        return -(misfit + spread + n_samples * math.log(2 * math.pi)) / 2

    def _block(self, length: int) -> _Block:
        """`length` samples as one observation of the state before them."""
        F, Q, H, R = self.F, self.Q, self.H, self.R
        eye = torch.eye(len(self.states), dtype=F.dtype, device=F.device).expand_as(F)
        # F^i and the covariance of x_i given x_0, i = 1..length, twice as many at a time
        power, spread = F[..., None, :, :], Q[..., None, :, :]
        while power.shape[-3] < length:
            spread = torch.cat([spread, spread + power @ spread[..., -1:, :, :] @ power.mT], -3)
            power = torch.cat([power, power @ power[..., -1:, :, :]], -3)
        power, spread = power[..., :length, :, :], spread[..., :length, :, :]
        before = torch.cat([eye[..., None, :, :], power[..., :-1, :, :]], -3)  # F^0 .. F^(length-1)
        output = H[..., None, :, :]
        seen, seen_before = (output @ power)[..., 0, :], (output @ before)[..., 0, :]  # H F^i: (..., length, state)
        reached = spread @ output.mT  # Cov(x_i, y_i): (..., length, state, 1)
        # Cov(y_i, y_k) = H F^(k-i) Cov(x_i, y_i), k >= i. Row i of the product over i and lag moves right by i: in rows
        # that are one shorter, what follows begins one later in each.
        by_lag = pad(reached[..., 0] @ seen_before.mT, (0, length))  # (..., i, lag)
        moved = by_lag.flatten(-2)[..., : length * (2 * length - 1)].unflatten(-1, (length, 2 * length - 1))
        upper = moved[..., :length]
        noise = upper + upper.triu(1).mT + R * torch.eye(length, dtype=R.dtype, device=R.device)
        unknown = ~noise.isfinite().all(-1).all(-1)[..., None, None]
        root, failed = torch.linalg.cholesky_ex(torch.where(unknown, torch.eye(length).to(noise), noise))
        if bool(failed.any()):
            items = [tuple(item) for item in failed.nonzero().tolist()]
            where = f" at batch item(s) {', '.join(map(str, items[:5]))} ({len(items)} of {failed.numel()})"
            raise ValueError(
                "`model`: expected noise in every sample, got a model that leaves some without"
                f"{where if failed.ndim else ''}; add WhiteNoise with a variance > 0"
            )
        root = torch.where(unknown, torch.nan, root)
        observe = torch.linalg.solve_triangular(root, seen, upper=False)
        # Cov(x_length, y_i) = F^(length-i) Cov(x_i, y_i)
        shared = (before.flip(-3) @ reached)[..., 0].mT
        shared = torch.linalg.solve_triangular(root.mT, shared, upper=True, left=False)
        advance = power[..., -1, :, :]
        rest = spread[..., -1, :, :] - shared @ shared.mT
        return _Block(root, observe, advance, shared, advance - shared @ observe, rest)


class _Block(NamedTuple):
    """Whitened samples `z = O x_0 + e` of one step and the state after them, `x = A x_0 + C z + r`.

    Attributes:
        root: Cholesky factor of the samples' covariance given the state, `(..., time, time)`.
        observe: `O`, `(..., time, state)`.
        advance: `A + C O`, the transition over the step, `(..., state, state)`.
        shared: `C`, covariance of the state's noise and `e`, `(..., state, time)`.
        decorrelated: `A`, `(..., state, state)`.
        rest: Covariance of `r`, `(..., state, state)`.
    """

    root: Tensor
    observe: Tensor
    advance: Tensor
    shared: Tensor
    decorrelated: Tensor
    rest: Tensor


def state_space(model: Model, rate: float) -> StateSpace:
    """Write a model as a linear system with one step per sample.

    A random walk and an AR(1) take one state, quantisation noise, a tone and a drift two, white noise none. The
    parameters are those of samples, so that nothing is discretised and nothing approximated.

    Args:
        model: Parameters may have batch dimensions `(...)`; the matrices keep them and are differentiable.
        rate: Sampling rate, Hz.

    Raises:
        ValueError: A parameter is to be estimated.
    """
    rate = check_positive("rate", rate)
    params = model.params  # of the whole model, for a message with full names
    batch = params.shape[:-1]
    parts = [_part(process) for process in model.processes]
    sizes = [0 if part is None else part.F.shape[-1] for part in parts]
    n_states = sum(sizes)
    F, Q, P0 = (params.new_zeros(*batch, n_states, n_states) for _ in range(3))
    H, x0 = params.new_zeros(*batch, 1, n_states), params.new_zeros(*batch, n_states)
    R = params.new_zeros(*batch, 1, 1)
    names: list[str] = []
    seen: dict[str, int] = {}
    for process, part in zip(model.processes, parts, strict=True):
        seen[process.key] = seen.get(process.key, 0) + 1
        if part is None:
            R = R + process.params[..., None]
            continue
        own = slice(len(names), len(names) + part.F.shape[-1])
        F[..., own, own], Q[..., own, own], P0[..., own, own] = part.F, part.Q, part.P0
        H[..., 0, own.start] = 1.0
        x0[..., own] = part.x0
        name = f"{process.key}_{seen[process.key]}" if process.repeatable else process.key
        names += [f"{name}.{component}" if component else name for component in part.components]
    return StateSpace(F, Q, H, R, x0, P0, tuple(names), rate)


class _Part(NamedTuple):
    """States of one process, whose first one is what it adds to the signal."""

    components: tuple[str, ...]
    F: Tensor
    Q: Tensor
    x0: Tensor
    P0: Tensor


def _part(process: Process) -> _Part | None:
    """States of a process; white noise has none."""
    first, *more = process.params.unbind(-1)
    zero, one = torch.zeros_like(first), torch.ones_like(first)
    if isinstance(process, WhiteNoise):
        return None
    if isinstance(process, AR1):
        (variance,) = more
        stationary = variance / ((1 - first) * (1 + first))
        return _Part(("",), _matrix([[first]]), _matrix([[variance]]), zero[..., None], _matrix([[stationary]]))
    if isinstance(process, RandomWalk):
        return _Part(("",), _matrix([[one]]), _matrix([[first]]), zero[..., None], _matrix([[zero]]))
    none = _matrix([[zero, zero], [zero, zero]])
    at_rest = none[..., 0]
    if isinstance(process, QuantizationNoise):
        # e_k - e_{k-1} and -e_k: the second is what the next sample takes back
        F = _matrix([[zero, one], [zero, zero]])
        Q = _matrix([[first, -first], [-first, first]])
        return _Part(("", "carried"), F, Q, at_rest, _matrix([[2 * first, -first], [-first, first]]))
    if isinstance(process, Drift):
        F = _matrix([[one, one], [zero, one]])
        return _Part(("", "slope"), F, none, torch.stack([zero, first], -1), none)
    if isinstance(process, Sinusoid):
        cos, sin = more[0].cos(), more[0].sin()
        power = first**2 / 2
        F = _matrix([[cos, sin], [-sin, cos]])
        return _Part(("sine", "cosine"), F, none, at_rest, _matrix([[power, zero], [zero, power]]))
    raise TypeError(f"`model`: {type(process).__name__} has no state space of finite dimension; leave it out")


def _matrix(rows: list[list[Tensor]]) -> Tensor:
    """Matrix `(..., row, column)` of elements `(...)`."""
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


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
        unit: Rate unit of the model: deg/s, mdeg/s, deg/h or rad/s.
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
        unit: Rate unit of the model, which the numbers keep: deg/s, mdeg/s, deg/h or rad/s.
        name: Prefix of everything defined, a C identifier.

    Raises:
        ValueError: A parameter is to be estimated or batched, an unknown unit, or `name` is not an identifier.
    """
    units.rate_unit_factor(unit)
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
    """Raise when the model is one of a batch."""
    if model.params.ndim > 1:
        raise ValueError(
            f"`{name}`: expected scalar parameters, got a batch of shape {tuple(model.params.shape[:-1])}; "
            "pick one item with model.with_params(model.params[i])"
        )
