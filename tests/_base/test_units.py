"""Datasheet units against hand-worked examples."""

from __future__ import annotations

import math

import pytest

from gyrofuse._base import units


def test_rate_units():
    assert units.rate_unit_factor("rad/s") == pytest.approx(57.29577951308232)
    assert units.rate_unit_factor("deg/s", "rad/s") == pytest.approx(math.pi / 180)
    assert units.rate_unit_factor("deg/s", "deg/h") == pytest.approx(3600)
    assert units.rate_unit_factor("mdeg/s", "deg/h") == pytest.approx(3.6)
    assert units.rate_unit_factor("rpm") == 6  # 360 deg in a minute
    assert units.rate_unit_factor("mrad/s", "rad/s") == pytest.approx(1e-3)
    for unit in units.RATE_UNITS:
        assert units.rate_unit_factor(unit, unit) == 1


def test_acceleration_units():
    assert units.acceleration_unit_factor("g") == 9.80665
    assert units.acceleration_unit_factor("mg", "ug") == pytest.approx(1000)
    with pytest.raises(ValueError, match=r"`unit`: expected one of m/s\^2, g, mg, ug, got 'deg/s'"):
        units.acceleration_unit_factor("deg/s")


@pytest.mark.parametrize(
    ("unit", "spellings"),
    [
        ("deg/s", "dps|deg/sec|°/s|º/s|deg s^-1|degrees per second|Deg/Sec|deg·s⁻¹"),
        ("mdeg/s", "mdps|mdeg/sec|m°/s"),
        ("deg/h", "deg/hr|°/h|º/hr|dph|degrees/hour|deg h^-1"),
        ("rad/s", "rad/sec|radps|rad s^-1|rad·s⁻¹|rad.s-1|radians per second"),
        ("mrad/s", "mrad/sec|mrad s^-1"),
        ("rpm", "RPM|rev/min"),
        ("m/s^2", "m/s/s|m s^-2|m.s-2|m/s²|mps2|m/sec^2"),
        ("g", "G|g0"),
        ("mg", "mg"),
        ("ug", "ug|\N{MICRO SIGN}g|\N{GREEK SMALL LETTER MU}g"),
        ("degC", "°C|C|Celsius"),
        ("uT", "\N{MICRO SIGN}T|\N{GREEK SMALL LETTER MU}T"),
        ("counts", "LSB|raw|digits"),
        ("furlong", "furlong| furlong "),
    ],
)
def test_spellings(unit, spellings):
    assert {units.canonical_unit(spelling) for spelling in spellings.split("|")} == {unit}
    if unit in units.RATE_UNITS:
        assert {units.rate_unit_factor(spelling, unit) for spelling in spellings.split("|")} == {1.0}


@pytest.mark.parametrize(("arguments", "name"), [(("furlong",), "unit"), (("deg/s", "Hz"), "target")])
def test_unknown_units_are_named(arguments, name):
    with pytest.raises(ValueError, match=f"`{name}`: expected one of deg/s, mdeg/s, deg/h, rad/s, mrad/s, rpm, got"):
        units.rate_unit_factor(*arguments)


def test_a_consumer_gyro_by_hand():
    # 0.005 deg/s/sqrt(Hz) sampled at 100 Hz: 0.05 deg/s rms; 0.3 deg/sqrt(h)
    assert units.white_noise_variance(0.005, 100.0) == pytest.approx(0.05**2)
    assert units.angle_random_walk(0.05**2, 100.0) == pytest.approx(0.005)
    assert units.per_sqrt_hour(0.005) == pytest.approx(0.3)
    # 1e-4 deg/s/sqrt(s): after 100 s the rate has wandered 1e-3 deg/s, in 10^4 steps of 1e-5
    assert units.random_walk_variance(1e-4, 100.0) == pytest.approx(1e-5**2)
    assert units.rate_random_walk(1e-5**2, 100.0) == pytest.approx(1e-4)
    # a correlation of 1/e after 50 s
    assert units.correlation_time(math.exp(-1 / 5000), 100.0) == pytest.approx(50.0)
    assert units.gauss_markov_phi(50.0, 100.0) ** 5000 == pytest.approx(1 / math.e)
    # an angle rounded with rms 1e-3 deg, differenced over 10 ms
    assert units.quantization(0.1**2, 100.0) == pytest.approx(1e-3)
    assert units.quantization_variance(1e-3, 100.0) == pytest.approx(0.1**2)
    assert units.tone_frequency(math.pi, 100.0) == pytest.approx(50.0)
    assert units.tone_beta(25.0, 100.0) == pytest.approx(math.pi / 2)
    assert units.rate_ramp(1e-6, 100.0) == pytest.approx(1e-4)
    assert units.drift_slope(1e-4, 100.0) == pytest.approx(1e-6)
    assert units.bias_instability(0.664) == pytest.approx(1.0, abs=1e-3)
    assert units.per_sqrt_hz(units.per_sqrt_hour(0.7)) == pytest.approx(0.7)


@pytest.mark.parametrize("phi", [-0.5, 0.0, 1.0])
def test_no_correlation_time_outside_zero_and_one(phi):
    with pytest.raises(ValueError, match="`phi`: expected a number strictly between 0 and 1"):
        units.correlation_time(phi, 100.0)
