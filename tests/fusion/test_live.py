"""Sensors that leave and return: weights of subsets, offsets, saturation."""

from __future__ import annotations

import copy
import functools
import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from contracts import (
    Member,
    check_a_batch_is_its_items,
    check_dtype_and_device_are_kept,
    check_global_state_is_left_alone,
    check_memory_layout_does_not_matter,
    check_the_signal_is_left_alone,
)
from reference import haar as naive_haar
from reference import live as naive
from scipy import stats
from torch import Tensor

from gyrofuse import ArrayModel, RandomWalk, WhiteNoise, fit_multiscale, fit_svo, wavelet_cross_covariance
from gyrofuse._base.linalg import SingularCovarianceError
from gyrofuse.fusion import SVOResult
from gyrofuse.fusion.live import LiveSVO
from gyrofuse.fusion.weights.subsets import subset_weights

N_SENSORS = 4


def array(n_samples: int = 3000, n_sensors: int = N_SENSORS, seed: int = 0) -> Tensor:
    return torch.from_numpy(naive_haar.array(n_sensors, n_samples, seed))


@functools.cache
def fitted() -> SVOResult:
    return fit_svo(array(), "long")


def dropped(signal: Tensor, share: float = 0.02, seed: int = 1) -> Tensor:
    """The signal with single samples and longer stretches missing here and there."""
    generator = torch.Generator().manual_seed(seed)
    gone = torch.rand(signal.shape, generator=generator) < share
    for length in (3, 30):
        starts = torch.rand(signal.shape, generator=generator) < share / length
        for k in range(length):
            gone |= starts.roll(k, -1)
    return torch.where(gone, torch.nan, signal)


# Weights of subsets


def test_subset_weights_are_those_of_a_fit_without_the_other_sensors():
    signal = array()
    wccv = wavelet_cross_covariance(signal)
    for n_live in (1, 2, 3):
        for subset in itertools.combinations(range(N_SENSORS), n_live):
            live = torch.zeros(N_SENSORS, dtype=torch.bool)
            live[list(subset)] = True
            weights = subset_weights(wccv, "long", live)
            assert (weights[~live] == 0).all()
            if n_live > 1:
                expected = fit_svo(signal[list(subset)], "long").weights
                torch.testing.assert_close(weights[live], expected, rtol=1e-9, atol=1e-12)
            else:
                assert weights[live].item() == 1


def test_subset_weights_broadcast_over_batch_and_time():
    wccv = torch.stack([wavelet_cross_covariance(array(seed=k), 6) for k in range(3)])  # (3, level, sensor, sensor)
    live = torch.rand(3, 50, N_SENSORS, generator=torch.Generator().manual_seed(0)) < 0.6
    live[..., 0] |= ~live.any(-1)
    got = subset_weights(wccv.unsqueeze(1), "flat", live)
    assert got.shape == (3, 50, N_SENSORS)
    combined = wccv.mean(1).numpy()
    for k, t in itertools.product(range(3), range(50)):
        expected = naive.subset_weights(combined[k], live[k, t].numpy())
        np.testing.assert_allclose(got[k, t], expected, rtol=1e-9, atol=1e-12)
    one = subset_weights(wccv[0], "flat", live[0])  # (time, sensor) with one array
    torch.testing.assert_close(one, got[0], rtol=1e-12, atol=1e-14)


def test_subsets_of_more_sensors_than_a_word_has_bits():
    matrix = torch.eye(70, dtype=torch.float64).expand(1, 70, 70)
    live = ~torch.eye(70, dtype=torch.bool)  # every sensor is away once
    weights = subset_weights(matrix, [1.0], live)
    torch.testing.assert_close(weights, live.double() / 69, rtol=1e-12, atol=0)


def test_no_live_sensor_has_no_weights():
    live = torch.tensor([[True] * N_SENSORS, [False] * N_SENSORS])
    weights = subset_weights(wavelet_cross_covariance(array(), 5), "flat", live)
    assert weights[0].isfinite().all()
    assert weights[1].isnan().all()


def test_subset_weights_are_differentiable():
    wccv = wavelet_cross_covariance(array(), 4).requires_grad_()
    live = torch.tensor([[True, True, False, True], [True, True, True, True]])
    assert torch.autograd.gradcheck(lambda w: subset_weights(w, "flat", live), wccv)


def test_bad_subsets_are_named():
    wccv = wavelet_cross_covariance(array(), 4)
    with pytest.raises(TypeError, match=r"`live`: expected a boolean tensor, got torch\.float32"):
        subset_weights(wccv, "flat", torch.ones(N_SENSORS))
    with pytest.raises(ValueError, match=r"`live`: expected \(..., sensor\) with 4 sensors, got shape \(3,\)"):
        subset_weights(wccv, "flat", torch.ones(3, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"`wccv`: expected \(..., level, sensor, sensor\), got shape \(4, 4\)"):
        subset_weights(wccv[0], "flat", torch.ones(4, dtype=torch.bool))
    wccv[:, 2, 2] = 0
    live = torch.tensor([True, True, False, True])
    assert subset_weights(wccv, "flat", live).isfinite().all()  # a dead sensor that is away does not matter
    with pytest.raises(SingularCovarianceError, match=r"of live sensors .* is not positive definite"):
        subset_weights(wccv, "flat", torch.ones(4, dtype=torch.bool))


# The live virtual gyro


@pytest.mark.parametrize(
    ("time_constant", "hold", "settle"), [(20.0, 0, 1), (20.0, 5, 10), (3.5, 40, 7), (100.0, 8, 33)]
)
def test_it_is_its_naive_twin(time_constant, hold, settle):
    signal = dropped(array(1000) + 10 * torch.arange(4.0, dtype=torch.float64)[:, None], 0.05)
    signal[:, 400:460] = torch.nan  # all away for long, back one by one
    for k in range(4):
        signal[k, 460 : 460 + 25 * k] = torch.nan
    live = LiveSVO.from_result(fitted(), time_constant=time_constant, hold=hold, settle=settle)
    expected = naive.fuse(signal.numpy(), live.combined.numpy(), time_constant, hold, settle)
    assert np.isnan(expected).sum() >= 60
    np.testing.assert_allclose(live(signal), expected, rtol=0, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("method", ["svo", "inverse_variance", "equal"])
def test_the_whole_array_is_plain_svo(method):
    result = fit_svo(array(), "long", method=method)
    signal = array(2000, seed=5) + 7
    torch.testing.assert_close(LiveSVO.from_result(result)(signal), result.virtual(signal), rtol=1e-10, atol=1e-10)


def test_a_common_rate_passes_exactly_whatever_the_set():
    signal = dropped(array(5000), 0.05)
    time = torch.arange(5000, dtype=torch.float64)
    rate = 300 * torch.sin(time / 40) + 0.1 * time
    live = LiveSVO.from_result(fitted(), time_constant=50)
    at_rest = live(signal)
    live.reset()
    moving = live(signal + rate)
    assert (moving - rate - at_rest).nan_to_num().abs().max() < 1e-10 * rate.abs().max()
    assert torch.equal(moving.isnan(), at_rest.isnan())


@pytest.mark.parametrize("chunk", [1, 17, 999])
def test_chunks_are_one_stream(chunk):
    signal = dropped(array(300 if chunk == 1 else 3000), 0.05)
    live = LiveSVO.from_result(fitted(), time_constant=40, hold=10)
    whole = live(signal)
    live.reset()
    parts = torch.cat([live(part) for part in signal.split(chunk, -1)])
    torch.testing.assert_close(parts, whole, rtol=0, atol=1e-10, equal_nan=True)


def test_an_empty_chunk_changes_nothing():
    live = LiveSVO.from_result(fitted())
    assert live(array()[:, :0]).shape == (0,)
    first = live(array()[:, :100])
    assert live(array()[:, :0]).shape == (0,)
    torch.testing.assert_close(first, fitted().virtual(array()[:, :100]))


N_STREAMS, OFFSET = 200, 10.0


@functools.cache
def offset_streams() -> tuple[SVOResult, Tensor]:
    """Two hundred arrays of four sensors with white noise of variance 1 and offsets of about ten times that."""
    noise = ArrayModel([(WhiteNoise(1.0), torch.eye(4)), (RandomWalk(1.0), 1e-6 * torch.eye(4))])
    generator = torch.Generator().manual_seed(3)
    signal = noise.simulate(8000, batch=(N_STREAMS,), generator=generator)
    result = fit_svo(noise.simulate(20_000, generator=generator), "long")
    offsets = OFFSET * torch.randn(N_STREAMS, 4, 1, generator=generator, dtype=torch.float64)
    return result, signal + offsets


def step_at(output: Tensor, instant: int, length: int = 400) -> Tensor:
    """By how much the mean output differs between the stretches before and after an instant."""
    return output[..., instant : instant + length].mean(-1) - output[..., instant - length : instant].mean(-1)


@pytest.mark.parametrize(("gone_for", "moved"), [(50, 0.0), (3000, 0.0), (3000, OFFSET)])
def test_leaving_and_returning_does_not_step_the_output(gone_for, moved):
    """Means over 400 samples before and after differ by the noise of such means and what the offset is known to.

    Offsets are ten times the noise of a sensor, 20 times that of the fused signal; with a time constant of 500 the
    offset of one sensor is known to 0.04, and its weight is a third at most. With the offsets ignored, as plain SVO of
    the live sensors would, the step is over 2.
    """
    result, signal = offset_streams()
    live = LiveSVO.from_result(result, time_constant=500)
    away = slice(3000, 3000 + gone_for)
    stream = signal.clone()
    stream[:, 1, away] = torch.nan
    stream[:, 1, away.stop :] += moved
    output = live(stream)
    assert output.isfinite().all()
    returned = away.stop + (1000 if gone_for > live.hold else 0)  # 500 to settle, 500 to grow
    noise = (output[:, 2000:2400].std(-1).mean() * (2 / 400) ** 0.5).item()
    for instant in (away.start, away.stop, returned):
        step = step_at(output, instant)
        # the spread of 200 steps has a relative error of 5 %
        assert step.std().item() < 1.6 * noise
        assert abs(step.mean().item()) < 4 * step.std().item() / N_STREAMS**0.5
        assert step.abs().max().item() < 6 * noise
    alone = subset_weights(result.wavelet_cross_covariance, result.scale_weights, torch.tensor([1, 0, 1, 1]).bool())
    blunt = torch.einsum("s,nst->nt", alone, torch.where(stream.isfinite(), stream, 0.0))
    assert step_at(torch.where(torch.arange(8000) < away.start, result.virtual(signal), blunt), away.start).std() > 2


def test_a_returning_sensor_is_watched_before_it_counts():
    """While it settles and long after, an offset that has moved by 1000 does not show in any single sample."""
    result, signal = offset_streams()
    stream = signal[0].clone()
    stream[1, 2000:4000] = torch.nan
    stream[1, 4000:] += 1000
    live = LiveSVO.from_result(result, time_constant=300)
    output = live(stream)
    assert output[2000:].diff().abs().max() < 6 * output[1000:2000].diff().std()
    # within hold nobody asks: that is what `hold` is for
    live = LiveSVO.from_result(result, time_constant=300, hold=2000)
    assert live(stream).diff().abs().max() > 100


def test_random_losses_hardly_make_the_output_wander():
    """With 2 % of all samples lost, long-scale noise of 60 arrays is that of all samples within 15 %."""
    generator = torch.Generator().manual_seed(5)
    walk = torch.tensor([1.0, 2.0, 8.0, 20.0], dtype=torch.float64) * 1e-5
    noise = ArrayModel([(WhiteNoise(1.0), torch.eye(4)), (RandomWalk(1.0), walk.diag())])
    signal = noise.simulate(2**13, batch=(60,), generator=generator)
    result = fit_svo(noise.simulate(2**15, generator=generator), "long")
    gone = torch.rand(signal.shape, generator=generator) < 0.02
    output = LiveSVO.from_result(result)(torch.where(gone, torch.nan, signal))
    plain = result.virtual(signal)
    assert output.isfinite().all()

    def long_scale(values: Tensor) -> float:
        return wavelet_cross_covariance(values[:, None], 11)[:, 10].mean().item()

    assert long_scale(output) < 1.15 * long_scale(plain)


def test_sensors_that_were_never_seen_together_start_where_they_can():
    """A sensor that comes later joins without a step, and one sensor alone is what it is."""
    signal = array(4000) + 10 * torch.arange(4.0, dtype=torch.float64)[:, None]
    signal[1:, :1000] = torch.nan
    live = LiveSVO.from_result(fitted(), time_constant=100)
    output = live(signal)
    torch.testing.assert_close(output[:1000], signal[0, :1000], rtol=0, atol=1e-9)
    assert step_at(output, 1100, 100).abs() < 1


def test_full_scale_takes_a_sensor_out():
    signal = array(2000)
    high = signal.clone()
    high[2, 1000:1100] = 77.0
    clean = high.clone()
    clean[2, 1000:1100] = torch.nan
    live = LiveSVO.from_result(fitted(), full_scale=77.0)
    plain = LiveSVO.from_result(fitted())
    assert torch.equal(live(high), plain(clean))
    infinite = torch.where(high == 77.0, torch.inf, high)
    assert torch.equal(LiveSVO.from_result(fitted())(infinite), LiveSVO.from_result(fitted())(clean))


def test_batches_of_fits_and_of_streams():
    signals = torch.stack([array(seed=k) for k in range(3)])
    together = fit_svo(signals, "long")
    stream = dropped(signals, 0.05)
    output = LiveSVO.from_result(together, time_constant=30)(stream)
    for k in range(3):
        alone = LiveSVO.from_result(together[k], time_constant=30)(stream[k])
        torch.testing.assert_close(output[k], alone, rtol=0, atol=1e-9, equal_nan=True)
    one_fit = LiveSVO.from_result(together[0], time_constant=30)(stream.expand(2, 3, 4, 3000))
    assert one_fit.shape == (2, 3, 3000)


def member() -> Member:
    return Member("LiveSVO", lambda: LiveSVO.from_result(fitted(), time_constant=30), tolerance=1e-9)


def test_it_keeps_what_every_operation_keeps():
    signal = dropped(array(1000), 0.03)
    batch = dropped(torch.stack([array(600, seed=k) for k in range(6)]).unflatten(0, (2, 3)), 0.03)
    check_a_batch_is_its_items(member(), batch)
    check_dtype_and_device_are_kept(member(), signal)
    check_the_signal_is_left_alone(member(), array(500))
    check_memory_layout_does_not_matter(member(), array(500))
    check_global_state_is_left_alone(member(), signal)


def test_float32_under_a_large_offset():
    signal = dropped(array(3000) + 1000, 0.03)
    exact = LiveSVO.from_result(fitted(), time_constant=30)(signal.float().double())
    single = LiveSVO.from_result(fitted(), time_constant=30)(signal.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), exact, rtol=0, atol=1e-4, equal_nan=True)


def test_a_module_made_float32_fuses_as_before():
    signal = array().float()
    torch.testing.assert_close(
        LiveSVO.from_result(fitted()).float()(signal), LiveSVO.from_result(fitted())(signal), rtol=0, atol=1e-5
    )


def test_gradients_reach_the_signal():
    signal = array(64).requires_grad_()
    live = LiveSVO.from_result(fitted(), time_constant=30)
    live(signal).sum().backward()
    torch.testing.assert_close(signal.grad, fitted().weights[:, None].expand(4, 64), rtol=1e-9, atol=1e-12)


def test_state_goes_round():
    """A module loaded from another's state goes on where that one is, whatever it has seen itself."""
    signal = dropped(array(2000), 0.05)
    live = LiveSVO.from_result(fitted(), time_constant=30)
    live(signal[:, :1000])
    state = copy.deepcopy(live.state_dict())
    rest = live(signal[:, 1000:])
    for other in (
        LiveSVO.from_result(fitted(), time_constant=30),
        LiveSVO.from_result(fit_svo(array(seed=2)), time_constant=30),
    ):
        other.load_state_dict(state)
        torch.testing.assert_close(other(signal[:, 1000:]), rest, rtol=0, atol=0, equal_nan=True)
    assert list(live.parameters()) == []
    assert "n_sensors=4, time_constant=30, hold=30, settle=30" in repr(live)


def test_the_time_constant_is_where_a_missing_sensor_matters_least():
    """Twice the averaging time of the Allan minimum of white noise and a random walk is 2 sqrt(3) sigma / g samples,
    and the time constant a quarter of that wavelet; 40 arrays, within the factor 2 of a level.
    """
    identity = torch.eye(4, dtype=torch.float64)
    for ratio in (20.0, 100.0):
        noise = ArrayModel([(WhiteNoise(1.0), identity), (RandomWalk(ratio**-2), identity)])
        signal = noise.simulate(20_000, batch=(40,), generator=torch.Generator().manual_seed(1))
        found = LiveSVO.from_result(fit_svo(signal, "long")).time_constant
        expected = 2 * 3**0.5 * ratio / 4
        assert (found.log2() - np.log2(expected)).abs().median() < 1
    walk = ArrayModel([(WhiteNoise(1e-6), identity), (RandomWalk(1.0), identity)]).simulate(2000)
    assert LiveSVO.from_result(fit_svo(walk)).time_constant.item() == 1


def test_it_is_never_worse_to_average_longer_than_that():
    """The default time constant keeps the wander of the offsets and their noise in balance: steps are the smallest.

    Over 100 arrays the mean square step on leaving is at most 1.3 times that of a time constant 8 times longer or
    shorter, judged by an F test at 1 in 1000.
    """
    identity = torch.eye(4, dtype=torch.float64)
    noise = ArrayModel([(WhiteNoise(1.0), identity), (RandomWalk(1 / 50.0**2), identity)])
    generator = torch.Generator().manual_seed(2)
    result = fit_svo(noise.simulate(50_000, generator=generator), "long")
    signal = noise.simulate(3000, batch=(100,), generator=generator)
    stream = signal.clone()
    stream[:, 0, 2000:] = torch.nan
    default = LiveSVO.from_result(result).time_constant.item()

    def step(time_constant: float) -> float:
        output = LiveSVO.from_result(result, time_constant=time_constant)(stream)
        ideal = (signal - signal[..., 1975:2025].mean(-1, keepdim=True))[:, 1:].mean(1)[:, 2000:2100].mean(-1)
        return ((output[:, 2000:2100].mean(-1) - output[:, 1975:2000].mean(-1)) - ideal).square().mean().item()

    allowed = stats.f.ppf(0.999, 100, 100)
    assert step(default) < allowed * min(step(default * 8), step(default / 8))
    assert step(default) < step(max(default / 30, 1.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time_constant": 0.0}, "`time_constant`: expected a finite number > 0, got 0.0"),
        ({"hold": -1}, "`hold`: expected a whole number >= 0, got -1"),
        ({"hold": torch.nan}, "`hold`: expected a whole number >= 0, got nan"),
        ({"hold": 2.7}, "`hold`: expected a whole number >= 0, got 2.7"),
        ({"full_scale": torch.ones(3)}, r"`full_scale`: .* one for each of 4 sensors .* got shape \(3,\)"),
        ({"settle": 0}, "`settle`: expected a whole number >= 1, got 0"),
        ({"full_scale": -1.0}, "`full_scale`: expected numbers > 0, got -1.0"),
    ],
)
def test_bad_numbers_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        LiveSVO.from_result(fitted(), **options)


def test_bad_streams_are_named():
    live = LiveSVO.from_result(fitted())
    with pytest.raises(
        ValueError, match=r"`signal`: expected .* with the 4 sensors that were fitted, got shape \(3, 9"
    ):
        live(array()[:3, :9])
    with pytest.raises(TypeError, match=r"`signal`: expected float32 or float64, got torch\.int64"):
        live(torch.ones(4, 9, dtype=torch.int64))
    live(array()[:, :9])
    with pytest.raises(
        ValueError, match=r"`signal`: expected batch shape \(\) as in the chunks before, got \(2,\); call"
    ):
        live(array()[:, :9].expand(2, 4, 9))
    live.reset()
    live(array()[:, :9].expand(2, 4, 9))
    batched = LiveSVO.from_result(fit_svo(array().expand(3, 4, 3000)))
    with pytest.raises(ValueError, match=r"`signal`: expected batch shape \(3,\) as fitted, got \(\)"):
        batched(array())


def test_full_scales_of_another_batch_than_the_stream_are_named():
    live = LiveSVO.from_result(fitted(), full_scale=torch.full((2, N_SENSORS), 100.0))
    assert live(array()[:, :9].expand(2, N_SENSORS, 9)).shape == (2, 9)
    live.reset()
    for batch in ((), (3,)):
        with pytest.raises(ValueError, match=r"`signal`: expected a batch shape that goes with `full_scale` of shape"):
            live(array()[:, :9].expand(*batch, N_SENSORS, 9))


@pytest.mark.parametrize("result", [array(100), fit_multiscale(array())])
def test_what_is_no_fit_is_named(result):
    with pytest.raises(TypeError, match=f"`result`: expected an SVOResult, got {type(result).__name__}; fit the array"):
        LiveSVO.from_result(result)


def test_other_methods_have_no_weights_of_subsets():
    with pytest.raises(ValueError, match=r"`result`: expected a fit by 'svo', .* got 'rdvg'"):
        LiveSVO.from_result(replace(fitted(), method="rdvg"))
