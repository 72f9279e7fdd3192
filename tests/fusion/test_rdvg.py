"""RDVG: against published software, a naive twin, its own theory, and arrays whose noise is known."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from reference import haar, published
from reference import rdvg as naive
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fusion.weights.rdvg import _sampling_covariances, _weights, fit_allan_covariances, rdvg, rdvg_weights


def array(*batch: int, n_samples: int = 500, n_sensors: int = 3) -> Tensor:
    n_items = int(np.prod(batch)) if batch else 1
    items = [torch.from_numpy(haar.array(n_sensors, n_samples, seed)) for seed in range(n_items)]
    return torch.stack(items).view(*batch, n_sensors, n_samples)


def white_and_walk(n_samples: int, batch: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Simulated arrays with their R and Q."""
    R = torch.tensor([2.8, 1.1, 1.7], dtype=torch.float64)
    Q = 1e-3 * torch.tensor([[2.5, 0.3, -1.0], [0.3, 4.7, 1.9], [-1.0, 1.9, 3.5]], dtype=torch.float64)
    model = gf.ArrayModel([(gf.WhiteNoise(1.0), R.diag()), (gf.RandomWalk(1.0), Q)])
    return model.simulate(n_samples, batch=(batch,), generator=torch.Generator().manual_seed(seed)), R, Q


# Published software


@pytest.mark.parametrize(("key", "n_scales"), [("algorithm_2", 9), ("algorithm_2_remove_last", 8)])
def test_published_software_is_reproduced_from_its_allan_covariances(key, n_scales):
    # It drops the last cluster of every size, so that its covariances are not those of the whole record.
    synimu = published.table("synimu")
    covariances = torch.tensor(synimu["acov_covariance"], dtype=torch.float64)[:n_scales]
    R, Q = fit_allan_covariances(covariances, 4096)
    np.testing.assert_allclose(R, synimu[key]["R"], rtol=1e-12)
    np.testing.assert_allclose(Q, synimu[key]["Q"], rtol=1e-12)
    if key == "algorithm_2":
        np.testing.assert_allclose(_weights(Q), synimu["coef_vaccaro"], rtol=1e-10)
        assert torch.linalg.eigvalsh(Q)[0] < 0


def test_allan_covariances_of_published_software_are_those_without_the_last_cluster():
    synimu, signal = published.table("synimu"), published.array()
    for m, expected in list(zip(synimu["acov_scales"], synimu["acov_covariance"], strict=True))[3:]:
        shortened = signal[:, : 4096 - m]
        got = [[naive.allan_covariance(a, b, m) for b in shortened] for a in shortened]
        np.testing.assert_allclose(got, expected, rtol=1e-10)


# The naive twin


@pytest.mark.filterwarnings("ignore:RDVG")
@pytest.mark.parametrize("n_samples", [32, 500, 777])
def test_a_batch_is_its_naive_twins(n_samples):
    signal = array(2, 2, n_samples=n_samples)
    result = rdvg(signal)
    for index in np.ndindex(2, 2):
        R, Q = naive.fit(naive.allan_covariances(signal[index].numpy()), n_samples)
        np.testing.assert_allclose(result.R[index], R, rtol=1e-8)
        np.testing.assert_allclose(result.Q[index], Q, rtol=1e-7, atol=1e-10 * np.abs(Q).max())
        expected = np.linalg.solve(Q, np.ones(3))
        np.testing.assert_allclose(result.weights[index], expected / expected.sum(), rtol=1e-6)
        assert result.positive_definite[index] == bool((np.linalg.eigvalsh(Q) > 0).all())
    assert torch.equal(rdvg_weights(signal), result.weights)


@pytest.mark.filterwarnings("ignore:RDVG")
def test_a_first_guess_stands_in_where_no_scale_is_short_or_an_estimate_is_negative():
    steps = torch.from_numpy(np.random.default_rng(2).normal(size=(2, 600)))
    signal = torch.stack([steps[0].cumsum(-1), steps[1], steps[0] + 0.1 * steps[1].cumsum(-1)])
    covariances = naive.allan_covariances(signal.numpy())
    R, Q = naive.fit(covariances, 600)
    assert covariances[:, 0, 0].argmin() == 0, "no scale is short"
    assert min(R.min(), Q.diagonal().min()) < 0, "an estimate is negative"
    result = rdvg(signal)
    np.testing.assert_allclose(result.R, R, rtol=1e-8)
    np.testing.assert_allclose(result.Q, Q, rtol=1e-7, atol=1e-12)


@pytest.mark.filterwarnings("ignore:RDVG")
def test_clusters_with_a_missing_sample_are_left_out():
    signal = array(n_samples=700)
    signal[0, 100:130], signal[2, 300] = torch.nan, torch.nan
    R, Q = naive.fit(naive.allan_covariances(signal.numpy()), 700)
    signal[2, 300] = torch.inf
    result = rdvg(signal)
    np.testing.assert_allclose(result.R, R, rtol=1e-8)
    np.testing.assert_allclose(result.Q, Q, rtol=1e-7, atol=1e-10)


def test_float32_with_a_large_offset_gives_what_float64_gives():
    signal, _, _ = white_and_walk(4096, 3, seed=4)
    exact = rdvg((signal + 100).float().double())
    single = rdvg((signal + 100).float())
    assert single.weights.dtype == single.R.dtype == single.Q.dtype == torch.float32
    for got, expected in ((single.weights, exact.weights), (single.R, exact.R), (single.Q, exact.Q)):
        torch.testing.assert_close(got.double(), expected, rtol=1e-6, atol=1e-12)


# Theory


@pytest.mark.parametrize("process", ["white", "walk"])
def test_sampling_covariances_are_those_of_simulated_clusters(process):
    n_samples, n_runs = 256, 8_000
    steps = torch.randn(n_runs, n_samples, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    # Within a cluster of the published theory a random walk is continuous: sixteen steps a sample come close.
    if process == "walk":
        fine = torch.randn(n_runs, n_samples * 16, generator=torch.Generator().manual_seed(2)) / 4
        steps = fine.cumsum(-1).unflatten(-1, (n_samples, 16)).mean(-1).double()
    variances = []
    for m in (2, 4, 8, 16):
        means = steps.unflatten(-1, (-1, m)).mean(-1)
        variances.append(means.diff(dim=-1).square().mean(-1) / 2)
    got = torch.cov(torch.stack(variances))
    size = torch.tensor([2.0, 4, 8, 16], dtype=torch.float64)
    white, walk = _sampling_covariances(size, n_samples)
    expected = white if process == "white" else walk
    spread = expected.diagonal().sqrt()
    error = (got - expected) / (spread[:, None] * spread)
    assert error.abs().max() < 5 * (2 / n_runs) ** 0.5  # of a variance of nearly normal numbers


def test_noise_is_found_within_its_sampling_error():
    n_runs = 40
    signal, R, Q = white_and_walk(2**15, n_runs, seed=11)
    result = rdvg(signal)
    for got, truth in ((result.R, R), (result.Q, Q)):
        error = (got.mean(0) - truth) / (got.std(0) / n_runs**0.5)
        assert error.abs().max() < 4
        assert (got.std(0).max() / truth.abs().max()) < 0.5
    best = torch.linalg.solve(Q, torch.ones(3, dtype=torch.float64))
    error = (result.weights.mean(0) - best / best.sum()) / (result.weights.std(0) / n_runs**0.5)
    assert error.abs().max() < 4.5
    assert bool(result.positive_definite.all())


# Failure is data


def test_arrays_whose_q_is_no_covariance_are_counted_and_kept():
    signal, _, _ = white_and_walk(4096, 4, seed=0)
    signal[1] = torch.randn(3, 4096, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    with pytest.warns(UserWarning, match=r"not positive definite in 1 of 4 array\(s\)"):
        result = rdvg(signal)
    assert result.positive_definite.tolist() == [True, False, True, True]
    expected = torch.linalg.solve(result.Q, torch.ones(4, 3, dtype=torch.float64))
    torch.testing.assert_close(result.weights, expected / expected.sum(-1, keepdim=True))
    with pytest.warns(UserWarning, match="1 of 1"):
        rdvg_weights(signal[1])


def test_a_singular_q_has_no_weights():
    Q = torch.stack([torch.ones(2, 2), torch.eye(2)]).double()
    weights = _weights(Q)
    assert weights[0].isnan().all()
    assert weights[1].tolist() == [0.5, 0.5]


def test_bad_signals_are_told():
    signal = array(n_samples=64)
    with pytest.raises(ValueError, match="`signal`: expected at least 32 samples for two cluster sizes, got 31"):
        rdvg(signal[:, :31])
    with pytest.raises(TypeError, match="`signal`: expected float32 or float64"):
        rdvg(signal.int())
    with pytest.raises(ValueError, match=r"`signal`: expected \(..., sensor, time\)"):
        rdvg_weights(signal[0])
    dead = signal.clone()
    dead[1] = 3.0
    with pytest.raises(ValueError, match="one that is dead or stuck"):
        rdvg(dead)
    sparse = signal.clone()
    sparse[0, ::4] = torch.nan
    with pytest.raises(ValueError, match="missing samples leave none; give a stretch with fewer gaps"):
        rdvg(sparse)


def test_a_virtual_gyro_says_where_its_weights_minimise_nothing():
    signal, _, _ = white_and_walk(4096, 2, seed=0)
    signal[1] = torch.randn(3, 4096, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    with pytest.warns(UserWarning, match="not positive definite in 1 of 2"):
        result = gf.fit_svo(signal, method="rdvg")
    assert result.to_dict()["positive_definite"] == [True, False]
    assert result[1].to_dict()["positive_definite"] is False
    assert gf.fit_svo(signal[0], method="equal").to_dict()["positive_definite"] is None


def test_the_summary_and_the_dictionary_say_what_was_found():
    signal, _, _ = white_and_walk(4096, 2, seed=0)
    result = rdvg(signal[0])
    lines = str(result).splitlines()
    assert len(lines) == 4
    assert f"{result.weights[1]:+.5f}" in lines[2]
    plain = json.loads(json.dumps(result.to_dict()))
    assert plain["positive_definite"] is True
    np.testing.assert_allclose(plain["Q"], result.Q)
    signal[1] = torch.randn(3, 4096, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    with pytest.warns(UserWarning, match="1 of 2"):
        failed = rdvg(signal)
    assert "not positive definite in 1 of 2" in failed.summary()
