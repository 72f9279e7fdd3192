"""Weak outliers, small changes of level and dead bands: mean likelihood ratios against naive twins, what is found."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from mismatch_draws import LEVEL, even, nominated, normal
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse import WhiteNoise
from gyrofuse.mismatch.detectors.values import quantisation_grid as lattices
from gyrofuse.mismatch.detectors.values.ties import band_of, recurring
from gyrofuse.mismatch.detectors.values.values import values_test
from gyrofuse.mismatch.detectors.variance import weak_outliers as shocks
from gyrofuse.mismatch.detectors.variance.noise_level import compared_levels, level_between, whitened_recording
from gyrofuse.mismatch.diagnose import diagnose
from gyrofuse.mismatch.likelihoods.laws.outlier_law import Outliers, fitted_shock, shock_posterior, shock_scores
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.regimes.spikes import Spikes
from gyrofuse.mismatch.mechanisms.regimes.variance_change import VarianceChange
from gyrofuse.mismatch.mechanisms.values.rounding.dead_band import DeadBand
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.selection.held_out import score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import sd_of_sum
from gyrofuse.mismatch.stats import level_scan
from gyrofuse.mismatch.stats import segments as episodes
from gyrofuse.mismatch.stats.multiplicity import SHARES, e_value_of_some

N, RATE = 16384, 100.0
SCENE = RecordingInfo(RATE, "deg/s", ("x", "y", "z"))


def drawn(seed: int) -> tuple[Tensor, Tensor, torch.Generator]:
    g = torch.Generator().manual_seed(seed)
    noise = WhiteNoise(1.0)
    return noise.simulate(N, batch=(3,), generator=g), noise.simulate(N, batch=(2, 3), generator=g), g


def covers(found: Finding, name: str, truth: float) -> bool:
    return found.parameters[name].low <= truth <= found.parameters[name].high


# Outliers.


def test_ratios_of_outliers_are_products_over_samples_and_sets() -> None:
    g = torch.Generator().manual_seed(0)
    z, size = normal(3, 800, g=g), 2.7
    z[:, ::100] += 3.0
    rates = torch.tensor([0.005, 0.02], dtype=torch.float64)
    mine = shocks._log_ratios(z, size, rates)
    for k, p in enumerate(rates.tolist()):
        for members in range(1, 8):
            own = z.numpy()[[i for i in range(3) if members >> i & 1]]
            ratio = (np.cosh(size * own) * math.exp(-(size**2) / 2)).prod(0)
            # Two terms of a series stand for the many small ones.
            assert float(mine[k, members]) == pytest.approx(np.log1p(p * (ratio - 1)).sum(), abs=0.02)


def test_nothing_is_seen_in_noise_even_if_sensors_share_it() -> None:
    false = 0
    for seed in range(30):
        g = torch.Generator().manual_seed(seed)
        z = normal(4, 4096, g=g) + 0.7 * normal(1, 4096, g=g)
        false += shocks.weak_outliers(z / z.std(-1, keepdim=True)).p_value < 0.05
    assert stats.binom.sf(6, 30, 0.05) < 1e-3
    assert false <= 6


@pytest.mark.statistical
def test_shocks_too_weak_for_any_sensor_alone_are_named() -> None:
    named = inside = 0
    for seed in range(6):
        recording, simulation, g = drawn(100 + seed)
        hit = (even(1, N, g=g) < 3e-3) & torch.tensor([[True], [False], [True]])
        recording = recording + hit * 3.0 * (even(3, N, g=g) - 0.5).sign()
        comparison = Comparison.of(SCENE, recording, simulation)
        found = Spikes.detect_and_fit(comparison, LEVEL)
        if found is None:
            continue
        assert isinstance(found.effect, Spikes)
        named += found.sensors == (0, 2) and found.effect.together
        inside += covers(found, "rate", 3e-3 * RATE * 3600) if found.effect.together else 0
        gain = score_held_out(comparison, found.effect)
        assert gain.total > sd_of_sum(gain.blocks)
        if not seed:
            assert Spikes.detect_and_fit(found.effect.repair(comparison, g), LEVEL) is None
    assert named >= 5
    # Fewer than 4 of 6 at 95 % have probability 2e-3.
    assert inside >= 4


def test_a_fit_of_shocks_recovers_them_and_says_which_samples_are_hit() -> None:
    g = torch.Generator().manual_seed(3)
    hit = even(1, N, g=g) < 4e-3
    z = normal(3, N, g=g) + hit * 4.0 * (even(3, N, g=g) - 0.5).sign()
    start = [Outliers(1e-3, 2.7, 0.3)] * 3
    laws = fitted_shock(z, start, 40)
    for law in laws:
        for value, (_, high), truth in (
            (law.amplitude, law.amplitude_limits, 4.0),
            (law.rate, law.rate_limits, 4e-3),
        ):
            assert abs(math.log(truth / value)) < 2 * math.log(high / value)  # limits are at 2 sd
    said = shock_posterior(z, laws) > 0.5
    assert int((said != hit[0]).sum()) < 0.05 * int(hit.sum()) + 3
    assert float(shock_scores(z, laws).sum()) > float(shock_scores(z, start).sum())


# Levels.


@pytest.mark.parametrize("referred", [False, True])
def test_the_scan_of_levels_is_the_mean_over_stretches_and_factors(referred: bool) -> None:
    g = torch.Generator().manual_seed(4)
    squares, other = normal(2, 64, g=g).square(), normal(2, 100, g=g).square()
    reference = level_scan.Reference(other.mean(-1) / squares.mean(-1), 100.0) if referred else None
    energy = (squares.sum(-1, keepdim=True) + referred * other.sum(-1, keepdim=True)).numpy()
    x, observed, n = squares.numpy() / energy, 64, 164 if referred else 64

    def mean_ratio(m: int, starts: range) -> float:
        reach = np.minimum(level_scan._DEVIATIONS.numpy() * math.sqrt(2 / m + 2 / (n - m)), math.log(30))
        ratios = []
        for log_r, a in itertools.product([*reach, *-reach], starts):
            share = x[:, a : a + m].sum(-1)
            one = math.exp(-m / 2 * log_r) * (1 - share + share * math.exp(-log_r)) ** (-n / 2)
            ratios.append(np.mean([(1 - e + e * one).prod() for e in SHARES]))
        return float(np.mean(ratios))

    lengths = sorted({round(2 ** (k / 2)) for k in range(11)})
    by_length = [mean_ratio(m, range(0, observed - m + 1, max(m // 8, 1))) for m in lengths]
    found = level_scan.scanned_levels(squares, reference)
    assert found.log_ratio == pytest.approx(math.log(np.mean(by_length)), abs=1e-9)
    if reference is not None:
        throughout = level_scan.other_level(observed, reference)
        assert throughout == pytest.approx(math.log(mean_ratio(observed, range(1))), abs=1e-9)


def test_the_simulated_level_counts_as_samples_outside_of_episodes() -> None:
    g = torch.Generator().manual_seed(5)
    white, other = normal(2, 400, g=g), normal(2, 300, g=g)
    white[:, 100:200] *= 1.7
    reference = level_scan.Reference(other.square().mean(-1) / white.square().mean(-1), 300.0)
    inside, both = torch.arange(400).div(100, rounding_mode="floor") == 1, torch.cat([white, other], -1)
    within = torch.nn.functional.pad(inside, (0, 300))
    for mine, whole in zip(
        episodes.log_factors(white.square(), inside, reference),
        episodes.log_factors(both.square(), within, None),
        strict=True,
    ):
        np.testing.assert_allclose(mine, whole, rtol=1e-12)
    factor = torch.tensor([2.0, 1.0], dtype=torch.float64)
    scores = episodes.two_level_scores(both, factor, within)[:, :400]
    torch.testing.assert_close(episodes.two_level_scores(white, factor, inside, reference), scores)


def test_the_simulated_level_tells_of_long_episodes() -> None:
    """Two fifths of the record: the rest tells 0.6 of what is to be told of its level, with the simulation 0.87."""
    beside, alone = 0.0, 0.0
    for seed in range(6):
        recording, simulation, _ = drawn(500 + seed)
        recording[:, 5000:11500] *= math.sqrt(1.1)
        comparison = Comparison.of(SCENE, recording, simulation)
        levels = compared_levels(comparison)
        assert levels is not None
        assert levels.p_value < 1e-4
        beside += levels.scan.log_ratio
        alone += level_scan.scanned_levels(whitened_recording(comparison).square()).log_ratio
        found = nominated(comparison, VarianceChange)
        assert len(found.sensors) >= 2  # each tells 9 nats: all three do in 9 of 10
        assert found.alternatives == ()
    assert beside > 1.2 * alone


def test_another_level_throughout_is_no_episode() -> None:
    for seed in range(6):
        recording, simulation, _ = drawn(600 + seed)
        comparison = Comparison.of(SCENE, recording * math.sqrt(1.06), simulation)
        levels = compared_levels(comparison)
        assert levels is not None
        assert levels.throughout > levels.scan.log_ratio + 5
        assert levels.p_value == 1.0
        assert VarianceChange.detect_and_fit(comparison, LEVEL) is None
        inside = torch.arange(N) < N // 3
        assert level_between(comparison, inside) is None
        assert level_between(comparison.with_recording(recording), inside) is not None


@pytest.mark.statistical
def test_a_level_that_changes_by_little_in_several_sensors_is_named() -> None:
    found_all = 0
    for seed in range(6):
        recording, simulation, _ = drawn(200 + seed)
        recording[:, 5000:9000] *= math.sqrt(1.13)
        found = VarianceChange.detect_and_fit(Comparison.of(SCENE, recording, simulation), LEVEL)
        found_all += found is not None and covers(found, "start", 50.0) and covers(found, "stop", 90.0)
        assert VarianceChange.detect_and_fit(Comparison.of(SCENE, drawn(300 + seed)[0], simulation), LEVEL) is None
    # Start and stop of six at 95 % each: fewer than 4 have probability 2e-3.
    assert found_all >= 4


def test_the_level_that_the_simulation_has_is_the_rule() -> None:
    """Louder for five eighths of the record: the rest would be a quiet episode, were there no simulation."""
    recording, simulation, _ = drawn(250)
    recording[:, 4096:14336] *= math.sqrt(1.3)
    found = nominated(Comparison.of(SCENE, recording, simulation), VarianceChange)
    assert found.sensors == (0, 1, 2)
    assert covers(found, "start", 40.96)
    assert covers(found, "stop", 143.36)
    assert all(found.parameters[f"factor[{i}]"].value > 1.1 for i in range(3))


@pytest.mark.statistical
def test_what_a_shorter_simulation_cannot_show_is_not_found_again() -> None:
    recording, simulation, g = drawn(700)
    recording[:, 5000:11000] *= 1.2
    report = diagnose(recording, simulation[0, :, : N // 2], generator=g)
    assert [f.mechanism for f in report.findings].count("variance_change") == 1


# Dead bands.


def test_a_dead_band_is_found_among_values_that_do_not_recur() -> None:
    inside, half_width = 0, 8e-4
    for seed in range(8):
        recording, simulation, g = drawn(400 + seed)
        recording[:2][recording[:2].abs() < half_width] = 0.0
        comparison = Comparison.of(SCENE, recording, simulation)
        found = nominated(comparison, Quantization)
        assert isinstance(found.effect, DeadBand)
        assert (found.mechanism, found.sensors) == ("quantization", (0, 1))
        inside += covers(found, "dead_band[0]", half_width) + covers(found, "dead_band[1]", half_width)
        gain = score_held_out(comparison, found.effect)
        assert gain.total > sd_of_sum(gain.blocks)
        after = found.effect.repair(comparison, g)
        assert values_test(after).p_value > 0.001
    # Fewer than 12 of 16 at 95 % have probability 9e-4.
    assert inside >= 12


def test_one_return_to_a_value_known_from_another_sensor_is_proof() -> None:
    recording, simulation, _ = drawn(450)
    recording[0][recording[0].abs() < 8e-4] = 0.0
    recording[1, int(recording[1].abs().argmin())] = 0.0
    assert int((recording[0] == 0).sum()) >= 4
    assert nominated(Comparison.of(SCENE, recording, simulation), Quantization).sensors == (0, 1)


def test_a_value_filled_in_is_no_dead_band() -> None:
    recording, simulation, g = drawn(500)
    recording[0, even(N, g=g) < 1e-3] = 0.0
    comparison = Comparison.of(SCENE, recording, simulation)
    assert values_test(comparison).p_value < 1e-6
    assert Quantization.detect_and_fit(comparison, LEVEL) is None


def test_values_of_single_precision_return_by_chance_alone() -> None:
    for seed in range(10):
        recording, simulation, _ = drawn(600 + seed)
        comparison = Comparison.of(SCENE, recording.float().double(), simulation)
        assert values_test(comparison).p_value > 0.01
        assert Quantization.detect_and_fit(comparison, LEVEL) is None


def test_limits_of_a_band_follow_from_the_nearest_value_left() -> None:
    away = torch.linspace(0.01, 1.0, 500, dtype=torch.float64)
    returns = torch.tensor([0.0, 0.5] * 5, dtype=torch.float64)
    values = torch.cat([away, -1.2 * away, returns])
    own = recurring(0, values, 0.0)
    assert own is not None
    assert (own.times, own.below, own.above) == (5, pytest.approx(-0.012), pytest.approx(0.01))
    q = stats.f.ppf([0.975, 0.5, 0.025], 2, 10)
    low, middle, high = 0.01 / (1 + q / 5)
    band = band_of(own, values, float(values.std()))
    assert band is not None
    assert (band.half_width, band.low, band.high) == pytest.approx((middle, low, high))
    assert not band.subtracts
    assert band_of(own._replace(times=40, samples=40), values, float(values.std())) is None


# Hidden lattices.


def test_a_hidden_lattice_is_built_in_without_other_power() -> None:
    g = torch.Generator().manual_seed(7)
    x = normal(3, 200_000, g=g)
    numbers = (torch.tensor(v, dtype=torch.float64) for v in ([1.0, 0.0, 1.0], [0.2, 0.0, 0.0], [0.3, 0.0, 0.0]))
    effect = Quantization(*numbers, x.mean(-1))
    y = effect.apply(x, SCENE, g)
    turn = torch.exp(2j * math.pi * (y[0] - 0.2)).mean().abs()
    assert float(turn) == pytest.approx(math.exp(-2 * math.pi**2 * 0.09), rel=0.03)
    assert float((y[0] - x[0]).square().mean()) < 0.4 / 12
    assert torch.equal(y[1], x[1])
    assert torch.equal(y[2], x[2].round())


@pytest.mark.parametrize("bias", [0.0, 0.5])
def test_a_coarse_hidden_lattice_makes_of_noise_what_it_does_at_the_recording_s_bias(bias: float) -> None:
    """Of noise of 0.4 steps a bias between two steps makes two values, and one on a step mostly one.

    The simulation has the level that there is on average over all biases.
    """
    g = torch.Generator().manual_seed(9)
    made = (0.4 * normal(1, 200_000, g=g) + bias).round() + 0.4 * normal(1, 200_000, g=g)
    one = torch.ones(1, dtype=torch.float64)
    effect = Quantization(one, 0 * one, 0.4 * one, made.mean(-1))
    level = math.sqrt(2 * 0.4**2 + 1 / 12)
    y = effect.apply(level * normal(1, 200_000, g=g) + 17.3, RecordingInfo(RATE, "deg/s", ("x",)), g)
    assert float(y.mean()) == pytest.approx(17.3, abs=0.02)
    physical, mine = (float((v - v.mean()).pow(4).mean() / v.var() ** 2) for v in (made, y))
    assert (physical < 2.8) == (bias == 0.5)
    assert mine == pytest.approx(physical, abs=0.06)
    assert float(y.var() / made.var()) == pytest.approx(1.0, abs=0.02)


@pytest.mark.statistical
def test_a_hidden_lattice_of_one_sensor_is_looked_for_in_the_others() -> None:
    """The second has n exp(-4 pi^2 blur^2) = 6 nats, where a search of all steps would want 14; the third has none."""
    found = []
    for seed in range(10):
        g = torch.Generator().manual_seed(seed)
        recording, simulation = normal(3, 16384, g=g), normal(4, 3, 16384, g=g)
        for i, blur in ((0, 0.35), (1, 0.4475)):
            recording[i] = recording[i].round() + blur * normal(16384, g=g)
        level = recording.std(-1, keepdim=True)
        found.append(nominated(Comparison.of(SCENE, recording, simulation * level), Quantization).sensors)
    assert all(0 in sensors for sensors in found)
    # Power beyond 3.9 has a chance of 0.78, or of 0.02: fewer than 5 of 10 have probability 8e-3, more than 2 9e-4.
    assert sum(1 in sensors for sensors in found) >= 5
    assert sum(2 in sensors for sensors in found) <= 2


@pytest.mark.statistical
def test_a_hidden_lattice_that_no_sensor_shows_alone_is_seen_in_all_of_them_together() -> None:
    """Each of six has 5 nats, n exp(-4 pi^2 blur^2 V / (V + blur^2)), V = 13/12, where a search would want 14."""
    alone, together, nothing = [], [], []
    for seed in range(10):
        g = torch.Generator().manual_seed(seed)
        rounded = normal(6, 16384, g=g).round() + 0.5 * normal(6, 16384, g=g)
        plain, simulation = normal(6, 16384, g=g), normal(2, 6, 16384, g=g)
        info = RecordingInfo(RATE, "deg/s", tuple("abcdef"))
        comparison = Comparison.of(info, rounded, simulation * rounded.std())
        rows, sd = [row.unique() for row in rounded], lattices.core_sd(comparison.observed)
        alone.append(min(lattices._hidden_step([row], one[None]).p_value for row, one in zip(rows, sd, strict=True)))
        together.append(lattices.missing_lattices(comparison, LEVEL).p_value)
        nothing.append(lattices.missing_lattices(Comparison.of(info, plain, simulation), LEVEL).p_value)
        step = lattices._hidden_step(rows, sd).step
        assert together[-1] > LEVEL or step == pytest.approx(1.0, abs=0.06)
    assert sum(p < LEVEL for p in together) >= 9
    assert sum(p < LEVEL for p in alone) <= 5
    assert sum(p < 0.05 for p in nothing) <= 3  # four of ten have probability 1e-3


@pytest.mark.statistical
@pytest.mark.parametrize("kind", ["an episode", "half and half", "outliers", "heavy tails", "common noise"])
def test_noise_that_is_no_gaussian_of_one_sd_is_no_lattice(kind: str) -> None:
    """Its quiet or middle part has a characteristic function that reaches further than its variance says."""
    for seed in range(4):
        g = torch.Generator().manual_seed(60 + seed)
        x, simulation = normal(6, 65536, g=g), normal(1, 6, 65536, g=g)
        if kind == "an episode":
            x[:, 20_000:33_000] *= 3.0
        elif kind == "half and half":
            x[:, 32_768:] *= 2.0
        elif kind == "outliers":
            x = torch.where(even(6, 65536, g=g) < 0.01, 10 * x.sign(), x)
        elif kind == "heavy tails":
            x = x / (normal(5, 6, 65536, g=g).square().mean(0)).sqrt()
        else:
            x = math.sqrt(0.05) * x + math.sqrt(0.95) * normal(1, 65536, g=g)
        comparison = Comparison.of(RecordingInfo(RATE, "deg/s", tuple("abcdef")), x, simulation * x.std())
        assert lattices.missing_lattices(comparison, LEVEL).p_value > 0.01


def test_a_trace_is_no_lattice_beside_hidden_ones_and_exact_ones_are_no_measure() -> None:
    hidden = [lattices.Lattice(1.0, 0.0, 0.4, math.exp(-n), 6.0) for n in (200.0, 100.0, 4.2, 20.0)]
    exact = lattices.Lattice(1.0, 0.0, 0.0, 0.0)
    kept = lattices._as_large({0: exact, 1: hidden[0], 2: hidden[1], 3: hidden[2], 4: hidden[3]})
    assert sorted(kept) == [0, 1, 2, 4]
    assert sorted(lattices._as_large({0: exact, 1: exact, 2: hidden[3]})) == [0, 1, 2]


def test_the_ratio_of_a_lattice_that_some_sensors_have_has_mean_one() -> None:
    g = torch.Generator().manual_seed(12)
    power = -torch.rand(3, 200_000, generator=g, dtype=torch.float64).log()
    x = 2 * (2.0 * power).sqrt()
    own = x - 2.0 + torch.special.i0e(x).log()
    assert float(own.exp().mean()) == pytest.approx(1.0, abs=0.03)
    e = torch.tensor(SHARES, dtype=torch.float64)[:, None, None]
    naive = (1 - e + e * own.exp()).prod(1).mean(0).log()
    torch.testing.assert_close(e_value_of_some(own), naive)


@pytest.mark.statistical
@pytest.mark.parametrize("share", [0.5, 1, 1.5, 2])
def test_a_strong_episode_is_the_only_difference_whatever_the_simulation_s_length(share: float):
    """It lies at the same share of a longer or shorter simulation, and other witnesses look at noise without it."""
    noise, n = gf.WhiteNoise(1e-4) + gf.AR1(0.99, 1e-7), 32_768
    at = torch.arange(n)
    loud = torch.where((at >= 9000) & (at < 14_000), 1.3, 1.0)
    signal = noise.simulate(n, batch=(3,), generator=torch.Generator().manual_seed(1)) * loud
    simulation = noise.simulate(round(share * n), batch=(3,), generator=torch.Generator().manual_seed(2))
    report = gf.diagnose(gf.Recording(signal, rate=100.0), gf.Recording(simulation, rate=100.0))
    assert [f.mechanism for f in report.findings] == ["variance_change"]
    assert report.unexplained == ()
    told = report.findings[0].parameters
    assert told["start"].value == pytest.approx(90.0, abs=0.5)
    assert told["stop"].value == pytest.approx(140.0, abs=0.5)
    assert all(told[f"factor[{i}]"].value == pytest.approx(1.69, rel=0.08) for i in range(3))


@pytest.mark.statistical
def test_strong_noise_that_goes_up_and_down_is_no_episode():
    n = 32_768
    t = torch.arange(n, dtype=torch.float64)
    level = (0.5 * torch.sin(2 * torch.pi * 3.3 * t / n) + 0.2 * torch.sin(2 * torch.pi * 7.1 * t / n)).exp()
    noise = gf.WhiteNoise(1e-4)
    signal = noise.simulate(n, batch=(3,), generator=torch.Generator().manual_seed(1)) * level
    report = gf.diagnose(gf.Recording(signal, rate=100.0), noise)
    assert [f.mechanism for f in report.findings] == ["variance_change"]
    assert not {"start", "stop"} & set(report.findings[0].parameters)
    assert "bit by bit" in str(report)
    assert "variance" in [entry.test for entry in report.unexplained]  # two waves are more than one
