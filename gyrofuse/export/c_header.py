"""A C header with the matrices of a Kalman filter for the noise of a gyro."""

from __future__ import annotations

import re

from torch import Tensor

from gyrofuse._base import units
from gyrofuse.noise.model import check_scalar
from gyrofuse.noise.processes import (
    Model,
)
from gyrofuse.noise.state_space import state_space

_C_KEYWORDS = set(
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while".split()
)


def to_c_header(model: Model, rate: float, unit: str, name: str = "imu_noise") -> str:
    """Write the state space of a model as a C99 header of constants.

    It defines `NAME_N_STATES`, `NAME_RATE_HZ` and the arrays `name_F`, `name_Q`, `name_H`, `name_R`, `name_x0` and
    `name_P0` with the matrices of `StateSpace`, to the last digit; of white noise alone `name_R` only, as it has no
    states.

    Args:
        model: Noise model with scalar parameters.
        rate: Sampling rate, Hz.
        unit: Unit of the model, of rate or acceleration, which the numbers keep.
        name: Prefix of everything defined, a C identifier.

    Raises:
        ValueError: A parameter is to be estimated or batched, an unknown unit, or `name` is not an identifier.
    """
    units.unit_factor(unit, unit)
    unit = units.canonical_unit(unit)
    sensor = "an accelerometer" if units.quantity_of(unit) == "acceleration" else "a rate sensor"
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII) or name in _C_KEYWORDS:
        raise ValueError(f"`name`: expected a C identifier that starts with a letter, got {name!r}")
    check_scalar("model", model)
    system = state_space(model, rate)
    capital = name.upper()
    guard = f"{capital}_H_INCLUDED"
    lines = [
        f"/* Noise of {sensor} in {unit}, one step per sample at {system.rate:g} Hz:",
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
