"""Every operation of the library keeps the promises of `contracts.py`."""

from __future__ import annotations

import contracts
import pytest
import torch
from contracts import Member
from reference import haar as naive
from torch import Tensor, nn

from gyrofuse import (
    SVO,
    CrossCovariance,
    HaarFilterBank,
    MultiScaleSVO,
    SVOWeights,
    WaveletCrossCovariance,
    equal_weights,
    fit_array_gmwm,
    fit_gmwm,
    fit_multiscale,
    fit_svo,
    haar_coefficients,
    inverse_variance_weights,
    rdvg_weights,
    robust_wavelet_variance,
    svo_weights,
    wavelet_cross_covariance,
    wavelet_cross_covariance_interval,
    wavelet_variance,
    wavelet_variance_interval,
)
from gyrofuse.fusion.weights.svo import resolve_scale_weights
from gyrofuse.wavelets import cross_covariance

LEVELS = 5


def signal_of(*shape: int, seed: int = 0) -> Tensor:
    """White noise and random walks in three sensors."""
    n_items = int(torch.tensor(shape[:-1]).prod()) if len(shape) > 1 else 1
    arrays = [torch.from_numpy(naive.array(3, shape[-1], seed + i)) for i in range(n_items)]
    return torch.stack(arrays).view(*shape[:-1], 3, shape[-1])


SIGNAL = signal_of(300)
LONGER = signal_of(457, seed=50)
BATCH = signal_of(2, 3, 300, seed=100)


def weights_of(signal: Tensor) -> Tensor:
    return svo_weights(wavelet_cross_covariance(signal, LEVELS), "long")


def inverse_variance_of(signal: Tensor) -> Tensor:
    return inverse_variance_weights(wavelet_cross_covariance(signal, LEVELS), resolve_scale_weights("short", LEVELS))


def fit(signal: Tensor) -> list[Tensor]:
    """Everything that a fit gives."""
    result = fit_svo(signal, "short", n_levels=LEVELS)
    limits = result.confidence_interval
    return [
        result.weights,
        result.weights_cov,
        limits.low,
        limits.high,
        result.wavelet_cross_covariance,
        result.virtual_wavelet_variance,
        result.equal_wavelet_variance,
        result.virtual(signal),
    ]


class Fused(nn.Module):
    """A signal to the virtual signal of its own weights, through the layers."""

    def __init__(self) -> None:
        super().__init__()
        self.weights = nn.Sequential(HaarFilterBank(LEVELS), CrossCovariance(), SVOWeights([1, 2, 3, 2, 1]))

    def forward(self, signal: Tensor) -> Tensor:
        return (self.weights(signal).unsqueeze(-2) @ signal).squeeze(-2)


def fitted() -> SVO:
    svo = SVO("long")
    svo.fit(signal_of(400, seed=7))
    return svo


def moments() -> nn.Module:
    return nn.Sequential(HaarFilterBank(LEVELS), CrossCovariance())


def chain() -> nn.Module:
    return nn.Sequential(HaarFilterBank(LEVELS), CrossCovariance(), SVOWeights("long"))


def multiscale() -> nn.Module:
    """A fitted multi-scale virtual gyro."""
    module = MultiScaleSVO(4, n_levels=LEVELS)
    module.fit(signal_of(3000, seed=9))
    return module


MEMBERS = [
    Member("haar_coefficients", lambda: lambda x: haar_coefficients(x, LEVELS), differentiable=True),
    Member("HaarFilterBank", lambda: HaarFilterBank(LEVELS), differentiable=True, module=True, onnx=True),
    Member("wavelet_cross_covariance", lambda: lambda x: wavelet_cross_covariance(x, LEVELS), differentiable=True),
    Member("wavelet_variance", lambda: lambda x: wavelet_variance(x, LEVELS), differentiable=True),
    Member("robust_wavelet_variance", lambda: lambda x: robust_wavelet_variance(x, LEVELS)),
    Member("cross_covariance", lambda: lambda x: cross_covariance(haar_coefficients(x, LEVELS)), differentiable=True),
    Member("CrossCovariance", moments, differentiable=True, module=True, onnx=True),
    Member("svo_weights", lambda: weights_of, differentiable=True, tolerance=1e-9),
    Member("SVOWeights", chain, differentiable=True, module=True, tolerance=1e-9),
    Member("virtual signal of the layers", Fused, differentiable=True, module=True, tolerance=1e-9),
    Member("inverse_variance_weights", lambda: inverse_variance_of, differentiable=True),
    Member("equal_weights", lambda: lambda x: equal_weights(wavelet_cross_covariance(x, LEVELS))),
    Member("fit_svo", lambda: fit, tolerance=1e-8),
    Member("SVO", fitted, differentiable=True, module=True, onnx=True),
    Member(
        "fit_svo, auto", lambda: lambda x: fit_svo(x, "long", method="auto", n_levels=LEVELS).weights, tolerance=1e-8
    ),
    Member("fit_svo, nonnegative", lambda: lambda x: fit_svo(x, method="nonnegative", n_levels=LEVELS).weights),
    Member("wavelet_variance_interval", lambda: lambda x: list(wavelet_variance_interval(x, LEVELS)), tolerance=1e-8),
    Member(
        "wavelet_cross_covariance_interval",
        lambda: lambda x: list(wavelet_cross_covariance_interval(x, LEVELS)),
        tolerance=1e-8,
    ),
    # Parameters are float64 whatever the signal.
    Member(
        "fit_gmwm",
        lambda: lambda x: fit_gmwm(x, "WN + RW", n_levels=LEVELS).params.to(x.dtype),
        tolerance=1e-5,
    ),
    Member(
        "fit_array_gmwm",
        lambda: lambda x: fit_array_gmwm(x, "WN + RW", n_levels=LEVELS).theta.to(x.dtype),
        tolerance=1e-5,
    ),
    Member("rdvg_weights", lambda: rdvg_weights, tolerance=1e-8),
    Member("fit_multiscale", lambda: lambda x: fit_multiscale(x, n_levels=LEVELS).weights, tolerance=1e-8),
    Member("MultiScaleSVO", multiscale, differentiable=True, module=True, onnx=True),
]


def those(which: str = "") -> pytest.MarkDecorator:
    chosen = [m for m in MEMBERS if not which or getattr(m, which)]
    return pytest.mark.parametrize("member", chosen, ids=lambda m: m.name.replace(" ", "_"))


@those()
def test_a_batch_is_its_items(member):
    contracts.check_a_batch_is_its_items(member, BATCH)


@those()
def test_dtype_and_device_are_kept(member):
    contracts.check_dtype_and_device_are_kept(member, SIGNAL)


@those()
def test_memory_layout_does_not_matter(member):
    contracts.check_memory_layout_does_not_matter(member, SIGNAL)


@those()
def test_the_signal_is_left_alone(member):
    contracts.check_the_signal_is_left_alone(member, SIGNAL)


@those()
def test_global_state_is_left_alone(member):
    contracts.check_global_state_is_left_alone(member, SIGNAL)


@those("differentiable")
def test_gradients(member):
    contracts.check_gradients(member, BATCH[0, :2, :, :80])


@those("module")
def test_compiles(member):
    contracts.check_compiles(member, SIGNAL, LONGER)


@those("module")
def test_exports(member):
    contracts.check_exports(member, SIGNAL, LONGER)


@pytest.mark.filterwarnings("ignore:.*treespec, LeafSpec.*:FutureWarning")  # torch's exporter about itself
@those("onnx")
def test_runs_in_onnxruntime(member, tmp_path):
    contracts.check_runs_in_onnxruntime(member, SIGNAL.float(), LONGER.float(), tmp_path)


@those("module")
def test_state_goes_round(member):
    contracts.check_state_goes_round(member, SIGNAL)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@those()
def test_cuda_equals_cpu(member):
    contracts.check_cuda_equals_cpu(member, SIGNAL)
    contracts.check_cuda_equals_cpu(member, BATCH)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_streaming_on_cuda_equals_cpu():
    metric = WaveletCrossCovariance(3, LEVELS).cuda()
    for chunk in LONGER.split(100, dim=-1):
        metric.update(chunk.cuda())
    assert metric.compute().is_cuda
    contracts.assert_same(metric.compute().cpu(), wavelet_cross_covariance(LONGER, LEVELS), 1e-10)


def test_compiled_with_breaks():
    """The tiled functions look at values and so are no single graph; they still give the same when compiled."""
    torch._dynamo.reset()
    compiled = torch.compile(lambda x: wavelet_cross_covariance(x, LEVELS), backend="eager")
    contracts.assert_same(compiled(SIGNAL), wavelet_cross_covariance(SIGNAL, LEVELS), 1e-12)


def test_the_metric_keeps_the_global_state_and_its_chunks():
    def stream(signal: Tensor) -> Tensor:
        metric = WaveletCrossCovariance(3, LEVELS)
        for chunk in signal.split(70, dim=-1):
            metric.update(chunk)
        return metric.compute()

    member = Member("WaveletCrossCovariance", lambda: stream)
    contracts.check_global_state_is_left_alone(member, SIGNAL)
    contracts.check_the_signal_is_left_alone(member, SIGNAL)
