"""Weights that move along and logarithmic moments: the same minima as naive searches, and what each costs."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from scipy import optimize, special, stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.fitting.moments.log_moments import log_residual

WALK = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-3)
MIXED = gf.WhiteNoise(1.0) + gf.AR1(0.95, 0.05) + gf.RandomWalk(1e-3)
OPTIONS = [{"weighting": "continuous"}, {"moments": "log"}]


def signals(n: int, n_samples: int, model: gf.Model, seed: int = 0) -> Tensor:
    return model.simulate(n_samples, batch=(n,), generator=torch.Generator().manual_seed(seed))[:, None]


def residual_of(model: gf.Model, params: np.ndarray, n_samples: int, nu: np.ndarray) -> tuple[np.ndarray, ...]:
    """`nu(theta)`, `V(theta)` and the plain residual at given parameters."""
    there = model.with_params(torch.from_numpy(params))
    covariance = moment_covariance(there, n_samples, len(nu)).numpy()
    expected = there.wavelet_variance(len(nu)).numpy()
    return expected, covariance, nu - expected


def from_unknowns(u: np.ndarray) -> np.ndarray:
    """White noise, `phi`, AR1's variance and walk from logarithms and `atanh phi`."""
    return np.array([np.exp(u[0]), np.tanh(u[1]), np.exp(u[2]), np.exp(u[3])])


def test_continuous_fits_are_minima_that_a_naive_search_finds_too():
    """Nelder-Mead on `r' V(theta)^-1 r`, from the truth."""
    found = gf.fit_gmwm(signals(2, 4096, MIXED, seed=2), "WN + AR1 + RW", weighting="continuous")
    assert bool(found.converged.all())
    for params, nu, objective in zip(
        found.params[:, 0], found.wavelet_variance[..., 0].numpy(), found.objective, strict=True
    ):

        def distance(u: np.ndarray, nu: np.ndarray = nu) -> float:
            _, covariance, residual = residual_of(MIXED, from_unknowns(u), 4096, nu)
            return float(residual @ np.linalg.solve(covariance, residual))

        truth = MIXED.params.numpy()
        start = np.array([np.log(truth[0]), np.arctanh(truth[1]), *np.log(truth[2:])])
        options = {"xatol": 1e-8, "fatol": 1e-11, "maxiter": 4000, "maxfev": 4000}
        least = optimize.minimize(distance, start, method="Nelder-Mead", options=options)
        assert objective.item() == pytest.approx(least.fun, rel=1e-7)
        np.testing.assert_allclose(params, from_unknowns(least.x), rtol=1e-4)


def test_continuous_fits_never_end_above_where_they_started():
    signal = signals(20, 1024, MIXED)
    optimal, found = (gf.fit_gmwm(signal, "WN + AR1 + RW", weighting=name) for name in ("optimal", "continuous"))
    assert (found.objective <= optimal.j_statistic * (1 + 1e-9)).all()
    assert (found.objective < optimal.j_statistic * (1 - 1e-3)).double().mean() > 0.9
    torch.testing.assert_close(found.objective, found.j_statistic)
    at_zero = optimal.params == 0
    assert bool(at_zero.any())
    assert (found.params[at_zero] == 0).all()


def test_a_log_residual_is_that_of_chi_squares():
    """Bias and variance of the logarithm of a scaled chi-square, from its own moments; correlations stay."""
    eta, expected = np.array([3.0, 40.0]), np.array([2.0, 0.5])
    sd = expected * np.sqrt(2 / eta)
    covariance = np.array([[1, 0.3], [0.3, 1]]) * np.outer(sd, sd)
    measured = np.array([1.5, 0.6])
    residual, spread = log_residual(*(torch.from_numpy(v) for v in (measured, expected, covariance)))
    logs = [stats.loggamma(e / 2, loc=np.log(2 * nu / e)) for e, nu in zip(eta, expected, strict=True)]
    np.testing.assert_allclose(residual, expected * (np.log(measured) - [v.mean() for v in logs]), rtol=1e-10)
    own = expected * np.array([v.std() for v in logs])
    np.testing.assert_allclose(spread, np.array([[1, 0.3], [0.3, 1]]) * np.outer(own, own), rtol=1e-8)


def test_log_fits_solve_their_equations():
    """`d ln nu / d theta' C^-1 (ln nu^ - bias - ln nu(theta)) = 0`, derivatives by differences."""
    found = gf.fit_gmwm(signals(3, 4096, MIXED, seed=2), "WN + AR1 + RW", moments="log")
    assert bool(found.converged.all())
    for params, nu, statistic in zip(
        found.params[:, 0].numpy(), found.wavelet_variance[..., 0].numpy(), found.j_statistic, strict=True
    ):
        expected, covariance, _ = residual_of(MIXED, params, 4096, nu)
        sd = np.sqrt(np.diag(covariance))
        half = (expected / sd) ** 2
        residual = np.log(nu / expected) - special.digamma(half) + np.log(half)
        own = np.sqrt(special.polygamma(1, half))
        weight = np.linalg.inv(covariance / np.outer(sd, sd) * np.outer(own, own))
        for k, value in enumerate(params):
            step = np.zeros_like(params)
            step[k] = 1e-5 * value
            up, down = (np.log(residual_of(MIXED, params + sign * step, 4096, nu)[0]) for sign in (1, -1))
            slope = up - down
            assert abs(slope @ weight @ residual) < 1e-4 * np.sqrt(slope @ weight @ slope)  # standard deviations
        assert statistic.item() == pytest.approx(residual @ weight @ residual, rel=1e-8)


@pytest.mark.parametrize("options", OPTIONS)
def test_a_batch_is_its_items_and_scale_only_scales(options):
    signal = signals(3, 2048, MIXED)
    together = gf.fit_gmwm(signal, "WN + AR1 + RW", **options)
    small = gf.fit_gmwm(1e-6 * signal, "WN + AR1 + RW", **options)
    factor = torch.tensor([1e-12, 1, 1e-12, 1e-12], dtype=torch.float64)
    torch.testing.assert_close(small.params / factor, together.params, rtol=1e-4, atol=1e-9)
    for i in range(3):
        alone = gf.fit_gmwm(signal[i], "WN + AR1 + RW", **options)
        torch.testing.assert_close(alone.params, together.params[i], rtol=1e-4, atol=1e-9)
        torch.testing.assert_close(alone.param_cov, together.param_cov[i], rtol=1e-2, atol=1e-12)


def test_gradients_may_be_off():
    signal = signals(2, 1024, WALK)
    expected = gf.fit_gmwm(signal, "WN + RW", weighting="continuous")
    with torch.no_grad():
        found = gf.fit_gmwm(signal, "WN + RW", weighting="continuous")
    torch.testing.assert_close(found.params, expected.params)
    assert not expected.params.requires_grad


@pytest.mark.parametrize("options", OPTIONS)
def test_every_process_has_its_derivatives(options):
    model = gf.WhiteNoise(1.0) + gf.AR1(0.9, 0.1) + gf.Sinusoid(0.5, 0.35) + gf.Drift(2e-4) + gf.QuantizationNoise(0.5)
    found = gf.fit_gmwm(signals(4, 8192, model), "WN + AR1 + SIN + DR + QN", **options)
    assert found.params.isfinite().all()
    assert found.param_cov.isfinite().all()
    assert found.converged.sum() >= 3


def test_an_incomplete_model_ends_at_its_limit_or_says_so():
    """A ramp, for which an AR1 is as slow as it may be; the continuous fit goes on along the limit."""
    ramp = signals(2, 4096, gf.WhiteNoise(1.0)) + 0.01 * torch.arange(4096)
    optimal, found = (gf.fit_gmwm(ramp, "WN + AR1", weighting=name) for name in ("optimal", "continuous"))
    assert bool(found.converged.all())
    assert (found.objective < optimal.j_statistic / 2).all()
    torch.testing.assert_close(found.params[..., 1], optimal.params[..., 1], rtol=1e-6, atol=0)
    assert (found.p_value < 1e-9).all()


@pytest.mark.parametrize("options", OPTIONS)
def test_degenerate_items_fail_alone(options):
    """White noise alone, whose walk is at zero in half of the records, beside a constant signal."""
    signal = signals(20, 512, gf.WhiteNoise(1.0))
    signal[3] = 1.0
    with pytest.warns(UserWarning, match="item 3; their results are NaN"):
        found = gf.fit_gmwm(signal, "WN + RW", **options)
    rest = torch.arange(20) != 3
    assert found.params[3].isnan().all()
    assert found.params[rest].isfinite().all()
    assert bool(found.converged[rest].all())
    assert not bool(found.converged[3])
    low, high = found.confidence_interval
    at_zero = found.params[..., 1] == 0
    assert 3 <= at_zero.sum() <= 16
    assert (low[..., 1][at_zero] == 0).all()
    assert (high[..., 1][at_zero] > 0).all()


@pytest.mark.parametrize("options", OPTIONS)
def test_long_records_make_little_difference(options):
    """40 000 samples, 40 records: half of the estimates within 0.2 standard deviations, of the walk within 0.8."""
    model = gf.WhiteNoise(1.0) + gf.AR1(0.95, 0.05) + gf.RandomWalk(1e-4)
    signal = signals(40, 40_000, model, seed=4)
    optimal, found = gf.fit_gmwm(signal, "WN + AR1 + RW"), gf.fit_gmwm(signal, "WN + AR1 + RW", **options)
    sd = optimal.param_cov[:, 0].diagonal(dim1=-2, dim2=-1).sqrt()
    apart = ((found.params - optimal.params)[:, 0].abs() / sd).median(0)[0]
    assert (apart < torch.tensor([0.2, 0.2, 0.2, 0.8])).all(), apart.tolist()
    assert bool(found.converged.all())


@pytest.fixture(scope="module")
def short() -> dict[str, gf.GMWMResult]:
    """400 records of 512 samples."""
    signal = signals(400, 512, WALK, seed=5)
    every = {"optimal": {}, "continuous": OPTIONS[0], "log": OPTIONS[1]}
    return {name: gf.fit_gmwm(signal, "WN + RW", **options) for name, options in every.items()}


def coverage(result: gf.GMWMResult) -> list[int]:
    low, high = result.confidence_interval
    return ((low <= WALK.params) & (WALK.params <= high)).sum((0, 1)).tolist()


def test_moving_weights_excuse_large_walks(short):
    """What the documentation warns of: intervals of the walk that hold it in fewer than nine of ten records."""
    white, walk = coverage(short["continuous"])
    assert white >= stats.binom.ppf(0.0005, 400, 0.95)
    assert walk < stats.binom.ppf(0.0005, 400, 0.9), walk
    means = {name: result.params[..., 1].mean().item() / 1e-3 for name, result in short.items()}
    assert means["continuous"] > 1.5 > means["log"] > means["optimal"], means
    assert (short["continuous"].p_value < 0.05).double().mean() < 0.05  # the J test is cautious


def test_log_moments_hold_the_truth_as_often(short):
    """Coverage within binomial bounds, errors at most a third larger, medians higher."""
    least = stats.binom.ppf(0.0005, 400, 0.95)
    assert min(coverage(short["log"])) >= least
    off = {name: short[name].params[..., 1] / 1e-3 - 1 for name in ("optimal", "log")}
    errors = {name: value.square().mean().sqrt().item() for name, value in off.items()}
    assert errors["log"] < errors["optimal"] * 4 / 3, errors
    assert off["log"].median() > off["optimal"].median()
    rejected = int((short["log"].p_value < 0.05).sum())
    assert rejected <= stats.binom.ppf(0.9995, 400, 0.07), rejected


@pytest.mark.parametrize("options", OPTIONS)
def test_results_and_bootstrap_carry_the_option(options):
    found = gf.fit_gmwm(signals(2, 2048, WALK), "WN + RW", **options)
    data = json.loads(json.dumps(found.to_dict()))
    assert data["weighting"] == options.get("weighting", "optimal")
    assert data["moments"] == options.get("moments", "variance")
    assert next(iter(options.values())) in found.summary().splitlines()[0]
    assert found.p_value.isfinite().all()
    again = gf.bootstrap_gmwm(found, 100, generator=torch.Generator().manual_seed(1))
    assert again.std.isfinite().all()
    # The resamples are fitted as the signal was: walks come out a third too large where weights move along.
    bias = (again.bias[..., 1] / found.params[..., 1]).mean()
    assert (bias > 0.15) == ("weighting" in options), bias


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weighting": "best"}, "`weighting`: expected one of 'optimal', 'diagonal', 'identity', 'continuous' or"),
        ({"moments": "cube"}, "`moments`: expected one of 'variance', 'log', got 'cube'"),
        ({"moments": "log", "weighting": "diagonal"}, "`moments`: expected 'log' with .*, got 'diagonal'"),
        ({"moments": "log", "weighting": torch.ones(8)}, "`moments`: expected 'log' with .*, got 'given'"),
    ],
)
def test_bad_options_are_told(options, message):
    with pytest.raises(ValueError, match=message):
        gf.fit_gmwm(signals(1, 512, WALK), "WN + RW", **options)
