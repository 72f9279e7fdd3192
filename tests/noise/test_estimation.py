"""Fitted models know what their numbers were estimated from, and how their spectra depend on them."""

from __future__ import annotations

import json

import pytest
import torch

import gyrofuse as gf
from gyrofuse.noise.estimation import EstimatedFrom

TRUE = gf.parse_model("WN(variance=1.0) + AR1(phi=0.975, variance=0.03) + RW(variance=1e-5)")
FREQUENCIES = torch.tensor([1e-4, 1e-3, 0.02, 0.1, 0.45], dtype=torch.float64)


def signals(n_sensors=2, n_samples=5003):
    return TRUE.simulate(n_samples, batch=(n_sensors,), generator=torch.Generator().manual_seed(1))


def again(model):
    return gf.model_from_dict(json.loads(json.dumps(model.to_dict(), allow_nan=False)))


def test_fits_hand_on_the_record_and_the_covariance_that_their_model_has():
    x = signals()
    fit = gf.fit_gmwm(x, "WN + AR1 + RW")
    assert fit.model.estimated_from.n_samples == fit.n_samples == 5003
    torch.testing.assert_close(fit.model.estimated_from.param_cov, fit.param_cov, rtol=0, atol=0)
    joint = gf.fit_gmwm_joint([x, x[:, :4100]], "WN + AR1 + RW")
    assert joint.model.estimated_from.n_samples == joint.n_samples == 9103
    torch.testing.assert_close(joint.model.estimated_from.param_cov, joint.param_cov, rtol=0, atol=0)
    best = gf.rank_models(x, ["WN + AR1", "WN + AR1 + RW"]).best
    for one in best:
        assert one.model.estimated_from.n_samples == 5003
        torch.testing.assert_close(one.model.estimated_from.param_cov, one.param_cov, rtol=0, atol=0)
    array = gf.fit_array_gmwm(x, "WN + AR1 + RW")
    assert array.model.estimated_from.n_samples == array.n_samples == 5003
    assert array.model.estimated_from.param_cov.shape == (10, 10) == (len(array.model.param_names),) * 2


def test_the_covariance_of_an_array_has_the_spreads_of_its_entries_and_shared_parameters():
    x = signals(3) * torch.tensor([[1.0], [30.0], [0.1]], dtype=torch.float64)
    fit = gf.fit_array_gmwm(x, "WN + AR1 + RW")
    sd = dict(zip(fit.model.param_names, fit.param_cov.diagonal().sqrt().tolist(), strict=True))
    for k in range(3):
        for i in range(3):
            for j in range(i, 3):
                assert sd[f"{k + 1}.covariance[{i},{j}]"] == pytest.approx(float(fit.theta_std_err[k, i, j]))
    assert sd["2.phi"] == pytest.approx(float(fit.params_std_err[0]))
    assert torch.linalg.eigvalsh(fit.param_cov)[0] > -1e-9 * fit.param_cov.diagonal().max()
    missing = x.clone()
    missing[1] = torch.nan
    without, alone = gf.fit_array_gmwm(missing, "WN + AR1 + RW"), gf.fit_array_gmwm(x[[0, 2]], "WN + AR1 + RW")
    torch.testing.assert_close(
        without.model.estimated_from.param_cov, alone.model.estimated_from.param_cov, rtol=1e-2, atol=1e-13
    )


def test_a_models_record_goes_through_json_and_other_units_and_not_to_other_numbers():
    model = gf.fit_gmwm(signals(), "WN + AR1 + RW").model
    told = again(model).estimated_from
    assert told.n_samples == 5003
    torch.testing.assert_close(told.param_cov, model.estimated_from.param_cov, rtol=0, atol=0)
    scale = torch.tensor([9.0, 1.0, 9.0, 9.0], dtype=torch.float64)
    torch.testing.assert_close(
        model.scaled(3.0).estimated_from.param_cov, told.param_cov * scale[:, None] * scale, rtol=1e-12, atol=0
    )
    assert model.with_params(model.params).estimated_from is None
    assert (model + gf.QuantizationNoise(torch.ones(2))).estimated_from is None
    array = gf.fit_array_gmwm(signals(), "WN + RW").model
    torch.testing.assert_close(again(array).estimated_from.param_cov, array.estimated_from.param_cov, rtol=0, atol=0)


def test_models_without_a_record_count_as_known():
    assert "estimated_from" not in TRUE.to_dict()
    assert again(TRUE).estimated_from is None
    array = gf.ArrayModel.from_sensors([TRUE, TRUE])
    assert array.estimated_from is None
    assert "estimated_from" not in array.to_dict()
    assert again(array).estimated_from is None


def test_what_a_model_was_estimated_from_is_checked():
    with pytest.raises(ValueError, match=r"`estimated_from`: expected a covariance of parameters \(4,\), got shape"):
        gf.Model([TRUE], estimated_from=EstimatedFrom(100, torch.eye(3)))
    with pytest.raises(ValueError, match="`estimated_from`: expected a covariance of the 2 parameters"):
        gf.ArrayModel(
            [(gf.WhiteNoise(1.0), [1.0]), (gf.WhiteNoise(1.0), [2.0])], estimated_from=EstimatedFrom(9, torch.eye(3))
        )
    with pytest.raises(ValueError, match="`estimated_from`: expected the entries n_samples and param_cov"):
        gf.model_from_dict(TRUE.to_dict() | {"estimated_from": {"samples": 3}})
    with pytest.raises(ValueError, match="`n_samples`"):
        EstimatedFrom(0)


def test_an_array_of_fitted_sensors_has_their_records_without_what_has_no_spectrum():
    one = gf.Model(
        [gf.Drift(0.1), gf.WhiteNoise(1.0)],
        estimated_from=EstimatedFrom(50, torch.diag(torch.tensor([4.0, 9.0]).double())),
    )
    two = gf.Model([gf.WhiteNoise(1.0)], estimated_from=EstimatedFrom(40, torch.tensor([[16.0]]).double()))
    array = gf.ArrayModel.from_sensors([one, two])
    assert array.param_names == ("1.variance", "2.variance", "3.slope")
    assert array.estimated_from.n_samples == 40
    torch.testing.assert_close(array.estimated_from.param_cov, torch.diag(torch.tensor([9.0, 16.0, 0.0]).double()))
    assert gf.ArrayModel.from_sensors([one, gf.WhiteNoise(1.0)]).estimated_from is None
    less = gf.Model([gf.WhiteNoise(1.0)], estimated_from=EstimatedFrom(30))
    assert gf.ArrayModel.from_sensors([one, less]).estimated_from.to_dict() == {"n_samples": 30, "param_cov": None}


@pytest.mark.parametrize(
    "model",
    [
        TRUE,
        gf.QuantizationNoise(0.3) + gf.Sinusoid(0.4, 0.2) + gf.AR1(-0.4, 0.2) + gf.Drift(0.1),
        gf.AR1(torch.tensor([0.3, 0.999]).double(), torch.tensor([0.1, 0.0]).double()) + gf.WhiteNoise(2.0),
    ],
)
def test_the_jacobian_of_a_spectrum_is_its_derivative(model):
    jacobian = model.spectrum_jacobian(FREQUENCIES)
    params = model.params
    assert jacobian.shape == (*params.shape[:-1], len(FREQUENCIES), params.shape[-1])
    for k in range(params.shape[-1]):
        step = torch.zeros_like(params)
        step[..., k] = 1e-6
        forward, middle = (model.with_params(params + times * step).spectrum(FREQUENCIES) for times in (2.0, 1.0))
        slope = (4 * middle - forward - 3 * model.spectrum(FREQUENCIES)) / 2e-6  # of second order, from one side
        scale = jacobian[..., k].abs().amax().clamp(min=1.0)
        torch.testing.assert_close(jacobian[..., k] / scale, slope / scale, rtol=0, atol=1e-4)


def test_the_jacobian_of_an_array_is_that_of_its_matrices_and_processes():
    matrix, root = torch.tensor([[2.0, 0.5], [0.5, 1.0]]).double(), torch.tensor([0.6, -0.3]).double()
    array = gf.ArrayModel([(gf.AR1(0.9, 1.0), matrix), (gf.WhiteNoise(3.0), root)])
    assert array.param_names == ("1.covariance[0,0]", "1.covariance[0,1]", "1.covariance[1,1]", "1.phi", "2.variance")
    jacobian = array.spectrum_jacobian(FREQUENCIES)
    own, white = gf.AR1(0.9, 1.0), torch.ones(5, dtype=torch.float64)
    torch.testing.assert_close(jacobian[:, 0, 1, 1], own.spectrum(FREQUENCIES))
    torch.testing.assert_close(jacobian[:, 1, 0, 1], own.spectrum(FREQUENCIES))
    assert not jacobian[:, 0, 0, 1].any()
    torch.testing.assert_close(jacobian[:, 0, 1, 3], 0.5 * own.spectrum_jacobian(FREQUENCIES)[:, 0])
    torch.testing.assert_close(jacobian[:, 0, 1, 4], -0.18 * white)


def test_fits_of_one_sensor_each_make_an_array():
    one = gf.fit_gmwm(signals(1, 2000), "WN")
    array = gf.ArrayModel.from_sensors([one.model, one.model])
    assert array.estimated_from.n_samples == 2000
    torch.testing.assert_close(array.estimated_from.param_cov, one.param_cov.reshape(1) * torch.eye(2).double())
    with pytest.raises(ValueError, match="expected scalar parameters, got a batch"):
        gf.ArrayModel.from_sensors([gf.WhiteNoise(torch.ones(2)), TRUE])
