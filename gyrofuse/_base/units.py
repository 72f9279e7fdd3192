"""Units, and conversion between parameters per sample and those of datasheets (IEEE Std 952 and 1293).

With `rate` in Hz and a unit `u` of rate or acceleration (such as deg/s): per-sample variances are in u^2, angle random
walk `N` (of an accelerometer: velocity random walk) in u/sqrt(Hz), rate random walk `K` in u/s/sqrt(Hz), quantisation
`Q` in u s, rate ramp `R` in u/s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

SECONDS_PER_HOUR = 3600.0
ARCSECONDS_PER_DEGREE = 3600.0
GRAVITY = 9.80665  # standard acceleration of gravity in m/s^2, by definition (CGPM 1901): a unit g
_PREFIX = {"": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9}  # SI prefixes

# Size of each unit of time in seconds, of rate in deg/s, of acceleration in m/s^2.
SECONDS_PER = {f"{prefix}s": size for prefix, size in _PREFIX.items()}
_DEG_PER_S = {
    "deg/s": _PREFIX[""],
    "mdeg/s": _PREFIX["m"],
    "deg/h": 1 / SECONDS_PER_HOUR,
    "rad/s": 180 / math.pi,
    "mrad/s": 180 / math.pi * _PREFIX["m"],
    "rpm": 6.0,
}
_M_PER_S2 = {"m/s^2": _PREFIX[""], **{f"{prefix}g": _PREFIX[prefix] * GRAVITY for prefix in ("", "m", "u")}}
_SIZES = {"rate": _DEG_PER_S, "acceleration": _M_PER_S2}
QUANTITIES = tuple(_SIZES)
RATE_UNITS, ACCELERATION_UNITS = tuple(_DEG_PER_S), tuple(_M_PER_S2)
DATASHEET_UNITS = (*RATE_UNITS, *ACCELERATION_UNITS)
KNOWN_UNITS = (*DATASHEET_UNITS, "counts")

# Spellings of a unit as `canonical_unit` looks them up: in small letters, without blanks and without signs of
# multiplication and powers, with `u` for a Greek mu and `s`, `h`, `deg` for `sec`, `hr`, `degree`.
_SPELLINGS = {
    "deg/s": "deg/s degs-1 degs degps dps",
    "mdeg/s": "mdeg/s mdegs-1 mdegs mdegps mdps",
    "deg/h": "deg/h degh-1 degh degph dph",
    "rad/s": "rad/s rads-1 rads radps",
    "mrad/s": "mrad/s mrads-1 mrads mradps",
    "rpm": "rpm rev/min r/min",
    "m/s^2": "m/s2 m/s/s ms-2 m/ss mps2",
    "g": "g g0 gn",
    "mg": "mg mg0",
    "ug": "ug ug0",
    "degC": "degc c celsius",
    "K": "k kelvin",
    "uT": "ut",
    "counts": "count counts lsb raw digit digits adc",
}
UNITS = tuple(_SPELLINGS)
_CANONICAL = {spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings.split()}
# Replacements that `canonical_unit` makes, in this order: a longer word before one that it contains.
_REPLACEMENTS = (
    *((sign, "u") for sign in "\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}"),
    *((sign, "deg") for sign in "\N{DEGREE SIGN}\N{MASCULINE ORDINAL INDICATOR}\N{RING ABOVE}"),
    *((sign, "") for sign in " \N{NO-BREAK SPACE}\N{MIDDLE DOT}\N{DOT OPERATOR}.*^_"),
    ("\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT ONE}", "-1"),
    ("\N{SUPERSCRIPT TWO}", "2"),
    ("degrees", "deg"),
    ("degree", "deg"),
    ("radians", "rad"),
    ("radian", "rad"),
    ("seconds", "s"),
    ("second", "s"),
    ("sec", "s"),
    ("hours", "h"),
    ("hour", "h"),
    ("hr", "h"),
    ("per", "/"),
)


def canonical_unit(text: str) -> str:
    """Return the project's spelling of a unit of rate, acceleration, temperature or magnetic field.

    `dps`, `°/sec` and `degrees per second` are `deg/s`, `deg/hr` is `deg/h`, `µg` with either mu is `ug`.

    Args:
        text: The unit in any spelling; an unknown unit is returned as it is, without blanks around it.
    """
    spelling = text.strip().lower()
    for sign, plain in _REPLACEMENTS:
        spelling = spelling.replace(sign, plain)
    return _CANONICAL.get(spelling, text.strip())


def known_unit(option: str, unit: str) -> str:
    """Return the project's spelling of a unit that signals may have, or raise `ValueError`.

    Args:
        option: Argument that gives it, for the message.
        unit: The unit in any spelling that `canonical_unit` knows.
    """
    name = canonical_unit(unit)
    if name not in KNOWN_UNITS:
        scale = "--scale" if option.startswith("-") else "`scale`"
        raise ValueError(
            f"`{option}`: expected one of {', '.join(KNOWN_UNITS)}, got {unit!r}; give one of them, and with {scale} "
            "the factor that brings the numbers of the log to it"
        )
    return name


def quantity_of(unit: str) -> str | None:
    """Return the quantity that a unit measures: `"rate"`, `"acceleration"`, or `None` for neither.

    Args:
        unit: The unit in any spelling that `canonical_unit` knows.
    """
    name = canonical_unit(unit)
    return next((quantity for quantity, sizes in _SIZES.items() if name in sizes), None)


def check_quantity(quantity: str) -> None:
    """Raise `ValueError` where `quantity` is neither `"rate"` nor `"acceleration"`."""
    if quantity not in QUANTITIES:
        raise ValueError(f"`quantity`: expected {' or '.join(map(repr, QUANTITIES))}, got {quantity!r}")


def unit_factor(unit: str, target: str) -> float:
    """Return the factor that converts numbers in `unit` to `target`.

    Args:
        unit: Unit of a rate or an acceleration, in any spelling that `canonical_unit` knows.
        target: Unit of the same quantity.

    Raises:
        ValueError: An unknown unit, or units of different quantities.
    """
    return _factor(_SIZES[quantity_of(target) or "rate"], unit, target)


def rate_unit_factor(unit: str, target: str = "deg/s") -> float:
    """Return the factor that converts rates in `unit` to `target`.

    Args:
        unit: Unit of a rate, in any spelling that `canonical_unit` knows.
        target: Unit of a rate.

    Raises:
        ValueError: An unknown unit.
    """
    return _factor(_DEG_PER_S, unit, target)


def acceleration_unit_factor(unit: str, target: str = "m/s^2") -> float:
    """Return the factor that converts accelerations in `unit` to `target`.

    Args:
        unit: Unit of an acceleration, in any spelling that `canonical_unit` knows.
        target: Unit of an acceleration.

    Raises:
        ValueError: An unknown unit.
    """
    return _factor(_M_PER_S2, unit, target)


def _factor(sizes: Mapping[str, float], unit: str, target: str) -> float:
    """Ratio of the size of `unit` to the size of `target`."""
    names = [canonical_unit(unit), canonical_unit(target)]
    for argument, name, given in zip(("unit", "target"), names, (unit, target), strict=True):
        if name not in sizes:
            raise ValueError(
                f"`{argument}`: expected one of {', '.join(sizes)}, got {given!r}; multiply the signal by the factor "
                "to one of them, or state the unit where none is"
            )
    return sizes[names[0]] / sizes[names[1]]


def angle_random_walk(variance: float, rate: float) -> float:
    """Noise density `N = sqrt(s2 / fs)` of white noise, u/sqrt(Hz)."""
    return math.sqrt(variance / rate)


def white_noise_variance(angle_random_walk: float, rate: float) -> float:
    """Per-sample variance `s2 = N^2 fs` of white noise."""
    return angle_random_walk**2 * rate


def per_sqrt_hour(density: float) -> float:
    """Angle random walk in deg/sqrt(h) from one in deg/s/sqrt(Hz): `60 N`."""
    return density * math.sqrt(SECONDS_PER_HOUR)


def per_sqrt_hz(random_walk: float) -> float:
    """Angle random walk in deg/s/sqrt(Hz) from one in deg/sqrt(h): `N / 60`."""
    return random_walk / math.sqrt(SECONDS_PER_HOUR)


def rate_random_walk(variance: float, rate: float) -> float:
    """`K = sqrt(g2 fs)` of a random walk with increments of variance `g2`, u/s/sqrt(Hz)."""
    return math.sqrt(variance * rate)


def random_walk_variance(rate_random_walk: float, rate: float) -> float:
    """Increment variance `g2 = K^2 / fs` of a random walk."""
    return rate_random_walk**2 / rate


def bias_instability(allan_deviation_floor: float) -> float:
    """`B = floor / sqrt(2 ln 2 / pi)`, the floor over 0.664, in the floor's unit."""
    return allan_deviation_floor / math.sqrt(2 * math.log(2) / math.pi)


def correlation_time(phi: float, rate: float) -> float:
    """Correlation time `-1 / (fs ln phi)` in seconds of a first-order Gauss-Markov process.

    Raises:
        ValueError: `phi` is not strictly between 0 and 1.
    """
    if not 0 < phi < 1:
        raise ValueError(f"`phi`: expected a number strictly between 0 and 1, got {phi!r}")
    return -1 / (rate * math.log(phi))


def gauss_markov_phi(correlation_time: float, rate: float) -> float:
    """`phi = exp(-1 / (fs tau_c))` of a first-order Gauss-Markov process, `correlation_time` in seconds."""
    return math.exp(-1 / (rate * correlation_time))


def quantization(variance: float, rate: float) -> float:
    """`Q = sqrt(q2) / fs` of quantisation noise, u s."""
    return math.sqrt(variance) / rate


def quantization_variance(quantization: float, rate: float) -> float:
    """`q2 = (Q fs)^2` of quantisation noise."""
    return (quantization * rate) ** 2


def tone_frequency(beta: float, rate: float) -> float:
    """Frequency `beta fs / (2 pi)` in Hz of a sinusoid of `beta` rad per sample."""
    return beta * rate / (2 * math.pi)


def tone_beta(frequency: float, rate: float) -> float:
    """Angular frequency `2 pi f / fs` in rad per sample of a tone of `frequency` Hz."""
    return 2 * math.pi * frequency / rate


def rate_ramp(slope: float, rate: float) -> float:
    """`R = w fs` of a drift of `slope` per sample, u/s."""
    return slope * rate


def drift_slope(rate_ramp: float, rate: float) -> float:
    """Slope `w = R / fs` per sample of a rate ramp."""
    return rate_ramp / rate
