"""Tests of hypotheses about weights: against linear regression, by hand, and by size, power and coverage."""

from __future__ import annotations

import functools
import json

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from gyrofuse import ArrayModel, RandomWalk, WhiteNoise, fit_svo, svo_weights
from gyrofuse.fusion import SVOResult
from gyrofuse.fusion.uncertainty.tests import (
    WeightsInference,
    dropped_sensor_test,
    enough_data,
    equal_weights_test,
    verdicts,
)

# Studies on recordings of this length, 6 levels (the last holds 14 to 30 observations); the chance that a true claim is
# refused.
N_SENSORS, N_SAMPLES, N_LEVELS, REFUSED = 4, 1024, 6, 1e-3
SCALE_WEIGHTS = ("flat", "short", "long")


def at_most(claim: float, n: int, tests: int = 1) -> int:
    """How many of `n` events of a probability of at most `claim` there may be, with all `tests` passing at once."""
    return int(stats.binom.isf(REFUSED / tests, n, claim))


def at_least(claim: float, n: int, tests: int = 1) -> int:
    return int(stats.binom.ppf(REFUSED / tests, n, claim))


def within(count: int, claim: float, n: int) -> bool:
    return stats.binomtest(count, n, claim).pvalue > REFUSED


# One level of independent observations: linear regression, exact


def one_level(observations: Tensor) -> WeightsInference:
    """WeightsInference of `(..., observation, sensor)` with the covariance that theory gives the weights."""
    n, p = observations.shape[-2:]
    gamma = (observations.mT @ observations / n)[..., None, :, :]
    omega = torch.ones(1, dtype=torch.float64)
    weights = svo_weights(gamma, omega)
    left = torch.full_like(weights, n - p + 1)
    dof = torch.full_like(weights[..., :1], n)
    inference = WeightsInference(weights, gamma[..., 0, :, :], left, gamma, omega, dof, 0.95)
    covariance = inference.influence * inference.residual[..., None, None] / (n - p + 1)
    return WeightsInference(weights, covariance, left, gamma, omega, dof, 0.95)


def drawn(*shape: int, covariance: Tensor | None = None, seed: int = 1) -> Tensor:
    unit = torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return unit if covariance is None else unit @ torch.linalg.cholesky(covariance).T


def residual_of(observations: np.ndarray, start: np.ndarray, directions: np.ndarray) -> float:
    """Smallest sum of squares of the combinations `start + directions b` of the sensors."""
    target, regressors = observations @ start, observations @ directions
    return float(np.linalg.lstsq(regressors, target, rcond=None)[1][0])


def test_equal_weights_are_tested_as_in_a_regression():
    n, p = 25, 5
    x = drawn(n, p)
    got = equal_weights_test(one_level(x))
    equal = np.full(p, 1 / p)
    contrasts = np.eye(p)[:, 1:] - np.eye(p)[:, :-1]
    null, full = float((x.numpy() @ equal) @ (x.numpy() @ equal)), residual_of(x.numpy(), equal, contrasts)
    statistic = (null - full) / (p - 1) / (full / (n - p + 1))
    assert got.statistic.item() == pytest.approx(statistic, rel=1e-10)
    assert [d.item() for d in got.dof] == pytest.approx([p - 1, n - p + 1], rel=1e-10)
    assert got.p_value.item() == pytest.approx(stats.f.sf(statistic, p - 1, n - p + 1), rel=1e-9)
    assert got.excess.item() == pytest.approx(null / full - 1, rel=1e-10)


def test_a_sensor_is_tested_as_in_a_regression():
    n, p, sensor = 25, 5, 2
    x = drawn(n, p, seed=2)
    inference = one_level(x)
    got = dropped_sensor_test(inference, sensor, "3")
    start, contrasts = np.eye(p)[0], np.eye(p)[:, 1:] - np.eye(p)[:, :1]
    others = np.delete(contrasts, sensor - 1, axis=1)  # no way to give this sensor a weight
    null, full = residual_of(x.numpy(), start, others), residual_of(x.numpy(), start, contrasts)
    t = inference.weights[sensor] / inference.covariance[sensor, sensor].sqrt()
    assert got.statistic.item() == pytest.approx((null - full) / (full / (n - p + 1)), rel=1e-9)
    assert got.statistic.item() == pytest.approx(t.item() ** 2, rel=1e-10)
    assert got.p_value.item() == pytest.approx(2 * stats.t.sf(abs(t.item()), n - p + 1), rel=1e-9)
    without = np.delete(np.delete(inference.combined.numpy(), sensor, 0), sensor, 1)
    ratio = np.linalg.inv(inference.combined.numpy()).sum() / np.linalg.inv(without).sum()
    assert got.excess.item() == pytest.approx(ratio - 1, rel=1e-9)


@pytest.mark.parametrize(("n", "p"), [(6, 4), (30, 4), (12, 2)])
def test_size_is_exact_for_one_level(n, p):
    """4000 samples of equal sensors: 5 % of each test come out below 5 %."""
    inference = one_level(drawn(4000, n, p, seed=3))
    assert within(int((equal_weights_test(inference).p_value < 0.05).sum()), 0.05, 4000)


def idle_last(n_sensors: int = N_SENSORS) -> Tensor:
    """A covariance for which the best weight of the last sensor is zero: the others' best, and noise."""
    mix = torch.eye(n_sensors - 1, dtype=torch.float64) + 0.3 * drawn(n_sensors - 1, n_sensors - 1, seed=4)
    covariance = torch.full((n_sensors, n_sensors), 0.0, dtype=torch.float64)
    covariance[:-1, :-1] = mix @ mix.T
    covariance[-1, :] = covariance[:, -1] = 1 / torch.linalg.inv(covariance[:-1, :-1]).sum()
    covariance[-1, -1] *= 2
    return covariance


def test_size_of_the_test_of_a_sensor_is_exact_for_one_level():
    inference = one_level(drawn(4000, 12, 4, covariance=idle_last(), seed=5))
    assert within(int((dropped_sensor_test(inference, 3, "4").p_value < 0.05).sum()), 0.05, 4000)


@pytest.mark.parametrize("variances", [(1, 1, 3, 3), (1, 2, 3, 100)])
@pytest.mark.parametrize("n", [8, 60])
def test_coverage_of_the_excess_for_one_level(n, variances):
    """4000 samples: limits of 95 % miss the true excess above and below by 2.5 % each, the lower ones at most so."""
    covariance = torch.diag(torch.tensor(variances, dtype=torch.float64))
    inference = one_level(drawn(4000, n, 4, covariance=covariance, seed=6))
    best = 1 / torch.linalg.inv(covariance).sum()
    without = torch.linalg.inv(covariance[:3, :3]).sum()
    for test, truth in (
        (equal_weights_test(inference), covariance.mean() / best - 1),
        (dropped_sensor_test(inference, 3, "4"), 1 / without / best - 1),
    ):
        low, high = test.confidence_interval
        assert within(int((low > truth).sum()), 0.025, 4000)
        assert int((high < truth).sum()) <= at_most(0.025, 4000)


def test_limits_of_the_excess_are_quantiles_of_its_law():
    """Simulated excesses with the limits for truth are beyond the one found in 2.5 % of cases, within 0.1 %."""
    n, p = 30, 4
    x = drawn(n, p, covariance=torch.diag(torch.tensor([1.0, 1, 6, 6]).double()), seed=9)
    test = equal_weights_test(one_level(x))
    rng = np.random.default_rng(1)
    count = 400_000
    unexplained = rng.chisquare(n - p + 1, count)
    for limit, beyond in zip(test.confidence_interval, (np.greater, np.less), strict=True):
        assert limit > 0
        # The true excess times the squares of what is regressed on, in the direction of the hypothesis.
        explained = rng.noncentral_chisquare(p - 1, limit.item() * rng.chisquare(n, count))
        tail = beyond(explained / unexplained, test.excess.item()).mean()
        assert tail == pytest.approx(0.025, abs=1e-3)


def test_no_excess_found_is_no_evidence_of_less_than_none():
    inference = one_level(drawn(500, 20, 4, seed=7))
    low, high = equal_weights_test(inference).confidence_interval
    assert (low >= 0).all()
    assert (high > 0.05).all()


# Recordings


@pytest.fixture
def n_runs(draws) -> int:
    return draws(60, 120)


@functools.cache
def recordings(noise: str, kind: str, n_runs: int) -> Tensor:
    covariance = {
        "equal": torch.eye(N_SENSORS, dtype=torch.float64),
        "idle": idle_last(),
        "unequal": torch.diag(torch.tensor([1.0, 1.0, 1.5, 2.0], dtype=torch.float64)),
    }[kind]
    components = {
        "white": [(WhiteNoise(1.0), covariance)],
        "white and walk": [(WhiteNoise(1.0), covariance), (RandomWalk(1e-3), covariance)],
        "walk": [(RandomWalk(1.0), covariance)],
    }[noise]
    return ArrayModel(components).simulate(N_SAMPLES, batch=(n_runs,), generator=torch.Generator().manual_seed(8))


@functools.cache
def fitted(noise: str, kind: str, scale_weights: str, n_runs: int) -> SVOResult:
    return fit_svo(recordings(noise, kind, n_runs), scale_weights, n_levels=N_LEVELS)


@pytest.mark.statistical
@pytest.mark.parametrize("scale_weights", SCALE_WEIGHTS)
@pytest.mark.parametrize("noise", ["white", "white and walk", "walk"])
def test_sizes_on_recordings(noise, scale_weights, n_runs):
    """At most 5 % refuse what is true: 10 of 60 (15 of 120) where one true claim in a thousand is refused."""
    most = at_most(0.05, n_runs, tests=2)
    assert (fitted(noise, "equal", scale_weights, n_runs).test_equal().p_value < 0.05).sum() <= most
    assert (fitted(noise, "idle", scale_weights, n_runs).test_drop(3).p_value < 0.05).sum() <= most


@pytest.mark.statistical
@pytest.mark.parametrize("scale_weights", SCALE_WEIGHTS)
def test_levels_of_few_observations_do_not_deceive(scale_weights, n_runs):
    """All 10 levels, the last of which hold one observation and decide: refusals are no more frequent."""
    result = fit_svo(recordings("white and walk", "equal", n_runs), scale_weights, n_levels=10)
    assert (result.test_equal().p_value < 0.05).sum() <= at_most(0.05, n_runs)
    if scale_weights == "long":
        assert result.enough_data().resolved.double().mean() < 0.05


@pytest.mark.statistical
@pytest.mark.parametrize("scale_weights", SCALE_WEIGHTS)
def test_power_on_recordings(scale_weights, n_runs):
    """Variances of 1, 1, 1.5 and 2, where equal weights cost 9 %, are told from equal ones 9 times in 10."""
    assert fitted("white and walk", "unequal", scale_weights, n_runs).test_equal().significant.double().mean() > 0.9


@pytest.mark.statistical
@pytest.mark.parametrize("scale_weights", SCALE_WEIGHTS)
@pytest.mark.parametrize("noise", ["white", "white and walk", "walk"])
def test_coverage_of_excesses_on_recordings(noise, scale_weights, n_runs):
    result = fitted(noise, "unequal", scale_weights, n_runs)
    variance = torch.tensor([1.0, 1.0, 1.5, 2.0], dtype=torch.float64)
    for test, truth in (
        (result.test_equal(), variance.mean() / 4 * variance.reciprocal().sum() - 1),
        (result.test_drop(3), variance.reciprocal().sum() / variance[:3].reciprocal().sum() - 1),
    ):
        low, high = test.confidence_interval
        assert ((low <= truth) & (truth <= high)).sum() >= at_least(0.95, n_runs, tests=2)


# Enough data


def test_observations_of_one_level_are_counted():
    n, p = 40, 4
    inference = one_level(drawn(n, p))
    data = enough_data(inference, 0.05)
    np.testing.assert_allclose(data.effective_observations, n, rtol=1e-10)
    assert data.deciding_observations.item() == pytest.approx(n)
    assert data.expected_excess.item() == pytest.approx((p - 1) / (n - p + 1))
    longer = n * data.times_longer.item()
    assert (p - 1) / (longer - p + 1) == pytest.approx(0.05)
    assert data.resolved
    assert not data.enough
    relaxed = enough_data(inference, 0.2)
    assert relaxed.enough
    assert relaxed.times_longer == 1


@pytest.mark.parametrize(("n", "resolved"), [(7, False), (8, True)])
def test_weights_are_resolved_by_two_observations_a_sensor(n, resolved):
    assert bool(enough_data(one_level(drawn(n, 4)), 0.05).resolved) is resolved


def test_errors_of_weights_cost_what_is_expected_of_them():
    """The mean excess over the best weights, with true covariances, of 4000 samples of one level: within 10 %."""
    p, n = 4, 40
    inference = one_level(drawn(4000, n, p, seed=10))
    actual = p * inference.weights.square().sum(-1) - 1
    expected = enough_data(inference, 0.05).expected_excess
    assert actual.mean().item() == pytest.approx(expected.mean().item(), rel=0.1)


def test_deciding_levels_by_hand():
    result = fit_svo(drawn(3, 4, 500, seed=11).cumsum(-1), "long", n_levels=5)[0]
    inference = result._inference("test")
    added = [
        (omega * np.trace(inference.influence.numpy() @ gamma)) ** 2 / eta
        for omega, gamma, eta in zip(
            inference.scale_weights.numpy(), inference.wccv.numpy(), inference.dof.numpy(), strict=True
        )
    ]
    expected = sum(added) / sum(a / eta for a, eta in zip(added, inference.dof.numpy(), strict=True))
    assert result.enough_data().deciding_observations.item() == pytest.approx(expected, rel=1e-9)


# The public face


def test_a_batch_is_its_items_and_dtype_hardly_matters():
    signal = drawn(2, 3, 4, 600, seed=12)
    result, single = fit_svo(signal, "short"), fit_svo(signal.float(), "short")
    for ask in (SVOResult.test_equal, lambda r: r.test_drop(1), SVOResult.enough_data):
        whole, coarse = ask(result).to_dict(), ask(single).to_dict()
        item = ask(result[1, 2]).to_dict()
        for name, value in item.items():
            if isinstance(value, float) and np.ndim(whole[name]) == 2:
                assert whole[name][1][2] == pytest.approx(value, rel=1e-9)
                assert coarse[name][1][2] == pytest.approx(value, rel=1e-2)
    assert result.effective_observations.shape == (2, 3, 4)
    assert single.effective_observations.dtype == torch.float32


def test_a_level_that_does_not_count_may_be_unknown():
    signal = drawn(3, 400, seed=13)
    signal[:, 128:160] = torch.nan
    gappy = fit_svo(signal, [1.0, 1.0, 0.0, 1.0])
    unknown = gappy.wavelet_cross_covariance.clone()
    unknown[2] = torch.nan
    hidden = SVOResult(**{**vars(gappy), "wavelet_cross_covariance": unknown})
    assert hidden.test_equal().to_dict() == gappy.test_equal().to_dict()
    assert hidden.enough_data().to_dict() == gappy.enough_data().to_dict()


def test_sensors_go_by_index_or_name():
    result = fit_svo(drawn(3, 400, seed=14))
    assert result.test_drop(2).to_dict() == result.test_drop("3").to_dict()
    for wrong in ("7", 3, -1, True, 1.0):
        with pytest.raises(ValueError, match=r"`sensor`: expected an index from 0 to 2 or one of 1, 2, 3, got"):
            result.test_drop(wrong)


QUESTIONS = {
    "test_equal": SVOResult.test_equal,
    "test_drop": lambda result: result.test_drop(0),
    "enough_data": SVOResult.enough_data,
    "effective_observations": lambda result: result.effective_observations,
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_questions_need_svo_weights_and_their_covariance(name):
    signal = drawn(3, 400, seed=15)
    for method in ("equal", "inverse_variance"):
        with pytest.raises(ValueError, match=f"`{name}`: expected SVO weights, got method '{method}'; fit with method"):
            QUESTIONS[name](fit_svo(signal, method=method))
    with pytest.raises(ValueError, match=f"`{name}`: expected the covariance of the weights, got none; fit with cov"):
        QUESTIONS[name](fit_svo(signal, covariance="none"))


def test_what_is_asked_of_the_errors_has_to_be_positive():
    with pytest.raises(ValueError, match=r"`largest_excess`: expected a finite number > 0, got 0"):
        fit_svo(drawn(3, 400)).enough_data(0)


def test_answers_become_json():
    result = fit_svo(drawn(2, 3, 400, seed=16), confidence_level=0.9)
    test = json.loads(json.dumps(result.test_equal().to_dict(), allow_nan=False))
    assert test["subject"] == "equal weights"
    assert test["confidence_level"] == 0.9
    assert np.shape(test["degrees_of_freedom"]) == (2, 2)
    assert set(test["confidence_interval"]) == {"low", "high"}
    data = json.loads(json.dumps(result.enough_data().to_dict(), allow_nan=False))
    assert np.shape(data["effective_observations"]) == (2, 3)
    assert data["resolved"] == [True, True]


def scaled(*variances: float, n: int = 2000) -> Tensor:
    return torch.tensor(variances, dtype=torch.float64).sqrt()[:, None] * drawn(len(variances), n, seed=17)


def test_sentences():
    good = fit_svo(scaled(1, 1, 1), "short")
    assert str(good.test_equal()) == good.test_equal().summary()
    assert good.test_equal().summary().startswith("Equal weights: a small loss, ")
    assert good.test_drop("2").summary().startswith("Leaving out sensor 2: a loss, ")
    assert good.test_drop("2").summary().endswith("p < 0.0001.")
    assert good.enough_data().summary().startswith("Recording: long enough, ")
    assert good.enough_data(1e-5).summary().startswith("Recording: rather short, ")
    few = fit_svo(scaled(1, 1, 1.2, n=60), "short")
    assert few.test_equal().summary().startswith("Equal weights: perhaps a loss, ")
    short = fit_svo(scaled(1, 1, 1, n=12), "long")
    assert short.test_equal().summary().startswith("Equal weights: too short a recording to judge, ")
    assert "F(" not in short.test_equal().summary()  # no verdict, no p-value beside it
    assert not short.test_equal().significant
    assert short.enough_data().summary().endswith("record longer or use fewer levels.")
    batch = fit_svo(scaled(1, 1, 1).expand(10, 3, 2000))
    lines = batch.test_equal().summary().splitlines()
    assert [line[:3] for line in lines[:8]] == [f"[{i}]" for i in range(1, 9)]
    assert lines[8] == "... and 2 more"
    assert max(map(len, (*lines, str(good.test_drop(1))))) <= 180


@pytest.mark.parametrize(
    ("variances", "n", "answers"),
    [
        ((1, 1, 1), 2000, ("Equal weights: good enough, 0 to ", "each earns its place", "long enough")),
        ((1, 2, 100), 2000, ("Equal weights: not good enough, ", "3 could be left out", "long enough")),
        ((1, 1.2, 9), 100, ("Equal weights: not good enough, ", "3 may or may not be needed", "long enough")),
        ((1, 1, 1.3), 30, ("Equal weights: perhaps good enough, ", "each earns its place", "rather short")),
    ],
)
def test_verdicts_in_a_summary(variances, n, answers):
    result = fit_svo(scaled(*variances, n=n), "short")
    lines = verdicts(result._inference("test"), result.sensors)
    assert len(lines) == 3
    for line, answer in zip(lines, answers, strict=True):
        assert answer in line
    assert "\n".join(lines) in result.summary()
    assert max(map(len, result.summary().splitlines())) <= 120


def test_a_summary_says_that_a_recording_is_too_short_and_no_more():
    result = fit_svo(scaled(1, 1, 1, n=12), "long")
    assert result.summary().splitlines()[-1].startswith("Recording: too short, ")
    assert "Equal weights" not in result.summary()
    assert "Recording" not in fit_svo(scaled(1, 1, 1), covariance="none").summary()
    assert "Recording" not in fit_svo(scaled(1, 1, 1), method="equal").summary()
