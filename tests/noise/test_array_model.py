"""Sample paths of processes, models and arrays against theory, and arrays against the published weights."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from reference import processes as naive
from reference import published

from gyrofuse._base.checks import own_generator
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.parsing import model_from_dict
from gyrofuse.noise.processes import AR1, Drift, QuantizationNoise, RandomWalk, Sinusoid, WhiteNoise
from gyrofuse.noise.processes.ar1_recursion import ar1_recursion

RANDOM = [
    WhiteNoise(0.7),
    QuantizationNoise(0.3),
    AR1(0.9, 0.5),
    AR1(-0.6, 2.0),
    AR1(0.999, 0.1),
    RandomWalk(0.04),
    Sinusoid(0.85, 0.35),
    WhiteNoise(1.0) + AR1(0.95, 0.2) + RandomWalk(0.01) + Sinusoid(0.3, 0.1),
]
MEMBERS = [*RANDOM, Drift(-0.02)]

R = [[2.0, 0.5, 0.0], [0.5, 1.0, -0.3], [0.0, -0.3, 0.5]]
Q = [[0.04, -0.03, 0.0], [-0.03, 0.04, 0.01], [0.0, 0.01, 0.02]]
TONE = [0.6, -0.6, 0.1]


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def z_scores(replications: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Standardised error of the mean over the first axis, its standard error taken from the replications."""
    error = replications.std(axis=0, ddof=1) / np.sqrt(len(replications))
    return (replications.mean(axis=0) - expected) / error


def small_array() -> ArrayModel:
    return ArrayModel([(WhiteNoise(1.0), R), (AR1(0.9, 0.2), R), (RandomWalk(1.0), Q), (Sinusoid(1.0, 0.3), TONE)])


def cases() -> dict[str, ArrayModel]:
    """The two simulated arrays of [Z], sections V-A and V-B."""
    svo = published.table("zhang")
    white = (WhiteNoise(1.0), svo["R"])
    slow = [(AR1(phi, 1.0), svo[name]) for phi, name in zip(svo["phi"], ("P1", "P2", "P3"), strict=True)]
    return {"case1": ArrayModel([white, (RandomWalk(1.0), svo["Q"])]), "case2": ArrayModel([white, *slow])}


# --- the recursion ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_samples", [1, 63, 64, 65, 128, 5000])
@pytest.mark.parametrize("phi", [0.0, 0.7, -0.99, 1 - 1e-9])
def test_recursion_matches_the_loop(n_samples, phi):
    innovations = np.random.default_rng(n_samples).standard_normal((2, n_samples))
    got = ar1_recursion(torch.tensor(innovations), torch.tensor(phi, dtype=torch.float64))
    np.testing.assert_allclose(got.numpy(), naive.ar1_path(innovations, phi), rtol=1e-10, atol=1e-11)


def test_recursion_broadcasts_phi_and_passes_gradcheck():
    phi = torch.tensor([0.5, -0.9], dtype=torch.float64, requires_grad=True)
    innovations = torch.randn(3, 2, 70, generator=seeded(), dtype=torch.float64, requires_grad=True)
    got = ar1_recursion(innovations, phi).detach()
    for i in range(2):
        expected = naive.ar1_path(innovations[:, i].detach().numpy(), phi[i].item())
        np.testing.assert_allclose(got[:, i].numpy(), expected, rtol=1e-12, atol=1e-12)
    assert torch.autograd.gradcheck(ar1_recursion, (innovations[:1], phi))


# --- sample paths -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(len(RANDOM)))
def test_wavelet_variance_of_400_paths_agrees_with_theory(seed):
    model = RANDOM[seed]
    paths = model.simulate(1024, batch=(400,), generator=seeded(seed)).numpy()
    z = z_scores(naive.wavelet_variance(paths, 7), model.wavelet_variance(7).numpy())
    assert np.abs(z).max() < 4.5


def test_drift_is_a_ramp_from_the_first_slope():
    path = Drift(-0.5).simulate(300, batch=(2,))
    assert torch.equal(path, -0.5 * torch.arange(1, 301, dtype=torch.float64).expand(2, 300))
    nu = naive.wavelet_variance(path.numpy(), 5)
    np.testing.assert_allclose(nu, Drift(-0.5).wavelet_variance(5).expand(2, 5).numpy(), rtol=1e-12)


def test_ar1_is_stationary_from_the_first_sample_on():
    x = AR1(0.99, 2.0).simulate(200, batch=(40_000,), generator=seeded()).numpy()
    variance = 2.0 / (1 - 0.99**2)
    for t in (0, 1, 63, 64, 199):
        assert abs(z_scores(x[:, t] ** 2, variance)) < 4.5
        assert abs(z_scores(x[:, t] * x[:, t - 1 if t else 1], variance * 0.99)) < 4.5


def test_random_walk_starts_with_its_first_increment():
    x = RandomWalk(0.25).simulate(10, batch=(40_000,), generator=seeded()).numpy()
    assert np.abs(z_scores(x**2, 0.25 * np.arange(1, 11))).max() < 4.5


def test_quantization_noise_has_its_two_autocovariances():
    x = QuantizationNoise(0.5).simulate(4, batch=(40_000,), generator=seeded()).numpy()
    assert abs(z_scores(x[:, 0] ** 2, 1.0)) < 4.5
    assert abs(z_scores(x[:, 0] * x[:, 1], -0.5)) < 4.5
    assert abs(z_scores(x[:, 0] * x[:, 2], 0.0)) < 4.5


def test_sinusoid_has_one_amplitude_and_every_phase():
    beta, n = 2 * np.pi * 5 / 200, 200  # whole cycles
    x = Sinusoid(0.8, beta).simulate(n, batch=(4000,), generator=seeded()).numpy()
    np.testing.assert_allclose((x**2).mean(-1), 0.8**2 / 2, rtol=1e-12)
    turns = np.sort(np.angle(np.fft.rfft(x)[:, 5]) / (2 * np.pi) % 1)
    uniform = (np.arange(4000) + 0.5) / 4000
    assert np.abs(turns - uniform).max() < 2.0 / np.sqrt(4000)  # Kolmogorov-Smirnov, p = 7e-4


@pytest.mark.parametrize("model", MEMBERS, ids=str)
def test_a_generator_makes_paths_reproducible_and_the_global_one_is_left_alone(model):
    before = torch.get_rng_state()
    first = model.simulate(100, batch=(2, 3), generator=seeded(7))
    again = model.simulate(100, batch=(2, 3), generator=seeded(7))
    fresh = [model.simulate(100) for _ in range(2)]
    assert torch.equal(torch.get_rng_state(), before)
    assert first.shape == (2, 3, 100)
    assert torch.equal(first, again)
    assert torch.equal(*fresh) == isinstance(model, Drift)


@pytest.mark.parametrize("model", MEMBERS, ids=str)
def test_float32_paths_are_rounded_float64_paths(model):
    double = model.simulate(500, generator=seeded(1))
    single = model.simulate(500, generator=seeded(1), dtype=torch.float32)
    assert double.dtype == torch.float64
    assert torch.equal(single, double.to(torch.float32))


def test_batched_parameters_come_after_the_batch_and_every_path_is_independent():
    variance = torch.tensor([1.0, 4.0], dtype=torch.float64)
    model = WhiteNoise(variance) + AR1(0.0, 1.0)
    x = model.simulate(4000, batch=(3,), generator=seeded())
    assert x.shape == (3, 2, 4000)
    covariance = torch.cov(x.flatten(0, 1)).numpy()
    np.testing.assert_allclose(covariance, np.diag([2.0, 5.0] * 3), atol=0.5)
    correlation = np.corrcoef(x.flatten(0, 1).numpy()) - np.eye(6)
    assert np.abs(correlation).max() < 4.5 / np.sqrt(4000)


def test_paths_are_differentiable_in_the_parameters():
    def path(phi, s2, r2, amplitude, beta):
        model = AR1(phi, s2) + RandomWalk(r2) + Sinusoid(amplitude, beta)
        return model.simulate(80, generator=seeded())

    values = [0.8, 1.0, 0.1, 0.5, 0.3]
    leaves = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in values]
    assert torch.autograd.gradcheck(path, leaves)


def test_arguments_are_checked():
    with pytest.raises(ValueError, match="`n_samples`"):
        WhiteNoise(1.0).simulate(0)
    with pytest.raises(ValueError, match="`generator`: expected a generator on device 'cuda', got one on 'cpu'"):
        WhiteNoise(1.0).simulate(3, generator=seeded(), device="cuda")
    assert own_generator(seeded(), "cpu").device.type == "cpu"
    assert own_generator(None, None).initial_seed() != own_generator(None, None).initial_seed()


# --- arrays -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", ["case1", "case2"])
@pytest.mark.parametrize("scales", ["long", "short"])
def test_published_arrays_give_the_true_weights(case, scales):
    svo = published.table("zhang")
    # the printed weights of the scales, three digits, normalised
    omega = torch.tensor(svo[f"scale_weights_{scales}"], dtype=torch.float64)
    gamma = cases()[case].wavelet_cross_covariance(19)
    a = torch.einsum("j,jab->ab", omega / omega.sum(), gamma)
    c = torch.linalg.solve(a, torch.ones(6, dtype=torch.float64))
    c = c / c.sum()
    np.testing.assert_allclose(c.numpy(), svo["true_weights"][f"{case}_{scales}"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        torch.einsum("a,jab,b->j", c, gamma, c).numpy(),
        svo["true_wavelet_variance_of_virtual"][f"{case}_{scales}"],
        rtol=1e-12,
    )


@pytest.mark.parametrize("case", ["case1", "case2"])
def test_100_recordings_of_a_published_array_agree_with_theory(case):
    array = cases()[case]
    x = array.simulate(2048, batch=(100,), generator=seeded(3)).numpy()
    assert x.shape == (100, 6, 2048)
    z = z_scores(naive.wavelet_cross_covariance(x, 7), array.wavelet_cross_covariance(7).numpy())
    assert np.abs(z).max() < 4.5


def test_cross_covariances_of_400_recordings_agree_with_theory():
    array = small_array()
    x = array.simulate(512, batch=(20, 20), generator=seeded()).flatten(0, 1).numpy()
    z = z_scores(naive.wavelet_cross_covariance(x, 6), array.wavelet_cross_covariance(6).numpy())
    assert np.abs(z).max() < 4.5


def test_array_moments_are_those_of_the_processes_times_the_matrices():
    array = small_array()
    r, q, tone = (np.array(m) for m in (R, Q, TONE))
    f = torch.tensor([0.1, 0.3], dtype=torch.float64)
    for got, of in (
        (array.wavelet_cross_covariance(6), lambda p: p.wavelet_variance(6).numpy()[:, None, None]),
        (array.spectrum(f), lambda p: p.spectrum(f).numpy()[:, None, None]),
    ):
        expected = of(WhiteNoise(1.0) + AR1(0.9, 0.2)) * r + of(RandomWalk(1.0)) * q
        expected = expected + of(Sinusoid(1.0, 0.3)) * np.outer(tone, tone)
        np.testing.assert_allclose(got.numpy(), expected, rtol=1e-12, atol=1e-15)


def test_array_is_reproducible_and_keeps_its_dtype():
    before = torch.get_rng_state()
    array = small_array()
    x = array.simulate(50, generator=seeded(5))
    assert torch.equal(x, array.simulate(50, generator=seeded(5)))
    assert torch.equal(x.float(), array.simulate(50, generator=seeded(5), dtype=torch.float32))
    assert not torch.equal(array.simulate(50), array.simulate(50))
    assert torch.equal(torch.get_rng_state(), before)


def test_one_tone_is_seen_by_every_sensor_with_its_gain():
    x = ArrayModel([(Sinusoid(1.0, 0.3), TONE)]).simulate(100, generator=seeded())
    np.testing.assert_allclose((x[1] / x[0]).numpy(), -1.0, rtol=1e-12)
    np.testing.assert_allclose((x[2] / x[0]).numpy(), 1 / 6, rtol=1e-12)


def test_array_of_independent_sensors_has_one_drift():
    models = [WhiteNoise(1.0) + Drift(-0.3), AR1(0.5, 2.0), RandomWalk(0.1) + Drift(0.2)]
    array = ArrayModel.from_sensors(models)
    slopes = np.array([-0.3, 0.0, 0.2])
    ramps = np.outer(slopes, slopes)[None] * Drift(1.0).wavelet_variance(4).numpy()[:, None, None]
    own = np.stack([m.wavelet_variance(4).numpy() for m in models], axis=-1)
    expected = np.where(np.eye(3, dtype=bool), own[:, None, :], ramps)
    np.testing.assert_allclose(array.wavelet_cross_covariance(4).numpy(), expected, rtol=1e-12, atol=1e-18)
    x = array.simulate(400, batch=(200,), generator=seeded()).mean(0).numpy()
    assert np.polyfit(np.arange(400), x.T, 1)[0] == pytest.approx(slopes, abs=0.01)


def test_array_round_trip_and_sum():
    array = small_array() + ArrayModel([(Drift(0.5), [1.0, 2.0, 3.0])])
    again = model_from_dict(json.loads(json.dumps(array.to_dict())))
    assert isinstance(again, ArrayModel)
    assert again.to_dict() == array.to_dict()
    assert torch.equal(again.simulate(30, generator=seeded()), array.simulate(30, generator=seeded()))
    assert array.n_sensors == 3
    assert str(array).startswith("ArrayModel(3 sensors: WhiteNoise(variance=1.0) + AR1(phi=0.9")
    with pytest.raises(TypeError, match="unsupported operand"):
        array + WhiteNoise(1.0)


def test_wavelet_cross_covariance_passes_gradcheck():
    covariance = torch.tensor(R, dtype=torch.float64, requires_grad=True)
    phi = torch.tensor(0.9, dtype=torch.float64, requires_grad=True)

    def moments(phi, root):
        return ArrayModel([(AR1(phi, 1.0), root @ root.mT)]).wavelet_cross_covariance(4)

    assert torch.autograd.gradcheck(moments, (phi, covariance))


def test_a_singular_covariance_is_fine_and_rounding_below_zero_too():
    direction = np.array([1.0, 2.0, -1.0]) / np.sqrt(6)
    plane = np.eye(3) - (1 + 1e-14) * np.outer(direction, direction)
    x = ArrayModel([(WhiteNoise(1.0), plane)]).simulate(1000, generator=seeded()).numpy()
    assert np.abs(direction @ x).max() < 1e-6
    assert np.abs(x).max() > 1


@pytest.mark.parametrize(
    ("components", "error", "message"),
    [
        ([], ValueError, "at least one"),
        ([("WN", R)], TypeError, "expected a process such as"),
        ([(WhiteNoise(torch.ones(3)), R)], ValueError, "expected scalar parameters, got a batch"),
        ([(WhiteNoise(1.0), [[1.0, 2.0]])], ValueError, r"expected a covariance \(sensor, sensor\) or gains"),
        ([(WhiteNoise(1.0), 1.0)], ValueError, r"got shape \(\)"),
        ([(WhiteNoise(1.0), [[1.0, 0.2], [0.1, 1.0]])], ValueError, "symmetric matrix.*differ.*by 0.1"),
        (
            [(AR1(0.5, 1.0), [[1.0, 2.0], [2.0, 1.0]])],
            ValueError,
            "matrix of AR1: expected a positive semi-definite matrix, got eigenvalues from -1 to 3",
        ),
        ([(WhiteNoise(1.0), [[float("nan")]])], ValueError, "expected finite numbers"),
        ([(Drift(1.0), R)], ValueError, "a drift is deterministic; give the slopes as gains"),
        ([(Drift(1.0), TONE), (Drift(2.0), TONE)], ValueError, "at most one Drift"),
        ([(WhiteNoise(1.0), R), (RandomWalk(1.0), [[1.0]])], ValueError, r"same number.*\[1, 3\]"),
    ],
)
def test_array_components_are_checked(components, error, message):
    with pytest.raises(error, match=message):
        ArrayModel(components)


def test_unknown_parameters_of_an_array_are_named():
    array = ArrayModel([(AR1(), R)])
    with pytest.raises(ValueError, match=r"`ar1_1.phi`, `ar1_1.variance`.*to be estimated"):
        array.simulate(10)
    with pytest.raises(ValueError, match=r"`ar1_1.phi`"):
        array.wavelet_cross_covariance(3)
