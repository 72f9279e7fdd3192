"""Limits by profile: against closed forms, coverage near zero, and words for what cannot be told apart."""

from __future__ import annotations

import json
import math

import pytest
import torch
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.fit import composition_of
from gyrofuse.fitting.moments.profile import profile_grid, profile_limits
from gyrofuse.fitting.moments.profile_objectives import SpectralProfile
from gyrofuse.fitting.spectral.bands import BandSpectrum, Bins
from gyrofuse.fitting.spectral.search import deviance
from gyrofuse.fitting.spectral.whittle import refine_whittle


def signals(n: int, n_samples: int, model: gf.Model, seed: int = 0) -> Tensor:
    return model.simulate(n_samples, batch=(n,), generator=torch.Generator().manual_seed(seed))[:, None]


def test_limits_are_the_outermost():
    """A parabola, one with a second valley, and one that never rises on the right."""
    own = torch.tensor([0.0, 0.0, 0.0], dtype=torch.float64)

    def rise(which: Tensor, at: Tensor) -> Tensor:
        two = torch.minimum(at.square(), (at - 6).square() * 4 + 1)
        flat = torch.where(at < 0, at.square(), 0.0 * at)
        return torch.stack([at.square(), two, flat])[which, torch.arange(len(at))]

    ends = torch.full_like(own, 10.0)
    values = profile_grid(own, torch.ones_like(own), -ends, ends)
    low, high = profile_limits(rise, own, values, torch.full_like(own, 2.0))
    torch.testing.assert_close(low, torch.full_like(own, -2.0), rtol=0, atol=0.02)
    assert high[0].item() == pytest.approx(2.0, abs=0.02)
    assert high[1].item() == pytest.approx(6 + math.sqrt(3) / 2, abs=0.05)
    assert high[2].item() == math.inf


def test_a_held_variance_stays_and_the_others_fit_around_it():
    """Against bounded least squares of the other columns."""
    from scipy.optimize import nnls

    structure = composition_of("WN + RW + QN", held=False)
    tau = 2.0 ** torch.arange(1, 10, dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    target = torch.rand(5, 9, generator=generator, dtype=torch.float64) + 0.1
    value = torch.linspace(0, 1e-2, 5, dtype=torch.float64)
    shape = target.new_empty(5, 0)
    linear, _, objective, _ = search.minimise(target, 1 / target, tau, structure, shape, fixed=(1, value))
    torch.testing.assert_close(linear[:, 1], value)
    columns = structure.columns(tau, shape)
    for i in range(5):
        weighted = (columns[i] / target[i, :, None]).numpy()
        rest = 1 - weighted[:, 1] * value[i].item()
        expected, norm = nnls(weighted[:, [0, 2]], rest)
        torch.testing.assert_close(linear[i, [0, 2]], torch.from_numpy(expected), rtol=1e-8, atol=1e-12)
        assert objective[i].item() == pytest.approx(norm**2, rel=1e-8)


@pytest.mark.parametrize("refine", [False, True])
def test_limits_hold_a_variance_near_zero(refine):
    """A walk of which half of 200 records show nothing: nominal 95 to 97.5 %, 99.9 % binomial bound below."""
    model = gf.WhiteNoise(1.0) + gf.RandomWalk(3e-6)
    found = gf.fit_gmwm(signals(200, 2048, model), "WN + RW", refine=refine)
    low, high = (limit[:, 0, 1] for limit in found.confidence_interval)
    zero = found.params[:, 0, 1] == 0
    assert 40 <= int(zero.sum()) <= 160
    assert (low[zero] == 0).all()
    assert high.isfinite().all()
    assert (low <= found.params[:, 0, 1]).all()
    assert (high > found.params[:, 0, 1]).all()
    assert int(((low <= 3e-6) & (high >= 3e-6)).sum()) >= stats.binom.ppf(0.0005, 200, 0.95)


def test_limits_scale_with_the_signal():
    signal = signals(6, 2048, gf.WhiteNoise(1.0))
    found, small = gf.fit_gmwm(signal, "WN + RW"), gf.fit_gmwm(1e-8 * signal, "WN + RW")
    expected = found.confidence_interval.high * 1e-16
    torch.testing.assert_close(small.confidence_interval.high, expected, rtol=1e-4, atol=0)


def test_what_is_well_determined_keeps_its_interval():
    """Symmetric in logarithms, by the covariance."""
    model = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-2)
    found = gf.fit_gmwm(signals(4, 8192, model), "WN + RW")
    assert bool(found.determined.all())
    assert bool(found.identified.all())
    assert found.notes == ((),) * 4
    low, high = found.confidence_interval
    torch.testing.assert_close((low * high).sqrt(), found.params, rtol=1e-9, atol=0)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("model", "formula", "n_samples", "said"),
    [
        (gf.WhiteNoise(1.0) + gf.RandomWalk(1e-3), "WN + AR1", 4096, "indistinguishable from a random walk"),
        (gf.WhiteNoise(1.0), "WN + AR1", 4096, "ar1_1: "),
        (gf.AR1(0.9, 1.0), "2*AR1", 4096, "ar1_"),
        (gf.WhiteNoise(1.0) + gf.Sinusoid(2.0, 2 * math.pi * 2 / 4096), "WN + SIN", 4096, "fewer than 3 cycles"),
    ],
)
def test_what_cannot_be_told_apart_is_said(model, formula, n_samples, said):
    found = gf.fit_gmwm(signals(8, n_samples, model, seed=2), formula)
    heard = [any(said in text for text in texts) for texts in found.notes]
    absent = [bool((found.params[i, 0] == 0).any()) for i in range(8)]
    assert sum(h or a for h, a in zip(heard, absent, strict=True)) >= 7, found.notes
    assert any(heard)
    assert found.identified[:, 0].tolist() == [not texts for texts in found.notes]
    i = heard.index(True)
    assert said in found.summary()
    assert json.loads(json.dumps(found.to_dict()))["remarks"][i] == list(found.notes[i])


def test_memory_that_is_unknown_has_no_limits():
    """White noise taken for an AR1 beside white noise: nearly any `phi`, and no variance to rely on."""
    found = gf.fit_gmwm(signals(12, 4096, gf.WhiteNoise(1.0), seed=5), "WN + AR1")
    low, high = (limit[:, 0] for limit in found.confidence_interval)
    assert ((low[:, 1] < 0) & (high[:, 1] > 0.9)).sum() >= 8
    assert (low[:, 2] == 0).sum() >= 9
    assert (high[:, 0] > 0.95).sum() >= 9  # the white noise may be all of it, whichever took it


def test_the_rise_of_the_likelihood_is_that_of_a_fine_grid():
    """White noise and a walk held at some value: the best of 4000 levels of the white noise."""
    signal = signals(2, 1024, gf.WhiteNoise(1.0) + gf.RandomWalk(1e-3))[:, 0]
    structure = composition_of("WN + RW", held=True)
    start = torch.tensor([[1.0, 1e-3]], dtype=torch.float64).expand(2, -1)
    fit = refine_whittle(signal, structure, start, start.new_empty(2, 0))
    surface = SpectralProfile(fit.linear, fit.shape, fit.energy, fit.count, structure, 1024)
    bins, noise = Bins(1024, torch.device("cpu")), BandSpectrum(structure)
    white = torch.linspace(0.5, 2.0, 4000, dtype=torch.float64)
    for value in (0.0, 1e-4, 1e-2):
        found = surface.rise(torch.arange(2), 1, torch.full((2,), value, dtype=torch.float64))
        for i in range(2):
            p = torch.stack([white, torch.full_like(white, value)], -1)
            x = p.new_empty(len(p), 0)
            energy, count = fit.energy[i].expand(len(p), -1), fit.count[i].expand(len(p), -1)
            least = deviance(energy, count, bins, noise, p, x).min()
            own = deviance(fit.energy, fit.count, bins, noise, fit.linear, fit.shape)[i]
            assert found[i].item() == pytest.approx((least - own).item(), abs=0.01)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("model", "unknown", "place"),
    [
        (gf.WhiteNoise(1.0) + gf.AR1(0.999, 1e-3), 2, 1),
        (gf.WhiteNoise(1.0) + gf.AR1(0.98, 0.01) + gf.AR1(0.9, 0.05), 3, 1),
    ],
    ids=["a third of the record", "two alike"],
)
def test_limits_are_where_the_likelihood_has_fallen_enough(model, unknown, place):
    """Of an AR1 hardly shorter than the record, and of the slower one of two that are alike: the likelihood is bent.

    A straight line from the estimate has limits where the root of the rise is a fifth off and more.
    """
    formula = "WN + " + " + ".join(["AR1"] * (len(model.processes) - 1))
    signal = signals(8, 3000 if unknown == 2 else 16384, model)
    fit = gf.fit_gmwm(signal, formula, refine=True)
    structure = composition_of(formula, held=True)
    params = fit.params[:, 0]
    linear = params[:, [at for at, name in enumerate(fit.param_names) if name.endswith("variance")]]
    shape = params[:, [at for at, name in enumerate(fit.param_names) if name.endswith("phi")]].atanh()
    there = refine_whittle(signal[:, 0], structure, linear, shape)
    surface = SpectralProfile(there.linear, there.shape, there.energy, there.count, structure, signal.shape[-1])
    below = fit.confidence_interval.low[:, 0, place]
    order = torch.ones(8, dtype=torch.bool)
    rise = surface.rise(torch.arange(8), unknown, below.atanh(), order)
    told = below > params[:, place + 2] if unknown == 3 else torch.ones_like(order)
    assert bool(told.all())
    torch.testing.assert_close(rise.sqrt(), torch.full_like(rise, 1.96), rtol=0.02, atol=0)
