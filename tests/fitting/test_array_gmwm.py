"""Matrices of an array's noise: that they are found with the spread that theory says, and what is not known is told."""

from __future__ import annotations

import json
import math

import matplotlib as mpl
import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting import ArrayGMWMResult, fit_array_gmwm_moments
from gyrofuse.fitting.array import search
from gyrofuse.fitting.array.fit import _Problem
from gyrofuse.fitting.array.inference import covariance_of_fit
from gyrofuse.fitting.array.moments import array_moment_covariance, unvech, vech
from gyrofuse.fitting.moments import fit as moment_fit
from gyrofuse.fitting.moments.fit import composition_of
from gyrofuse.fitting.moments.records import SampleDesign
from gyrofuse.fusion.weights.svo import resolve_scale_weights

N_SAMPLES, N_RUNS = 4096, 200
WHITE = torch.tensor([[1.0, 0.2, 0.0], [0.2, 0.5, 0.0], [0.0, 0.0, 2.0]], dtype=torch.float64)
WALK = 2e-3 * torch.tensor([[1.0, -0.6, 0.3], [-0.6, 1.5, 0.0], [0.3, 0.0, 0.8]], dtype=torch.float64)
TRUTH = torch.stack([WHITE, WALK])
ARRAY = gf.ArrayModel([(gf.WhiteNoise(1.0), WHITE), (gf.RandomWalk(1.0), WALK)])


def signals(n: int, model: gf.ArrayModel = ARRAY, n_samples: int = N_SAMPLES, seed: int = 0) -> Tensor:
    return model.simulate(n_samples, batch=(n,), generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def many() -> ArrayGMWMResult:
    return gf.fit_array_gmwm(signals(N_RUNS, seed=1), "WN + RW")


def naive_moment_covariance(processes: list[tuple[np.ndarray, np.ndarray]], n_levels: int) -> np.ndarray:
    """`Cov(x_a' K x_b, x_c' L x_d) = tr(K S_bd L S_ca) + tr(K S_bc L S_da)` with matrices over time."""
    n_samples, p = len(processes[0][0]), len(processes[0][1])
    whole = sum(np.einsum("ab,st->abst", theta, time) for time, theta in processes)
    kernels = []
    for level in range(1, n_levels + 1):
        half = 2 ** (level - 1)
        windows = np.zeros((n_samples - 2 * half + 1, n_samples))
        for row in range(len(windows)):
            windows[row, row : row + half] = -1 / (2 * half)
            windows[row, row + half : row + 2 * half] = 1 / (2 * half)
        kernels.append(windows.T @ windows / len(windows))
    pairs = [(a, b) for a in range(p) for b in range(a, p)]
    found = np.zeros((n_levels, len(pairs), n_levels, len(pairs)))
    for j, first in enumerate(kernels):
        for i, second in enumerate(kernels):
            for q, (a, b) in enumerate(pairs):
                for r, (c, d) in enumerate(pairs):
                    found[j, q, i, r] = np.trace(first @ whole[b, d] @ second @ whole[c, a])
                    found[j, q, i, r] += np.trace(first @ whole[b, c] @ second @ whole[d, a])
    return found


def test_covariance_of_moments_is_that_of_quadratic_forms():
    n_samples, levels, phi = 96, 4, 0.9
    time = np.arange(1, n_samples + 1)
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((3, 2, 2))
    theta = roots @ roots.transpose(0, 2, 1) * np.array([1.0, 0.1, 0.01])[:, None, None]
    lags = np.abs(time[:, None] - time)
    over_time = [np.eye(n_samples), phi**lags / (1 - phi**2), np.minimum(time[:, None], time).astype(float)]
    expected = naive_moment_covariance(list(zip(over_time, theta, strict=True)), levels)
    structure = composition_of("WN + AR1 + RW", held=False)
    shape = torch.tensor([[math.atanh(phi)]], dtype=torch.float64)
    got = array_moment_covariance(
        structure, torch.from_numpy(theta)[None], shape, SampleDesign((n_samples,), (levels,))
    )[0]
    scale = np.sqrt(np.einsum("jqjq->jq", expected))
    error = np.abs(got.numpy() - expected) / (scale[:, :, None, None] * scale)
    assert error.max() < 0.01  # what the covariance of one sensor promises


def test_derivatives_are_those_of_the_distance():
    """Slopes of slopes are differences of step 1e-4: their error, of its square, is below 1e-7 of the largest."""
    structure = composition_of("WN + AR1 + RW", held=False)
    generator = torch.Generator().manual_seed(2)
    tau = 2.0 ** torch.arange(1, 7, dtype=torch.float64)
    root = torch.randn(1, 3, 2, 2, generator=generator, dtype=torch.float64)
    root = root + root.mT
    shape = torch.tensor([[1.3]], dtype=torch.float64)
    gamma = torch.randn(1, 6, 3, generator=generator, dtype=torch.float64)
    half = torch.randn(18, 18, generator=generator, dtype=torch.float64)
    weight = (half @ half.T)[None]
    gradient, bends, _ = search._quadratic(gamma, weight, tau, structure, root, shape, exact=True)

    def distance(unknown: Tensor) -> Tensor:
        moved = root + search._in_basis(unknown[:9].view(1, 3, 3))
        return search._distance(gamma, weight, tau, structure, moved, shape + unknown[9:]).sum()

    nowhere = torch.zeros(10, dtype=torch.float64)
    torch.testing.assert_close(-2 * gradient[0], torch.func.grad(distance)(nowhere), rtol=1e-7, atol=0)
    expected = torch.func.hessian(distance)(nowhere)
    torch.testing.assert_close(2 * bends[0], expected, rtol=1e-7, atol=1e-7 * expected.abs().max().item())


def test_mean_and_spread_are_those_of_theory(many):
    """Mean within 0.2 standard deviations and 3.5 standard errors of the truth, spread within 3.5 of theory."""
    structure = composition_of("WN + RW", held=False)
    levels = many.wavelet_cross_covariance.shape[-3]
    gamma = ARRAY.wavelet_cross_covariance(levels)
    nothing = torch.empty(1, 0, dtype=torch.float64)
    spread, *_ = covariance_of_fit(gamma[None], TRUTH[None], nothing, SampleDesign((N_SAMPLES,), (levels,)), structure)
    theory = unvech(spread[0].diagonal().sqrt().view(2, 6))
    bias = (many.theta.mean(0) - TRUTH) / theory
    assert (bias.abs() < 0.2 + 3.5 / math.sqrt(N_RUNS)).all(), bias
    ratio = many.theta.std(0) / theory
    assert ((ratio - 1).abs() < 3.5 / math.sqrt(2 * N_RUNS)).all(), ratio


def test_intervals_hold_the_truth(many):
    """95 % intervals of every entry and correlation: within the 99.9 % binomial bounds of 200 runs."""
    least = stats.binom.ppf(0.0005, N_RUNS, 0.95)
    low, high = many.confidence_interval
    held = ((low <= TRUTH) & (high >= TRUTH)).sum(0)
    assert (held >= least).all(), held
    sd = TRUTH.diagonal(dim1=-2, dim2=-1).sqrt()
    correlation = TRUTH / (sd[:, :, None] * sd[:, None])
    low, high = many.correlation_interval
    held = ((low <= correlation + 1e-12) & (correlation <= high + 1e-12)).sum(0)
    assert (held >= least).all(), held
    assert bool(many.converged.all())


def test_j_test_has_its_size_and_power(many):
    rejected = int((many.p_value < 0.05).sum())
    assert rejected <= stats.binom.ppf(0.9995, N_RUNS, 0.1), rejected  # at most 10 % at nominal 5 %
    assert stats.binom.cdf(int((many.p_value < 0.5).sum()), N_RUNS, 0.5) > 0.0005
    model = ARRAY + gf.ArrayModel([(gf.AR1(0.9, 1.0), 0.1 * torch.eye(3))])
    without = gf.fit_array_gmwm(signals(20, model), "WN + RW")
    assert (without.p_value < 0.05).all()


def test_weights_from_the_model_lose_less(many):
    levels = many.wavelet_cross_covariance.shape[-3]
    omega = resolve_scale_weights("long", levels)
    combined = torch.einsum("j,jab->ab", omega, ARRAY.wavelet_cross_covariance(levels))
    best = gf.svo_weights(ARRAY.wavelet_cross_covariance(levels), "long")

    def excess(weights: Tensor) -> float:
        return (((weights @ combined) * weights).sum(-1) / (best @ combined @ best) - 1).mean().item()

    assert excess(many.svo_weights("long")) < excess(gf.svo_weights(many.wavelet_cross_covariance, "long")) / 2


@pytest.mark.parametrize(
    ("model", "formula"),
    [
        (gf.WhiteNoise(1.0) + gf.AR1(0.99, 0.02), "WN + AR1"),
        (gf.WhiteNoise(1.0) + gf.RandomWalk(1e-3), "WN + RW"),
    ],
)
def test_one_sensor_is_the_plain_fit(model, formula, monkeypatch):
    """With the weights of both at rest: here where a step moves the fit by less than a chi-square of 1e-5.

    That is 0.0032 standard deviations, and of a parameter known to 19 % a change of its weights, and so of the
    objective, of 2 * 0.0032 * 0.19 = 1.2e-3, of which steps that contract leave less than 1e-3. The plain fit stops
    after three changes of its weights, which alone leaves 1.3e-3 of its objective; ten bring it to rest.
    """
    monkeypatch.setattr(moment_fit, "N_REWEIGHTINGS", 10)
    signal = model.simulate(2**13, batch=(6,), generator=torch.Generator().manual_seed(3))[:, None]
    plain = gf.fit_gmwm(signal, formula)
    found = gf.fit_array_gmwm(signal, formula)
    own = dict(zip(plain.param_names, plain.params[:, 0].unbind(-1), strict=True))
    # A signal also tells the tails of its white noise; moments alone have the Gaussian law of the array's fit.
    of_moments = gf.fit_gmwm_moments(gf.wavelet_variance(signal), 2**13, formula).param_cov[:, 0]
    sd = dict(zip(plain.param_names, of_moments.diagonal(dim1=-2, dim2=-1).sqrt().unbind(-1), strict=True))
    sizes = [name for name in plain.param_names if name.endswith("variance")]
    for k, name in enumerate(sizes):
        assert ((found.theta[:, k, 0, 0] - own[name]).abs() < 0.0032 * sd[name]).all(), name
        torch.testing.assert_close(found.theta_std_err[:, k, 0, 0], sd[name], rtol=1e-2, atol=0)
    for k, name in enumerate(found.param_names):
        assert ((found.params[:, k] - own[name]).abs() < 0.0032 * sd[name]).all(), name
    torch.testing.assert_close(found.objective, plain.j_statistic[:, 0], rtol=1e-3, atol=0)


def test_shared_memory_is_found_with_its_tone():
    gains = torch.tensor([0.5, 0.25, 0.1], dtype=torch.float64)
    memory = gf.ArrayModel([(gf.AR1(0.98, 1.0), WALK * 20)])
    tone = gf.ArrayModel([(gf.Sinusoid(1.0, 0.3), gains)])
    model = gf.ArrayModel([(gf.WhiteNoise(1.0), WHITE)]) + memory + tone
    found = gf.fit_array_gmwm(signals(4, model, 2**14), "WN + AR1 + SIN")
    assert found.param_names == ("ar1_1.phi", "sinusoid_1.beta")
    assert ((found.params[:, 0] - 0.98).abs() < 4 * found.params_std_err[:, 0]).all()
    assert ((found.params[:, 1] - 0.3).abs() < 4 * found.params_std_err[:, 1]).all()
    assert ((found.theta[:, 2] - gains.outer(gains)).abs() < 4.5 * found.theta_std_err[:, 2]).all()
    assert (found.rank[:, 2] <= 2).all()
    assert "SIN: squared amplitudes, twice the variances, with 95 % intervals" in found[0].summary()


def test_matrices_are_positive_where_truth_lacks_rank():
    gains = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    model = gf.ArrayModel([(gf.WhiteNoise(1.0), WHITE), (gf.RandomWalk(1.0), 1e-3 * gains.outer(gains))])
    found = gf.fit_array_gmwm(signals(10, model), "WN + RW")
    values = torch.linalg.eigvalsh(found.theta)
    assert (values[..., 0] > -1e-12 * values[..., -1]).all()
    assert (found.correlation[:, 1, 0, 1] < -0.95).all()
    assert (found.correlation.abs() <= 1).all()
    assert bool(found.converged.all())


def test_without_a_walk_its_variances_are_next_to_nothing():
    """Above three standard deviations of theory one in ten at most (Cantelli); directions without variance vanish.

    The search ends with a move of less than a chi-square of 1e-9, 3e-5 standard deviations.
    """
    white = gf.ArrayModel([(gf.WhiteNoise(1.0), WHITE)])
    found = gf.fit_array_gmwm(signals(20, white), "WN + RW")
    assert bool(found.converged.all())
    structure = composition_of("WN + RW", held=False)
    levels = found.wavelet_cross_covariance.shape[-3]
    gamma = white.wavelet_cross_covariance(levels)
    truth = torch.stack([WHITE, 1e-12 * torch.eye(3, dtype=torch.float64)])
    nothing = torch.empty(1, 0, dtype=torch.float64)
    spread, *_ = covariance_of_fit(gamma[None], truth[None], nothing, SampleDesign((N_SAMPLES,), (levels,)), structure)
    sd = unvech(spread[0].diagonal().sqrt().view(2, 6))[1].diagonal()
    walk = found.theta[:, 1].diagonal(dim1=-2, dim2=-1)
    assert int((walk > 3 * sd).sum()) <= stats.binom.ppf(0.9995, walk.numel(), 0.1)
    values = torch.linalg.eigvalsh(found.theta[:, 1])
    lost = (values < 3e-5 * sd.amax()).sum(-1)
    assert torch.equal(found.rank[:, 1], 3 - lost)
    assert (lost > 0).sum() >= 10
    low, high = (limit[lost > 0, 1] for limit in found.confidence_interval)
    assert (low.diagonal(dim1=-2, dim2=-1) == 0).all()
    assert (high.diagonal(dim1=-2, dim2=-1) > 0).all()
    assert low[:, 0, 1].isnan().all()
    item = int((lost > 0).nonzero()[0])
    assert "random_walk: matrix of rank" in found[item].notes[0][0]
    assert found[item].notes[0][0] in str(found[item])
    assert found.theta.isfinite().all()


def test_memory_as_long_as_the_record_has_upper_limits():
    """The matrix has full rank, and yet its variances have upper limits only: they hold the truth, per sensor."""
    memory = gf.ArrayModel([(gf.AR1(math.exp(-7 / N_SAMPLES), 1.0), WALK)])
    found = gf.fit_array_gmwm(signals(40, gf.ArrayModel([(gf.WhiteNoise(1.0), WHITE)]) + memory), "WN + AR1")
    assert (found.rank == 3).all()
    low, high = (limit[:, 1] for limit in found.confidence_interval)
    own = torch.eye(3, dtype=torch.bool)
    assert (low[:, own] == 0).all()
    held = (high[:, own] >= WALK.diagonal()).sum(0)
    assert (held >= stats.binom.ppf(0.0005, 40, 0.95)).all(), held
    for nothing in (low[:, ~own], high[:, ~own], found.correlation_interval.low[:, 1][:, ~own]):
        assert nothing.isnan().all()
    assert found.params_interval.low.isnan().all()
    assert found.params.isfinite().all()
    words = "ar1_1: hardly told from a random walk at this length, its memory is longer than 1/50 of the record"
    assert words in found[0].notes[0][0]
    assert words in str(found[0])
    assert "no interval, see below" in str(found[0])
    assert found[0].to_dict()["remarks"] == [list(found[0].notes[0])]


def test_memory_next_to_white_noise_is_said_to_be():
    found = gf.fit_array_gmwm(signals(8, gf.ArrayModel([(gf.WhiteNoise(1.0), WHITE)]), 512), "WN + AR1")
    low, high = (limit[:, 0] for limit in found.params_interval)
    alike = (low <= 0) & (high >= 0)
    assert alike.any()
    said = ["ar1_1: indistinguishable from white noise at this length" in texts for texts in found.notes]
    assert said == alike.tolist()


def test_fit_is_no_worse_than_the_truth():
    """In `r' V^-1 r + ln det V`, also where weights that stay would lead far off, as in the first of these arrays."""
    slow, fast = math.exp(-7 / N_SAMPLES), 0.9
    theta = torch.stack([WHITE, 5 * WALK, 50 * WALK.flip(0, 1)])
    processes = (gf.WhiteNoise(1.0), gf.AR1(slow, 1.0), gf.AR1(fast, 1.0))
    model = gf.ArrayModel(list(zip(processes, theta, strict=True)))
    found = gf.fit_array_gmwm(signals(40, model, seed=3)[13:17], "WN + 2*AR1")
    gamma = found.wavelet_cross_covariance
    present, records = torch.ones_like(vech(gamma), dtype=torch.bool), SampleDesign((N_SAMPLES,), (gamma.shape[1],))
    problem = _Problem(vech(gamma), present, records, composition_of("WN + 2*AR1", held=False))
    none = torch.zeros(4, 3, dtype=torch.float64)
    got = problem.objective(search.square_root(found.theta, none), found.params.atanh())
    shape = torch.tensor([slow, fast], dtype=torch.float64).atanh().expand(4, -1)
    assert (got < problem.objective(search.square_root(theta.expand(4, -1, -1, -1), none), shape)).all()
    assert bool(found.converged.all())


def test_missing_sensor_is_the_fit_of_the_others():
    signal = signals(3)
    without = gf.fit_array_gmwm(signal[:, :2], "WN + RW")
    signal[:, 2] = torch.nan
    found = gf.fit_array_gmwm(signal, "WN + RW")
    torch.testing.assert_close(found.theta[..., :2, :2], without.theta, rtol=1e-7, atol=0)
    torch.testing.assert_close(found.theta_std_err[..., :2, :2], without.theta_std_err, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.p_value, without.p_value, rtol=1e-6, atol=0)
    assert found.theta[..., 2, :].isnan().all()
    weights = found.svo_weights("long")
    assert (weights[:, 2] == 0).all()
    torch.testing.assert_close(weights[:, :2], without.svo_weights("long"), rtol=1e-6, atol=1e-9)
    assert found[0].model.n_sensors == 2


def test_pair_that_never_meets_is_not_known():
    signal = signals(1)[0]
    signal[0, : N_SAMPLES // 2] = torch.nan
    signal[2, N_SAMPLES // 2 :] = torch.nan
    found = gf.fit_array_gmwm(signal, "WN + RW")
    assert found.theta[:, 0, 2].isnan().all()
    assert found.theta_std_err[:, 0, 2].isnan().all()
    assert found.theta.isfinite().sum() == 14
    assert found.fitted_wavelet_cross_covariance[:, 0, 2].isnan().all()
    assert bool(found.converged)
    with pytest.raises(ValueError, match=r"`model`: expected a fitted array whose sensors are recorded together"):
        _ = found.model


def test_gaps_leave_out_levels_without_windows():
    signal = signals(2)
    signal[:, 1, ::500] = torch.nan  # windows of 256 and less
    found = gf.fit_array_gmwm(signal, "WN + RW")
    assert found.wavelet_cross_covariance[:, 8:, 1].isnan().all()
    assert found.theta.isfinite().all()
    assert ((found.theta - TRUTH).abs() < 5 * found.theta_std_err).all()
    assert (found.dof == 11 * 6 - 3 * 3 - 12).all()


def test_a_batch_is_its_items():
    signal = signals(4).view(2, 2, 3, -1)
    together = gf.fit_array_gmwm(signal, "WN + RW")
    assert together.theta.shape == (2, 2, 2, 3, 3)
    for i in range(2):
        alone = gf.fit_array_gmwm(signal[1, i], "WN + RW")
        torch.testing.assert_close(alone.theta, together.theta[1, i], rtol=1e-8, atol=0)
        torch.testing.assert_close(alone.p_value, together[1, i].p_value, rtol=1e-6, atol=0)


def test_units_of_the_sensors_do_not_matter():
    signal = signals(2)
    units = torch.tensor([1e-6, 1.0, 1e3], dtype=torch.float64)
    found, scaled = (gf.fit_array_gmwm(s, "WN + RW") for s in (signal, signal * units[:, None]))
    torch.testing.assert_close(scaled.theta / units.outer(units), found.theta, rtol=1e-6, atol=1e-12)


def test_float32_and_moments_alone_give_the_same():
    signal = signals(2)
    found = gf.fit_array_gmwm(signal, "WN + RW", n_levels=9)
    single = gf.fit_array_gmwm((signal + 100).float(), "WN + RW", n_levels=9)
    assert single.theta.dtype == torch.float64
    torch.testing.assert_close(single.theta, found.theta, rtol=1e-3, atol=1e-6)
    wccv = gf.wavelet_cross_covariance(signal)
    moments = fit_array_gmwm_moments(wccv, N_SAMPLES, "WN + RW", n_levels=9)
    torch.testing.assert_close(moments.theta, found.theta, rtol=1e-9, atol=0)


def test_fitted_model_simulates_what_was_fitted(many):
    one = many[3]
    levels = one.wavelet_cross_covariance.shape[-3]
    torch.testing.assert_close(one.model.wavelet_cross_covariance(levels), one.fitted_wavelet_cross_covariance)
    torch.testing.assert_close(vech(one.theta), vech(many.theta[3]))
    assert one.model.simulate(100).shape == (3, 100)


def test_result_speaks_for_itself(many, tmp_path):
    mpl.use("Agg")
    recording = gf.Recording(signals(1)[0], rate=100.0, unit="deg/s", sensors=("a", "b", "c"))
    found = gf.fit_array_gmwm(recording, "WN + RW")
    text = str(found)
    for words in ("3 sensors, 4096 samples, 11 levels", "95 % interval", "degrees of freedom", "RW: variances", "  b "):
        assert words in text
    plain = json.loads(json.dumps(found.to_dict()))
    assert plain["theta"] == found.theta.tolist()
    assert plain["processes"] == ["WN", "RW"]
    axes = found.plot()
    axes.figure.savefig(tmp_path / "fit.png")
    assert [line.get_text() for line in axes.get_legend().get_texts()] == ["3 sensors", "fitted model"]
    assert "200 arrays in a batch (200,), 200 converged" in str(many)
    with pytest.raises(ValueError, match=r"`plot`: expected one array, got a batch \(200,\)"):
        many.plot()
    with pytest.raises(ValueError, match=r"`model`: expected one array, got a batch"):
        _ = many.model
    with pytest.raises(IndexError, match=r"expected at most 0 indices for batch shape \(\)"):
        found[0]


def test_dead_sensor_in_a_batch_is_data():
    signal = signals(2)
    signal[0, 1] = 3.0
    with pytest.warns(UserWarning, match=r"`signal`: expected wavelet variances > 0 .* got others in array\(s\) 0"):
        found = gf.fit_array_gmwm(signal, "WN + RW")
    assert found.converged.tolist() == [False, True]
    assert found.theta[0].isnan().all()
    assert "not fitted" in str(found[0])
    with pytest.raises(ValueError, match="leave sensors out or ask for fewer"):
        gf.fit_array_gmwm(signal[0], "WN + RW")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"model": "WN + DR"}, r"`model`: expected noise processes, got a Drift"),
        ({"model": "WN(variance=1)"}, r"`model`: expected parameters to be estimated"),
        ({"model": "WN + 2*AR1", "n_levels": 3}, r"`model`: expected at most as many parameters of a sensor as the 3"),
        ({"weighting": "pairwise"}, r"`weighting`: expected 'optimal', got 'pairwise'; .* fit arrays .* in groups"),
        ({"n_levels": 30}, r"`n_levels`: expected at most 12 for 4096 samples"),
        ({"confidence_level": 1.5}, r"`confidence_level`: expected a number between 0 and 1"),
    ],
)
def test_what_cannot_be_fitted_is_said(options, words):
    with pytest.raises(ValueError, match=words):
        gf.fit_array_gmwm(signals(1)[0], **{"model": "WN + RW", **options})


def test_levels_of_given_moments_are_checked():
    wccv = gf.wavelet_cross_covariance(signals(1)[0], 6)
    with pytest.raises(ValueError, match=r"`wavelet_cross_covariance`: expected .* of at most 12 levels"):
        fit_array_gmwm_moments(signals(1)[0], N_SAMPLES, "WN + RW")
    with pytest.raises(ValueError, match=r"`n_levels`: expected 1 to 6, the levels given, got 7"):
        fit_array_gmwm_moments(wccv, N_SAMPLES, "WN + RW", n_levels=7)
    with pytest.raises(TypeError, match=r"`signal`: expected a torch tensor"):
        gf.fit_array_gmwm([[1.0, 2.0]], "WN + RW")


@pytest.mark.parametrize("value", [3.0, math.inf])
def test_the_sensor_that_spoils_an_array_is_named(value):
    signal = signals(2)
    signal[0, 1, :: 1 if math.isfinite(value) else 1000] = value
    with pytest.warns(UserWarning, match=r"got others in array\(s\) 0 \(sensor 2\); their results are NaN"):
        assert gf.fit_array_gmwm(signal, "WN + RW").converged.tolist() == [False, True]
    recording = gf.Recording(signal[0], rate=1.0, sensors=("a", "b", "c"))
    with pytest.raises(ValueError, match=r"got others in array\(s\) 0 \(sensor b\); leave sensors out"):
        gf.fit_array_gmwm(recording, "WN + RW")


def test_given_moments_are_symmetric_and_not_a_recording():
    wccv = gf.wavelet_cross_covariance(signals(1)[0].float(), 6)  # rounds
    assert bool(fit_array_gmwm_moments(wccv, N_SAMPLES, "WN + RW").converged)
    wccv[2, 0, 1] *= 1.5
    with pytest.raises(ValueError, match="`wavelet_cross_covariance`: expected a symmetric one"):
        fit_array_gmwm_moments(wccv, N_SAMPLES, "WN + RW")
    with pytest.raises(ValueError, match="`n_samples`: expected None with a Recording"):
        gf.fit_array_gmwm(gf.Recording(signals(1)[0], rate=1.0), "WN + RW", n_samples=N_SAMPLES)


def test_a_duplicated_sensor_is_named():
    signal = torch.randn(3, 4096, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    signal[1] = 2 * signal[0]
    with pytest.raises(gf.SingularCovarianceError, match="1 and 2"):
        gf.fit_array_gmwm(signal, "WN")
