"""SVO: the weights, their fit from recordings, the layers and the result."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
import torch
from reference import haar as naive

from gyrofuse import (
    SVO,
    CrossCovariance,
    HaarFilterBank,
    Recording,
    SingularCovarianceError,
    SVOWeights,
    equal_weights,
    fit_svo,
    inverse_variance_weights,
    svo_weights,
    wavelet_cross_covariance,
)
from gyrofuse.fusion.weights.svo import resolve_scale_weights

NAMES = ["flat", "short", "long"]
GENERATOR = np.random.default_rng(11)


def array(n_sensors: int = 4, n_samples: int = 3000, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(naive.array(n_sensors, n_samples, seed))


@pytest.fixture(scope="module")
def wccv() -> torch.Tensor:
    return wavelet_cross_covariance(array())


# Weights


@pytest.mark.parametrize("omega", ["flat", [1, 0, 0], [0.2, 0.3, 0.5]])
def test_weights_equal_the_formula(wccv, omega):
    three = wccv[:3]
    weights = svo_weights(three, omega)
    expected = naive.svo_weights(three, resolve_scale_weights(omega, 3))
    np.testing.assert_allclose(weights, expected, rtol=1e-12)
    np.testing.assert_allclose(SVOWeights(omega)(three), expected, rtol=1e-12)
    assert weights.sum().item() == pytest.approx(1, abs=1e-15)


def test_by_hand():
    """Independent sensors of variance 1 and 3 count 3 to 1; correlation may make a weight negative."""
    assert svo_weights(torch.tensor([[[1.0, 0.0], [0.0, 3.0]]])).tolist() == [0.75, 0.25]
    weights = svo_weights(torch.tensor([[[1.0, 2.0], [2.0, 5.0]]], dtype=torch.float64))
    torch.testing.assert_close(weights, torch.tensor([1.5, -0.5], dtype=torch.float64))


@pytest.mark.parametrize("omega", NAMES)
def test_weights_do_not_depend_on_unit_or_order(wccv, omega):
    weights = svo_weights(wccv, omega)
    for unit in (1e-6, 57.29577951308232, 1e10):
        torch.testing.assert_close(svo_weights(wccv * unit**2, omega), weights, rtol=1e-11, atol=1e-13)
    order = torch.tensor([2, 0, 3, 1])
    shuffled = svo_weights(wccv[:, order][:, :, order], omega)
    torch.testing.assert_close(shuffled, weights[order], rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("omega", NAMES)
def test_common_noise_leaves_the_weights_alone(wccv, omega):
    """Adding the same variance to every entry changes `A` by `k 1 1'`, which no unit-sum weights see."""
    common = torch.rand(len(wccv), 1, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(svo_weights(wccv + common, omega), svo_weights(wccv, omega), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("omega", NAMES)
def test_a_common_signal_passes_with_gain_one(omega):
    signal, motion = array(), torch.sin(torch.arange(3000, dtype=torch.float64) / 50)
    result = fit_svo(signal, omega)
    torch.testing.assert_close(result.virtual(signal + motion), result.virtual(signal) + motion, rtol=0, atol=1e-12)


@pytest.mark.parametrize("omega", NAMES)
def test_no_other_weights_are_better(wccv, omega):
    shape = resolve_scale_weights(omega, len(wccv))
    best = naive.risk(wccv, shape, svo_weights(wccv, omega))
    for _ in range(200):
        step = GENERATOR.normal(size=4) * 10.0 ** GENERATOR.uniform(-4, 1)
        other = svo_weights(wccv, omega).numpy() + step - step.mean()
        assert naive.risk(wccv, shape, other) >= best * (1 - 1e-12)


def test_a_level_that_does_not_count_may_be_unknown(wccv):
    unknown = wccv.clone()
    unknown[-1] = torch.nan
    omega = [1.0] * (len(wccv) - 1) + [0.0]
    expected = svo_weights(wccv[:-1], omega[:-1])
    torch.testing.assert_close(svo_weights(unknown, omega), expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(SVOWeights(omega)(unknown), expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("wccv", "error", "message"),
    [
        (torch.ones(3, 3), ValueError, r"`wccv`: expected \(..., level, sensor, sensor\), got shape \(3, 3\)"),
        (torch.ones(2, 3, 4), ValueError, r"`wccv`: expected \(..., level, sensor, sensor\), got shape \(2, 3, 4\)"),
        (torch.ones(2, 3, 3, dtype=torch.int64), TypeError, "`wccv`: expected float32 or float64, got torch.int64"),
        (np.ones((2, 3, 3)), TypeError, "`wccv`: expected a torch tensor, got ndarray"),
        (torch.ones(2, 3, 3), SingularCovarianceError, "combined over scales is not positive definite.*copies"),
        (
            torch.eye(3).expand(5, 2, 3, 3) * torch.tensor([1.0, 1.0, 0.0]),
            ValueError,
            r"\(5 of 5\): sensor\(s\) 3 never",
        ),
    ],
)
def test_bad_covariances_are_named(wccv, error, message):
    with pytest.raises(error, match=message):
        svo_weights(wccv)


def test_other_weights(wccv):
    assert equal_weights(wccv).tolist() == [0.25] * 4
    assert equal_weights(wccv.expand(2, 3, *wccv.shape)).shape == (2, 3, 4)
    omega = resolve_scale_weights("long", len(wccv))
    variance = np.einsum("j,jii->i", omega.numpy(), wccv.numpy())
    np.testing.assert_allclose(inverse_variance_weights(wccv, omega), (1 / variance) / (1 / variance).sum(), rtol=1e-12)


# Fit


@pytest.mark.parametrize("omega", NAMES)
def test_fit_goes_from_signal_to_weights(omega):
    signal = array(n_samples=1500)
    result = fit_svo(signal, omega)
    wccv = naive.wavelet_cross_covariance(signal, 10)
    shape = resolve_scale_weights(omega, 10)
    assert result.n_levels == 10
    assert naive.relative_error(result.wavelet_cross_covariance, wccv) < 1e-10
    np.testing.assert_allclose(result.weights, naive.svo_weights(wccv, shape), rtol=1e-9)
    np.testing.assert_allclose(result.virtual(signal), result.weights @ signal, rtol=1e-12)
    # The virtual signal has the wavelet variance that is told for this recording.
    np.testing.assert_allclose(
        result.in_sample_wavelet_variance,
        naive.wavelet_variance(result.virtual(signal)[None], 10)[:, 0],
        rtol=1e-9,
    )
    np.testing.assert_allclose(
        result.equal_wavelet_variance, naive.wavelet_variance(signal.mean(0, keepdim=True), 10)[:, 0], rtol=1e-9
    )
    risk = [naive.risk(wccv, shape, weights) for weights in (result.weights, np.full(4, 0.25))]
    assert risk[0] < risk[1]


@pytest.mark.parametrize("method", ["svo", "inverse_variance", "equal"])
def test_methods(method):
    signal = array()
    result = fit_svo(signal, "short", method=method)
    wccv, omega = result.wavelet_cross_covariance, result.scale_weights
    expected = {
        "svo": svo_weights(wccv, omega),
        "inverse_variance": inverse_variance_weights(wccv, omega),
        "equal": equal_weights(wccv),
    }[method]
    torch.testing.assert_close(result.weights, expected, rtol=1e-12, atol=0)
    assert result.method == method
    low, high = result.confidence_interval
    assert ((low <= result.weights) & (result.weights <= high)).all()
    assert (high - low == 0).all().item() == (method == "equal")
    torch.testing.assert_close(result.weights_cov.sum(-1), torch.zeros(4, dtype=torch.float64), rtol=0, atol=1e-12)


def test_intervals_on_request():
    signal = array()
    assert fit_svo(signal, covariance="none").weights_cov.isnan().all()
    narrow, wide = (fit_svo(signal, confidence_level=level).confidence_interval for level in (0.5, 0.99))
    assert ((wide.low < narrow.low) & (narrow.high < wide.high)).all()


def test_resampling_without_intervals_says_so():
    signal = torch.randn(2, 2, 512, dtype=torch.float64, generator=torch.Generator().manual_seed(8))
    signal[1, 0, 250] = torch.nan
    with pytest.warns(UserWarning, match="`covariance`: resampling gives no intervals for 1 of 2 array") as caught:
        result = fit_svo(signal, covariance="resampling", n_levels=8)
    assert caught[0].filename == __file__
    assert result.confidence_interval.low.isnan().all(-1).tolist() == [False, True]
    for options in ({"n_levels": 8}, {"n_levels": 3, "covariance": "resampling"}):  # what it says to do
        assert fit_svo(signal, **options).confidence_interval.low.isfinite().all()


def test_a_batch_equals_its_items():
    signal = torch.stack([array(seed=seed) for seed in range(6)]).view(2, 3, 4, 3000)
    result = fit_svo(signal, "long")
    for item in np.ndindex(2, 3):
        alone, part = fit_svo(signal[item], "long"), result[item]
        torch.testing.assert_close(part.weights, alone.weights, rtol=1e-10, atol=0)
        torch.testing.assert_close(part.weights_cov, alone.weights_cov, rtol=1e-8, atol=1e-14)
        torch.testing.assert_close(part.virtual(signal[item]), result.virtual(signal)[item], rtol=1e-12, atol=1e-12)
        assert part.summary() == alone.summary()
    with pytest.raises(IndexError, match="expected at most 2 indices"):
        result[0, 0, 0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_everything_is_in_the_dtype_of_the_signal(dtype):
    signal = array().to(dtype)
    result = fit_svo(signal)
    for value in (result.weights, result.weights_cov, result.wavelet_cross_covariance, result.virtual(signal)):
        assert value.dtype == dtype
    torch.testing.assert_close(result.weights.double(), fit_svo(array()).weights, rtol=1e-3, atol=1e-4)


def test_offsets_and_infinite_samples_and_gaps_are_harmless():
    signal = array(n_samples=4000)
    weights = fit_svo(signal, "short", n_levels=8).weights
    offset = torch.tensor([[250.0], [-3.0], [0.0], [1e5]])
    torch.testing.assert_close(fit_svo(signal + offset, "short", n_levels=8).weights, weights, rtol=1e-9, atol=1e-12)
    holes = signal.clone()
    holes[0, 100] = torch.nan
    holes[2, 3000:3010] = torch.inf
    result = fit_svo(holes, "short", n_levels=8)
    torch.testing.assert_close(result.weights, weights, rtol=0, atol=0.05)
    # A sample that any sensor lacks is missing in the virtual signal, and only those.
    assert (~result.virtual(holes).isfinite()).nonzero().flatten().tolist() == [100, *range(3000, 3010)]


def test_levels_that_gaps_leave_without_window_are_not_used():
    signal = array()
    signal[1, ::20] = torch.nan
    assert fit_svo(signal).n_levels == 4
    # By name they are refused, unless they do not count.
    with pytest.raises(SingularCovarianceError, match=r"sensor\(s\) 2 have no complete window at some level"):
        fit_svo(signal, n_levels=6)
    result = fit_svo(signal, [1, 1, 1, 1, 0, 0])
    torch.testing.assert_close(result.weights, fit_svo(signal).weights, rtol=1e-12, atol=0)
    torch.testing.assert_close(result.weights_cov, fit_svo(signal).weights_cov, rtol=1e-10, atol=0)
    assert result.virtual_wavelet_variance.isnan().tolist() == [False] * 4 + [True] * 2
    assert "nan" in result.summary()
    json.dumps(result.to_dict(), allow_nan=False)


def with_row(row: int, values: torch.Tensor | float) -> torch.Tensor:
    signal = array(n_samples=400)
    signal[row] = values
    return signal


@pytest.mark.parametrize(
    ("signal", "options", "error", "message"),
    [
        (array(1), {}, ValueError, "`signal`: expected at least 2 sensors to fuse, got 1; give an array of gyros"),
        (array()[0], {}, ValueError, r"`signal`: expected \(..., sensor, time\), got shape \(3000,\)"),
        (array().to(torch.int32), {}, TypeError, "`signal`: expected float32 or float64, got torch.int32"),
        (array().half(), {}, TypeError, "`signal`: expected float32 or float64, got torch.float16"),
        (array().numpy(), {}, TypeError, "`signal`: expected a torch tensor, got ndarray"),
        (array()[:, :1], {}, ValueError, "`signal`: expected at least 2 samples for one wavelet level, got 1"),
        (array()[:, :2], {}, ValueError, r"as many complete windows as sensors \(4\), got 1; record longer"),
        (array(8)[:, :5], {}, ValueError, r"as many complete windows as sensors \(8\), got 6; record longer"),
        (array(), {"n_levels": 12}, ValueError, "`n_levels`: expected at most 11 for 3000 samples"),
        (array(), {"scale_weights": [1] * 12}, ValueError, "`n_levels`: expected at most 11 for 3000 samples"),
        (array(), {"scale_weights": [1] * 3, "n_levels": 4}, ValueError, "one number for each of 4 levels, got 3"),
        (array(), {"method": "median"}, ValueError, "`method`: expected one of 'auto', 'svo', .*'rdvg', got 'median'"),
        (array(), {"covariance": "hac"}, ValueError, "`covariance`: expected one of 'model', .*'none', got 'hac'"),
        (array(), {"confidence_level": 95}, ValueError, "`confidence_level`: expected a number between 0 and 1"),
        (with_row(2, torch.nan), {}, ValueError, r"`signal`: sensor\(s\) 3 have no finite sample; leave them out"),
        (with_row(2, 250.1), {}, SingularCovarianceError, r"sensor\(s\) 3 never change \(dead or stuck\)"),
        (with_row(3, array(n_samples=400)[1]), {}, SingularCovarianceError, "sensors 2 and 4 are copies"),
        (with_row(0, array(n_samples=400)[1:3].sum(0)), {}, SingularCovarianceError, "linearly dependent"),
    ],
)
def test_bad_recordings_are_named(signal, options, error, message):
    with pytest.raises(error, match=message):
        fit_svo(signal, **options)


def test_sensors_not_recorded_together_are_named():
    signal = array()
    signal[0, ::2] = torch.nan
    with pytest.raises(ValueError, match="two samples in a row that all sensors have, found none"):
        fit_svo(signal)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (torch.tensor(250.1), r"sensor\(s\) 3 never change"),
        (array(n_samples=400)[0] - 240, "sensors 1 and 3 are copies"),
        (array(n_samples=400)[0] / 57.3, "sensors 1 and 3 are copies"),
        (array(n_samples=400)[:2].sum(0), "linearly dependent"),
    ],
)
def test_float32_hides_no_useless_sensor(values, message):
    """Rounding makes a copy differ a little from its original, and must not make a fortune out of the difference."""
    with pytest.raises(SingularCovarianceError, match=message):
        fit_svo(with_row(2, values).float())


def test_whole_numbers_in_any_type_count_levels():
    assert fit_svo(array(), n_levels=3.0).n_levels == 3


def test_weights_fitted_without_gradients_serve_in_training():
    svo = SVO("short")
    with torch.inference_mode():
        svo.fit(array())
    signal = array().requires_grad_()
    svo(signal).sum().backward()
    assert signal.grad is not None


def test_a_batch_without_items():
    result = fit_svo(torch.zeros(0, 3, 40, dtype=torch.float64))
    assert result.weights.shape == (0, 3)
    assert result.weights_cov.shape == (0, 3, 3)


@pytest.mark.parametrize("axes", [(), ("x", "y", "z")])
def test_a_recording_brings_its_names_rate_and_unit(axes):
    signal = array().expand(*[3] * bool(axes), 4, 3000).clone()
    names = ("front left", "front right", "rear left", "rear right")
    recording = Recording(signal, rate=100.0, unit="deg/s", sensors=names, axes=axes)
    svo = SVO("long")
    result = svo.fit(recording)
    assert torch.equal(result.weights, fit_svo(signal, "long").weights)
    assert (result.sensors, result.axes, result.rate, result.unit) == (names, axes, 100.0, "deg/s")
    assert result.tau[:3].tolist() == [0.01, 0.02, 0.04]
    assert torch.equal(result.virtual(recording), result.virtual(signal))
    text = result.summary()
    for part in (*names, *(f"[{axis}]" for axis in axes), "100 Hz", "Allan deviation (deg/s)", "tau (s)"):
        assert part in text
    signal[..., 2, :] = signal[..., 1, :]
    with pytest.raises(SingularCovarianceError, match="sensors front right and rear left are copies"):
        fit_svo(recording)


# Layers


def test_the_layers_chained_equal_the_fit():
    signal = array(n_samples=1000)
    chain = torch.nn.Sequential(HaarFilterBank(9), CrossCovariance(), SVOWeights("long"))
    torch.testing.assert_close(chain(signal), fit_svo(signal, "long").weights, rtol=1e-9, atol=1e-12)
    assert list(chain.parameters()) == []
    assert chain.state_dict() == {}


def test_a_fitted_module_keeps_its_weights_and_fuses():
    signal = array()
    svo = SVO("short", n_levels=8)
    result = svo.fit(signal)
    assert torch.equal(svo.weights, result.weights)
    assert torch.equal(svo(signal), result.virtual(signal))
    assert list(svo.parameters()) == []
    assert repr(svo) == "SVO(scale_weights='short')"


def test_saved_weights_go_into_a_new_module():
    signal = array()
    svo = SVO("short")
    svo.fit(signal)
    file = io.BytesIO()
    torch.save(svo.state_dict(), file)
    file.seek(0)
    new = SVO("short")
    new.load_state_dict(torch.load(file))
    assert torch.equal(new(signal), svo(signal))
    inside = torch.nn.ModuleDict({"fusion": SVO()})
    inside.load_state_dict(torch.nn.ModuleDict({"fusion": svo}).state_dict())
    assert torch.equal(inside["fusion"](signal), svo(signal))
    with pytest.raises(RuntimeError, match="Missing key"):
        SVO().load_state_dict({})


@pytest.mark.parametrize("n_batch", [0, 1])
def test_a_module_follows_to(n_batch):
    signal = array().expand(*[3] * n_batch, 4, 3000)
    svo = SVO()
    svo.fit(signal)
    assert svo.to(torch.float32).weights.dtype == torch.float32
    virtual = svo(signal.float())
    assert virtual.dtype == torch.float32
    torch.testing.assert_close(virtual.double(), fit_svo(signal).virtual(signal), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("length", [1, 7, 777])
def test_a_stream_equals_one_shot(length):
    signal = array()
    svo = SVO()
    svo.fit(signal)
    streamed = torch.cat([svo(chunk) for chunk in signal.split(length, dim=-1)], dim=-1)
    torch.testing.assert_close(streamed, svo(signal), rtol=1e-14, atol=1e-14)


def test_gradients_reach_the_signal_that_is_fused():
    signal = array(n_samples=100)
    svo = SVO()
    svo.fit(signal)
    signal.requires_grad_()
    svo(signal)[50].backward()
    assert torch.equal(signal.grad[:, 50], svo.weights)


def test_an_unfitted_module_says_so():
    with pytest.raises(RuntimeError, match=r"SVO has no weights yet: call fit\(signal\), or load a state_dict"):
        SVO()(array())


def test_a_failed_fit_leaves_the_weights():
    svo = SVO()
    svo.fit(array())
    before = svo.weights.clone()
    with pytest.raises(SingularCovarianceError, match="never change"):
        svo.fit(with_row(0, 1.0))
    assert torch.equal(svo.weights, before)


def test_other_signals_than_the_weights_are_for_are_named():
    svo = SVO()
    result = svo.fit(array())
    for fuse in (svo, result.virtual):
        with pytest.raises(ValueError, match=r"`signal`: expected .* with the 4 sensors .* got shape \(5, 3000\)"):
            fuse(array(5))
        with pytest.raises(ValueError, match=r"`signal`: expected \(..., sensor, time\), got shape \(3000,\)"):
            fuse(array()[0])
        with pytest.raises(TypeError, match=r"`signal`: expected float32 or float64, got torch.int16"):
            fuse(array().to(torch.int16))
