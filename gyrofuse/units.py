"""Datasheet units: from parameters per sample to those of IEEE Std 952, and back.

With `rate` in Hz and a rate unit `u` (such as deg/s): per-sample variances are in u^2, angle random walk `N`
in u/sqrt(Hz), rate random walk `K` in u/s/sqrt(Hz), quantisation `Q` in u s, rate ramp `R` in u/s.
"""

from __future__ import annotations

import math

SECONDS_PER_HOUR = 3600.0
ARCSECONDS_PER_DEGREE = 3600.0
GRAVITY = 9.80665  # m/s^2, standard

_DEG_PER_S = {"deg/s": 1.0, "mdeg/s": 1e-3, "deg/h": 1 / SECONDS_PER_HOUR, "rad/s": 180 / math.pi}
RATE_UNITS = tuple(_DEG_PER_S)
# Of what else sensors give; no datasheet speaks in them.
OTHER_UNITS = ("m/s^2", "g", "counts")


def rate_unit_factor(unit: str, target: str = "deg/s") -> float:
    """Factor that takes a rate in `unit` to `target`; both among deg/s, mdeg/s, deg/h and rad/s.

    Raises:
        ValueError: An unknown unit.
    """
    for name, value in (("unit", unit), ("target", target)):
        if value not in _DEG_PER_S:
            raise ValueError(
                f"`{name}`: expected one of {', '.join(RATE_UNITS)}, got {value!r}; multiply the signal by the factor "
                "to one of them, or state the unit where none is"
            )
    return _DEG_PER_S[unit] / _DEG_PER_S[target]


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
