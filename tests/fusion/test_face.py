"""One way to make a layer, one kind of scale weights, and old calls that still work with a warning."""

from __future__ import annotations

import pytest
import torch

import gyrofuse as gf
from gyrofuse.fusion import shrinkage_weights
from gyrofuse.fusion.weights.svo import resolve_scale_weights


def array(seed: int = 0, n_samples: int = 2000) -> torch.Tensor:
    return torch.randn(2, 4, n_samples, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("weights", [gf.svo_weights, gf.inverse_variance_weights, gf.nonnegative_weights])
def test_weights_take_names_and_any_sum(weights):
    wccv = gf.wavelet_cross_covariance(array(), 6)
    omega = resolve_scale_weights("long", 6)
    expected = weights(wccv, "long")
    torch.testing.assert_close(weights(wccv, omega), expected)
    torch.testing.assert_close(weights(wccv, (7 * omega).tolist()), expected)
    torch.testing.assert_close(weights(wccv), weights(wccv, "flat"))
    with pytest.raises(ValueError, match="`scale_weights`: expected one number for each of 6 levels, got 5"):
        weights(wccv, [1.0] * 5)


def test_shrunk_weights_take_names_too():
    wccv, dof = gf.wavelet_cross_covariance(array(), 6), torch.full((2, 6), 50.0, dtype=torch.float64)
    expected = shrinkage_weights(wccv, "long", dof)
    torch.testing.assert_close(shrinkage_weights(wccv, 3 * resolve_scale_weights("long", 6), dof), expected)
    with pytest.warns(DeprecationWarning, match="`degrees` is deprecated .* use `dof`"):
        torch.testing.assert_close(shrinkage_weights(wccv, "long", degrees=dof), expected)


def test_options_of_a_layer_belong_to_its_constructor():
    signal = array()
    expected = gf.fit_svo(signal, "long", method="nonnegative", n_levels=6, covariance="none").weights
    layer = gf.SVO("long", method="nonnegative", n_levels=6, covariance="none")
    assert torch.equal(layer.fit(signal).weights, expected)
    with pytest.warns(DeprecationWarning, match="SVO.fit with options"):
        old = gf.SVO("long").fit(signal, method="nonnegative", n_levels=6, covariance="none")
    assert torch.equal(old.weights, expected)
    expected = gf.fit_multiscale(signal, "short", n_bands=3, n_levels=6).weights
    assert torch.equal(gf.MultiScaleSVO(3, "short", n_levels=6).fit(signal).weights, expected)
    with pytest.warns(DeprecationWarning, match="MultiScaleSVO.fit with options"):
        assert torch.equal(gf.MultiScaleSVO(3).fit(signal, "short", n_levels=6).weights, expected)


def test_a_live_layer_is_fitted_like_the_others():
    signal = array()
    result = gf.fit_svo(signal, "long", method="inverse_variance")
    expected = gf.LiveSVO.from_result(result, time_constant=30)(signal)
    layer = gf.LiveSVO("long", method="inverse_variance", time_constant=30)
    with pytest.raises(RuntimeError, match="LiveSVO has no weights yet"):
        layer(signal)
    assert torch.equal(layer.fit(signal).weights, result.weights)
    assert torch.equal(layer(signal), expected)
    with pytest.warns(DeprecationWarning, match="LiveSVO.result. is deprecated"):
        assert torch.equal(gf.LiveSVO(result, time_constant=30)(signal), expected)
    with pytest.warns(DeprecationWarning, match="LiveSVO.result. is deprecated"):
        assert torch.equal(gf.LiveSVO(result=result, time_constant=30)(signal), expected)
    loaded = gf.LiveSVO("long", time_constant=30)
    loaded.load_state_dict(gf.LiveSVO.from_result(result, time_constant=30).state_dict())
    assert torch.equal(loaded(signal), expected)


def test_a_state_goes_through_stream():
    signal = array()
    layer = gf.MultiScaleSVO(4)
    layer.fit(signal)
    expected, after = layer.stream(signal, layer.start(signal))
    assert torch.equal(layer(signal), expected)
    with pytest.warns(DeprecationWarning, match=r"use MultiScaleSVO\(\.\.\.\)\.stream") as warned:
        old, state = layer(signal, layer.start(signal))
    assert warned[0].filename == __file__
    assert torch.equal(old, expected)
    assert torch.equal(state, after)


def test_renamed_attributes_and_arguments():
    signal = array()
    result = gf.fit_svo(signal, n_levels=6)
    for old, new in (("degrees_of_freedom", "dof"), ("weights_degrees", "weights_dof")):
        with pytest.warns(DeprecationWarning, match=f"SVOResult.{old} is deprecated .* use {new}"):
            assert torch.equal(getattr(result, old), getattr(result, new))
    assert result.to_dict()["degrees_of_freedom"] == result.dof.tolist()
    test = result.test_equal()
    assert torch.equal(test[1].p_value, test.p_value[1])
    assert torch.equal(test[1].dof[0], test.dof[0][1])
    reference = gf.fit_parity_reference(signal[0], 100)
    for old, new in (("spread", "power_variance"), ("own_spread", "own_power_variance")):
        with pytest.warns(DeprecationWarning, match=f"ParityReference.{old} is deprecated .* use {new}"):
            assert torch.equal(getattr(reference, old), getattr(reference, new))
        assert reference.to_dict()[old] == getattr(reference, new).tolist()
    with pytest.warns(DeprecationWarning, match="argument `extra_spread` is deprecated .* use `extra_sd`"):
        allowed = gf.fit_parity_reference(signal[0], 100, extra_spread=0.3)
    assert torch.allclose(allowed.power_variance, reference.power_variance + 0.09)
    with pytest.warns(DeprecationWarning, match="gyrofuse.fit_parity is deprecated"):
        old_reference = gf.fit_parity(signal[0], 100)
    assert old_reference.to_dict() == reference.to_dict()
    with pytest.warns(DeprecationWarning, match="`before` is deprecated .* use `history`"):
        old = gf.parity_test(signal, reference, before=array(1))
    new = gf.parity_test(signal, reference, history=array(1))
    assert old.to_dict() == new.to_dict()
    assert torch.equal(new[1].p_value, new.p_value[1])
    assert new[1].batch_shape == ()
