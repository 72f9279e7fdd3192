"""Noise that recording and simulation share is no mismatch, whatever its law: kernels, witnesses, names."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from mismatch_draws import LEVEL, even, normal
from scipy import signal, stats
from scipy.signal import butter, lfilter
from slow_cases import slow_but_for
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.detectors.lines.clocks import clock_test
from gyrofuse.mismatch.detectors.spectra.band_tests import spectrum_test
from gyrofuse.mismatch.detectors.spectra.shape_scan import shape_test
from gyrofuse.mismatch.detectors.tests import family_wise_p_value, run_tests
from gyrofuse.mismatch.detectors.values import quantisation_grid as lattices
from gyrofuse.mismatch.detectors.variance import haar_kurtosis, noise_level, normality
from gyrofuse.mismatch.detectors.variance import outliers as impulses
from gyrofuse.mismatch.detectors.variance.level_spread import level_spread
from gyrofuse.mismatch.mechanisms.regimes.telegraph import RandomTelegraph
from gyrofuse.mismatch.mechanisms.regimes.variance_change import VarianceChange
from gyrofuse.mismatch.mechanisms.spectra.parameter_change import ParameterShift
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.selection import null_replicates as twins
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.stats import tails
from gyrofuse.mismatch.stats.kurtosis import bounded_kurtosis, kurtosis_p_value
from gyrofuse.mismatch.stats.level_scan import WINDOW, local_level
from gyrofuse.mismatch.stats.long_run_variance import chi_square_nodes, long_run_variance

N = 8209  # a prime: no length of a block or a transform fits it


def wandering(tau: float, n: int, g: torch.Generator) -> Tensor:
    """A variance `(time,)` whose logarithm is an AR1 of that time constant and sd 1/2."""
    phi = math.exp(-1 / tau)
    steps = normal(n, g=g).numpy() * 0.5 * math.sqrt(1 - phi**2)
    steps[0] /= math.sqrt(1 - phi**2)
    return torch.from_numpy(signal.lfilter([1.0], [1.0, -phi], steps)).exp()


def noise(kind: str, g: torch.Generator, p: int = 2, n: int = N) -> Tensor:
    """Noise `(sensor, time)` that is not Gaussian of a steady level, but for the first kind."""
    x = normal(p, n, g=g)
    if kind == "t5":
        return x / normal(5, p, n, g=g).square().mean(0).sqrt()
    if kind == "laplace":
        return -even(p, n, g=g).log() * x.sign()
    if kind == "wandering":
        return x * wandering(100.0, n, g).sqrt()
    if kind == "spiky":
        return x + 10 * (even(p, n, g=g) < 5e-4) * x.sign()
    return x


def case_of(kind: str, seed: int, p: int = 2, n: int = N) -> Comparison:
    g = torch.Generator().manual_seed(seed)
    return prepared(noise(kind, g, p, n), noise(kind, g, p, n), None, g)


# Kernels.


@pytest.mark.parametrize(("phi", "least"), [(0.0, 200.0), (0.9, 30.0)])
def test_the_long_run_variance_of_an_ar1_is_that_of_its_spectrum_at_zero(phi: float, least: float) -> None:
    g = torch.Generator().manual_seed(1)
    scores, ratios, degrees = [], [], []
    for _ in range(40):
        x = torch.from_numpy(signal.lfilter([1.0], [1.0, -phi], normal(1, 20011, g=g).numpy()))
        found = long_run_variance(x)
        ratios.append(found.value * (1 - phi) ** 2)
        scores.append(float(stats.chi2.cdf(found.dof * ratios[-1], found.dof)))
        degrees.append(found.dof)
    assert least <= np.median(degrees)
    # Where the density falls off within the ordinates it is a tenth too small.
    assert float(np.median(ratios)) == pytest.approx(1, abs=0.1 if not phi else 0.2)
    assert min(ratios) > 0.6
    if not phi:
        assert stats.kstest(scores, "uniform").pvalue > 1e-3


def test_nodes_average_over_a_chi_square_variable() -> None:
    for dof in (12.0, 200.0):
        values, weights = chi_square_nodes(dof)
        assert float(weights.sum()) == pytest.approx(1)
        assert float((weights * values).sum()) == pytest.approx(1, rel=0.02)
        # The mean of exp(-t x): the Laplace transform of a Gamma variable: p values are made of its lower tail.
        for t in (1.0, 20.0):
            assert float((weights * (-t * values).exp()).sum()) == pytest.approx(
                (1 + 2 * t / dof) ** (-dof / 2), rel=0.3
            )


def test_the_local_level_follows_what_changes_slowly_and_no_outlier() -> None:
    g = torch.Generator().manual_seed(2)
    x = normal(2, 20000, g=g)
    x[0, 10000:] *= 4.0
    x[1, 5000] = 50.0
    level = local_level(x)
    assert float(level[0, 12000:].mean() / level[0, :8000].mean()) == pytest.approx(16, rel=0.1)
    assert float(level[1, 4900:5100].mean()) < 1.2
    assert float(level[1].std()) == pytest.approx(math.sqrt(2 / WINDOW), rel=0.3)


def test_the_influence_of_a_value_is_what_the_kurtosis_moves_by() -> None:
    x = noise("t5", torch.Generator().manual_seed(3), 1, 2000)
    found = bounded_kurtosis(x)
    for place in (10, int(x.abs().argmax())):
        twice = torch.cat([x, x[:, place : place + 1].expand(1, 4)], -1)  # its weight is raised by 4/2000
        moved = (bounded_kurtosis(twice).value - found.value) * twice.shape[-1] / 4
        assert moved == pytest.approx(float(found.influence[0, place]), rel=0.05, abs=0.05)


@pytest.mark.parametrize("kind", ["gaussian", "t5", "laplace"])
def test_equal_kurtoses_are_told_apart_as_often_as_chance_has_it(kind: str) -> None:
    g = torch.Generator().manual_seed(4)
    low = sum(kurtosis_p_value(noise(kind, g, 1, 4001), noise(kind, g, 1, 4001)) < 0.05 for _ in range(60))
    assert stats.binom.sf(8, 60, 0.05) < 1e-2
    assert low <= 8
    assert kurtosis_p_value(noise("laplace", g, 1, 4001), noise("gaussian", g, 1, 4001)) < 1e-6
    assert kurtosis_p_value(normal(1, 4001, g=g).sign() + 0.5 * normal(1, 4001, g=g), normal(1, 4001, g=g)) < 1e-6


def test_counts_of_the_same_rate_have_the_binomial_law() -> None:
    own, other = np.array([0.0, 3.0, 9.0]), np.array([2.0, 2.0, 0.0])
    mine = tails.equal_rates_p_value(own, other, 0.5)
    np.testing.assert_allclose(mine, stats.binom.sf(own - 1, own + other, 1 / 3), rtol=1e-9)


def test_the_tail_beyond_the_largest_values_is_paretos() -> None:
    x = np.linspace(0, 5, 11)
    for xi in (-0.15, 0.0, 0.4):
        mine = tails._log_survival(x, np.array([xi]), np.array([1.3]))
        np.testing.assert_allclose(mine, stats.genpareto.logsf(x, xi, scale=1.3), rtol=1e-9)


@pytest.mark.parametrize("kind", ["gaussian", "t5", "laplace", "spiky"])
def test_tails_that_both_have_are_predicted(kind: str) -> None:
    g = torch.Generator().manual_seed(5)
    low = 0
    for _ in range(15):
        observed, reference = (noise(kind, g, 4, N).numpy() for _ in range(2))
        low += int((tails.tail_p_values(observed, reference[:, None]) < 0.01).sum())
    # More than 4 of 60 at 1 % have probability 3e-4.
    assert low <= 4
    observed[0, ::1000] = 12.0 * np.abs(reference).max()
    assert tails.tail_p_values(observed, reference[:, None])[0] < 1e-4


def test_outliers_that_few_have_by_chance_are_no_taller_tail() -> None:
    # Ten sd where the simulation's own sensor has none: others show that they come.
    g = torch.Generator().manual_seed(21)
    observed, reference = normal(3, N, g=g).numpy(), normal(3, N, g=g).numpy()
    observed[2, [100, 5000]] = 11.2, -11.5
    reference[:2, [70, 3000]] = 10.4, -9.8
    assert tails.tail_p_values(observed, reference[:, None])[2] > 0.05
    # Twice as tall they are others.
    observed[2, [100, 5000]] = 24.0, -25.0
    assert tails.tail_p_values(observed, reference[:, None])[2] < 1e-3


def burst(n: int, at: tuple[int, ...], g: torch.Generator) -> Tensor:
    """Noise `(1, time)` that is three times as loud for 20 samples after each place."""
    x = normal(1, n, g=g)
    for start in at:
        x[:, start : start + 20] *= 3.0
    return x


def test_a_simulation_with_few_bursts_by_chance_is_not_surer_of_them() -> None:
    g = torch.Generator().manual_seed(22)
    observed = burst(4500, tuple(range(100, 4500, 450)), g)
    reference = burst(4500, (700,), g)
    assert kurtosis_p_value(observed, reference) > 1e-4


def test_records_of_another_level_have_the_kurtosis_of_each() -> None:
    g = torch.Generator().manual_seed(23)
    observed = noise("wandering", g)
    reference = torch.cat([normal(2, N, g=g), 1.5 * normal(2, N, g=g)], -1) * wandering(100.0, 2 * N, g).sqrt()
    assert float(haar_kurtosis.kurtosis_p_values(prepared(observed, reference, None, g))[0].min()) > 0.01


def test_a_run_of_values_on_one_step_is_no_quiet_stretch() -> None:
    g = torch.Generator().manual_seed(24)
    observed, reference = normal(2, N, g=g).round(), normal(2, N, g=g).round()
    observed[0, 3000:3018] = 0.0  # by chance about once in forty million samples, hence no law is met
    found = prepared(observed + 0.3, reference + 0.3, None, g)
    assert noise_level.variance_p_value(found) > 1e-3
    # Without a lattice such a stretch is one.
    quiet = normal(2, N, g=g)
    quiet[0, 3000:3200] *= 0.3
    assert noise_level.variance_p_value(prepared(quiet, normal(2, N, g=g), None, g)) < 1e-6


def test_fast_noise_may_go_up_and_down_beside_slow_noise_that_does_not() -> None:
    alarms = 0
    for seed in range(6):
        g = torch.Generator().manual_seed(40 + seed)
        slow = [torch.from_numpy(signal.lfilter([1.0], [1.0, -0.999], normal(4, N, g=g).numpy())) for _ in range(2)]
        both = [normal(4, N, g=g) * wandering(2000.0, N, g).sqrt() + 0.1 * part for part in slow]
        alarms += shape_test(prepared(*both, None, g)).p_value < 1e-3
    assert alarms == 0


def test_a_peak_of_noise_is_no_tone() -> None:
    g = torch.Generator().manual_seed(25)
    peak = gf.AR1(phi=-0.9995, variance=2e-4)
    tone = gf.Sinusoid(amplitude=0.2, beta=0.7)
    model = gf.WhiteNoise(1.0) + peak + tone
    found = prepared(model.simulate(N, batch=(2,), generator=g), model, None, g)
    (line,) = found.reference.lines
    assert line == pytest.approx(0.7 / (2 * math.pi), abs=1 / N)


def test_tails_of_values_that_hardly_leave_a_step_are_numbers() -> None:
    rng = np.random.default_rng(1)
    rounded = np.where(rng.random((2, 4096)) < 0.01, 60.0, 0.0)
    p_values = tails.tail_p_values(rounded, rounded[:, None])
    assert (p_values > 0.1).all()
    assert (tails.tail_p_values(0 * rounded, 0 * rounded[:, None]) == 1).all()


def test_events_in_clumps_count_for_fewer() -> None:
    rng = np.random.default_rng(0)
    alone = rng.random((1, 64_000)) < 0.002
    clumps = np.zeros((1, 64_000), dtype=bool)
    for at in rng.integers(0, 63_990, 25):
        clumps[0, at : at + 5] = True
    assert tails.dispersion(torch.from_numpy(alone)) < 1.6
    assert tails.dispersion(torch.from_numpy(clumps)) == pytest.approx(5, rel=0.4)


def test_squares_that_come_together_in_both_are_no_bursts() -> None:
    g = torch.Generator().manual_seed(6)

    def bursting(share: float) -> Tensor:
        x = normal(1, N, g=g)
        for at in (even(30, g=g) * (N - 20)).long().tolist():
            x[:, at : at + 20] *= 1 + share
        return x

    def p_value(observed: float, reference: float) -> float:
        return noise_level.variance_test(prepared(bursting(observed), bursting(reference), None, g)).p_value

    low = sum(p_value(1.0, 1.0) < 0.01 for _ in range(25))
    assert low <= 3  # four of 25 at 1 % have probability 1e-4
    assert p_value(1.5, 0.0) < 1e-4


def test_levels_that_vary_by_themselves_make_a_sample_count_for_less() -> None:
    g = torch.Generator().manual_seed(7)
    x = normal(1, 3, 65536, g=g) * wandering(100.0, 65536, g).sqrt()
    doubtful = torch.zeros(3, dtype=torch.bool)
    spread = level_spread(x / x.std(), doubtful)
    assert spread.dof < 2 * 256
    assert float(spread.weight.max()) < 0.1
    sure = level_spread(x, ~doubtful)
    assert math.isinf(sure.dof)
    assert sure.weight.tolist() == [1.0, 1.0, 1.0]


# Which simulations are Gaussian.


def test_a_model_is_gaussian_and_samples_are_what_they_look_like() -> None:
    g = torch.Generator().manual_seed(8)
    model = prepared(noise("t5", g), gf.Model([gf.WhiteNoise(1.0)]), None, g)
    assert bool(normality.gaussian_sensors(model.reference).all())
    for kind in ("t5", "laplace", "wandering", "spiky"):
        assert not bool(normality.gaussian_sensors(case_of(kind, 9).reference).any()), kind
    passed = torch.stack([normality.gaussian_sensors(case_of("gaussian", 100 + k).reference) for k in range(20)])
    # Nine of ten sensors at least: fewer than 29 of 40 have probability 1e-3.
    assert int(passed.sum()) >= 29


# Witnesses and names.


@pytest.mark.parametrize("kind", ["t5", "laplace", "wandering", "spiky"])
def test_noise_that_both_share_is_no_mismatch(kind: str) -> None:
    low = {}
    for seed in range(4):
        comparison = case_of(kind, 200 + seed, n=4099)
        for witness in (
            impulses.outliers_test,
            haar_kurtosis.jump_test,
            noise_level.variance_test,
            spectrum_test,
            shape_test,
        ):
            low[witness.__name__] = low.get(witness.__name__, 0) + (witness(comparison).p_value < 0.01)
    # More than two of twenty at 1 % have probability 1e-3; all four were low before.
    assert sum(low.values()) <= 2, low


def test_no_law_that_both_share_gets_a_name() -> None:
    """Once something else made it a mismatch; of modulated noise spectra gained any number of nats."""
    for seed in range(2):
        comparison = case_of("wandering", 300 + seed, n=4099)
        for mechanism in (ParameterShift, RandomTelegraph, VarianceChange):
            assert mechanism.detect_and_fit(comparison, LEVEL) is None, mechanism.name


def test_a_change_of_level_is_seen_beside_tails_that_both_have() -> None:
    g = torch.Generator().manual_seed(10)
    observed, reference = noise("t5", g, n=16381), noise("t5", g, n=16381)
    observed[:, 3000:9000] *= 1.4
    comparison = prepared(observed, reference, None, g)
    assert not bool(normality.gaussian_sensors(comparison.reference).any())
    assert noise_level.variance_test(comparison).p_value < 1e-4
    found = VarianceChange.detect_and_fit(comparison, LEVEL)
    assert found is not None
    assert found.parameters["start"].value == pytest.approx(3000, abs=400)


def test_a_course_of_the_level_that_both_have_is_no_mismatch() -> None:
    g = torch.Generator().manual_seed(11)
    loud = torch.ones(N, dtype=torch.float64)
    loud[2000:4000] = 2.0
    assert noise_level.variance_test(prepared(noise("", g) * loud, noise("", g) * loud, None, g)).p_value > 0.05


# Twins.


def test_twins_have_the_innovations_of_the_simulation() -> None:
    g = torch.Generator().manual_seed(12)
    comparison = case_of("t5", 13, n=16381)
    assert twins.block_length(left_out(comparison.reference).white) == 1
    twin = twins.twin(comparison, g)
    for ours, theirs in ((twin.recording, comparison.reference.signal[0]), (twin.reference.signal[0],) * 2):
        assert (ours.std(-1) / theirs.std(-1)).tolist() == pytest.approx([1, 1], abs=0.05)
        assert float(stats.kurtosis(ours.numpy(), axis=-1).min()) > 1.5
    assert float((twin.recording[0, 1:] * twin.recording[0, :-1]).mean().abs()) < 0.06
    assert 100 < twins.block_length(left_out(case_of("wandering", 14).reference).white) <= N / 8


# Lattices.


def test_a_mixture_of_normal_laws_has_no_lattice_and_one_that_is_rounded_has() -> None:
    for seed in range(3):
        g = torch.Generator().manual_seed(20 + seed)
        wide = torch.where(even(1, 65537, g=g) < 0.5, 4.0, 1.0)
        mixed = normal(1, 65537, g=g) * wide
        simulation = normal(1, 65537, g=g) * mixed.std()
        info = RecordingInfo(100.0, "deg/s", ("x",))
        assert lattices.missing_lattices(Comparison.of(info, mixed, simulation[None]), LEVEL).p_value > 0.01
        rounded = (mixed / 2).round() * 2 + 0.5 * normal(1, 65537, g=g)
        found = lattices.missing_lattices(Comparison.of(info, rounded, simulation[None]), LEVEL)
        assert found.p_value < 1e-9
        assert found.lattices[0].step == pytest.approx(2.0, rel=0.05)


def test_contaminated_noise_of_a_real_gyro_is_not_rounded(data: Path) -> None:
    observed = torch.from_numpy(np.load(data / "mtig_contaminated_gx.npz")["gyro_x"].astype(np.float64))
    for first in (0, 300_000):
        part = observed[None, first : first + 65537]
        simulation = part.std() * normal(1, 1, 65537, g=torch.Generator().manual_seed(21))
        comparison = Comparison.of(RecordingInfo(100.0, "rad/s", ("x",)), part, simulation)
        assert lattices.missing_lattices(comparison, LEVEL).p_value > 0.01


@pytest.mark.parametrize("taps", [signal.bessel(3, 0.4, norm="mag"), signal.butter(4, 0.3)], ids=["bessel", "butter"])
@pytest.mark.parametrize("n", [2 * N, 20011])
def test_a_steep_filter_makes_no_outliers_and_changes_no_level(taps, n: int):
    """Where it passes next to nothing, the ends of the record leak in; they are no noise that predicts samples."""
    g = torch.Generator().manual_seed(7)
    recording, simulation = normal(3, n + 500, g=g), normal(3, n, g=g)
    recording[0] = torch.from_numpy(signal.lfilter(*taps, recording[0].numpy()))
    given = prepared(recording[:, 500:], simulation, None, g)
    assert float(left_out(given.observed).z[0].abs().max()) < 6
    assert impulses.outliers_test(given).p_value > LEVEL
    assert noise_level.variance_test(given).p_value > LEVEL


FORMS = ("pole", "butterworth", "steep", "low", "average", "triangle", "windowed", "high", "band", "difference")


@pytest.mark.parametrize("form", slow_but_for(("high", "triangle"), FORMS))
def test_what_a_filter_leaves_alike_on_both_sides_is_no_mismatch(form: str):
    """Stop bands and zeros that recording and simulation share: leakage, few ordinates and ends are no evidence."""
    numerator, denominator = {
        "pole": butter(1, 0.1),
        "butterworth": butter(2, 0.4),
        "steep": butter(4, 0.4),
        "low": butter(4, 0.1),
        "average": (np.ones(4) / 4, [1.0]),
        "triangle": (np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9, [1.0]),
        "windowed": (signal.firwin(31, 0.4), [1.0]),
        "high": butter(2, 0.04, "high"),
        "band": butter(2, (0.1, 0.4), "band"),
        "difference": ([1.0, -1.0], [1.0]),
    }[form]
    alarms = 0
    for seed in range(6):
        white = torch.randn(5, 3, 10192, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        made = torch.from_numpy(lfilter(numerator, denominator, white.numpy())[..., 2000:].copy())
        results = run_tests(Comparison.of(RecordingInfo(100.0, "deg/s", ("1", "2", "3")), made[0], made[1:]))
        alarms += family_wise_p_value(results) < 0.01
    assert alarms <= 1  # two of six come by chance once in 700 times


def test_a_tone_that_fades_on_both_sides_slips_nowhere():
    """Once it has died away, any phase is as good as another one."""
    n, rate, g = 16_384, 200.0, torch.Generator().manual_seed(4)
    t = torch.arange(n, dtype=torch.float64)
    for _ in range(3):
        both = []
        for _ in range(2):
            turn = 2 * math.pi * float(torch.rand((), generator=g))
            fading = 0.9 * torch.exp(-t / 4500) * torch.sin(2 * math.pi * 0.165 * t + turn)
            both.append(torch.randn(3, n, generator=g, dtype=torch.float64) + fading)
        comparison = Comparison.of(RecordingInfo(rate, "deg/s", ("1", "2", "3")), both[0], both[1][None])
        assert clock_test(comparison).p_value > 1e-3


def test_faint_lines_that_both_sides_have_are_no_difference():
    n, g = 16_384, torch.Generator().manual_seed(5)
    t = torch.arange(n, dtype=torch.float64)
    seen = 0
    for _ in range(40):
        both = []
        for _ in range(2):
            turn = 2 * math.pi * float(torch.rand((), generator=g))
            faint = 0.036 * torch.sin(2 * math.pi * 0.19 * t + turn)
            both.append(torch.randn(3, n, generator=g, dtype=torch.float64) + faint)
        comparison = Comparison.of(RecordingInfo(200.0, "deg/s", ("1", "2", "3")), both[0], both[1][None])
        seen += comparison.line.p_value < 0.01
    assert seen <= 2
