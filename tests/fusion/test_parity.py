"""The parity test: by a naive twin, by its false alarms, and by the faults that it names."""

from __future__ import annotations

import functools
import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from bounds import at_least, at_most
from contracts import assert_same
from reference import haar as naive_haar
from reference import parity as naive
from reference import published
from torch import Tensor

from gyrofuse import ArrayModel, RandomWalk, Recording, WhiteNoise, fit_svo
from gyrofuse.fusion.faults.classify import KINDS, _share_of_rate
from gyrofuse.fusion.faults.parity import parity_test
from gyrofuse.fusion.faults.reference import ParityReference
from gyrofuse.fusion.faults.reference import fit_parity_reference as fit_reference
from gyrofuse.fusion.faults.residuals import own_variance
from gyrofuse.fusion.faults.result import ParityResult

N_SENSORS, WINDOW, ONSET = 5, 256, 1300


@functools.cache
def noise() -> ArrayModel:
    """White noise and random walks, both correlated, that meet at about 100 samples."""
    mix = torch.eye(N_SENSORS, dtype=torch.float64) + 0.2
    white = mix @ torch.tensor([1.0, 1.5, 0.7, 2.0, 1.2], dtype=torch.float64).diag() @ mix.T
    walk = 3e-4 * torch.eye(N_SENSORS, dtype=torch.float64) + 1e-4
    return ArrayModel([(WhiteNoise(1.0), white), (RandomWalk(1.0), walk)])


@functools.cache
def healthy() -> Tensor:
    return noise().simulate(12_000, generator=torch.Generator().manual_seed(1))


@functools.cache
def reference() -> ParityReference:
    return fit_reference(healthy()[:, :9000], WINDOW)


def stretch() -> tuple[Tensor, Tensor]:
    """Healthy samples to put a fault into, and those before."""
    return healthy()[:, 9000:].clone(), healthy()[:, :9000]


def turning(n_samples: int) -> Tensor:
    return 30 * torch.sin(torch.arange(n_samples, dtype=torch.float64) / 40)


# Against the naive twin


@pytest.mark.parametrize("moving", [False, True])
def test_p_values_are_those_of_explicit_regressions(moving):
    calm = torch.from_numpy(naive_haar.array(4, 4000))
    fit = fit_svo(calm[:, :3000])
    signal = calm[:, 3000:].clone()
    signal[2, 500:] += 3
    signal[:, 130:140] = torch.nan
    if moving:
        signal = signal + turning(1000)
    gamma = fit.wavelet_cross_covariance.numpy()
    usable = int((fit.dof >= 2 + 4).sum())
    assert usable > 7
    own = own_variance(fit.wavelet_cross_covariance[:usable]).numpy()
    signal[1, 800:] = signal[1, 800:] * 0.3 + signal[1:2, 800:].mean() * 0.7  # too quiet
    result = parity_test(signal, fit, window=200)
    for number in range(5):
        loud, quiet, n_tests = naive.p_values(signal.numpy(), gamma[:usable], own, fit.dof.numpy(), 200, number)
        p = np.fmin(np.nanmin(loud, 0), np.nanmin(quiet, 0)) * n_tests
        np.testing.assert_allclose(result.p_value[number], min(p.min(), 1), rtol=1e-5)
        if not result.alarm[number]:
            np.testing.assert_allclose(result.p_values[number], np.minimum(p, 1), rtol=1e-5)


def test_levels_that_hold_too_little_are_left_out():
    long, short = fit_reference(healthy(), 64), fit_reference(healthy()[:, :300], 64)
    assert long.n_levels == 10  # up to sixteen windows
    # 280/151 x 225/32 = 13 observations at level 5 and 5.6 at level 6; 3 are spent, and 4 more are asked for
    assert short.n_levels == 5
    assert fit_reference(healthy(), 64, n_levels=3).n_levels == 3
    assert (long.dof - 3 >= 4).all()


# False alarms


def claimed(alarms: Tensor, probability: float) -> bool:
    """Whether the number of alarms is no more than a true claim gives by chance."""
    return int(alarms.sum()) <= at_most(alarms.numel(), probability)


@functools.cache
def null_results(compression: float, n_runs: int) -> dict[str, ParityResult]:
    """Arrays like Case 1 of Zhang et al., time compressed: reference and two windows from each.

    Levels above the seventh are longer than the windows of 128 samples that are tested, and would only take time.
    """
    settings = published.table("zhang")
    white, walk = (torch.tensor(settings[name], dtype=torch.float64) for name in "RQ")
    array = ArrayModel([(WhiteNoise(1.0), white), (RandomWalk(1.0), walk * compression)])
    signal = array.simulate(1024 + 256, batch=(n_runs,), generator=torch.Generator().manual_seed(4))
    calm, moving = signal[..., :1024], signal + white.max().sqrt() * turning(1280)
    before, after = moving[..., :1024], moving[..., 1024:]
    return {
        "fit": parity_test(after, fit_svo(calm, covariance="none", n_levels=7), window=128, history=before),
        "windows": parity_test(after, fit_reference(calm, 128), history=before),
    }


@pytest.mark.statistical
@pytest.mark.parametrize("kind", ["fit", "windows"])
@pytest.mark.parametrize("compression", [2.0**14, 2.0**20])
def test_false_alarms_are_as_rare_as_stated(compression, kind, draws):
    """At most 1 % of first windows raise an alarm at 1 %, and 10 % at 10 %, white noise or random walk ruling.

    The claim is refused above 11 of 400 (59 at 10 %), and above 21 of 1000 (131 at 10 %).
    """
    result = null_results(compression, draws(400, 1000))[kind]
    for window in (0, 1):
        assert claimed(result.alarm[:, window], 0.01)
        assert claimed(result.p_value[:, window] < 0.1, 0.1)


@pytest.mark.statistical
@pytest.mark.parametrize("compression", [2.0**14, 2.0**20])
def test_false_alarms_are_not_rarer_than_need_be(compression, draws):
    """Windows below 10 % are no fewer than one in eight of what is stated: Bonferroni costs, but not power."""
    p = null_results(compression, draws(400, 1000))["fit"].p_value.flatten()
    assert (p < 0.1).sum() >= at_least(len(p), 0.1 / 8)


@pytest.mark.statistical
def test_noise_that_varies_by_itself_is_no_fault_to_who_has_seen_it():
    """Noise power that differs by 60 % (standard deviation) from window to window: 50 arrays, 10 windows of each."""
    generator = torch.Generator().manual_seed(6)
    unit = torch.randn(50, 4, 50, 128, dtype=torch.float64, generator=generator)
    power = torch.exp(0.55 * torch.randn(50, 4, 50, 1, dtype=torch.float64, generator=generator))
    signal = (unit * power.sqrt()).flatten(-2)
    calm, rest = signal[..., : 40 * 128], signal[..., 40 * 128 :]
    assert claimed(parity_test(rest, fit_reference(calm, 128)).alarm, 0.01)
    stationary = torch.randn(4, 40 * 128, dtype=torch.float64, generator=generator)
    assert claimed(parity_test(rest, fit_reference(stationary, 128, extra_sd=0.8)).alarm, 0.01)
    for blind in (fit_reference(stationary, 128), fit_svo(calm[0], covariance="none")):
        assert parity_test(rest[0], blind, window=128).alarm.double().mean() > 0.5


@pytest.mark.statistical
def test_scale_factors_may_differ_by_what_is_tolerated():
    generator = torch.Generator().manual_seed(7)
    signal = noise().simulate(1024, batch=(40,), generator=generator)
    gains = 1 + 0.01 * (2 * torch.rand(40, N_SENSORS, 1, dtype=torch.float64, generator=generator) - 1)
    moving = signal + gains * 20 * turning(1024)
    assert parity_test(moving, reference()).alarm.all()
    assert claimed(parity_test(moving, reference(), scale_factor_tolerance=0.01).alarm, 0.01)
    moving[:, 1, 512:] += 200
    assert parity_test(moving, reference(), scale_factor_tolerance=0.01).faulty[:, 2:, 1].any(-1).all()


# Faults


def faulty(kind: str, sensor: int = 3) -> Tensor:
    signal, _ = stretch()
    signal = signal + turning(3000)
    time = torch.arange(3000 - ONSET, dtype=torch.float64)
    part = signal[sensor, ONSET:]
    if kind == "frozen":
        part[:] = part[0].clone()
    elif kind == "biased":
        part += 12
    elif kind == "drifting":
        part += 0.02 * time
    elif kind == "noisier":
        part += 3 * torch.randn(len(part), dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    elif kind == "sign-flipped":
        part *= -1
    else:
        part *= 0.3
    return signal


@pytest.mark.parametrize("sensor", range(N_SENSORS))
@pytest.mark.parametrize("kind", ["frozen", "biased", "drifting", "noisier", "sign-flipped"])
def test_a_fault_is_found_named_and_told(kind, sensor):
    """While the array turns by 30 times its noise, of which differences hold nothing."""
    _, before = stretch()
    result = parity_test(faulty(kind, sensor), reference(), history=before)
    first = -(-ONSET // WINDOW)  # the first window that is all after the onset
    assert not result.alarm[: first - 1].any()
    assert result.alarm[first : first + 3].all()
    assert result.faulty[first : first + 3, sensor].all()
    assert result.faulty.sum(-1).le(1).all()
    assert result.kind[first + 1, sensor] == KINDS.index(kind)
    assert result.kind[~result.faulty].eq(-1).all()
    assert abs(result.faults[0].start - ONSET) <= WINDOW
    fault = next(fault for fault in result.faults if fault.kind == kind)
    assert fault.sensor == str(sensor + 1)
    size = {"biased": 12, "drifting": 0.02}.get(kind)
    if size:
        assert fault.size == pytest.approx(size, rel=0.2)
    assert f"Sensor {sensor + 1} " in str(result)


def test_a_quieter_sensor_is_told_from_a_frozen_one():
    signal, before = stretch()
    signal[2, ONSET:] = 0.2 * torch.randn(1700, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    result = parity_test(signal, reference(), history=before)
    assert result.kind[7, 2] == KINDS.index("quieter")


def test_a_turned_sign_shows_at_rest_by_the_bias():
    signal, before = stretch()
    signal, before = signal + 20, before + 20
    signal[1, ONSET:] *= -1
    result = parity_test(signal, reference(), history=before)
    assert result.kind[6, 1] == KINDS.index("sign-flipped")
    fixed, before = stretch()
    fixed[1, ONSET:] -= 15  # a step, but not to the mirror image
    assert parity_test(fixed, reference(), history=before).kind[6, 1] == KINDS.index("biased")


def test_a_sensor_without_noise_of_its_own_and_without_a_rate_is_no_evidence_of_a_sign():
    levels, variance = torch.tensor([0, 0, 1]), torch.tensor([[0.5, 0.25]], dtype=torch.float64)
    share = _share_of_rate(torch.zeros(1, 3, dtype=torch.float64), torch.ones(1, 3), variance, variance, levels)
    assert share.tolist() == [[0.0, 0.0, 0.0]]


def test_two_faults_at_once_are_both_named():
    signal, before = stretch()
    signal[0, ONSET:] += 8
    signal[4, ONSET:] += 5 * torch.randn(1700, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    result = parity_test(signal, reference(), history=before)
    assert result.faulty[6].tolist() == [True, False, False, False, True]
    assert result.kind[6, [0, 4]].tolist() == [KINDS.index("biased"), KINDS.index("noisier")]


def test_huge_faults_are_still_named():
    """p-values of 0 for several sensors: the likelihood tells them apart."""
    for sensor in range(N_SENSORS):
        signal, before = stretch()
        signal[sensor, ONSET:] += 1e12
        result = parity_test(signal, reference(), history=before)
        assert result.p_value[6] == 0
        assert result.faulty[6].nonzero().tolist() == [[sensor]]


def test_a_bias_is_seen_only_against_what_was_before():
    signal, before = stretch()
    signal[3] += 4
    assert parity_test(signal, reference(), history=before).faulty[0, 3]
    assert not parity_test(signal, reference()).alarm.any()


def test_two_sensors_only_disagree():
    signal, before = stretch()
    signal[1, ONSET:] += 8
    result = parity_test(signal[:2], fit_reference(before[:2], WINDOW), history=before[:2])
    assert result.alarm[6]
    assert not result.faulty.any()
    assert "two sensors disagree; it takes a third" in result.summary()
    signal[1, ONSET:] = 0.0
    frozen = parity_test(signal[:2], fit_reference(before[:2], WINDOW), history=before[:2])
    assert frozen.faulty[7].tolist() == [False, True]


def test_missing_sensors_are_left_out():
    signal, before = stretch()
    signal[2, 600:2000] = torch.nan
    signal[3, ONSET:] += 8
    result = parity_test(signal, reference(), history=before)
    assert result.faulty[6].nonzero().tolist() == [[3]]
    assert result.p_values[3:7, 2].eq(1).all()
    others = [0, 1, 3, 4]
    alone = parity_test(signal[others], fit_reference(healthy()[others, :9000], WINDOW), history=before[others])
    torch.testing.assert_close(result.p_value[3:7], alone.p_value[3:7], rtol=0.3, atol=1e-3)
    assert result.tested[:2].all()
    assert result.tested[3:7].tolist() == [[True, True, False, True, True]] * 4


def test_what_could_not_be_tested_is_named():
    signal, before = stretch()
    n_windows = signal.shape[-1] // WINDOW
    signal[2, : 5 * WINDOW] = torch.nan
    result = parity_test(signal, reference(), history=before)
    expected = torch.ones(n_windows, N_SENSORS, dtype=torch.bool)
    expected[:5, 2] = False
    assert torch.equal(result.tested, expected)
    text = result.summary()
    assert "No sensor stands out, as far as they were tested (smallest p = " in text
    assert f"- Not tested: sensor 3 in windows 1 to 5 of {n_windows} (0 to 1280 samples); too few samples" in text
    assert json.loads(json.dumps(result.to_dict()))["tested"] == expected.tolist()
    signal[:, 6 * WINDOW : 7 * WINDOW] = torch.nan  # where nobody is there nothing is judged by what came before
    signal[0] = torch.nan
    batch = parity_test(Recording(torch.stack([stretch()[0], signal]), rate=100.0, axes=("x", "y")), reference())
    assert not batch.tested[1, 6].any()
    assert batch.p_value[1, 6] == 1
    text = batch.summary()
    assert "[x] Not" not in text
    assert "- [y] Not tested: sensor 1 in any window; too few samples to compare." in text
    assert f"- [y] Not tested: sensor 3 in windows 1 to 5, 7 of {n_windows} (0 to 12.8, 15.36 to 17.92 s); too" in text
    assert f"- [y] Not tested: sensors 2, 4, 5 in window 7 of {n_windows}" in text
    whole = parity_test(stretch()[0], reference(), history=before)
    assert "ested:" not in whole.summary()


def test_many_gaps_are_cut_short():
    signal = noise().simulate(60 * 64, batch=(30,), generator=torch.Generator().manual_seed(5))
    for item in range(30):
        signal[item, item % N_SENSORS].unflatten(-1, (60, 64))[::2] = torch.nan
    text = parity_test(signal, fit_reference(healthy(), 64)).summary()
    assert "in windows 1, 3, 5, 7, 9 and 25 more of 60 (0 to 64, 128 to 192, " in text
    assert text.endswith("- ... and 10 more not tested")


@pytest.mark.statistical
def test_scattered_losses_neither_alarm_nor_blunt():
    """Each sensor loses 2 % of its samples, on 40 moving arrays: the rate cancels, and long levels are still there."""
    generator = torch.Generator().manual_seed(8)
    signal = noise().simulate(1536, batch=(40,), generator=generator) + turning(1536)
    lost = torch.rand(signal.shape, generator=generator) < 0.02
    holes = torch.where(lost, torch.nan, signal)
    result = parity_test(holes, reference())
    assert claimed(result.alarm, 0.01)
    holes[:, 1, 768:] += 8
    found = parity_test(holes, reference()).faulty[:, 3:5, 1].any(-1)
    signal[:, 1, 768:] += 8
    assert found.sum() > 0.9 * parity_test(signal, reference()).faulty[:, 3:5, 1].any(-1).sum()


def test_a_reference_with_scattered_losses_is_as_good():
    generator = torch.Generator().manual_seed(9)
    holes = torch.where(torch.rand(5, 9000, generator=generator) < 0.02, torch.nan, healthy()[:, :9000])
    whole, torn = reference(), fit_reference(holes, WINDOW)
    assert torn.n_levels == whole.n_levels
    ratio = torn.wavelet_cross_covariance.diagonal(dim1=-2, dim2=-1) / whole.wavelet_cross_covariance.diagonal(
        dim1=-2, dim2=-1
    )
    assert ((ratio > 0.8) & (ratio < 1.2)).all()


def test_several_stretches_make_one_reference():
    """Their levels do not matter, nor what lies between them."""
    pieces = [healthy()[:, :4000] + 100, healthy()[:, 4000:9000] - 100]
    together, whole = fit_reference(pieces, WINDOW), reference()
    levels = slice(6)
    torch.testing.assert_close(
        together.wavelet_cross_covariance[levels], whole.wavelet_cross_covariance[levels], rtol=0.1, atol=0.02
    )


def test_a_calmer_day_is_no_fault():
    """The reference felt a vibration of six times the noise, which is no noise of the sensors; a frozen one shows."""
    vibration = 6 * torch.randn(9000, dtype=torch.float64, generator=torch.Generator().manual_seed(11))
    shaken = fit_reference(healthy()[:, :9000] + vibration, WINDOW)
    truth = noise().wavelet_cross_covariance(4).diagonal(dim1=-2, dim2=-1)
    assert (shaken.wavelet_cross_covariance.diagonal(dim1=-2, dim2=-1)[:4] > 5 * truth).all()
    assert (shaken.own_variance[:4] < 1.5 * truth).all()
    signal, before = stretch()
    assert not parity_test(signal, shaken, history=before).alarm.any()
    signal[2, ONSET:] = 0.0
    assert parity_test(signal, shaken, history=before).kind[6:9, 2].eq(KINDS.index("frozen")).all()


def test_own_variances_of_independent_sensors():
    """Whatever is common, and exactly: `v_i` from the differences of three sensors or more."""
    variance = torch.tensor([[1.0, 2.0, 0.7, 5.0], [3.0, 1.0, 1.0, 1.0]], dtype=torch.float64)
    for common in (0.0, 100.0):
        gamma = torch.diag_embed(variance) + common
        torch.testing.assert_close(own_variance(gamma), variance, rtol=1e-4, atol=0)
    assert torch.equal(own_variance(gamma[:, :2, :2]), gamma[:, :2, :2].diagonal(dim1=-2, dim2=-1))


# Real arrays


@functools.cache
def study() -> ModuleType:
    """The example that injects faults, as a module."""
    path = Path(__file__).resolve().parents[2] / "examples" / "fault_study.py"
    spec = importlib.util.spec_from_file_location("fault_study", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fault_study"] = module  # its dataclass looks itself up
    spec.loader.exec_module(module)
    return module


def test_untouched_recordings_raise_no_more_alarms_than_stated(data: Path):
    """Five sessions of a board of eight gyros, each tested against its own first half: 3 axes, 600 windows."""
    count, total = study().false_alarms(study().mimu_sessions(data / "mimu4444_8imu.npz", 256, 10))
    assert total == 600
    assert count <= at_most(total, 0.01)


def test_every_sensor_of_a_real_array_is_named(data: Path):
    """A bias of three times the noise per sample, in each sensor and axis of the board."""
    fs = study()
    session = fs.mimu_sessions(data / "mimu4444_8imu.npz", 256, 2)[2]
    for sensor in range(8):
        signal = fs.inject(session.pieces[:1], "biased", 3.0, sensor, session, 256)
        faults = parity_test(signal, session.reference).faulty[..., 2:, :].any(-2)  # (piece, axis, sensor)
        expected = torch.arange(8) == sensor
        assert (faults == expected).all()


# What every operation keeps


def columns(result: ParityResult) -> list[Tensor]:
    return [result.p_value, result.p_values, result.statistic, result.size, result.kind.double()]


def test_a_batch_is_its_items():
    signal = torch.stack([faulty(kind) for kind in ("frozen", "biased", "noisier", "sign-flipped")]).unflatten(
        0, (2, 2)
    )
    before = healthy()[:, :9000].expand(2, 2, -1, -1)
    whole = parity_test(signal, reference(), history=before)
    assert whole.p_value.shape == (2, 2, 11)
    for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
        item = parity_test(signal[a, b], reference(), history=before[a, b])
        assert_same([c[a, b] for c in columns(whole)], columns(item), 1e-7)
    references = fit_reference(healthy()[:, :9000].expand(2, -1, -1), WINDOW)
    assert_same(columns(parity_test(signal, references, history=before)), columns(whole), 1e-7)


def test_long_signals_are_tested_in_parts(monkeypatch: pytest.MonkeyPatch):
    from gyrofuse.fusion.faults import residuals as parity_energy

    whole = parity_test(faulty("drifting"), reference(), history=healthy()[:, :9000])
    monkeypatch.setattr(parity_energy, "_AT_ONCE", 1)
    parts = parity_test(faulty("drifting"), reference(), history=healthy()[:, :9000])
    assert_same(columns(parts), columns(whole), 1e-7)


def test_float32_under_an_offset():
    signal, before = faulty("biased") + 100, healthy()[:, :9000] + 100
    single = parity_test(signal.float(), reference(), history=before.float())
    exact = parity_test(signal.float().double(), reference(), history=before.float().double())
    assert_same(columns(single), columns(exact), 1e-9)


def test_memory_layout_and_signal_are_left_alone():
    signal = faulty("biased")
    copy = signal.clone()
    expected = parity_test(signal, reference())
    assert torch.equal(signal, copy)
    assert_same(columns(parity_test(signal.mT.contiguous().mT, reference())), columns(expected), 1e-9)


# The result


def test_the_result_says_it_in_words(tmp_path: Path):
    signal, before = stretch()
    signal[3, ONSET:] += 4
    recording = Recording(signal, rate=100.0, unit="deg/s", sensors=("a", "b", "c", "d", "e"))
    result = parity_test(recording, reference(), history=before)
    text = result.summary()
    assert text == str(result)
    assert text.startswith("Parity test of 5 sensors, 11 windows of 256 samples (2.56 s), false alarms in 1 %")
    assert "- Sensor d is biased: it steps by +" in text
    assert "deg/s against the others; seen from 1" in text
    values = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert values["faults"][0]["sensor"] == "d"
    assert values["start"][:2] == [0.0, 2.56]
    quiet = parity_test(Recording(stretch()[0], rate=100.0), reference(), history=before)
    assert "- No sensor stands out (smallest p = " in quiet.summary()


def test_batches_name_their_items():
    signal = torch.stack([faulty("biased"), faulty("noisier")])
    result = parity_test(Recording(signal, rate=1.0, axes=("x", "y")), reference())
    assert {fault.item for fault in result.faults} == {(0,), (1,)}
    assert "[x] Sensor 4 " in result.summary()
    with pytest.raises(ValueError, match=r"expected one array to plot, got a batch \(2,\)"):
        result.plot()


def test_plot_outlines_what_was_found():
    result = parity_test(faulty("biased"), reference())
    import matplotlib.pyplot as plt

    ax = result.plot()
    assert len(ax.patches) == int(result.faulty.sum())
    other = plt.figure().add_subplot()
    assert result.plot(other) is other
    plt.close("all")


def test_plot_leaves_out_what_was_not_tested():
    signal = faulty("biased").clone()
    signal[1, :300] = torch.nan
    result = parity_test(signal, reference())
    assert not bool(result.tested.all())
    import matplotlib.pyplot as plt

    shown = result.plot().collections[0].get_array()
    assert shown.mask.T.tolist() == (~result.tested).tolist()
    plt.close("all")


def test_the_reference_says_what_it_rests_on():
    text = reference().summary()
    assert text == str(reference())
    assert text.startswith("Healthy array of 5 sensors, windows of 256 samples")
    assert len(text.splitlines()) == 2 + reference().n_levels
    values = json.loads(json.dumps(reference().to_dict(), allow_nan=False))
    assert values["window"] == WINDOW


@pytest.mark.parametrize(
    ("use", "error", "message"),
    [
        (
            lambda: fit_reference(healthy()[:1], 64),
            ValueError,
            "`signal`: expected at least 2 sensors to compare, got 1",
        ),
        (
            lambda: fit_reference(healthy()[:, :9], 8),
            ValueError,
            "`signal`: expected at least 7 independent obs.* longer",
        ),
        (
            lambda: fit_reference(healthy(), 20_000),
            ValueError,
            "`window`: expected at most the 12000 samples of `signal`",
        ),
        (lambda: fit_reference(healthy(), 0), ValueError, "`window`: expected a whole number >= 1, got 0"),
        (
            lambda: fit_reference(healthy(), 9, extra_sd=-1),
            ValueError,
            "`extra_sd`: expected a finite .* got -1",
        ),
        (lambda: fit_reference([], 9), ValueError, "`signal`: expected at least one stretch, got none"),
        (
            lambda: fit_reference([healthy(), healthy()[:2]], 9),
            ValueError,
            "`signal`: expected stretches of the same sens",
        ),
        (lambda: fit_reference(healthy()[0], 9), ValueError, r"`signal`: expected \(..., sensor, time\)"),
        (lambda: parity_test(healthy()[:3], reference()), ValueError, "`signal`: expected .* the 5 sensors of the ref"),
        (lambda: parity_test(healthy()[:, :99], reference()), ValueError, "`window`: expected at most the 99 samples"),
        (
            lambda: parity_test(healthy(), reference(), window=1),
            ValueError,
            "`window`: expected at least 2 samples.* 1;",
        ),
        (lambda: parity_test(healthy(), reference(), window=0), ValueError, "`window`: expected a whole number >= 1"),
        (lambda: fit_reference(healthy(), 1), ValueError, "`window`: expected at least 2 samples"),
        (
            lambda: parity_test(torch.full_like(healthy(), torch.nan), reference()),
            ValueError,
            r"`signal`: expected a window of 256 samples .* found none \(100 % of all samples are missing\)",
        ),
        (
            lambda: parity_test(healthy(), healthy()),
            TypeError,
            "`reference`: expected a ParityReference or an SVOResult, got Tensor; .* fit_parity_reference",
        ),
        (lambda: parity_test(healthy(), reference(), false_alarm=1), ValueError, "`false_alarm`: expected .* got 1"),
        (
            lambda: parity_test(healthy(), reference(), scale_factor_tolerance=-1),
            ValueError,
            "`scale_factor_tolerance`: expected .* -1",
        ),
        (
            lambda: parity_test(healthy(), reference(), history=healthy()[:4]),
            ValueError,
            "`history`: expected the shape",
        ),
        (
            lambda: parity_test(healthy(), fit_reference(healthy().expand(3, -1, -1), 256)),
            ValueError,
            r"`signal`: expected the batch shape \(3,\) of the reference, got \(\)",
        ),
    ],
)
def test_bad_input_is_named(use, error, message):
    with pytest.raises(error, match=message):
        use()
