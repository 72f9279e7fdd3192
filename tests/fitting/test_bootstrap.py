"""The parametric bootstrap of a moment fit, against theory and a plain loop."""

from __future__ import annotations

import json

import matplotlib as mpl
import numpy as np
import pytest
import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting import GMWMResult
from gyrofuse.fitting import bootstrap as moment_bootstrap

MODEL = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-2)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def signals(n: int = 2, n_samples: int = 2048) -> Tensor:
    return MODEL.simulate(n_samples, batch=(n,), generator=seeded(3))


@pytest.fixture(scope="module")
def fitted() -> GMWMResult:
    return gf.fit_gmwm(signals(), "WN + RW")


def test_it_is_what_a_loop_over_fits_gives(fitted):
    """Bias, spread, percentiles and p-value of fits to the same records."""
    found = gf.bootstrap_gmwm(fitted, 30, generator=seeded(1))
    records = fitted.model.simulate(2048, batch=(30,), generator=seeded(1))
    again = gf.fit_gmwm(records, "WN + RW")
    torch.testing.assert_close(found.bias, again.params.mean(0) - fitted.params, rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(found.std_err, again.params.std(0), rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(found.percentile.high, again.params.quantile(0.975, 0), rtol=1e-6, atol=1e-12)
    larger = (again.j_statistic >= fitted.j_statistic).sum(0)
    torch.testing.assert_close(found.p_value, (1 + larger) / 31, check_dtype=False)
    # u = ln p: t = (u* - u) / sd*
    sd = again.param_cov.diagonal(dim1=-2, dim2=-1).sqrt() / again.params
    t = (again.params / fitted.params).log() / sd
    own = fitted.param_cov.diagonal(dim1=-2, dim2=-1).sqrt() / fitted.params
    expected = fitted.params * (-t.quantile(0.975, 0) * own).exp()
    torch.testing.assert_close(found.studentized.low, expected, rtol=1e-6, atol=1e-12)


def test_chunks_do_not_matter(fitted, monkeypatch):
    whole = gf.bootstrap_gmwm(fitted, 20, generator=seeded(1))
    monkeypatch.setattr(moment_bootstrap, "items_at_once", lambda numbers: 1)
    parts = gf.bootstrap_gmwm(fitted, 20, generator=seeded(1))
    assert parts.std_err.shape == whole.std_err.shape
    # Other records, as draws come in another order, of the same law: within 4 standard errors of a ratio of two.
    assert ((parts.std_err / whole.std_err).log().abs() < 4 / 20**0.5).all()


def test_spread_is_that_of_theory(fitted):
    """Within 4 standard errors, 14 %, and 10 % for the linearisation."""
    found = gf.bootstrap_gmwm(fitted, 400, generator=seeded(2))
    said = fitted.param_cov.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((found.std_err / said - 1).abs() < 0.24).all(), found.std_err / said
    assert (found.bias.abs() < 0.3 * found.std_err).all()


@pytest.mark.parametrize("weighting", ["optimal", "diagonal", "identity"])
def test_p_values_reject_what_is_incomplete(weighting):
    """Of six complete records at most two at 5 %, which is exceeded once in 450 times; all without their tone.

    Equal weights look at the largest variances, those of the walk, and see no tone.
    """
    tone = gf.Sinusoid(1.0, 0.35).simulate(2048, generator=seeded(5))
    fits = [gf.fit_gmwm(signal, "WN + RW", weighting=weighting) for signal in (signals(6), signals(6) + tone)]
    good, bad = (gf.bootstrap_gmwm(fit, 99, generator=seeded(4)).p_value for fit in fits)
    assert int((good <= 0.05).sum()) <= 2
    if weighting != "identity":
        torch.testing.assert_close(bad, torch.full_like(bad, 0.01), rtol=1e-6, atol=0)


def test_refined_fits_and_tones_are_fitted_the_same_way():
    model = gf.WhiteNoise(1.0) + gf.Sinusoid(0.85, 0.35)
    signal = model.simulate(1024, batch=(1,), generator=seeded(6))
    found = gf.fit_gmwm(signal, "WN + SIN", refine=True)
    again = gf.bootstrap_gmwm(found, 40, generator=seeded(7))
    assert again.n_failed.tolist() == [0]
    said = found.param_cov.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((again.std_err / said).log().abs() < 4 / 80**0.5).all()


def test_it_speaks_and_leaves_out_what_was_not_fitted():
    signal = signals()
    signal[1] = 1.0
    with pytest.warns(UserWarning, match="constant signal"):
        fitted = gf.fit_gmwm(signal, "WN + RW")
    found = gf.bootstrap_gmwm(fitted, 20, generator=seeded())
    assert found.std_err[0].isfinite().all()
    assert found.std_err[1].isnan().all()
    assert "random_walk.variance" in str(found)
    assert json.loads(json.dumps(found.to_dict()))["p_value"][1] is None


def test_where_nothing_can_be_stated_it_says_why(fitted, monkeypatch):
    signal = signals()
    signal[1] = 1.0
    with pytest.warns(UserWarning, match="constant signal"):
        half = gf.fit_gmwm(signal, "WN + RW")
    text = str(gf.bootstrap_gmwm(half, 20, generator=seeded()))
    assert "sensor 2: not fitted, so that there is nothing to resample" in text
    assert "nan" not in text

    def fails(records, *rest):
        again, spread, distance = moment_bootstrap_fitted(records, *rest)
        again[:, 0] = torch.nan
        again[1:, 1] = torch.nan
        return again, spread, distance

    moment_bootstrap_fitted = moment_bootstrap._fitted
    monkeypatch.setattr(moment_bootstrap, "_fitted", fails)
    found = gf.bootstrap_gmwm(fitted, 20, generator=seeded())
    text = str(found)
    assert "sensor 1: none of 20 resamples could be fitted; the fit stands alone" in text
    assert f"{fitted.params[0, 0].item():.6g}" in text
    assert ", 19 not fitted" in text
    assert "nan" not in text
    assert found.p_value.isfinite().tolist() == [False, True]
    assert found.std_err.isnan().all()  # of one resample there is no spread


def test_a_variance_at_zero_is_referred_to_the_fit():
    white = torch.randn(1, 512, generator=seeded(0), dtype=torch.float64)
    fit = gf.fit_gmwm(white, "WN + QN + RW")
    assert (fit.params == 0).any()
    assert "at its limit: see the interval of the fit" in str(gf.bootstrap_gmwm(fit, 20, generator=seeded()))


def test_figure_shows_intervals_in_standard_deviations(fitted):
    found = gf.bootstrap_gmwm(fitted, 20, generator=seeded(1))
    with mpl.rc_context({"backend": "agg"}):
        ax = found.plot(index=(1,))
    assert [label.get_text() for label in ax.get_yticklabels()] == list(fitted.param_names)
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["95 % percentile", "95 % studentized", "mean of the resamples"]
    drawn = torch.as_tensor(np.array([line[:, 0] for line in ax.collections[1].get_segments()]))
    low, high = ((limit[1] - found.params[1]) / found.std_err[1] for limit in found.studentized)
    torch.testing.assert_close(drawn, torch.stack([low, high], -1))


def test_bad_arguments_are_told(fitted):
    with pytest.raises(ValueError, match="`n_resamples`: expected at least 20, got 5"):
        gf.bootstrap_gmwm(fitted, 5)
    with pytest.raises(ValueError, match="`weighting`: expected the weights exactly where"):
        gf.bootstrap_gmwm(fitted, 20, weighting=torch.ones(10))
