"""Noise processes: wavelet variances, spectra and composition against independent references."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from reference import processes as naive
from reference import published

from gyrofuse.noise.parsing import model_from_dict, parse_model
from gyrofuse.noise.processes import (
    AR1,
    Drift,
    FlickerNoise,
    Matern32,
    Model,
    Process,
    QuantizationNoise,
    RandomWalk,
    Sinusoid,
    WhiteNoise,
    haar_kernel,
)

# Every member of the catalogue, with its second moments E[x_s x_t] for s, t = 1, 2, ..
CATALOGUE = [
    pytest.param(WhiteNoise(0.7), lambda s, t: 0.7 * (s == t), id="white_noise"),
    pytest.param(
        QuantizationNoise(0.3),
        lambda s, t: 0.3 * (2.0 * (s == t) - (abs(s - t) == 1)),
        id="quantization_noise",
    ),
    pytest.param(AR1(0.9, 0.5), lambda s, t: 0.5 / (1 - 0.81) * 0.9 ** abs(s - t), id="ar1"),
    pytest.param(AR1(-0.6, 2.0), lambda s, t: 2 / 0.64 * (-0.6) ** abs(s - t), id="ar1_negative"),
    pytest.param(
        Matern32(0.9, 0.5), lambda s, t: 0.5 * (1 - math.log(0.9) * abs(s - t)) * 0.9 ** abs(s - t), id="matern32"
    ),
    # Its second moments but for a constant, which no wavelet sees.
    pytest.param(FlickerNoise(0.4), lambda s, t: -0.8 / math.pi * naive.odd_harmonic(abs(s - t)), id="flicker_noise"),
    pytest.param(Drift(-0.02), lambda s, t: 4e-4 * s * t, id="drift"),
    pytest.param(RandomWalk(0.04), lambda s, t: 0.04 * np.minimum(s, t), id="random_walk"),
    pytest.param(Sinusoid(0.85, 0.35), lambda s, t: 0.85**2 / 2 * np.cos(0.35 * (s - t)), id="sinusoid"),
]
MEMBERS = [pytest.param(case.values[0], id=case.id) for case in CATALOGUE]


def assert_close(got: torch.Tensor, expected: object, rtol: float = 1e-12, atol: float = 0.0) -> None:
    np.testing.assert_allclose(got.detach().numpy(), expected, rtol=rtol, atol=atol)


def columns(process: Process) -> list[torch.Tensor]:
    """The process' parameters as leaves of a graph."""
    return [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in process.parameters.values()]


# --- wavelet variance -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("process", "moment"), CATALOGUE)
def test_wavelet_variance_is_the_filtered_second_moment(process, moment):
    t = np.arange(1, 257)
    expected = naive.expected_wavelet_variance(moment(t[:, None], t), 8)
    assert_close(process.wavelet_variance(8), expected, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("index", range(19))
def test_wavelet_variance_matches_120_digits_at_25_levels(index):
    case = published.table("exact_wavelet_variance")["cases"][index]
    if case["process"] == "ar1":
        process = AR1(float(case["phi"]), case["innovation_variance"])
    else:
        process = Sinusoid(case["amplitude"], float(case["beta"]))
    # at beta = pi only the rounding of pi is left beyond level 1, some 1e-65
    assert_close(process.wavelet_variance(25), case["wavelet_variance"], rtol=1e-13, atol=1e-40)


@pytest.mark.parametrize(
    ("process", "key"),
    [
        (WhiteNoise(1.0), "WN_1"),
        (QuantizationNoise(0.5), "QN_0.5"),
        (RandomWalk(4e-4), "RW_4e4"),
        (Drift(1e-3), "DR_1e3"),
    ],
)
def test_wavelet_variance_matches_other_software(process, key):
    assert_close(process.wavelet_variance(20), published.table("r_wv")["theory"][key], rtol=1e-13)


@pytest.mark.parametrize(
    ("process", "key"),
    [
        (AR1(0.975, 0.03), "AR1_0.975_0.03"),
        (AR1(0.999995, 3e-11), "AR1_0.999995_3e11"),
        (AR1(0.9997083, 9e-9), "AR1_0.9997083_9e9"),
        (Sinusoid(0.85, 0.35), "SIN_0.85_0.35"),
        (Sinusoid(0.0015, 8e-5), "SIN_0.0015_8e-5_small_beta"),
    ],
)
def test_wavelet_variance_matches_decimal_arithmetic(process, key):
    assert_close(process.wavelet_variance(20), published.table("r_wv")["decimal"][key], rtol=1e-9)


def test_ar1_keeps_its_digits_everywhere():
    near_one = 1 - 10.0 ** -np.arange(1, 13)
    for phi in [*near_one, *(-near_one[:6]), 0.0, 1e-12, 0.49, 0.5, 0.51, 0.7]:
        exact = [naive.exact_ar1_wavelet_variance(phi, j) for j in range(1, 10)]
        # near -1 the parameter itself holds only eps / (1 + phi) of relative accuracy
        assert_close(AR1(phi, 1.0).wavelet_variance(9), exact, rtol=1e-13 + 4e-16 / (1 + phi))


def test_ar1_without_memory_is_white_noise_and_differentiable():
    phi = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    nu = AR1(phi, 2.0).wavelet_variance(10)
    assert_close(nu, WhiteNoise(2.0).wavelet_variance(10))
    nu.sum().backward()
    # d nu / d phi = 2 sum_s a_s a_{s+1} s2 at phi = 0
    filters = [naive.haar_filter(j) for j in range(1, 11)]
    assert phi.grad.item() == pytest.approx(sum(4 * (a[1:] * a[:-1]).sum() for a in filters))


@pytest.mark.parametrize("z", [0.95 * np.exp(0.4j), 0.999 * np.exp(1e-3j), 0.5 * np.exp(3j)])
def test_kernel_takes_damped_oscillations(z):
    lag = np.abs(np.subtract.outer(np.arange(256), np.arange(256)))
    expected = naive.expected_wavelet_variance((z**lag).real, 8)
    tau = 2.0 ** torch.arange(1, 9, dtype=torch.float64)
    kernel = haar_kernel(torch.tensor([z], dtype=torch.complex128), tau).real
    assert_close(kernel, expected, rtol=1e-10, atol=1e-15)


# --- spectrum ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("process", [m for m in MEMBERS if m.id not in ("drift", "flicker_noise")])
def test_spectrum_and_lines_through_the_gain_give_the_wavelet_variance(process):
    n = 4096
    f = (np.arange(n) + 0.5) / n - 0.5  # the midpoint rule is exact to rounding for smooth periodic functions
    density = process.spectrum(torch.tensor(f)).numpy()
    for level, nu in enumerate(process.wavelet_variance(8).tolist(), start=1):
        got = (naive.squared_gain(level, f) * density).mean()
        got += sum(line.power * naive.squared_gain(level, line.frequency.numpy()) for line in process.lines)
        assert got == pytest.approx(nu, rel=1e-10)


@pytest.mark.parametrize(
    ("process", "variance"),
    [(WhiteNoise(0.7), 0.7), (QuantizationNoise(0.3), 0.6), (AR1(0.9, 0.5), 0.5 / 0.19), (Matern32(0.9, 0.5), 0.5)],
)
def test_spectrum_integrates_to_the_variance(process, variance):
    f = (torch.arange(4096, dtype=torch.float64) + 0.5) / 4096 - 0.5
    assert process.spectrum(f).mean().item() == pytest.approx(variance)


def test_spectrum_keeps_the_shape_of_the_frequencies():
    model = WhiteNoise(torch.ones(3)) + AR1(0.5, 1.0)
    assert model.spectrum(0.1).shape == (3,)
    assert model.spectrum([0.1, 0.2]).shape == (3, 2)
    assert model.spectrum(torch.rand(4, 5, generator=torch.Generator().manual_seed(0))).shape == (3, 4, 5)
    assert RandomWalk(1.0).spectrum(0.0) == math.inf


def test_a_sinusoid_and_a_drift_have_no_continuous_spectrum():
    model = Sinusoid(2.0, 0.5) + Drift(1.0)
    assert_close(model.spectrum([0.0, 0.1]), [0.0, 0.0])
    ((frequency, power),) = model.lines
    assert frequency.item() == pytest.approx(0.5 / (2 * math.pi))
    assert power.item() == pytest.approx(2.0)
    assert (WhiteNoise(1.0) + RandomWalk(1.0)).lines == ()


# --- what every member shares -----------------------------------------------------------------------------


@pytest.mark.parametrize("process", MEMBERS)
def test_wavelet_variance_and_spectrum_pass_gradcheck(process):
    f = torch.tensor([0.05, 0.2, 0.4], dtype=torch.float64)
    kind = type(process)
    assert torch.autograd.gradcheck(lambda *p: kind(*p).wavelet_variance(6), columns(process))
    assert torch.autograd.gradcheck(lambda *p: kind(*p).spectrum(f), columns(process))


@pytest.mark.parametrize("process", MEMBERS)
def test_a_batch_of_parameters_is_the_stacked_items(process):
    scale = torch.tensor([[1.0, 0.5, 0.25], [0.9, 0.8, 0.7]], dtype=torch.float64)
    batch = type(process)(*(value * scale for value in process.parameters.values()))
    items = [type(process)(*(v * s for v in process.parameters.values())) for s in scale.flatten().tolist()]
    nu = torch.stack([item.wavelet_variance(7) for item in items]).unflatten(0, (2, 3))
    density = torch.stack([item.spectrum([0.1, 0.3]) for item in items]).unflatten(0, (2, 3))
    assert_close(batch.wavelet_variance(7), nu.numpy())
    assert_close(batch.spectrum([0.1, 0.3]), density.numpy())
    assert batch.params.shape == (2, 3, len(process.param_names))


@pytest.mark.parametrize("process", MEMBERS)
def test_parameters_are_kept_and_results_are_double(process):
    single = [torch.tensor(value, dtype=torch.float32) for value in process.parameters.values()]
    kept = type(process)(*single)
    assert all(kept.parameters[name] is value for name, value in zip(kept.parameters, single, strict=True))
    assert kept.wavelet_variance(5).dtype == torch.float64
    assert_close(kept.wavelet_variance(5), process.wavelet_variance(5).numpy(), rtol=1e-5)


@pytest.mark.parametrize("process", MEMBERS)
def test_dictionary_text_and_parameter_vector_round_trip(process):
    model = process + AR1(0.123456789012345678, 1 / 3)
    for again in (
        model_from_dict(json.loads(json.dumps(model.to_dict()))),
        parse_model(str(model)),
        model.with_params(model.params),
    ):
        assert again.param_names == model.param_names
        assert again.params.tolist() == model.params.tolist()
    assert model_from_dict(process.to_dict()).to_dict() == process.to_dict()


@pytest.mark.parametrize("process", MEMBERS)
def test_what_is_to_be_estimated_is_named(process):
    unknown = type(process)()
    name = unknown.param_names[0]
    for compute in (
        lambda: unknown.wavelet_variance(3),
        lambda: unknown.spectrum(0.1),
        lambda: unknown.simulate(10),
        lambda: unknown.lines,
        lambda: unknown.params,
    ):
        with pytest.raises(ValueError, match=f"`{name}`.*to be estimated"):
            compute()
    assert str(unknown) == f"{type(process).__name__}()"
    assert model_from_dict(unknown.to_dict()).to_dict() == unknown.to_dict()


@pytest.mark.parametrize("process", MEMBERS)
def test_number_of_levels_is_checked(process):
    with pytest.raises(ValueError, match="`n_levels`"):
        process.wavelet_variance(0)


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (WhiteNoise, {"variance": -1.0}, "`variance` of WhiteNoise: expected a finite number >= 0, got -1"),
        (RandomWalk, {"variance": math.inf}, "`variance` of RandomWalk.*got inf"),
        (QuantizationNoise, {"variance": math.nan}, "`variance` of QuantizationNoise.*got nan"),
        (AR1, {"phi": 1.0}, "`phi` of AR1: expected a number strictly between -1 and 1, got 1"),
        (AR1, {"phi": torch.tensor([0.5, -1.5])}, "`phi` of AR1.*got -1.5"),
        (Matern32, {"phi": -0.5}, "`phi` of Matern32: expected a number strictly between 0 and 1, got -0.5"),
        (Drift, {"slope": math.inf}, "`slope` of Drift: expected a finite number"),
        (Sinusoid, {"amplitude": -0.1}, "`amplitude` of Sinusoid"),
        (Sinusoid, {"beta": 0.0}, r"`beta` of Sinusoid: expected a number in \(0, pi\], got 0"),
        (Sinusoid, {"beta": 3.2}, "`beta` of Sinusoid"),
    ],
)
def test_values_outside_the_domain_are_refused(kind, values, message):
    with pytest.raises(ValueError, match=message):
        kind(**values)


@pytest.mark.parametrize("value", ["1", [1.0], True, torch.tensor(1)])
def test_parameters_are_numbers_or_floating_point_tensors(value):
    with pytest.raises(TypeError, match="`variance` of WhiteNoise: expected a number or a floating point"):
        WhiteNoise(value)


def test_nan_marks_a_failed_item_of_a_batch():
    phi = torch.tensor([0.5, math.nan], dtype=torch.float64)
    nu = AR1(phi, 1.0).wavelet_variance(4)
    assert torch.isfinite(nu[0]).all()
    assert torch.isnan(nu[1]).all()


# --- composition ------------------------------------------------------------------------------------------


def test_a_model_is_the_sum_of_its_processes():
    parts = [
        WhiteNoise(1.0),
        AR1(0.9, 0.1),
        AR1(0.99, 0.01),
        RandomWalk(1e-4),
        Sinusoid(0.2, 0.3),
        Drift(1e-3),
    ]
    model = sum(parts)
    assert isinstance(model, Model)
    assert model.processes == tuple(parts)
    assert_close(model.wavelet_variance(9), sum(p.wavelet_variance(9) for p in parts).numpy())
    assert_close(model.spectrum([0.1, 0.2]), sum(p.spectrum([0.1, 0.2]) for p in parts).numpy())
    assert model.lines == parts[4].lines
    assert str(model) == " + ".join(map(str, parts))


def test_parameter_names_number_what_may_repeat():
    model = WhiteNoise() + QuantizationNoise() + 2 * AR1() + RandomWalk() + Drift() + Sinusoid()
    assert model.param_names == (
        "white_noise.variance",
        "quantization_noise.variance",
        "ar1_1.phi",
        "ar1_1.variance",
        "ar1_2.phi",
        "ar1_2.variance",
        "random_walk.variance",
        "drift.slope",
        "sinusoid_1.amplitude",
        "sinusoid_1.beta",
    )
    assert (Matern32() + FlickerNoise()).param_names == (
        "matern32_1.phi",
        "matern32_1.variance",
        "flicker_noise.variance",
    )
    assert AR1().param_names == ("ar1_1.phi", "ar1_1.variance")
    assert str(2 * AR1() + WhiteNoise()) == "AR1() + AR1() + WhiteNoise()"
    assert str(AR1() * 2) == str(sum([AR1(), AR1()])) == "AR1() + AR1()"


def test_with_params_takes_a_batch_of_estimates():
    params = torch.tensor([[1.0, 0.9, 0.1], [2.0, 0.8, 0.2]], dtype=torch.float64)
    model = (WhiteNoise() + AR1()).with_params(params)
    assert model.params.tolist() == params.tolist()
    assert model.wavelet_variance(5).shape == (2, 5)
    one = (WhiteNoise() + AR1()).with_params(params[1])
    assert_close(model.wavelet_variance(5)[1], one.wavelet_variance(5).numpy())
    assert str(model) == "WhiteNoise(variance=<batch (2,)>) + AR1(phi=<batch (2,)>, variance=<batch (2,)>)"
    with pytest.raises(ValueError, match=r"`params`: expected \(..., 3\) for white_noise.variance"):
        model.with_params(params[:, :2])


@pytest.mark.parametrize("kind", [WhiteNoise, QuantizationNoise, FlickerNoise, RandomWalk, Drift])
def test_copies_that_cannot_be_told_apart_are_refused(kind):
    with pytest.raises(ValueError, match=f"{kind.__name__} appears more than once.*use one {kind.__name__}"):
        2 * kind()


def test_only_processes_compose():
    with pytest.raises(TypeError, match="unsupported operand"):
        WhiteNoise() + 1.0
    with pytest.raises(TypeError, match="unsupported operand"):
        1.5 * AR1()
    with pytest.raises(ValueError, match="`times`"):
        0 * AR1()
    with pytest.raises(ValueError, match="at least one process"):
        Model([])
    with pytest.raises(TypeError, match="expected processes such as"):
        Model(["WN"])
