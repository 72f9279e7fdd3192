"""The J test of refined fits: of the parameters that are given, with the law it has there."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

import gyrofuse as gf
from gyrofuse.fitting.moments.fit import composition_of
from gyrofuse.fitting.moments.inference import Estimates, either
from gyrofuse.fitting.spectral.whittle import refine_whittle

NOISE = gf.WhiteNoise(1.0) + gf.AR1(0.99, 5e-3) + gf.RandomWalk(1e-5)
TONE = gf.Sinusoid(0.3, 0.35)
N_SAMPLES, N_RECORDS = 4096, 120


def records(model: gf.Model, n: int = N_RECORDS) -> torch.Tensor:
    return model.simulate(N_SAMPLES, batch=(n, 1), generator=torch.Generator().manual_seed(17))


def test_the_statistic_is_that_of_the_parameters_given():
    signal = records(NOISE + TONE, 3)
    found = gf.fit_gmwm(signal, "WN + AR1 + RW + SIN", refine=True)
    for i in range(3):
        model = found.model.with_params(found.params[i, 0])
        covariance = found.records.covariance(model).numpy()
        fitted = model.wavelet_variance(found.wavelet_variance.shape[-2])
        torch.testing.assert_close(found.fitted_wavelet_variance[i, :, 0], fitted)
        left = found.wavelet_variance[i, :, 0].numpy() - fitted.numpy()
        statistic = left @ np.linalg.solve(covariance, left)
        assert found.j_statistic[i, 0].item() == pytest.approx(statistic, rel=1e-6)
        assert found.objective[i, 0].item() == pytest.approx(statistic, rel=1e-6)


def test_the_p_value_is_that_of_a_weighted_sum_of_squares():
    """Weights by finite differences of the model, and the tail by simulation."""
    signal = records(NOISE, 1)
    found = gf.fit_gmwm(signal, "WN + AR1 + RW", refine=True)
    structure = composition_of("WN + AR1 + RW", held=True)
    own = found.params[0, 0]
    linear, shape = own[[0, 2, 3]][None], own[1].atanh()[None, None]
    spread = refine_whittle(signal[:, 0], structure, linear, shape).covariance[0].numpy()
    unknown = torch.cat([linear[0].log(), shape[0]])
    tau = 2.0 ** torch.arange(1, found.wavelet_variance.shape[-2] + 1, dtype=torch.float64)

    def moments(u: torch.Tensor) -> np.ndarray:
        return structure.wavelet_variance(tau, u[:3].exp(), u[3:]).numpy()

    step = 1e-5 * torch.eye(4, dtype=torch.float64)
    jacobian = np.stack([(moments(unknown + h) - moments(unknown - h)) / 2e-5 for h in step], -1)
    covariance = found.records.covariance(found.model.with_params(own)).numpy()
    remains = np.eye(len(tau)) - np.linalg.solve(covariance, jacobian @ spread @ jacobian.T)
    weights = np.linalg.eigvals(remains).real.clip(0, 1)
    drawn = np.random.default_rng(3).chisquare(1, (100_000, len(tau))) @ weights
    assert found.p_value[0, 0].item() == pytest.approx((drawn >= found.j_statistic[0, 0].item()).mean(), abs=0.01)


@pytest.mark.statistical
@pytest.mark.parametrize("tone", [False, True])
def test_complete_models_are_refused_as_often_as_stated(tone):
    """Of 120 records at 5 %: 0 to 15 but for one time in a thousand."""
    truth, formula = (NOISE + TONE, "WN + AR1 + RW + SIN") if tone else (NOISE, "WN + AR1 + RW")
    found = gf.fit_gmwm(records(truth), formula, refine=True)
    refused = int((found.p_value < 0.05).sum())
    assert stats.binomtest(refused, N_RECORDS, 0.05).pvalue > 1e-3


def test_a_missing_tone_is_refused():
    found = gf.fit_gmwm(records(NOISE + gf.Sinusoid(0.5, 0.35), 20), "WN + AR1 + RW", refine=True)
    assert (found.p_value < 1e-3).all()


def test_a_moment_fit_that_bends_to_what_is_missing_does_not_speak_for_the_refined_one():
    """A resonance: of the moments a tone of the right size explains it, of the spectrum none does."""
    generator = torch.Generator().manual_seed(3)
    quick = gf.AR1(-0.6, 1.0).simulate(2**15, generator=generator) + gf.AR1(0.95, 0.01).simulate(
        2**15, generator=generator
    )
    found = gf.fit_gmwm(quick[None], "AR1 + RW + 2*SIN", refine=True)
    assert found.p_value[0] < 1e-6


def test_an_amplitude_that_stands_in_for_a_missing_process_is_told():
    """Noise of high frequency that the model lacks: a sinusoid has it in the moments, not in the spectrum."""
    signal = records(gf.AR1(-0.6, 1.0) + gf.Sinusoid(0.5, 2.7), 4)
    told = "sinusoid_1: the spectrum holds an amplitude of 0."
    found = gf.fit_gmwm(signal, "WN + SIN")
    assert all(any(text.startswith(told) for text in texts) for texts in found.notes)
    assert "refine the fit" in found.summary()
    for fit in (gf.fit_gmwm(signal, "AR1 + SIN"), gf.fit_gmwm(signal, "WN + SIN", refine=True)):
        assert not any("stands in" in text for texts in fit.notes for text in texts)


def test_ranked_and_fitted_agree_on_whether_a_model_is_complete():
    for truth, complete in ((NOISE + TONE, True), (gf.WhiteNoise(1.0) + gf.AR1(0.99, 5e-3) + gf.AR1(0.5, 1.0), False)):
        candidates = ["WN + AR1 + RW + SIN"] if complete else ["WN + RW"]
        result = gf.rank_models(records(truth, 8), candidates)
        own = torch.stack([fit.p_value for fit in result.best])
        torch.testing.assert_close(result.p_value[:, 0], own)
        apart = gf.rank_models(records(truth, 8), candidates, fit=False).p_value
        for p_value in (own, apart):
            assert bool((p_value > 1e-3).all()) == bool((p_value > 1e-3).any()) == complete


def test_items_are_chosen_one_by_one():
    one, other = (Estimates(*(torch.full((3, 2), v) for _ in range(5))) for v in (1.0, 2.0))
    mixed = either(torch.tensor([True, False, True]), one, other)
    assert mixed.low.tolist() == [[1.0, 1.0], [2.0, 2.0], [1.0, 1.0]]
