"""The blind proof's generator: effects of the size claimed, nulls without one."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import periodogram
from scipy.stats import binom, kurtosis

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from blind import (
    bench,
    cases,
    common_noise,
    converter,
    filters,
    kinds,
    likelihood,
    mechanics,
    ordinary_view,
    scoring,
    seal,
    thermal,
)
from blind.analog import OVERSAMPLING, consumer_base
from blind.cases import make_case

BLIND = Path(__file__).parent / "benchmarks" / "blind"
N = 8192
MADE = [name for group in (*kinds.GROUPS, *kinds.WIDER) for name in kinds.kinds(group)]
EFFECTS = [name for name in MADE if kinds.KINDS[name].effects and kinds.KINDS[name].group != "unidentifiable"]


def test_generator_knows_nothing_of_the_library():
    for path in set(BLIND.glob("*.py")) - {BLIND / "analyser.py"}:
        assert not re.search(
            r"import gyrofuse|from gyrofuse|import torch|from torch|import analyse", path.read_text()
        ), path


@pytest.mark.statistical
@pytest.mark.parametrize("kind", MADE)
def test_case_is_complete_and_repeatable(kind):
    n = 2048
    first, again = (make_case(kind, 30.0, 5, n_samples=n) for _ in range(2))
    np.testing.assert_array_equal(first.recording["gyro"], again.recording["gyro"])
    assert seal.digest_of(seal.plain(first.truth)) == seal.digest_of(seal.plain(again.truth))
    assert first.recording["gyro"].shape == (6, n)
    for name, values in first.recording.items():
        if name not in ("gyro", "fs", "unit"):
            assert values.shape[-1] == n, name
            assert np.isfinite(values).all(), name
    assert np.isfinite(first.recording["gyro"]).all()
    assert ("terms" in first.simulation) != ("gyro" in first.simulation)
    json.dumps(seal.plain(first.truth), allow_nan=False)
    for effect in first.truth["effects"]:
        assert effect["mechanism"] in effect["class"]
        assert all(0 <= sensor < 6 for sensor in effect["sensors"])
        assert len(effect["sensor_nats"]) in (0, len(effect["sensors"]))
        for parameter in effect["parameters"].values():
            assert len(parameter.get("per_sensor", effect["sensors"])) == len(effect["sensors"])


WIDE = [name for name in MADE if kinds.KINDS[name].group in ("mechanism", *kinds.WIDER) and "telegraph" not in name]


@pytest.mark.statistical
@pytest.mark.parametrize("kind", WIDE)
def test_a_wide_case_is_complete_at_every_size_that_exists(kind):
    """Sensors, rate, length and reach of its own: whatever is drawn, shapes, truth and number of sensors agree."""
    made = 0
    for seed, nats in enumerate((30.0, *cases.STRONG)):
        try:
            case = make_case(kind, nats, seed, n_samples=4096, wide=True)
        except likelihood.OutOfReachError:
            continue
        made += 1
        truth, gyro = case.truth, case.recording["gyro"]
        assert gyro.shape == (truth["n_sensors"], truth["n_samples"])
        assert case.recording["fs"] == truth["rate_hz"]
        assert np.isfinite(gyro).all()
        again = make_case(kind, nats, seed, **truth["asked"])
        np.testing.assert_array_equal(gyro, again.recording["gyro"])
        for effect in truth["effects"]:
            assert effect["nats"] == pytest.approx(bench.CERTAIN if kind in kinds.SIZELESS else nats, rel=1e-6)
            reached = {"one": 2 if effect["mechanism"] == "common_mode" else 1, "all": truth["n_sensors"]}
            if effect["oracle_law"] != "certain":  # which may turn out to touch fewer
                assert len(effect["sensors"]) <= reached.get(truth["reach"], truth["n_sensors"])
    assert made


@pytest.mark.parametrize(
    ("design", "made"), [*filters.DESIGNS.items(), *((f"high pass {k}", v) for k, v in filters.HIGH_PASSES.items())]
)
def test_a_filter_of_any_design_leaves_the_power_that_is_said(design, made):
    """Power of filtered white noise in 8 bands over that promised, within 5 standard errors; a corner of 0.1.

    Where it passes next to nothing the ends of the record are all that is seen.
    """
    n, corner = 2**15, 0.1
    noise = made.apply(corner, np.random.default_rng(0).standard_normal((4, n)))
    power = likelihood.coefficients(noise) ** 2
    told = made.power(corner, likelihood.grid(n))
    assert told[-1 if design.startswith("high") else 0] == pytest.approx(1, abs=0.11)  # a ripple of half a decibel
    for seen, said in zip(np.array_split(power, 8, axis=1), np.array_split(told, 8), strict=True):
        if said.mean() < 1e-3:
            continue
        share = (said**2).sum() / said.sum() ** 2  # of the variance of a sum of weighted chi-squares
        assert abs(seen.sum() / (4 * said.sum()) - 1) < 5 * np.sqrt(2 * share / 4) + 0.02


@pytest.mark.parametrize("law", common_noise.LAWS)
def test_noise_alike_on_both_sides_has_one_law(law):
    """Spread, and the law of the sizes, of two sides agree; none but flicker, steady and rounded noise is Gaussian."""
    base = consumer_base(np.random.default_rng(0), 200.0)
    one, other = (
        np.diff(common_noise.simulated(law, base, 2**15, np.random.default_rng(seed)), axis=1) for seed in (1, 2)
    )
    assert np.std(one, axis=1) == pytest.approx(np.std(other, axis=1), rel=0.15)
    heavy = [kurtosis(x, axis=None) for x in (one, other)]
    if law in ("flicker", "rounded"):
        assert np.abs(heavy).max() < 0.1
    else:
        assert min(heavy) > 0.2


def test_too_large_an_effect_is_no_case():
    with pytest.raises(likelihood.OutOfReachError, match="of the samples"):
        make_case("stuck_samples", 3e5, 0, n_samples=2048)


@pytest.mark.parametrize(
    ("kind", "nats", "what"),
    [
        ("clock_skew", 3e4, "an offset of the clock"),
        ("g_sensitivity", 3e6, "a gain on acceleration"),
        ("form:late_acceleration", 3e6, "a gain on acceleration"),
        ("quadratic_coupling", 3e6, "a gain on squared acceleration"),
        ("scale_factor", 3e7, "a scale error"),
        ("temperature_drift", 3e7, "a temperature coefficient"),
        ("warm_up_transient", 3e7, "an output at rest"),
        ("pair:level_not_low_pass", 3e5, "white noise that is less"),
    ],
)
def test_what_no_sensor_has_is_no_case(kind, nats, what):
    with pytest.raises(likelihood.OutOfReachError, match=what):
        make_case(kind, nats, 0, n_samples=16384)


def test_seed_kind_and_size_all_change_the_numbers():
    names = [("step", 30.0, 5), ("step", 30.0, 6), ("step", 31.0, 5), ("null", None, 5)]
    first = [make_case(kind, nats, seed, n_samples=64).recording["gyro"][0, 0] for kind, nats, seed in names]
    assert len(set(first)) == 4


def test_unknown_kind():
    with pytest.raises(ValueError, match="`kind`: expected one of"):
        make_case("gremlins", 30.0, 0)


# base and simulation


@pytest.mark.parametrize("kind", ["null", "null_slow_ar1", "null_white_only"])
def test_null_recording_and_simulation_share_one_spectrum(kind):
    """Ratio of powers in 12 bands pooled over 6 sensors and 12 seeds; every |z| < 4 of the F law's log."""
    edges = np.geomspace(1e-3, 0.5, 13)
    powers = np.zeros((2, len(edges) - 1))
    counts = np.zeros((2, len(edges) - 1))
    for seed in range(12):
        case = make_case(kind, None, seed, n_samples=N)
        if "terms" in case.simulation:
            continue
        reference = None
        for side, signal in enumerate((case.recording["gyro"], case.simulation["gyro"])):
            f, power = periodogram(np.diff(signal, axis=1), window="hann")
            white = 2 - 2 * np.cos(2 * np.pi * f)
            level = np.median(power[:, f > 0.3] / white[f > 0.3], axis=1) if reference is None else reference
            reference = level
            band = np.digitize(f, edges) - 1
            for k in range(len(edges) - 1):
                powers[side, k] += (power[:, band == k] / white[band == k] / level[:, None]).sum()
                counts[side, k] += power[:, band == k].size
    ratio = np.log(powers[0] / counts[0]) - np.log(powers[1] / counts[1])
    # a band's ordinates have the mean's relative variance 1.94/n (Hann), more where sensors differ in level
    z = ratio / np.sqrt(1.94 * (1 / counts[0] + 1 / counts[1]) * 1.5)
    assert np.abs(z).max() < 4, z


def test_oversampled_base_has_the_spectrum_that_is_said():
    base = consumer_base(np.random.default_rng(0), 200.0)
    analog = base.analog(2 * N, np.random.default_rng(1))
    power = likelihood.coefficients(converter.decimate(analog, OVERSAMPLING)) ** 2 / base.spectrum(2 * N)
    for part in np.array_split(power, 8, axis=1):
        assert abs(part.mean() - 1) < 4 * np.sqrt(2 / part.size)


@pytest.mark.statistical
def test_wavelet_variance_of_nulls_is_ordinary():
    """The ordinary view's false alarms: at most what 1 % allows in 30 cases (binomial bound fixed beforehand)."""
    p = []
    for seed in range(30):
        case = make_case("null", None, seed, n_samples=N)
        p.append(ordinary_view.ordinary_p_value(case.recording["gyro"], case.simulation))
    assert np.sum(np.array(p) < 0.01) <= binom.ppf(0.999, 30, 0.01)


# the size of an effect


def test_folded_spectrum_against_a_simulated_one():
    rng = np.random.default_rng(3)
    nu, quality = 0.03, 5.0
    fine = mechanics.resonator_spectrum(np.arange(8 * N + 1) / (16 * N), nu, quality)
    predicted = likelihood.folded(fine, 8)[1:-1]
    runs = [converter.decimate(mechanics.resonator(8 * N, nu, quality, rng), 8) for _ in range(30)]
    power = np.mean([likelihood.coefficients(run) ** 2 for run in runs], axis=0)
    for a, b in zip(np.array_split(power, 20), np.array_split(predicted, 20), strict=True):
        assert abs(a.mean() / b.mean() - 1) < 4 * np.sqrt(2 / (30 * a.size / 4))


def test_white_noise_stays_white_through_the_converter():
    np.testing.assert_allclose(likelihood.folded(np.full(8 * 64 + 1, 8.0), 8), 1.0, rtol=1e-12)


def test_expected_power_against_the_double_sum():
    """E c_k^2 = sum_st b_k(s) b_k(t) r(s - t) for an AR1 process on 64 samples."""
    n, phi = 64, 0.8
    spectrum = likelihood.ar1_spectrum(np.arange(n + 1) / (2 * n), phi, 1 - phi**2)
    covariance = phi ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    basis = likelihood.coefficients(np.eye(n))  # row t: every coefficient of an impulse at t
    exact = np.einsum("sk,tk,st->k", basis, basis, covariance)
    np.testing.assert_allclose(likelihood.expected_power(spectrum), exact, rtol=1e-4)  # r(64) = 6e-7 folds over


@pytest.mark.statistical
def test_oracle_keeps_its_false_alarm_rate():
    """At nominal 5 %, 40 null recordings for each of six effects: at most the 99.9 % point of the binomial law."""
    rng = np.random.default_rng(8)
    alarms, trials = 0, 0
    for name in ("vibration_tone", "resonance", "common_mode", "variance_change", "quantization", "flicker"):
        table = bench.Bench(consumer_base(rng, 200.0), N, rng)
        part = kinds.KINDS[name].effects[0](table, 20.0)
        true = cases.effect_truth(part, 0.0)
        for _ in range(40):
            ratio = part.llr(table.base.simulate(N, rng) + table.base.bias[:, None])
            alarms += scoring.oracle_detects(true | {"oracle_llr": ratio}, 0.05)
            trials += 1
    assert binom.ppf(0.001, trials, 0.05) <= alarms <= binom.ppf(0.999, trials, 0.05)


# Those of single samples are certain; few designs of filters act as weakly; a trap's dwells change nothing; what only
# the simulation has no recording shows.
UNSIZED = (
    *kinds.SIZELESS,
    *("dead_band", "clipping", "stuck_samples", "form:filter", "form:asymmetric_telegraph"),
    *("high_pass", "form:high_pass", "form:band_stop"),
    *("form:simulated_resonance", "form:simulated_source", "form:simulated_spikes"),
)
SIZES = [k for k in EFFECTS if kinds.KINDS[k].group in ("mechanism", "outside", "form") and k not in UNSIZED]


@pytest.mark.statistical
@pytest.mark.parametrize("kind", [*SIZES, "pair:bursts_not_spikes"])
def test_oracle_ratio_has_the_claimed_mean(kind):
    """Mean of 8 log likelihood ratios at 60 nats, within 6 standard errors of the normal law and 8 %.

    Of a signal it is half the whitened energy; of what a simulation of few samples hides, the divergence from the base.
    """
    runs = 8
    effects = [make_case(kind, 60.0, 100 + s, n_samples=N).truth["effects"][0] for s in range(runs)]
    ratios, claimed = (np.mean([e[key] for e in effects]) for key in ("oracle_llr", "oracle_nats"))
    assert claimed >= 60 * (1 - 1e-6)
    assert abs(ratios - claimed) < 4 * 1.5 * np.sqrt(2 * claimed / runs) + 0.08 * claimed


@pytest.mark.parametrize("share", [0.5, 1.0, 4.0, np.inf])
def test_comparison_is_what_the_best_fit_of_both_records_leaves(share):
    """Expected log ratio of two records with their own variances over one with the pooled one, by 4e5 ordinates."""
    rng, n, ratio = np.random.default_rng(3), 4000, 1.1
    after, before = np.full((1, n), ratio), np.ones((1, n))
    told = likelihood.comparison(after, before, share)[0]
    if np.isinf(share):
        assert told == likelihood.divergence(after, before)[0]
        return
    other = int(share * n)
    found = []
    for _ in range(100):
        x, y = np.sqrt(ratio) * rng.standard_normal(n), rng.standard_normal(other)
        both = (ratio * n + other) / (n + other)
        logs = (x**2 / both - x**2 / ratio + np.log(both / ratio)).sum() + (y**2 / both - y**2 + np.log(both)).sum()
        found.append(logs / 2)
    assert abs(np.mean(found) - told) < 5 * np.std(found) / 10


@pytest.mark.parametrize("share", [1.0, 4.0, np.inf])
def test_common_mode_has_the_size_of_a_comparison_of_matrices(share):
    table = bench.Bench(consumer_base(np.random.default_rng(0), 200.0), 1024, np.random.default_rng(1), share)
    part = kinds.KINDS["common_mode"].effects[0](table, 60.0)
    gain = np.zeros(6)
    gain[list(part.sensors)] = part.parameters["gain"]["per_sensor"]
    before = table.spectrum.T[:, :, None] * np.eye(6)
    after = before + gain[:, None] * gain - np.diag(gain**2)

    def log_det(matrices):
        return np.linalg.slogdet(matrices)[1].sum()

    if np.isinf(share):
        told = (log_det(before) - log_det(after)) / 2
    else:
        both = (after + share * before) / (1 + share)
        told = ((1 + share) * log_det(both) - log_det(after) - share * log_det(before)) / 2
    assert told == pytest.approx(60.0, rel=1e-6)


def test_tone_stands_out_by_its_amplitude():
    case = make_case("vibration_tone", 300.0, 2, n_samples=N)
    (effect,) = case.truth["effects"]
    for sensor, amplitude in zip(effect["sensors"], effect["parameters"]["amplitude"]["per_sensor"], strict=True):
        t = np.arange(N) / case.recording["fs"]
        x = case.recording["gyro"][sensor]
        seen = 2 * abs(np.mean((x - x.mean()) * np.exp(-2j * np.pi * effect["frequency_hz"] * t)))
        assert abs(seen - amplitude) < 5 * np.std(x) * np.sqrt(2 / N)


def test_tone_bound_is_that_of_one_sinusoid():
    """Var omega = 24 S/(a^2 T^3), S the density at the tone."""
    base = consumer_base(np.random.default_rng(0), 200.0)
    table = bench.Bench(base, N, np.random.default_rng(0))
    tone = np.zeros((6, N))
    tone[2] = 0.01 * np.cos(2 * np.pi * 0.2 * np.arange(N) + 1.0)
    expected = np.sqrt(24 * table.spectrum[2, int(0.4 * N)] / (0.01**2 * N**3)) * 200.0 / (2 * np.pi)
    assert table.frequency_sd(tone) == pytest.approx(expected, rel=1e-3)


def test_spikes_have_heavy_tails_and_bare_rounding_a_lattice():
    spiky = make_case("spikes_bus", 1000.0, 1, n_samples=N)
    named = spiky.truth["effects"][0]["sensors"]
    tails = kurtosis(np.diff(spiky.recording["gyro"], axis=1), axis=1)
    others = [i for i in range(6) if i not in named]
    assert tails[named].min() > 0.3
    assert all(abs(tails[i]) < 0.3 for i in others)

    case = make_case("quantization_bare", None, 1, n_samples=N)
    step = case.truth["effects"][0]["parameters"]["lsb"]["value"]
    steps = case.recording["gyro"] / step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


def test_hidden_lattice_shows_in_the_characteristic_function_only():
    case = make_case("quantization", 3000.0, 4, n_samples=N)
    (effect,) = case.truth["effects"]
    turns = 2j * np.pi / effect["parameters"]["lsb"]["value"]
    power = N * np.abs(np.mean(np.exp(turns * case.recording["gyro"]), axis=1)) ** 2
    named = np.isin(np.arange(6), effect["sensors"])
    assert power[named].min() > 20
    assert np.all(power[~named] < 12)
    assert len(np.unique(case.recording["gyro"])) == 6 * N


def test_clipping_dead_band_and_repeats_are_counted():
    """Altered samples over 20 seeds: Poisson with the claimed mean, within 4 standard deviations."""
    found = {"clipping": 0, "dead_band": 0, "stuck_samples": 0}
    for seed in range(20):
        x = make_case("clipping", 30.0, seed, n_samples=N).recording["gyro"]
        found["clipping"] += sum(
            count for row in x for count in (np.sum(row == row.max()), np.sum(row == row.min())) if count > 1
        )
        found["dead_band"] += np.sum(make_case("dead_band", 30.0, seed, n_samples=N).recording["gyro"] == 0)
        x = make_case("stuck_samples", 30.0, seed, n_samples=N).recording["gyro"]
        same = np.any(np.diff(x, axis=1) == 0, axis=0)
        found["stuck_samples"] += np.sum(same[1:] & ~same[:-1]) + same[0]
    for name, count in found.items():
        assert abs(count - 600) < 4 * np.sqrt(600) + 0.1 * 600, name


def test_box_follows_the_heat_equation():
    time = np.arange(2000) / 10.0
    expected = 20 + 8 * (1 - np.exp(-(time + 0.1) / 25))
    np.testing.assert_allclose(thermal.box(np.full(2000, 20.0), 10.0, 8.0, 25.0), expected, rtol=1e-12)


def test_a_relay_that_turns_once_is_a_step():
    for seed, alike in ((707, ["hysteresis", "step"]), (700, ["hysteresis"])):
        assert cases.make_case("outside:hysteresis", 100.0, seed).truth["effects"][0]["class"] == alike


def test_alias_and_constant_rate_leave_nothing_to_find():
    case = make_case("blind:alias", None, 3, n_samples=N)
    (effect,) = case.truth["effects"]
    turn = np.exp(-2j * np.pi * effect["frequency_hz"] / case.recording["fs"] * np.arange(N))
    ours, theirs = (np.abs(x @ turn) for x in (case.recording["gyro"], case.simulation["gyro"]))
    for sensor in effect["sensors"]:
        assert abs(ours[sensor] - theirs[sensor]) < 5 * np.sqrt(N) * case.recording["gyro"][sensor].std()
    constant = make_case("blind:constant_rate", None, 3, n_samples=N)
    assert np.ptp(constant.recording["reference_rate"]) == 0
