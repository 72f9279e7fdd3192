"""Outliers, noise levels, telegraph noise: kernels against naive twins, what is found."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from mismatch_draws import LEVEL, NOISE, RATE, SCENE, N, covers, drawn, even, nominated, normal, settled
from scipy import fft, optimize, stats
from scipy.signal import butter, lfilter

from gyrofuse import AR1, RandomWalk, Recording, WhiteNoise, diagnose
from gyrofuse.mismatch.detectors.values import values as marginals
from gyrofuse.mismatch.detectors.variance import haar_kurtosis, noise_level
from gyrofuse.mismatch.detectors.variance import outliers as impulses
from gyrofuse.mismatch.likelihoods.laws import outlier_law as outliers
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.mechanisms.regimes import outlier_limits, spikes
from gyrofuse.mismatch.mechanisms.regimes.spikes import Spikes
from gyrofuse.mismatch.mechanisms.regimes.telegraph import RandomTelegraph, _path
from gyrofuse.mismatch.mechanisms.regimes.variance_change import VarianceChange
from gyrofuse.mismatch.mechanisms.simulated.spikes import SimulatedSpikes
from gyrofuse.mismatch.mechanisms.values.clipping import Clipping
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.mechanisms.values.stuck_samples import StuckSamples
from gyrofuse.mismatch.selection.discrepancy import leads_away
from gyrofuse.mismatch.signals import prediction_errors
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.folds import N_FOLDS
from gyrofuse.mismatch.signals.psd import bands
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats import segments as episodes
from gyrofuse.mismatch.stats.kurtosis import independent_values, normal_kurtosis
from gyrofuse.wavelets.haar import haar_coefficients

TESTS = (
    marginals.values_test,
    impulses.outliers_test,
    noise_level.variance_test,
    haar_kurtosis.jump_test,
)
MECHANISMS: tuple[type[Mechanism], ...] = (
    Quantization,
    Clipping,
    StuckSamples,
    Spikes,
    VarianceChange,
    RandomTelegraph,
)


# Nothing is missing.


@pytest.mark.statistical
def test_witnesses_and_nominations_are_silent_where_nothing_is_missing() -> None:
    false = np.zeros(len(TESTS))
    for seed in range(20):
        recording, simulation, _ = drawn(seed, records=1)
        comparison = Comparison.of(SCENE, recording, simulation)
        false += [witness(comparison).p_value < 0.05 for witness in TESTS]
        if seed < 6:
            assert [m.name for m in MECHANISMS if m.detect_and_fit(comparison, LEVEL) is not None] == []
    assert stats.binom.sf(5, 20, 0.05) < 5e-4
    assert (false <= 5).all(), false


def test_lines_and_a_resonance_make_neither_spikes_nor_levels() -> None:
    t = torch.arange(N, dtype=torch.float64)
    false = np.zeros(2)
    for seed in range(6):
        recording, simulation, g = drawn(100 + seed, records=1)
        poles = torch.tensor([1.0, -2 * 0.98 * math.cos(1.2), 0.98**2], dtype=torch.float64)
        impulse = torch.zeros(1024, dtype=torch.float64)
        impulse[0] = 1.0
        for k in range(1, 1024):
            impulse[k] = -poles[1] * impulse[k - 1] - (poles[2] * impulse[k - 2] if k > 1 else 0.0)
        driven = torch.fft.irfft(torch.fft.rfft(normal(3, N, g=g)) * torch.fft.rfft(impulse, n=N), n=N)
        recording = recording + 3 * torch.cos(1.931 * t + seed) + 0.8 * torch.cos(0.731 * t) + 0.1 * driven
        comparison = Comparison.of(SCENE, recording, simulation)
        false += [
            impulses.outliers_test(comparison).p_value < 0.01,
            noise_level.variance_test(comparison).p_value < 0.01,
        ]
    assert stats.binom.sf(1, 6, 0.01) < 5e-3
    assert (false <= 1).all(), false


# Outliers.


def test_whitening_is_division_by_the_smooth_spectrum_in_the_cosines() -> None:
    g = torch.Generator().manual_seed(7)
    x = normal(2, 600, g=g)
    side = Records(x[None], bands(4096))
    y = fft.dct(x.numpy(), norm="ortho")[:, 1:]
    spectrum = prediction_errors._smooth_spectrum(torch.from_numpy(y))[0].numpy()
    k, t = np.arange(1, 600)[:, None], np.arange(600)
    basis = math.sqrt(2 / 600) * np.cos(math.pi * k * (t + 0.5) / 600)
    white = (y / np.sqrt(spectrum)) @ basis
    white /= np.sort(np.abs(white))[:, 299:300] / stats.norm.ppf(0.75)  # torch's median is the lower one
    np.testing.assert_allclose(prediction_errors.left_out(side).white[0].numpy(), white, rtol=1e-9)
    np.testing.assert_allclose(spectrum[:, :32].mean(-1), np.exp(np.log(y[:, :32] ** 2).mean(-1) + 1.27), rtol=0.3)


def test_bands_of_the_smooth_spectrum_are_narrow_where_it_asks_for_it() -> None:
    y = normal(2, 2**16, g=torch.Generator().manual_seed(8))
    y[1, 20_000:20_200] *= 3.0
    spectrum, followed = prediction_errors._smooth_spectrum(y)
    quiet = spectrum[0].log()
    assert float(quiet[1000:].std()) < 0.1
    assert float(followed[0].max()) < 1.5 / 32 + 1e-9
    assert float(spectrum[1, 20_050:20_150].mean()) == pytest.approx(9.0, rel=0.3)
    assert float(spectrum[1, 21_000:22_000].mean()) == pytest.approx(1.0, rel=0.15)
    assert float(followed[1, 20_100]) == pytest.approx(1.5 / 64)


def test_an_outlier_keeps_its_size_in_the_errors_it_leaves() -> None:
    x = normal(1, 1, 4096, g=torch.Generator().manual_seed(9))
    hit = x.clone()
    at = torch.randperm(4096, generator=torch.Generator().manual_seed(10))[:50]  # at even steps they would make lines
    hit[..., at] += 4.0
    found = prediction_errors.left_out(Records(hit, bands(4096)))
    assert float((found.error[0, 0, at] - x[0, 0, at]).mean()) == pytest.approx(4.0, abs=0.1)


def test_isolated_outliers_are_spikes() -> None:
    recording, simulation, g = drawn(8)
    hit = even(3, N, g=g) < 2e-3
    hit[1] = False
    recording = recording + hit * 7.0 * (even(3, N, g=g) - 0.5).sign()
    comparison = Comparison.of(SCENE, recording, simulation)
    found = nominated(comparison, Spikes)
    assert found.sensors == (0, 2)
    assert found.alternatives == ()
    assert "not at the same time" in found.sentence
    assert covers(found, "amplitude[0]", 7.0)
    assert covers(found, "rate[0]", 2e-3 * RATE * 3600)
    after = settled(comparison, found, g)
    assert impulses.outliers_test(after).p_value > 0.001
    assert float(found.effect.remove(recording, SCENE).abs().max()) < 6.0


def test_a_sensor_that_speaks_against_the_outliers_of_a_bus_is_left_out() -> None:
    """Its own law, of many faint ones, would gain some nats; under that of the others it has none of theirs."""
    recording, simulation, g = drawn(11)
    hit = even(3, N, g=g) < 2e-3
    hit[1] = False
    sign = (even(3, N, g=g) - 0.5).sign()
    recording = recording + hit * 6.0 * sign
    recording[1] += 1.6 * (even(N, g=g) < 0.02) * sign[1]
    z = prediction_errors.left_out(Comparison.of(SCENE, recording, simulation).observed).z[0]
    laws = [outliers.fitted(row) for row in z]
    assert float((outliers.mixture(z[1], laws[1]) - outliers.free_gaussian(z[1])).sum()) > 4
    assert nominated(Comparison.of(SCENE, recording, simulation), Spikes).sensors == (0, 2)


def test_a_law_that_takes_half_of_the_noise_for_outliers_does_not_tell_its_sd() -> None:
    z, law = normal(3, N, g=torch.Generator().manual_seed(5)), outliers.Outliers(2e-3, 6.0, 0.5)
    z[:2] += law.height * (even(2, N, g=torch.Generator().manual_seed(6)) < law.rate)
    wild = outliers.Outliers(0.4, 1.2, 0.3, 0.5)
    for third in (outliers.Outliers.none(), wild):
        shared = spikes._shared(z, [law, law, third], (0, 1))
        assert [one.scale for one in shared] == pytest.approx([1, 1, 1], abs=0.02)
        assert [one.height for one in shared] == pytest.approx([6, 6, 6], rel=0.1)


@pytest.mark.parametrize("tone", [0.0, 5.0])
def test_outliers_near_the_ends_are_taken_off_and_none_is_put_there(tone: float) -> None:
    """Also where a steep walk or a tone makes lines, whose skirts reach the ends."""
    g = torch.Generator().manual_seed(12)
    walk = (WhiteNoise(1.0) + RandomWalk(4e-3)).simulate(N, batch=(3,), generator=g)
    clean = walk + tone * torch.cos(0.7 * torch.arange(N, dtype=torch.float64))
    hit = torch.zeros(3, N, dtype=torch.bool)
    hit[:2, [50, 120, 200, 5000, N - 184, N - 84]] = True
    spiky = clean + 12.0 * hit
    assert not torch.equal(prediction_errors.left_out(Records(spiky[None], bands(N))).at_ends,
                           prediction_errors.left_out(Records(spiky[None], bands(N))).error)  # fmt: skip
    rate = torch.tensor([3e-4, 3e-4, 0.0], dtype=torch.float64)
    effect = Spikes(rate, torch.full_like(rate, 12.0), torch.full_like(rate, 1.0), together=False)
    change = (effect.remove(spiky, SCENE) - clean).abs()
    assert float(change[~hit].max()) == 0.0
    assert float(change[hit].max()) < 6.0


def test_outliers_in_all_sensors_at_once_are_a_shock() -> None:
    recording, simulation, g = drawn(9)
    hit = even(1, N, g=g) < 2e-3
    comparison = Comparison.of(SCENE, recording + hit * 5.0 * (even(3, N, g=g) - 0.5).sign(), simulation)
    found = nominated(comparison, Spikes)
    assert found.sensors == (0, 1, 2)
    assert isinstance(found.effect, Spikes)
    assert found.effect.together
    reference = found.effect.apply(torch.zeros(3, N, dtype=torch.float64), SCENE, g)
    assert torch.equal(reference[0] != 0, reference[1] != 0)


@pytest.mark.statistical
@pytest.mark.parametrize(("height", "rate"), [(5.0, 3e-3), (3.2, 2e-3)])
def test_limits_of_rate_and_amplitude_hold(height: float, rate: float) -> None:
    inside = np.zeros(2)
    for seed in range(20):
        g = torch.Generator().manual_seed(seed)
        z = 1.003 * normal(N, g=g) + (even(N, g=g) < rate) * height * (even(N, g=g) - 0.5).sign()
        law = outlier_limits.with_limits(z, outliers.fitted(z))
        sides = ((law.rate_limits, rate), (law.amplitude_limits, height))
        inside += [low < truth < high for (low, high), truth in sides]
        assert law.rate_limits[0] < law.rate < law.rate_limits[1]
        assert law.amplitude_limits[0] < law.amplitude < law.amplitude_limits[1]
    # Fewer than 15 of 20 at 95 % have probability 3e-4.
    assert (inside >= 15).all(), inside


def test_a_limit_is_where_the_likelihood_at_best_is_lower_by_what_95_per_cent_allow() -> None:
    g = torch.Generator().manual_seed(5)
    z = normal(4096, g=g) + (even(4096, g=g) < 5e-3) * 4.0 * (even(4096, g=g) - 0.5).sign()
    law = outlier_limits.with_limits(z, outliers.fitted(z))
    sample = outliers.Sample(z)

    def lowest(rate: float) -> float:
        runs = [
            optimize.minimize(
                lambda rest: sample.deviance([math.log(rate), *rest])[0],
                [math.log(law.amplitude), start, 0.0],
                method="Nelder-Mead",
                options={"maxiter": 2000},
            )
            for start in (-2.0, -0.5)
        ]
        return min(float(run.fun) for run in runs)

    for limit in law.rate_limits:
        assert lowest(limit) - lowest(law.rate) == pytest.approx(1.92, abs=0.25)  # limits are found to 2 %


def test_slopes_of_the_likelihood_of_outliers_are_its_differences() -> None:
    g = torch.Generator().manual_seed(8)
    sample = outliers.Sample(normal(4096, g=g) + (even(4096, g=g) < 1e-2) * 5.0)
    for theta in ([-5.0, 1.5, -1.5, 0.01], [-2.0, 0.3, -0.2, -0.04]):
        total, slopes = sample.deviance(theta)
        law = outliers.law_of(theta)
        beforehand = (math.log(law.spread / law.height / 0.2) / 0.8) ** 2 / 2
        plain = -float((sample.counts * outliers.mixture(sample.values, law)).sum())
        assert total == pytest.approx(beforehand + plain, rel=1e-12)
        expected = optimize.approx_fprime(np.array(theta), lambda point: sample.deviance(point)[0], 1e-6)
        np.testing.assert_allclose(slopes, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


def test_what_is_held_of_the_spread_yields_to_many_outliers() -> None:
    g = torch.Generator().manual_seed(6)
    hit = even(N, g=g) < 1e-2
    z = normal(N, g=g) + hit * (12.0 + 8.0 * normal(N, g=g)) * (even(N, g=g) - 0.5).sign()
    law = outliers.fitted(z)
    assert law.spread == pytest.approx(8.0, rel=0.25)


def test_the_law_of_outliers_is_normalised() -> None:
    z = torch.linspace(-60, 60, 240001, dtype=torch.float64)
    density = outliers.mixture(z, outliers.Outliers(0.2, 5.0, 2.0)).exp()
    assert float(torch.trapezoid(density, z)) == pytest.approx(1, abs=1e-9)


# Levels of noise.


@pytest.mark.statistical
def test_a_louder_episode_is_a_change_of_variance() -> None:
    onset = 0
    for seed in range(6):
        recording, simulation, g = drawn(20 + seed, records=2)
        start, stop = 5000 + 211 * seed, 8500 + 211 * seed
        recording[:2, start:stop] += normal(2, stop - start, g=g)
        comparison = Comparison.of(SCENE, recording, simulation)
        found = nominated(comparison, VarianceChange)
        assert found.sensors == (0, 1)
        onset += covers(found, "start", start / RATE) + covers(found, "stop", stop / RATE)
        assert found.time_s == pytest.approx(start / RATE, abs=1.0)
        assert Spikes.detect_and_fit(comparison, LEVEL) is None
        if seed < 1:
            settled(comparison, found, g)
    # Fewer than 8 of 12 at 95 % have probability 2e-4.
    assert onset >= 8


def test_a_quiet_time_that_is_not_there_leads_away() -> None:
    recording, simulation, g = drawn(31)
    quieter = recording.clone()
    quieter[1, N // 5 :] *= 0.2
    factor = torch.ones(len(recording), dtype=torch.float64)
    factor[1] = 0.04
    effect = VarianceChange(((N / 5 / RATE, N / RATE),), factor)
    for given, away in ((recording, True), (quieter, False)):
        comparison = Comparison.of(SCENE, given, simulation)
        assert leads_away(comparison, comparison, (effect,) * N_FOLDS, g) is away


def test_bursts_are_no_spikes() -> None:
    recording, simulation, g = drawn(30)
    for k in range(8):
        at = 2048 * k + int(even(1, g=g) * 1800)
        recording[1, at : at + 160] += 2 * normal(160, g=g)
    comparison = Comparison.of(SCENE, recording, simulation)
    assert Spikes.detect_and_fit(comparison, LEVEL) is None
    found = nominated(comparison, VarianceChange)
    assert found.sensors == (1,)
    assert isinstance(found.effect, VarianceChange)
    assert len(found.effect.episodes) == 8
    settled(comparison, found, g)


def test_an_episode_may_begin_with_the_last_block_and_end_with_the_record() -> None:
    """After which a few samples are no block: their sum may be least at the record's end."""
    log_ratios = torch.full((4096 + 12,), -1.0, dtype=torch.float64)
    log_ratios[4080:4096], log_ratios[4096:] = 10.0, -40.0
    for episode in episodes._likeliest(log_ratios):
        assert 0 <= episode.start < episode.stop <= len(log_ratios)


def test_the_likeliest_stretches_are_those_of_all_that_are_possible() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        sums = rng.normal(size=9).tolist()

        def worth(states: tuple[int, ...], values: list[float] = sums) -> float:
            changes = sum(a != b for a, b in itertools.pairwise((0, *states)))
            return sum(v for v, s in zip(values, states, strict=True) if s) - 0.7 * changes

        best = max(itertools.product((0, 1), repeat=9), key=worth)
        assert worth(tuple(map(int, episodes._two_state_path(sums, 0.7)))) == pytest.approx(worth(best))
        one = max((sum(sums[a:b]), (a, b)) for a in range(9) for b in range(a + 1, 10))[1]
        total = torch.tensor([0.0, *sums], dtype=torch.float64).cumsum(0)
        assert episodes._single(total) == (one,)


# Telegraph noise.


def test_kurtosis_is_that_of_the_wavelet_coefficients() -> None:
    g = torch.Generator().manual_seed(11)
    x = NOISE.simulate(4096, batch=(2,), generator=g)
    scores = haar_kurtosis.kurtosis_scores(Records(x[None], bands(4096)))
    for level, w in enumerate(haar_coefficients(x, 6), start=1):
        w = w[..., :: max(2 ** (level - 2), 1) if level > 2 else 1]
        naive = stats.kurtosis(w.numpy(), axis=-1, fisher=False)
        mine = normal_kurtosis(torch.from_numpy(naive), independent_values(w - w.mean(-1, keepdim=True)))
        np.testing.assert_allclose(scores[level - 1].numpy(), mine.numpy(), atol=0.05)
    sample = np.random.default_rng(0).normal(size=200)
    b2 = torch.tensor(stats.kurtosis(sample, fisher=False))
    score = normal_kurtosis(b2, torch.tensor(200.0, dtype=torch.float64))
    assert float(score) == pytest.approx(float(stats.kurtosistest(sample).statistic), rel=1e-9)


def test_two_levels_are_telegraph_noise_and_an_ar1_is_not() -> None:
    recording, simulation, g = drawn(40)
    recording[1] += 0.8 * _path(N, 120.0, 180.0, g)
    comparison = Comparison.of(SCENE, recording, simulation)
    found = nominated(comparison, RandomTelegraph)
    assert found.sensors == (1,)
    assert found.parameters["half_step[1]"].value == pytest.approx(0.8, rel=0.15)
    assert found.parameters["dwell_up[1]"].value == pytest.approx(1.2, rel=0.5)
    assert found.parameters["dwell_down[1]"].value == pytest.approx(1.8, rel=0.5)
    settled(comparison, found, g)
    assert haar_kurtosis.jump_test(comparison).p_value < 1e-4
    other, simulation, g = drawn(41)
    other[1] += AR1(0.985, 0.64 * (1 - 0.985**2)).simulate(N, generator=g)
    assert RandomTelegraph.detect_and_fit(Comparison.of(SCENE, other, simulation), LEVEL) is None


def test_a_step_is_no_telegraph() -> None:
    recording, simulation, _ = drawn(42)
    recording[1, 6000:] += 8.0
    assert RandomTelegraph.detect_and_fit(Comparison.of(SCENE, recording, simulation), LEVEL) is None


def test_paths_dwell_as_they_should() -> None:
    path = _path(400_000, 50.0, 150.0, torch.Generator().manual_seed(5))
    assert set(path.unique().tolist()) == {-1.0, 1.0}
    assert float((path > 0).double().mean()) == pytest.approx(0.25, abs=0.03)
    assert int((path.diff() != 0).sum()) == pytest.approx(4000, rel=0.06)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("corner", [0.05, 0.2, 0.35])
def test_filters_leave_no_outliers(order: int, corner: float):
    """Gaussian noise through a steep filter: its prediction errors are those of many samples, and normal."""
    numerator, denominator = butter(order, 2 * corner)
    rare = 0
    for seed in range(8):
        white = torch.randn(3, 10192, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        signal = torch.from_numpy(lfilter(numerator, denominator, white.numpy())[:, 2000:].copy())
        rare += impulses.spike_p_value(Comparison.of(SCENE, signal, white[None, :, 2000:])) < 0.01
    assert rare <= 1  # 2 of 8 have a probability of 0.003


def test_outliers_that_only_the_simulation_has_are_told():
    g = torch.Generator().manual_seed(7)
    signal, simulation = (torch.randn(2, 20_000, generator=g, dtype=torch.float64) for _ in range(2))
    simulation[1, ::400] *= 8.0
    found = impulses.outliers_test(Comparison.of(SCENE, signal, simulation[None]))
    assert found.p_value < 1e-6
    assert found.sensors == (1,)
    assert found.words == "fewer samples far out than the simulation has in sensor y"
    for given in (simulation, signal):  # nothing differs, or the recording has them
        assert impulses.outliers_test(Comparison.of(SCENE, simulation, given[None])).words != found.words
    assert Spikes.detect_and_fit(Comparison.of(SCENE, signal, simulation[None]), LEVEL) is None


def student(g: torch.Generator, freedom: int, *shape: int) -> torch.Tensor:
    chi2 = torch.randn(freedom, *shape, generator=g, dtype=torch.float64).square().sum(0)
    return torch.randn(*shape, generator=g, dtype=torch.float64) / (chi2 / freedom).sqrt()


@pytest.mark.parametrize(("freedom", "off"), [(3, 0.3), (5, 0.1)])
def test_outliers_beside_heavy_tails_are_spikes_and_these_are_not(freedom: int, off: float):
    """Both sides have the tails; beyond them the recording has outliers in two of three sensors.

    Two levels are not quite the law of such tails: of the heaviest ones the farthest values count as outliers.
    """
    g = torch.Generator().manual_seed(freedom)
    recording, simulation = (student(g, freedom, 3, N) for _ in range(2))
    assert Spikes.detect_and_fit(Comparison.of(SCENE, recording, simulation[None]), LEVEL) is None
    hit = even(3, N, g=g) < 2e-3
    hit[0] = False
    recording = recording + hit * 25.0 * (even(3, N, g=g) - 0.5).sign()
    comparison = Comparison.of(SCENE, recording, simulation[None])
    found = nominated(comparison, Spikes)
    assert found.sensors == (1, 2)
    assert "not at the same time" in found.sentence
    for i in (1, 2):
        assert found.parameters[f"amplitude[{i}]"].value == pytest.approx(25.0, rel=off)
        assert found.parameters[f"rate[{i}]"].value == pytest.approx(2e-3 * RATE * 3600, rel=6 * off)
    after = found.effect.repair(comparison, g)
    assert impulses.outliers_test(after).p_value > 1e-4


def test_outliers_beside_noise_of_two_levels_are_spikes():
    """The law of the noise is told first, without them; then they are."""
    g = torch.Generator().manual_seed(4)
    simulation = torch.randn(1, N, generator=g, dtype=torch.float64)
    loud = even(1, N, g=g) < 0.4
    recording = torch.randn(1, N, generator=g, dtype=torch.float64) * torch.where(loud, 8.0, 1.0) / 5.12
    recording[0, even(N, g=g) < 1e-3] += 20.0
    report = diagnose(Recording(recording, rate=RATE, unit="deg/s"), simulation)
    names = [finding.mechanism for finding in report.findings]
    assert names[:2] == ["scale_mixture", "spikes"]
    assert report.findings[0].parameters["ratio[0]"].value == pytest.approx(8.0, rel=0.06)
    assert report.findings[1].parameters["amplitude[0]"].value == pytest.approx(20.0, rel=0.1)


def test_outliers_of_the_simulation_are_counted_in_all_sensors_together():
    """Too few in each sensor, and plainly too many in eight."""
    g = torch.Generator().manual_seed(1)
    info = replace(SCENE, sensors=tuple("abcdefgh"))
    signal, simulation = (torch.randn(8, N, generator=g, dtype=torch.float64) for _ in range(2))
    simulation = torch.where(even(8, N, g=g) < 5e-4, 9.0 * simulation.sign(), simulation)
    comparison = Comparison.of(info, signal, simulation[None])
    assert impulses.fewer_outliers_p_value(comparison) < 1e-9
    found = nominated(comparison, SimulatedSpikes)
    assert found.sensors == tuple(range(8))
    assert found.sentence.startswith("only the simulation has isolated outliers in all sensors")
    assert impulses.outliers_test(found.effect.repair(comparison, g)).p_value > 1e-3
