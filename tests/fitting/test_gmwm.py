"""The moment fit: that it reaches the minimum, recovers what was put in, and says what it does not know."""

from __future__ import annotations

import json
import math

import matplotlib as mpl
import numpy as np
import pytest
import torch
from reference import published
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting import GMWMResult, fit_array_gmwm_moments, rank_models_moments
from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.fit import composition_of

SIMULATION = gf.WhiteNoise(1.0) + gf.AR1(0.975, 0.03) + gf.RandomWalk(4e-4) + gf.Sinusoid(0.85, 0.35)
FORMULA = "WN + AR1 + RW + SIN"


def signals(n: int, n_samples: int = 8192, model: gf.Model = SIMULATION, seed: int = 0) -> Tensor:
    return model.simulate(n_samples, batch=(n,), generator=torch.Generator().manual_seed(seed))[:, None]


@pytest.fixture(scope="module")
def many() -> GMWMResult:
    """200 records of 10 000 samples."""
    return gf.fit_gmwm(signals(200, 10_000, seed=3), FORMULA)


@pytest.mark.statistical
def test_intervals_hold_the_truth(many):
    """95 % intervals of every parameter, tone included: within the 99.9 % binomial bounds of 200 runs."""
    low, high = many.confidence_interval
    held = ((low <= SIMULATION.params) & (SIMULATION.params <= high)).sum((0, 1))
    least = stats.binom.ppf(0.0005, 200, 0.95)
    assert (held >= least).all(), dict(zip(many.param_names, held.tolist(), strict=True))
    assert bool(many.converged.all())


def test_spread_and_mean_are_those_of_theory(many):
    """Mean within 0.2 standard deviations and 3.3 standard errors, spread within 20 % (3.3 standard errors are 17)."""
    found, truth = many.params[:, 0], SIMULATION.params
    said = many.param_cov[:, 0].diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    spread = found.std(0)
    assert ((spread / said - 1).abs() < 0.2).all(), (spread / said).tolist()
    bias = found.mean(0) - truth
    assert (bias.abs() < (0.2 + 3.3 / math.sqrt(200)) * spread).all(), (bias / spread).tolist()


@pytest.mark.statistical
def test_j_test_has_its_size_and_power(many):
    rejected = int((many.p_value < 0.05).sum())
    assert rejected <= stats.binom.ppf(0.9995, 200, 0.1), rejected  # 1 to 10 % at nominal 5 %
    without = gf.fit_gmwm(signals(40, 10_000, seed=3), "WN + AR1 + RW")
    assert (without.p_value < 0.05).all()  # a tone of 0.85 sigma is missing


@pytest.mark.parametrize(("axis", "formula"), [("gx", "WN + AR1 + RW"), ("gy", "WN + AR1 + RW + SIN")])
def test_published_criterion_is_reached_or_beaten(axis, formula):
    """The same weights, from automatic starts; the published package stops early, at several times the minimum."""
    simts = published.table("simts")[axis]
    nu = torch.tensor(simts["wv"], dtype=torch.float64)
    omega = 1 / torch.tensor(simts["V_diag"], dtype=torch.float64)
    found = gf.fit_gmwm_moments(nu[:, None], 20_000, formula, weighting=omega)
    assert found.objective.item() <= simts["obj"] * (1 + 1e-6)
    expected = torch.tensor(simts["opt"], dtype=torch.float64)
    named = dict(zip(found.param_names, found.params[0].tolist(), strict=True))
    got = [named[name] for name in ("ar1_1.phi", "ar1_1.variance", "white_noise.variance", "random_walk.variance")]
    torch.testing.assert_close(torch.tensor(got, dtype=torch.float64), expected[:4], rtol=1e-4, atol=0)


@pytest.mark.statistical
@pytest.mark.parametrize(("axis", "formula"), [("gx", "WN + AR1 + RW"), ("gy", "WN + AR1 + RW + SIN")])
def test_no_start_finds_a_lower_minimum_of_noisy_copies(axis, formula, draws):
    """20 random starts each for some copies."""
    simts = published.table("simts")[axis]
    nu, variance = (torch.tensor(simts[key], dtype=torch.float64) for key in ("wv", "V_diag"))
    generator = torch.Generator().manual_seed(5)
    n = draws(10, 40)
    noise = torch.randn(n, len(nu), generator=generator, dtype=torch.float64)
    copies = nu * (noise * (variance.sqrt() / nu).clamp(max=0.5)).exp()
    found = gf.fit_gmwm_moments(copies.unsqueeze(-1), 20_000, formula, weighting=1 / variance)
    structure = composition_of(formula, held=False)
    tau = 2.0 ** torch.arange(1, len(nu) + 1, dtype=torch.float64)
    best = torch.full((n,), torch.inf, dtype=torch.float64)
    for _ in range(20):
        start = torch.rand(n, len(structure.nonlinear), generator=generator, dtype=torch.float64)
        start[:, 0] = 8 * start[:, 0] - 1
        start[:, 1:] = 12 * start[:, 1:] - 9
        least = search.minimise(copies, variance.rsqrt().expand(n, -1), tau, structure, start, 200)[2]
        best = torch.minimum(best, least)
    assert (found.objective[:, 0] <= best * (1 + 1e-6)).all(), (found.objective[:, 0] / best).max()


def test_two_ar1s_are_found_and_come_in_order():
    model = gf.WhiteNoise(1.0) + gf.AR1(0.9995, 1e-3) + gf.AR1(0.9, 0.5)
    found = gf.fit_gmwm(signals(4, 100_000, model), "WN + 2*AR1")
    low, high = found.confidence_interval
    assert found.param_names[1] == "ar1_1.phi"
    assert ((low <= model.params) & (model.params <= high)).double().mean() > 0.8
    torch.testing.assert_close(found.params[..., 3], torch.full((4, 1), 0.9).double(), rtol=0.1, atol=0)


def test_an_empty_component_is_at_its_limit():
    """White noise alone: the walk's variance is zero in about half of the records, with an upper limit."""
    found = gf.fit_gmwm(signals(40, 4096, gf.WhiteNoise(1.0)), "WN + RW")
    walk = found.params[..., 1]
    assert 8 <= (walk == 0).sum() <= 32
    low, high = found.confidence_interval
    at_zero = walk == 0
    assert (low[..., 1][at_zero] == 0).all()
    assert (high[..., 1][at_zero] > 0).all()
    assert (found.param_cov[..., 1, 1][at_zero] == 0).all()
    assert "at its limit" in gf.fit_gmwm(signals(40, 4096, gf.WhiteNoise(1.0))[at_zero[:, 0]][0], "WN + RW").summary()


@pytest.mark.parametrize("weighting", ["diagonal", "identity"])
def test_other_weightings_find_the_same_truth(weighting):
    model = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-3)
    found = gf.fit_gmwm(signals(50, 8192, model), "WN + RW", weighting=weighting)
    low, high = found.confidence_interval
    held = ((low <= model.params) & (model.params <= high)).sum((0, 1))
    # With equal weights the last level decides, of hardly two observations: 90 % there.
    assert (held >= stats.binom.ppf(0.0005, 50, 0.9)).all(), held.tolist()
    assert found.p_value.isnan().all()


def test_a_batch_is_its_items():
    signal = signals(3)
    together = gf.fit_gmwm(signal, FORMULA)
    for i in range(3):
        alone = gf.fit_gmwm(signal[i], FORMULA)
        torch.testing.assert_close(alone.params, together.params[i], rtol=1e-5, atol=1e-9)
        torch.testing.assert_close(alone.param_cov, together.param_cov[i], rtol=1e-3, atol=1e-12)


def test_scale_only_scales():
    signal = signals(2)
    found, small = gf.fit_gmwm(signal, FORMULA), gf.fit_gmwm(1e-6 * signal, FORMULA)
    factor = torch.tensor([1e-12, 1, 1e-12, 1e-12, 1e-6, 1], dtype=torch.float64)
    torch.testing.assert_close(small.params / factor, found.params, rtol=1e-5, atol=1e-9)


def test_float32_gives_the_right_answer_far_from_zero():
    signal = signals(1)
    got = gf.fit_gmwm((signal + 1000).float(), FORMULA)
    assert got.params.dtype == torch.float64  # phi and beta need their digits
    torch.testing.assert_close(got.params, gf.fit_gmwm(signal, FORMULA).params, rtol=2e-3, atol=1e-6)


def test_refined_fits_know_their_parameters_better():
    """60 records: no wider on average, the truth held as often as binomial bounds ask, one with a gap not refined."""
    signal = signals(60, 10_000, seed=4)
    moments, refined = gf.fit_gmwm(signal, FORMULA), gf.fit_gmwm(signal, FORMULA, refine=True)
    sd, better = (r.param_cov.diagonal(dim1=-2, dim2=-1).mean((0, 1)).sqrt() for r in (moments, refined))
    assert (better < 1.02 * sd).all(), (better / sd).tolist()
    low, high = refined.confidence_interval
    held = ((low <= SIMULATION.params) & (SIMULATION.params <= high)).sum((0, 1))
    assert (held >= stats.binom.ppf(0.0005, 60, 0.95)).all(), held.tolist()
    assert refined.to_dict()["refined"]
    signal[1, 0, 500] = math.nan
    with pytest.warns(UserWarning, match="1 of 2 fits could not be refined"):
        kept = gf.fit_gmwm(signal[:2], "WN + AR1 + RW", refine=True)
    assert kept.params.isfinite().all()
    with pytest.raises(ValueError, match="`refine`: expected a signal"):
        gf.fit_gmwm(torch.ones(8, 1), "WN", n_samples=512, refine=True)


def test_one_bad_item_fails_alone():
    signal = signals(3)
    signal[1] = 2.5
    with pytest.warns(UserWarning, match="sensor 1 of item 1; their results are NaN and not converged"):
        found = gf.fit_gmwm(signal, "WN + AR1")
    assert found.converged.tolist() == [[True], [False], [True]]
    assert found.params[1].isnan().all()
    assert found.params[[0, 2]].isfinite().all()
    assert "item 1: not fitted" in found.summary()
    assert json.dumps(found.to_dict())
    with pytest.raises(ValueError, match="constant signal has none"):
        gf.fit_gmwm(signal, "WN + AR1", strict=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"model": "WN + 3*AR1 + RW + QN", "n_levels": 6}, "at most as many parameters as the 6 levels, got 9"),
        ({"model": "WN + FLICKER"}, "FLICKER"),
        ({"model": gf.WhiteNoise(1.0) + gf.AR1()}, "got values of white_noise.variance"),
        ({"model": "WN", "weighting": "best"}, "`weighting`: expected one of 'optimal'"),
        ({"model": "WN", "weighting": "continuous"}, "`weighting`: .* got 'continuous'; 'optimal' has the smallest"),
        ({"model": "WN", "moments": "log"}, "`moments`: expected 'variance', got 'log'; .* leave `moments` out"),
        ({"model": "WN", "weighting": torch.ones(3)}, r"expected \(12,\) or \(12, 12\)"),
        ({"model": "WN", "weighting": -torch.ones(12)}, "weights >= 0"),
        ({"model": "WN", "confidence_level": 1.0}, "`confidence_level`"),
        ({"model": "WN", "n_levels": 40}, "`n_levels`"),
    ],
)
def test_bad_options_are_told(arguments, message):
    with pytest.raises(ValueError, match=message):
        gf.fit_gmwm(signals(1), **arguments)


@pytest.mark.parametrize("value", [-1.0, math.nan, 0.0])
def test_bad_wavelet_variances_are_told(value):
    nu = torch.ones(10, 1, dtype=torch.float64)
    nu[3] = value
    with pytest.raises(ValueError, match="finite and > 0 at every level"):
        gf.fit_gmwm_moments(nu, 2048, "WN")
    with pytest.raises(ValueError, match="at most 11 levels for 2048 samples"):
        gf.fit_gmwm_moments(torch.ones(12, 1), 2048, "WN")


def test_result_speaks_draws_and_simulates_again():
    recording = gf.Recording(signals(1)[0], rate=100.0, unit="deg/s")
    found = gf.fit_gmwm(recording, FORMULA)
    text = str(found)
    for part in ("angle random walk N", "tone frequency", "J = "):
        assert part in text
    with mpl.rc_context({"backend": "agg"}):
        ax = found.plot()
        labels = [t.get_text() for t in ax.get_legend().get_texts()]
    assert ax.get_title(loc="left") == f"sensor 1: {found.name}"
    assert labels[:3] == ["95 % interval", "measured", "fitted model"]
    assert "SIN 1" in labels
    again = gf.model_from_dict(json.loads(json.dumps(found.to_dict()["model"])))
    torch.testing.assert_close(again.params, found.params)
    assert again.simulate(64).shape == (1, 64)


def test_a_process_more_does_not_fit_worse_where_no_model_fits(shared):
    """A hand-held recording: weights and fit would chase each other from one bad fit to another and back."""
    recorded = np.load(shared / "data" / "broad_trials.npz")
    first, last = (np.flatnonzero(np.diff(recorded["t26_movement"])) + 1)[:2]
    signal = torch.as_tensor(recorded["t26"][4:5, first + 600 : last - 600].astype(float))
    without, with_tone = (gf.fit_gmwm(signal, formula) for formula in ("AR1 + RW", "AR1 + RW + SIN"))
    assert with_tone.j_statistic < without.j_statistic
    assert bool(without.converged)


def test_a_refused_model_does_not_get_sharper_intervals():
    """White noise and a walk fitted to an AR1: what is minimised rises steeply beside a minimum that means nothing."""
    signal = gf.AR1(0.9, 1.0).simulate(2280, batch=(100,), generator=torch.Generator().manual_seed(7))
    result = gf.fit_gmwm(signal, "WN + RW")
    low, high = result.confidence_interval
    seen = (result.params[:, 0] > 0) & (result.p_value < 1e-3)
    assert seen.sum() > 50
    assert ((high - low)[seen, 0] > 0.2 * result.params[seen, 0]).all()


def test_the_figure_holds_what_is_measured_and_a_model_that_does_not_fit():
    signal = gf.AR1(0.9, 1.0).simulate(4000, batch=(1,), generator=torch.Generator().manual_seed(7))
    found = gf.fit_gmwm(signal, "RW")
    with mpl.rc_context({"backend": "agg"}):
        ax = found.plot()
        low, high = ax.get_ylim()
    for variance in (found.wavelet_variance, found.fitted_wavelet_variance):
        deviation = (2 * variance).sqrt()
        assert low < deviation.min() <= deviation.max() < high


@pytest.mark.filterwarnings("ignore:`signal`")
def test_a_sensor_that_is_not_fitted_is_none_in_the_dictionary():
    signal = torch.randn(2, 2000, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    signal[1] = 3.0
    plain = gf.fit_gmwm(signal, "WN + RW").to_dict()
    assert json.loads(json.dumps(plain, allow_nan=False))["model"]["processes"][0]["variance"][1] is None


def test_infinite_samples_are_no_measurement():
    signal = torch.randn(2, 1000, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    signal[1, 7] = -math.inf
    with pytest.warns(
        UserWarning, match=r"nor has one with infinite samples; .* got others at sensor 2; their results"
    ):
        found = gf.fit_gmwm(signal, "WN")
    assert found.converged.tolist() == [True, False]
    with pytest.raises(ValueError, match="infinite samples"):
        gf.fit_gmwm(signal, "WN", strict=True)
    with pytest.raises(ValueError, match=r"`signal`: .* infinite samples"):
        gf.fit_gmwm_joint([signal[:1], signal[1:]], "WN")
    signal[1, 7] = math.nan
    assert gf.fit_gmwm(signal, "WN").converged.all()


def test_a_signal_is_no_wavelet_variance():
    signal = torch.randn(2, 1000, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    for function, model in ((gf.fit_gmwm_moments, "WN"), (rank_models_moments, ["WN"])):
        message = r"`wavelet_variance`: expected a wavelet variance .* got shape \(2, 1000\), that of"
        with pytest.raises(ValueError, match=message):
            function(signal, 1000, model)
        with pytest.raises(TypeError, match="`wavelet_variance`: expected a torch tensor, got Recording"):
            function(gf.Recording(signal, rate=1.0), 1000, model)


def test_wavelet_variances_go_to_the_functions_for_signals_with_a_warning():
    signal = torch.randn(2, 1000, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    variance = gf.wavelet_variance(signal)
    calls = {
        "fit_gmwm": lambda values: gf.fit_gmwm(values, "WN + RW", n_samples=1000),
        "rank_models": lambda values: gf.rank_models(values, ["WN"], n_samples=1000, fit=False),
    }
    for name, call in calls.items():
        with pytest.warns(DeprecationWarning, match=f"`n_samples` of {name} is deprecated .* use {name}_moments"):
            call(variance)
        with pytest.raises(ValueError, match=r"`n_samples`: expected None with a Recording, .* got 1000; leave it out"):
            call(gf.Recording(signal, rate=1.0))
    expected = gf.fit_gmwm_moments(variance, 1000, "WN + RW")
    with pytest.warns(DeprecationWarning, match="n_samples"):
        torch.testing.assert_close(calls["fit_gmwm"](variance).params, expected.params, rtol=0, atol=0)
    wccv = gf.wavelet_cross_covariance(signal)
    with pytest.warns(DeprecationWarning, match="use fit_array_gmwm_moments"):
        found = gf.fit_array_gmwm(wccv, "WN", n_samples=1000)
    assert torch.equal(found.theta, fit_array_gmwm_moments(wccv, 1000, "WN").theta)


def test_old_names_of_fits_work_with_a_warning():
    signal = torch.randn(2, 1000, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    with pytest.warns(DeprecationWarning, match="argument `moments` of fit_gmwm"):
        found = gf.fit_gmwm(signal, "WN + RW", moments="variance")
    with pytest.warns(DeprecationWarning, match="GMWMResult.remarks is deprecated .* use notes"):
        assert found.remarks == found.notes
    with pytest.warns(DeprecationWarning, match="use gyrofuse.fitting.GMWMResult"):
        assert gf.GMWMResult is GMWMResult
    with pytest.warns(DeprecationWarning, match="fit_gmwm_joint"):
        joint = gf.fit_jointly([signal, signal], "WN")
    with pytest.warns(DeprecationWarning, match="use dof"):
        assert torch.equal(joint.degrees, joint.dof)
    again = gf.bootstrap_gmwm(found, 20)
    with pytest.warns(DeprecationWarning, match="use std_err"):
        assert torch.equal(again.std, again.std_err)
    array = gf.fit_array_gmwm(signal, "WN")
    for old, new in {"theta_sd": "theta_std_err", "params_sd": "params_std_err", "degrees_of_freedom": "dof"}.items():
        with pytest.warns(DeprecationWarning, match=f"use {new}"):
            assert torch.equal(getattr(array, old), getattr(array, new))
    with pytest.warns(DeprecationWarning, match="`max_tones` is deprecated .* use `max_sinusoids`"):
        ranked = gf.rank_models(signal, ["WN"], max_tones=1, fit=False)
    with pytest.warns(DeprecationWarning, match="use n_sinusoids"):
        assert torch.equal(ranked.n_tones, ranked.n_sinusoids)


def test_results_are_indexed_by_the_dimensions_of_the_batch():
    """What an item of a batch holds is what a fit of the item alone holds, and prints alike."""
    signal = torch.randn(3, 2, 1000, dtype=torch.float64, generator=torch.Generator().manual_seed(4)).cumsum(-1)
    axes = gf.Recording(signal, rate=1.0, axes=("x", "y", "z"))
    fits = gf.fit_gmwm(axes, "WN + AR1 + RW")
    joints = gf.fit_gmwm_joint([signal, signal[..., :800]], "WN + RW")
    ranked = gf.rank_models(axes, ["RW", "WN + RW"])
    again = gf.bootstrap_gmwm(fits, 20, generator=torch.Generator().manual_seed(1))
    for result in (fits, joints, ranked, again):
        assert result.batch_shape == (3,)
        one = result[1]
        assert one.batch_shape == ()
        assert result[1:].batch_shape == (2,)
        assert result[1:][0].to_dict() == one.to_dict()
        with pytest.raises(IndexError, match="expected at most 0 indices"):
            one[0]
    assert torch.equal(fits[1].params, fits.params[1])
    assert fits[1].notes == fits.notes[2:4]
    assert (fits[1].axes, fits[1:].axes) == ((), ("y", "z"))
    assert torch.equal(fits[1].model.params, fits.params[1])
    assert ranked[2].best == ranked.best[4:]
    torch.testing.assert_close(joints[1].shift, joints.shift[:, 1], rtol=0, atol=0, equal_nan=True)
    assert torch.equal(fits.std_err, fits.param_cov.diagonal(dim1=-2, dim2=-1).sqrt())
    alone = gf.fit_gmwm(gf.Recording(signal[1], rate=1.0), "WN + AR1 + RW")
    assert str(alone) == str(fits[1])


def test_limits_of_tones_are_printed_with_the_digits_they_need():
    signal = (gf.WhiteNoise(1.0) + gf.Sinusoid(1.0, 0.35)).simulate(
        20_000, batch=(1,), generator=torch.Generator().manual_seed(4)
    )
    found = gf.fit_gmwm(signal, "WN + SIN")
    (row,) = (line for line in found.summary().splitlines() if "beta" in line)
    cells = row.replace("[", " ").replace("]", " ").replace(",", " ").split()
    value, low, high = map(float, cells[1:])
    assert low < value < high
    first, last = (limit[0, 2].item() for limit in found.confidence_interval)
    assert high - low == pytest.approx(last - first, rel=0.1)


def test_squares_that_leave_the_range_are_told():
    signal = 1e160 * torch.randn(1, 1000, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    with pytest.raises(ValueError, match="squares of huge or tiny numbers leave the range"):
        gf.fit_gmwm(signal, "WN")


def test_other_units_than_of_rates_have_no_datasheet():
    signal = torch.randn(1, 1000, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    texts = {unit: str(gf.fit_gmwm(gf.Recording(signal, rate=1.0, unit=unit), "WN")) for unit in ("m/s^2", "deg/s")}
    assert "white_noise.variance" in texts["m/s^2"]
    assert "angle random walk" not in texts["m/s^2"]
    assert "angle random walk" in texts["deg/s"]


@pytest.mark.parametrize("refine", [False, True])
def test_a_drift_has_the_sign_of_the_signal(refine: bool):
    g = torch.Generator().manual_seed(5)
    slopes = torch.tensor([-1e-5, 1e-5], dtype=torch.float64)
    falling = gf.WhiteNoise(1e-4).simulate(8192, batch=(2,), generator=g) + slopes[:, None] * torch.arange(8192)
    fit = gf.fit_gmwm(falling, "WN + DR", refine=refine)
    at = fit.param_names.index("drift.slope")
    assert (fit.params[:, at].sign() == slopes.sign()).all()
    low, high = fit.confidence_interval
    assert ((low[:, at] < slopes) & (slopes < high[:, at])).all()
    assert (fit.param_cov.diagonal(dim1=-2, dim2=-1) >= 0).all()
    # The filter that is made of it follows the signal.
    own = gf.state_space(fit.model.with_params(fit.params[0]), 1.0).kalman_log_likelihood(falling[0])
    true = gf.state_space(gf.WhiteNoise(1e-4) + gf.Drift(-1e-5), 1.0).kalman_log_likelihood(falling[0])
    assert abs(float(own - true)) < 20
    if not refine:
        again = gf.bootstrap_gmwm(fit, 20, generator=g)
        assert ((again.percentile.low[:, at] < slopes) & (slopes < again.percentile.high[:, at])).all()
        joint = gf.fit_gmwm_joint([falling, falling], "WN + DR").joint
        assert (joint.params[:, at].sign() == slopes.sign()).all()


@pytest.mark.parametrize("model", ["DR", "SIN", "DR + SIN"])
def test_a_model_without_noise_is_refused(model: str):
    with pytest.raises(ValueError, match="a noise process beside sinusoids and drifts"):
        gf.fit_gmwm(torch.randn(1, 4096, dtype=torch.float64), model)


def test_what_is_no_fit_cannot_be_resampled():
    with pytest.raises(TypeError, match="expected a GMWMResult"):
        gf.bootstrap_gmwm(torch.zeros(3), 20)
