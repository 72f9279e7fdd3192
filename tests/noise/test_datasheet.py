"""Datasheets of models against hand-worked numbers."""

from __future__ import annotations

import json
import math

import pytest
import torch

from gyrofuse.noise.datasheet import datasheet
from gyrofuse.noise.processes import (
    AR1,
    Drift,
    FlickerNoise,
    Matern32,
    QuantizationNoise,
    RandomWalk,
    Sinusoid,
    WhiteNoise,
)


def values(sheet) -> dict[tuple[str, str], float]:
    return {(entry.name, entry.unit): entry.value for entry in sheet.entries}


def test_every_process_by_hand():
    model = (
        WhiteNoise(0.05**2)
        + QuantizationNoise(0.1**2)
        + RandomWalk(1e-5**2)
        + Drift(1e-6)
        + AR1(math.exp(-1 / 5000), 1e-8)
        + Sinusoid(0.02, math.pi / 2)
    )
    got = values(datasheet(model, 100.0, "deg/s"))
    assert got["angle random walk N", "deg/sqrt(h)"] == pytest.approx(0.3)
    assert got["angle random walk N", "deg/s/sqrt(Hz)"] == pytest.approx(0.005)
    assert got["quantization Q", "arcsec"] == pytest.approx(3.6)
    assert got["rate random walk K", "deg/h/sqrt(h)"] == pytest.approx(1e-4 * 3600 * 60)
    assert got["rate random walk K", "deg/s/s/sqrt(Hz)"] == pytest.approx(1e-4)
    assert got["rate ramp R", "deg/h/h"] == pytest.approx(1e-4 * 3600**2)
    assert got["Gauss-Markov correlation time", "s"] == pytest.approx(50.0)
    deviation = 1e-4 / math.sqrt(1 - math.exp(-1 / 2500))
    assert got["Gauss-Markov deviation", "deg/h"] == pytest.approx(3600 * deviation)
    assert got["tone frequency", "Hz"] == pytest.approx(25.0)
    assert got["tone amplitude", "deg/s"] == 0.02


def test_bias_instability_is_the_floor_of_the_allan_deviation():
    # white s2 = 1 and increments g2 = 3 * 4**-10: the Allan variance s2/m + g2 m/3 is least at m = 2**10
    got = values(datasheet(WhiteNoise(1.0) + RandomWalk(3 * 4.0**-10), 10.0, "deg/s"))
    assert got["bias instability B", "deg/h"] == pytest.approx(3600 * math.sqrt(2 * 2**-10) / 0.66428, rel=1e-5)
    assert got["bias instability reached at", "s"] == pytest.approx(102.4)


def test_flicker_noise_is_the_bias_instability():
    got = values(datasheet(WhiteNoise(1.0) + FlickerNoise(0.01**2) + RandomWalk(1e-12), 10.0, "deg/s"))
    assert got["bias instability B", "deg/h"] == pytest.approx(36.0)
    assert ("bias instability reached at", "s") not in got
    floor = (2 * FlickerNoise(0.01**2).wavelet_variance(30)[-1]).sqrt().item()
    assert floor == pytest.approx(0.01 * math.sqrt(2 * math.log(2) / math.pi))


def test_second_order_process_by_hand():
    got = values(datasheet(WhiteNoise(1.0) + Matern32(math.exp(-1 / 5000), 1e-4), 100.0, "deg/s"))
    assert got["2nd-order Gauss-Markov time", "s"] == pytest.approx(50.0)
    assert got["2nd-order Gauss-Markov sigma", "deg/h"] == pytest.approx(36.0)
    quick = datasheet(Matern32(math.exp(-1 / 50), 1e-4), 100.0, "deg/s")
    density = 2 / 50 * 1e-4 * 50**2 * 2 / 100  # 4 s2 time constant, in samples, over the rate
    assert values(quick)["angle random walk N of GM2s", "deg/s/sqrt(Hz)"] == pytest.approx(density**0.5, rel=1e-3)


def test_a_dip_that_is_undercut_later_is_no_floor():
    quick = WhiteNoise(1.0) + AR1(0.9, 1.0)  # dips before the AR1, falls below that after it
    deviation = (2 * quick.wavelet_variance(20)).sqrt()
    assert ((deviation[1:-1] < deviation[:-2]) & (deviation[1:-1] < deviation[2:])).any()
    assert not any("bias" in entry.name for entry in datasheet(quick, 10.0, "deg/s").entries)
    walk = values(datasheet(quick + RandomWalk(1e-6), 10.0, "deg/s"))
    deviation = (2 * (quick + RandomWalk(1e-6)).wavelet_variance(30)).sqrt()
    assert walk["bias instability reached at", "s"] == pytest.approx(2.0 ** int(deviation.argmin()) / 10.0)


def test_a_record_knows_no_averaging_times_beyond_its_own():
    slow = WhiteNoise(1.0) + AR1(1 - 1e-6, 1e-7)
    assert not any("bias" in entry.name for entry in datasheet(slow, 10.0, "deg/s").entries)
    assert any("bias" in entry.name for entry in datasheet(slow, 10.0, "deg/s", n_levels=16).entries)


@pytest.mark.parametrize(
    "model", [WhiteNoise(1.0), RandomWalk(1.0), WhiteNoise(1.0) + Sinusoid(1.0, 0.1), Drift(1.0)], ids=str
)
def test_no_floor_no_bias_instability(model):
    assert not any("bias" in entry.name for entry in datasheet(model, 10.0, "deg/s").entries)


def test_units_of_the_model_do_not_change_what_is_in_degrees():
    degrees = datasheet(WhiteNoise(1e-4) + RandomWalk(1e-12), 200.0, "deg/s")
    factor = (math.pi / 180) ** 2
    radians = datasheet(WhiteNoise(1e-4 * factor) + RandomWalk(1e-12 * factor), 200.0, "rad/s")
    for one, other in zip(degrees.entries, radians.entries, strict=True):
        if "deg/s" not in one.unit:
            assert one.unit == other.unit
            assert one.value == pytest.approx(other.value)
    assert values(radians)["angle random walk N", "rad/s/sqrt(Hz)"] == pytest.approx(math.radians(1e-2 / 200**0.5))


def test_negative_ar1_has_no_correlation_time():
    names = [entry.name for entry in datasheet(WhiteNoise(1.0) + AR1(-0.5, 1.0), 1.0, "deg/s").entries]
    assert names == 2 * ["angle random walk N"] + ["Gauss-Markov deviation"]


def test_without_white_noise_short_ar1s_walk():
    # As averages over many correlation times show it; one of ten seconds does not, nor does white noise of none.
    short, long = AR1(0.17, 1e-2), AR1(math.exp(-1 / 1000), 1e-9)
    got = values(datasheet(WhiteNoise(0.0) + short + long, 100.0, "deg/s"))
    assert got["angle random walk N of AR1s", "deg/s/sqrt(Hz)"] == pytest.approx(
        float((short.wavelet_variance(16)[-1] * 2 * 2**15).sqrt()) / 10, rel=1e-3
    )
    assert ("angle random walk N", "deg/s/sqrt(Hz)") not in got


def test_summary_is_of_fixed_width_and_the_dictionary_plain():
    sheet = datasheet(WhiteNoise(1e-4) + AR1(0.99, 1e-9), 200.0, "deg/s")
    assert str(sheet) == sheet.summary()
    assert sheet.summary().splitlines() == [
        "Datasheet at 200 Hz, model in deg/s",
        "angle random walk N                0.0424264  deg/sqrt(h)",
        "angle random walk N              0.000707107  deg/s/sqrt(Hz)",
        "Gauss-Markov correlation time       0.497496  s",
        "Gauss-Markov deviation              0.807005  deg/h",
    ]
    again = json.loads(json.dumps(sheet.to_dict()))
    assert again["rate"] == 200.0
    assert again["entries"][0] == {
        "name": "angle random walk N",
        "value": pytest.approx(0.0424264, rel=1e-5),
        "unit": "deg/sqrt(h)",
    }


def test_arguments_are_checked():
    with pytest.raises(ValueError, match="`rate`"):
        datasheet(WhiteNoise(1.0), 0.0, "deg/s")
    with pytest.raises(ValueError, match="`unit`: expected one of"):
        datasheet(WhiteNoise(1.0), 1.0, "counts")
    with pytest.raises(ValueError, match=r"`white_noise.variance`.*to be estimated"):
        datasheet(WhiteNoise(), 1.0, "deg/s")
    with pytest.raises(ValueError, match=r"got a batch of shape \(2,\); pick one item"):
        datasheet(WhiteNoise(torch.ones(2)), 1.0, "deg/s")
