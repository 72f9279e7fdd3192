"""Relatives of SVO: against brute force and general optimisers, naive twins, and arrays whose truth is known."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch
from reference import competitors as naive
from scipy import optimize
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fusion.weights import baselines as competitors
from gyrofuse.fusion.weights.baselines import (
    neighbouring_correlations,
    nonnegative_weights,
    shrinkage_weights,
    shrunk_covariance,
)
from gyrofuse.fusion.weights.svo import optimal_weights, resolve_scale_weights
from gyrofuse.wavelets.covariance import wavelet_products
from gyrofuse.wavelets.intervals import equivalent_dof
from gyrofuse.wavelets.moments import combined_covariance

ONE = torch.ones(1, dtype=torch.float64)


def covariances(n: int, p: int, common: float = 2.0, seed: int = 0) -> Tensor:
    """Covariances with a common part of another gain for each sensor: some sensors ask for negative weights."""
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(n, p, p + 2)) * rng.uniform(0.3, 3, (n, p, 1)) + common * rng.normal(size=(n, 1, p + 2))
    return torch.from_numpy(factors @ factors.swapaxes(-1, -2))


def assert_optimal(combined: Tensor, weights: Tensor) -> None:
    """Karush, Kuhn and Tucker: feasible, no gain in any direction, and none lost by a sensor at zero."""
    assert bool((weights >= 0).all())
    torch.testing.assert_close(weights.sum(-1), torch.ones_like(weights[..., 0]), rtol=1e-14, atol=0)
    slope = (combined @ weights[..., None])[..., 0]
    slack = slope / (weights * slope).sum(-1, keepdim=True) - 1
    assert slack.min() > -1e-12
    assert (slack * weights).abs().max() < 1e-12


# Weights that are not negative


@pytest.mark.parametrize("p", [1, 2, 3, 6])
def test_nonnegative_weights_are_the_best_of_all_subsets(p):
    A = covariances(60, p) * 1e-14
    got = nonnegative_weights(A[:, None], ONE)
    expected = np.stack([naive.nonnegative_weights(a) for a in A])
    np.testing.assert_allclose(got, expected, rtol=1e-10, atol=1e-14)
    assert_optimal(A, got)
    if p > 2:
        assert len(set((expected > 0).sum(-1))) > 1, "no variety among the test cases"


def test_nonnegative_weights_of_many_sensors_are_optimal():
    A = covariances(100, 32, seed=1)
    got = nonnegative_weights(A[:, None], ONE)
    assert_optimal(A, got)
    n_used = (got > 0).sum(-1)
    assert 2 < n_used.min() < n_used.max() < 32
    for a, weights in zip(A[:3].numpy(), got[:3].numpy(), strict=True):
        found = optimize.minimize(
            lambda c, a=a: c @ a @ c,
            np.full(32, 1 / 32),
            jac=lambda c, a=a: 2 * a @ c,
            bounds=[(0, None)] * 32,
            constraints={"type": "eq", "fun": lambda c: c.sum() - 1, "jac": np.ones_like},
            method="SLSQP",
            options={"ftol": 1e-15, "maxiter": 1000},
        )
        assert weights @ a @ weights <= found.fun * (1 + 1e-9)
        np.testing.assert_allclose(weights, found.x, atol=1e-4)


def test_nonnegative_weights_are_svos_where_these_are_positive():
    nearly = torch.eye(4) + 0.05 * covariances(5, 4, common=0.1, seed=3)
    wccv = nearly[:, None] * torch.tensor([1.0, 2.0]).double()[:, None, None]
    omega = torch.tensor([0.3, 0.7], dtype=torch.float64)
    svo = gf.svo_weights(wccv, omega)
    positive = (svo > 0).all(-1)
    assert positive.any()
    torch.testing.assert_close(nonnegative_weights(wccv, omega)[positive], svo[positive], rtol=1e-12, atol=0)


def test_nonnegative_weights_keep_batch_and_dtype_and_have_gradients():
    A = covariances(6, 3).view(2, 3, 1, 3, 3)
    got = nonnegative_weights(A, ONE)
    assert got.shape == (2, 3, 3)
    torch.testing.assert_close(got[1, 2], nonnegative_weights(A[1, 2], ONE))
    single = nonnegative_weights(A.float(), ONE)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), got, rtol=1e-4, atol=1e-6)
    # Away from the edges, where a sensor is about to enter or leave.
    assert torch.autograd.gradcheck(lambda a: nonnegative_weights(a, ONE), A[0].clone().requires_grad_())


def test_a_sensor_on_the_verge_and_equal_sensors_do_no_harm():
    # The second sensor adds nothing: its optimal weight is exactly zero.
    verge = torch.tensor([[1.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(
        nonnegative_weights(verge[None], ONE), torch.tensor([0.5, 0.0, 0.5], dtype=torch.float64), atol=1e-15, rtol=0
    )
    same = torch.eye(8, dtype=torch.float64) + 1e3
    torch.testing.assert_close(nonnegative_weights(same[None], ONE), torch.full((8,), 1 / 8, dtype=torch.float64))


def test_a_search_cut_short_is_told_and_stays_feasible(monkeypatch):
    # In two turns the second array, whose sensors leave one by one, does not come to its end.
    A = torch.stack([torch.eye(8).double(), covariances(1, 8, common=8.0, seed=1)[0]])
    monkeypatch.setattr(competitors, "_nonnegative_set", partial(competitors._nonnegative_set, most_turns=2))
    with pytest.warns(UserWarning, match="1 of 2 not at their optimum"):
        got = nonnegative_weights(A[:, None], ONE)
    assert bool((got >= 0).all())


# Shrinkage


def level_covariances(seed: int = 0) -> tuple[Tensor, Tensor]:
    """Six levels of three sensors that agree in their correlations, and degrees of freedom."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(covariances(1, 3, seed=7)[0].numpy())
    degrees = np.array([3000.0, 400, 100, 25, 6, 1.5])
    levels = []
    for j, eta in enumerate(degrees):
        draws = root @ rng.normal(size=(3, max(int(eta), 3)))
        levels.append(2.0**-j * draws @ draws.T / draws.shape[1])
    return torch.from_numpy(np.stack(levels)), torch.from_numpy(degrees)


def test_neighbouring_correlations_are_those_of_the_naive_twin():
    wccv, degrees = level_covariances()
    got = neighbouring_correlations(wccv, degrees)
    np.testing.assert_allclose(got, naive.neighbouring_correlations(wccv, degrees), rtol=1e-12)
    assert torch.equal(got[0], wccv[0]), "a level with many degrees of freedom needs no help"
    torch.testing.assert_close(got.diagonal(dim1=-2, dim2=-1), wccv.diagonal(dim1=-2, dim2=-1))


def test_shrinkage_takes_the_worth_of_the_target_with_the_largest_likelihood():
    wccv, degrees = level_covariances(1)
    target = neighbouring_correlations(wccv, degrees) * (1 + 0.05 * torch.eye(3))
    shrunk, worth = shrunk_covariance(wccv, target, degrees)
    grid = 2.0 ** (np.arange(-2, 61) / 2)
    likelihood = [
        sum(naive.log_marginal_likelihood(*level, nu) for level in zip(wccv, target, degrees.tolist(), strict=True))
        for nu in grid
    ]
    assert worth.item() == pytest.approx(grid[np.argmax(likelihood)], rel=1e-12)
    assert 1 < worth < 1e6
    eta = degrees[:, None, None]
    torch.testing.assert_close(shrunk, (eta * wccv + worth * target) / (eta + worth), rtol=1e-12, atol=0)


def test_the_worth_found_is_how_far_truth_strays_from_the_target():
    # Truth inverse Wishart around the target, worth 40 observations; 30 levels of 60 observations each.
    from scipy import stats

    p, nu, eta = 3, 40.0, 60
    target = covariances(1, p, seed=5)[0].numpy()
    rng = np.random.default_rng(0)
    found = []
    for _ in range(20):
        truth = stats.invwishart.rvs(nu + p + 1, nu * target, size=30, random_state=rng)
        data = np.stack([stats.wishart.rvs(eta, t, random_state=rng) / eta for t in truth])
        centre = torch.from_numpy(target).expand(30, p, p)
        found.append(shrunk_covariance(torch.from_numpy(data), centre, torch.full((30,), float(eta)))[1].log2().item())
    assert abs(np.mean(found) - np.log2(nu)) < 3 * np.std(found) / 20**0.5 + 0.25  # steps of half a power of two


def test_shrinkage_leaves_alone_what_it_does_not_know():
    wccv, degrees = level_covariances()
    batch = torch.stack([wccv, wccv])
    batch[1, 4] = torch.nan
    shrunk, worth = shrunk_covariance(batch, neighbouring_correlations(batch, degrees), degrees)
    assert shrunk[1, 4].isnan().all()
    assert shrunk[1, [0, 1, 2, 3, 5]].isfinite().all()
    alone, alone_worth = shrunk_covariance(wccv, neighbouring_correlations(wccv, degrees), degrees)
    torch.testing.assert_close(shrunk[0], alone)
    assert worth[0] == alone_worth
    omega = torch.tensor([0.2, 0.2, 0.2, 0.2, 0.0, 0.2], dtype=torch.float64)
    assert shrinkage_weights(batch, omega, degrees).isfinite().all()
    single = shrinkage_weights(wccv.float(), omega, degrees)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), shrinkage_weights(wccv, omega, degrees), rtol=1e-3, atol=1e-4)
    # A level on its own has no neighbours.
    torch.testing.assert_close(shrinkage_weights(wccv[3:4], ONE, degrees[3:4]), gf.svo_weights(wccv[3:4]))


def test_shrinkage_halves_the_risk_of_long_scale_weights():
    # White noise and correlated random walks; weights for the levels with one to thirty observations.
    R = torch.tensor([2.8, 1.4, 1.0, 2.0], dtype=torch.float64)
    Q = 1e-3 * covariances(1, 4, common=0.5, seed=2)[0]
    model = gf.ArrayModel([(gf.WhiteNoise(1.0), R.diag()), (gf.RandomWalk(1.0), Q)])
    signal = model.simulate(8192, batch=(60,), generator=torch.Generator().manual_seed(0))
    sums, counts = wavelet_products(signal, 12)
    wccv, degrees = sums / counts, equivalent_dof(counts[..., 0, 0])
    omega = resolve_scale_weights("long", 12)
    truth = combined_covariance(model.wavelet_cross_covariance(12), omega)
    best = optimal_weights(truth)

    def excess(weights: Tensor) -> Tensor:
        return torch.einsum("...i,ik,...k->...", weights, truth, weights) / (best @ truth @ best) - 1

    svo, shrunk = excess(gf.svo_weights(wccv, omega)), excess(shrinkage_weights(wccv, omega, degrees))
    assert shrunk.mean() < 0.7 * svo.mean()
    # Sixty arrays: fewer than 40 would be a chance of 0.7 % if neither were better.
    assert (shrunk < svo).sum() >= 40


@pytest.mark.filterwarnings("ignore:no complete window")
@pytest.mark.parametrize("weights", [gf.inverse_variance_weights, nonnegative_weights])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x.index_fill(0, torch.tensor([0]), 3.0), "sensor\\(s\\) 1 never change"),
        (lambda x: 1e-170 * x, "too small to be squared"),
        (lambda x: 1e170 * x, "too large to be squared"),
        (lambda x: torch.where(torch.arange(256) == 100, torch.nan, x), "no complete window"),
    ],
)
def test_weights_are_never_silently_missing(weights, change, message):
    signal = torch.from_numpy(np.random.default_rng(1).normal(size=(3, 256)))
    wccv = gf.wavelet_cross_covariance(change(signal))
    with pytest.raises(gf.SingularCovarianceError, match=message):
        weights(wccv, resolve_scale_weights("flat", 8))


@pytest.mark.parametrize("weights", [gf.inverse_variance_weights, nonnegative_weights])
def test_levels_that_do_not_count_may_be_unknown(weights):
    signal = torch.from_numpy(np.random.default_rng(1).normal(size=(3, 256)))
    wccv = gf.wavelet_cross_covariance(signal)
    short = torch.tensor([0.5, 0.5, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
    expected = weights(wccv, short)
    wccv[4:] = torch.nan
    torch.testing.assert_close(weights(wccv, short), expected)
