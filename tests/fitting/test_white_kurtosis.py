"""White noise that is not Gaussian: its excess kurtosis, and intervals and tests that count with it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.fitting.moments.fit import composition_of
from gyrofuse.fitting.moments.white_kurtosis import white_excess_kurtosis
from gyrofuse.fitting.spectral.tones import Tones

N_SAMPLES = 4096
WALK = 1e-4


def records(law: str, n: int, seed: int = 0) -> Tensor:
    """White noise of this law and variance 1 on a Gaussian random walk, `(n, 1, time)`."""
    rng = np.random.default_rng(seed)
    draw = {
        "normal": lambda size: rng.standard_normal(size),
        "laplace": lambda size: rng.laplace(size=size) / math.sqrt(2),
        "uniform": lambda size: rng.uniform(-1, 1, size) * math.sqrt(3),
        "t": lambda size: rng.standard_t(5, size) / math.sqrt(5 / 3),
    }[law]
    walk = np.cumsum(math.sqrt(WALK) * rng.standard_normal((n, N_SAMPLES)), -1)
    return torch.from_numpy(draw((n, N_SAMPLES)) + walk)[:, None]


@pytest.mark.parametrize(("law", "kappa"), [("normal", 0.0), ("laplace", 3.0), ("uniform", -1.2)])
def test_excess_kurtosis(law, kappa):
    """Of the white part, whatever walk and tone are there; mean of 50 records, four standard errors."""
    signal = records(law, 50)[:, 0]
    one = torch.ones(50, 1, dtype=torch.float64)
    tones = Tones(0.9 * one, 2 * one, 0 * one, 0 * one, 0 * one, 0 * one)
    signal[:, 7] = torch.nan
    structure = composition_of("WN + RW + SIN", held=True)
    params = torch.tensor([[1.0, WALK, 2.0, 0.9]]).double().expand(50, -1)
    found = white_excess_kurtosis(signal + tones.waveform(N_SAMPLES), tones, structure, params)
    assert found.mean().item() == pytest.approx(kappa, abs=4 * found.std().item() / math.sqrt(50))
    gone = white_excess_kurtosis(signal, None, structure, params * torch.tensor([0.0, 1, 1, 1]))
    assert (gone == 0).all()
    walks = composition_of("RW", held=True)
    assert (white_excess_kurtosis(signal, None, walks, params[:, 1:2]) == 0).all()


def test_the_variance_of_its_logarithm_grows_by_kappa_over_t():
    """As generalised least squares have it with the term in their covariance, which leaves the rest as it is."""
    model = gf.WhiteNoise(1.0) + gf.AR1(0.95, 0.02) + gf.RandomWalk(WALK)
    tau = 2.0 ** np.arange(1, 12)

    def variances(params: np.ndarray) -> np.ndarray:
        known = gf.WhiteNoise(params[0]) + gf.AR1(params[1], params[2]) + gf.RandomWalk(params[3])
        return known.wavelet_variance(len(tau)).numpy()

    params = np.array([1.0, 0.95, 0.02, WALK])
    jacobian = np.stack(
        [(variances(params + step) - variances(params - step)) / (2 * step.sum()) for step in np.diag(params * 1e-5)],
        -1,
    )
    spread = []
    for kappa in (0.0, 6.0):
        covariance = moment_covariance(model, N_SAMPLES, len(tau), excess_kurtosis=kappa).numpy()
        spread.append(np.linalg.inv(jacobian.T @ np.linalg.solve(covariance, jacobian)))
    sd = np.sqrt(np.diag(spread[0]))
    added = (spread[1] - spread[0]) / sd / sd[:, None]
    assert added[0, 0] == pytest.approx(6 / N_SAMPLES / spread[0][0, 0], rel=1e-2)
    added[0, 0] = 0
    assert np.abs(added).max() < 1e-2


@pytest.mark.parametrize("refine", [False, True])
def test_intervals_hold_under_heavy_and_light_tails(refine):
    """Of 100 records each; an interval that holds 95 % holds fewer than 87 once in 2000 times.

    With the Gaussian variance those of t with five degrees of freedom held three in four.
    """
    for law in ("t", "laplace", "uniform"):
        fit = gf.fit_gmwm(records(law, 100), "WN + RW", refine=refine)
        low, high = fit.confidence_interval
        truth = torch.tensor([1.0, WALK])
        held = ((low <= truth) & (truth <= high))[:, 0].sum(0)
        assert (held >= 87).all(), (law, held)
        sd = fit.param_cov[:, 0, 0, 0].sqrt().median()
        # The fourth moment of few records falls short of that of t, whose own variance is infinite.
        assert sd.item() == pytest.approx(fit.params[:, 0, 0].std().item(), rel=0.3), law


def test_equal_recordings_with_heavy_tails_are_not_refused():
    """At 5 % more than 7 of 50 once in 300 times; without the tails in the covariance 13 would be expected."""
    fit = gf.fit_gmwm_joint([records("t", 50, 1), records("t", 50, 2)], "WN + RW")
    assert int((fit.p_value < 0.05).sum()) <= stats.binom.ppf(0.99, 50, 0.05)
    low, high = fit.joint.confidence_interval
    assert int(((low <= 1) & (high >= 1))[:, 0, 0].sum()) >= stats.binom.ppf(0.001, 50, 0.95)


def test_a_spike_is_said_to_leave_the_white_noise_weakly_known():
    """Nearly all of its variance is one sample's."""
    signal = records("normal", 1)
    signal[..., 1000] = 200.0
    fit = gf.fit_gmwm(signal, "WN + RW")
    assert not fit.determined[0, 0, 0]
    assert fit.confidence_interval.high[0, 0, 0] > 2 * fit.params[0, 0, 0]
