"""Spectral refinement: spectra against dense covariances, the maximum against others' and against the exact likelihood,
and the spread of estimates against the Cramer-Rao bound.

Bounds on the spread of estimates leave one chance in a thousand each and were fixed before looking.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
import torch
from numpy.typing import NDArray
from torch import Tensor

from gyrofuse._base.transforms import cosine_ordinates, ramp_ordinates
from gyrofuse.fitting.spectral.bands import BandSpectrum, Bins
from gyrofuse.fitting.spectral.whittle import WhittleFit, refine_whittle
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.model import Model
from gyrofuse.noise.processes import AR1, Drift, QuantizationNoise, RandomWalk, Sinusoid, WhiteNoise
from gyrofuse.noise.state_space import state_space

Array = NDArray[np.float64]

# Voirol et al., Simulation 1
NOISE = WhiteNoise(1.0) + AR1(0.975, 0.03) + RandomWalk(4e-4)
LINEAR, X = [1.0, 0.03, 4e-4], math.atanh(0.975)
AMPLITUDE, BETA = 0.85, 0.35
THREE = ModelStructure((WhiteNoise(), AR1(), RandomWalk()), True)
WITH_TONE = ModelStructure((WhiteNoise(), AR1(), RandomWalk(), Sinusoid()), True)
WITH_WALK = ModelStructure((WhiteNoise(), RandomWalk()), True)


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def rows(values: list[float], n: int) -> Tensor:
    return torch.tensor(values, dtype=torch.float64).expand(n, -1)


def sds(fit: WhittleFit) -> Tensor:
    return fit.covariance.diagonal(dim1=-2, dim2=-1).sqrt()


def assert_rms(ratios: Tensor, most: float = 1.0) -> None:
    """Errors in units of their standard deviation, which may be `most` times what was expected."""
    low, high = scipy.stats.chi2.ppf([5e-4, 1 - 5e-4], len(ratios)) / len(ratios)
    assert low / most**2 < ratios.square().mean() < high * most**2


def dct(n: int) -> Array:
    """Orthonormal DCT-II without the mean, `(ordinate, time)`."""
    k, t = np.arange(1, n)[:, None], np.arange(n)
    return math.sqrt(2 / n) * np.cos(math.pi * k * (t + 0.5) / n)


def dense(process: object, n: int) -> Array:
    """Covariance `(time, time)` of a process of variance one."""
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    if isinstance(process, AR1):
        phi = float(process.phi)
        return phi**lag / (1 - phi**2)
    if isinstance(process, RandomWalk):
        return 1.0 + np.minimum.outer(np.arange(n), np.arange(n))
    if isinstance(process, QuantizationNoise):
        return 2.0 * (lag == 0) - (lag == 1)
    return 1.0 * (lag == 0)


def spectrum(process: object, n: int) -> Array:
    """Variances of all ordinates, term by term."""
    k = np.arange(1, n)
    sine, ends = np.sin(math.pi * k / (2 * n)) ** 2, 4 / n * np.cos(math.pi * k / (2 * n)) ** 2
    if isinstance(process, AR1):
        phi = float(process.phi)
        d = (1 - phi) ** 2 + 4 * phi * sine
        return 1 / d - ends * phi * (1 - phi) * (1 - (-1.0) ** k * phi**n) / (1 + phi) / d**2
    if isinstance(process, RandomWalk):
        return 1 / (4 * sine)
    if isinstance(process, QuantizationNoise):
        return 4 * sine + ends
    return np.ones(n - 1)


SHAPES = [
    WhiteNoise(),
    QuantizationNoise(),
    RandomWalk(),
    *(AR1(phi, 1.0) for phi in (-0.9, -0.3, 0.0, 0.4, 0.9, 0.999, 0.99999)),
]


# Spectra


@pytest.mark.parametrize("n", [32, 33, 50, 101])
def test_ordinates_are_a_cosine_transform(n):
    signal = torch.randn(3, n, generator=seeded(n), dtype=torch.float64) + 5
    found = cosine_ordinates(signal)
    np.testing.assert_allclose(found[:, 1:], signal.numpy() @ dct(n).T, atol=1e-12)
    assert (found[:, 0] == 0).all()


@pytest.mark.parametrize("n", [32, 33, 1000])
def test_ordinates_of_a_ramp(n):
    ramp = torch.arange(n, dtype=torch.float64)
    np.testing.assert_allclose(ramp_ordinates(n), cosine_ordinates(ramp[None])[0], atol=1e-10 * n)


@pytest.mark.parametrize("n", [40, 41])
@pytest.mark.parametrize("process", SHAPES, ids=repr)
def test_variances_of_ordinates_are_exact(process, n):
    transform = dct(n)
    expected = np.diag(transform @ dense(process, n) @ transform.T)
    np.testing.assert_allclose(spectrum(process, n), expected, rtol=1e-9)
    noise = BandSpectrum(ModelStructure((process,), True))
    x = rows([math.atanh(float(process.phi))], 1) if isinstance(process, AR1) else rows([], 1)
    found = noise.variances(Bins(n, torch.device("cpu")), rows([1.0], 1), x)[0]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("n", [1000, 5003])
@pytest.mark.parametrize("process", SHAPES, ids=repr)
def test_bands_are_means_of_ordinates(process, n):
    bins = Bins(n, torch.device("cpu"))
    assert bins.edges[0] == 1
    assert bins.edges[-1] == n
    assert bins.count.sum() == n - 1
    noise = BandSpectrum(ModelStructure((process,), True))
    x = rows([math.atanh(float(process.phi))], 1) if isinstance(process, AR1) else rows([], 1)
    found = noise.variances(bins, rows([1.0], 1), x)[0]
    means = np.add.reduceat(spectrum(process, n), np.array(bins.edges[:-1]) - 1) / bins.count.numpy()
    np.testing.assert_allclose(found, means, rtol=2e-3)


@pytest.mark.parametrize("x", [-1.0, -0.2, 0.0, 0.3, 2.3, 5.0])
def test_slopes_are_those_of_differences(x):
    bins, h = Bins(3000, torch.device("cpu")), 1e-5
    value, slope, bend = AR1.unit_band_variance(bins, torch.tensor([x], dtype=torch.float64))
    (above, slope_above, _), (below, slope_below, _) = (
        AR1.unit_band_variance(bins, torch.tensor([x + d], dtype=torch.float64)) for d in (h, -h)
    )
    torch.testing.assert_close(slope / value, (above - below) / (2 * h) / value, rtol=1e-6, atol=1e-7)
    # The ends of the record are left out of the second one: it steers the search only.
    ends = bins.mean_of(bins.ends / bins.sine_squared)
    inner = ends < 1e-4
    torch.testing.assert_close(
        (bend / value)[:, inner], ((slope_above - slope_below) / (2 * h) / value)[:, inner], rtol=0.02, atol=0.05
    )


def test_energy_is_the_sum_of_squares():
    n = 500
    signal = torch.randn(2, n, generator=seeded(2), dtype=torch.float64).cumsum(-1)
    bins = Bins(n, torch.device("cpu"))
    power = (signal.numpy() @ dct(n).T) ** 2
    expected = np.add.reduceat(power, np.array(bins.edges[:-1]) - 1, axis=-1)
    np.testing.assert_allclose(bins.energy([cosine_ordinates(signal)]), expected, rtol=1e-10)


# The maximum


def test_maximum_is_that_of_a_general_search():
    """All ordinates one by one, by a general minimiser."""
    n = 3000
    linear, x = [1.0, 0.1, 4e-3], math.atanh(0.9)
    model = WhiteNoise(1.0) + AR1(0.9, 0.1) + RandomWalk(4e-3)
    signal = model.simulate(n, batch=(4,), generator=seeded(3))
    fit = refine_whittle(signal, THREE, rows([2.0, 0.03, 1e-2], 4), rows([1.0], 4))
    assert fit.converged.all()
    power = (signal.numpy() @ dct(n).T) ** 2
    for i in range(4):

        def cost(q: Array, power: Array = power[i]) -> float:
            v = np.exp(q[0]) + np.exp(q[1]) * spectrum(AR1(math.tanh(q[3]), 1.0), n)
            v = v + np.exp(q[2]) * spectrum(RandomWalk(), n)
            return float((np.log(2 * math.pi * v) + power / v).sum() / 2)

        start = [math.log(p) for p in linear] + [x]
        best = scipy.optimize.minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9})
        found = np.r_[fit.linear[i].log().numpy(), fit.shape[i].numpy()]
        # Bands see 0.9999 of the information, which moves the top by 0.01 standard deviations.
        assert np.abs((found - best.x) / sds(fit)[i].numpy()).max() < 0.05
        assert fit.log_likelihood[i].item() == pytest.approx(-cost(found), abs=0.5)


@pytest.mark.parametrize("walk", [False, True])
def test_maximum_is_near_that_of_the_exact_likelihood(walk):
    """Of a record over an unknown level: the Kalman filter's likelihood integrated over it."""
    n, n_items = 2000, 3
    values = [1.0, 0.1, 4e-3] if walk else [1.0, 0.3]
    model: Model = WhiteNoise(1.0) + (AR1(0.9, 0.1) + RandomWalk(4e-3) if walk else AR1(0.9, 0.3))
    structure = ModelStructure(tuple(type(p)() for p in model.processes), True)
    signal = model.simulate(n, batch=(n_items,), generator=seeded(21))
    fit = refine_whittle(signal, structure, rows(values, n_items), rows([math.atanh(0.9)], n_items))
    for i in range(n_items):

        def cost(q: Array, record: Tensor = signal[i]) -> tuple[float, Array]:
            at = torch.tensor(q, requires_grad=True)
            own = structure.model(at[:-1].exp(), at[-1:])
            system = state_space(own, 1.0)
            # A parabola in the level
            here, above, below = (system.kalman_log_likelihood(record + d) for d in (0.0, 1.0, -1.0))
            slope, bend = (above - below) / 2, (above + below) / 2 - here
            value = here - slope**2 / (4 * bend) - (-2 * bend).log() / 2
            (-value).backward()
            assert at.grad is not None
            return -value.item(), at.grad.numpy()

        found = np.r_[fit.linear[i].log().numpy(), fit.shape[i].numpy()]
        best = scipy.optimize.minimize(cost, found, jac=True, method="BFGS", options={"gtol": 1e-4})
        assert np.abs((found - best.x) / sds(fit)[i].numpy()).max() < 0.3
        assert cost(found)[0] - best.fun < 0.05


def test_variances_go_to_zero_where_raising_them_does_not_help():
    """White noise: with a random walk of zero the score of its variance decides."""
    n, n_items = 1000, 400
    signal = WhiteNoise(1.0).simulate(n, batch=(n_items,), generator=seeded(5))
    fit = refine_whittle(signal, WITH_WALK, rows([0.5, 1e-3], n_items), rows([], n_items))
    assert fit.converged.all()
    power = (signal.numpy() @ dct(n).T) ** 2
    white = power.mean(-1, keepdims=True)
    score = (spectrum(RandomWalk(), n) * (power / white - 1)).sum(-1)
    zero = (fit.linear[:, 1] == 0).numpy()
    assert 0.2 < zero.mean() < 0.9
    assert (zero != (score < 0)).mean() <= 0.01
    np.testing.assert_allclose(fit.linear[zero, 0], white[zero, 0], rtol=1e-6)
    # Covariance: nothing of what is at zero, and how far it might be beside.
    assert (fit.covariance[zero][:, 1] == 0).all()
    assert sds(fit)[zero, 0].numpy() == pytest.approx(math.sqrt(2 / (n - 1)), rel=1e-9)
    slopes = np.stack([np.ones(n - 1), spectrum(RandomWalk(), n)]) / white[zero][0]
    sd = math.sqrt(np.linalg.inv(slopes @ slopes.T / 2)[1, 1])
    assert fit.edge_sd[zero][0, 1].item() == pytest.approx(sd, rel=1e-3)


def test_variances_leave_zero():
    signal = NOISE.simulate(10_000, batch=(5,), generator=seeded(6))
    expected = refine_whittle(signal, THREE, rows(LINEAR, 5), rows([X], 5))
    for start in ([1.0, 0.03, 0.0], [1.0, 0.0, 4e-4], [0.0, 0.03, 4e-4]):
        fit = refine_whittle(signal, THREE, rows(start, 5), rows([X - 0.5], 5))
        torch.testing.assert_close(fit.linear, expected.linear, rtol=1e-3, atol=0)
        torch.testing.assert_close(fit.log_likelihood, expected.log_likelihood, rtol=0, atol=1e-6)


def test_an_ar1_without_variance_has_any_phi():
    """In over-differenced noise an AR1 of positive phi has no place."""
    signal = (QuantizationNoise(1.0) + WhiteNoise(1.0)).simulate(3000, batch=(40,), generator=seeded(8))
    structure = ModelStructure((QuantizationNoise(), WhiteNoise(), AR1()), True)
    fit = refine_whittle(signal, structure, rows([1.0, 1.0, 0.0], 40), rows([2.0], 40))
    still = fit.linear[:, 2] == 0
    assert 5 < still.sum() < 35
    assert (fit.covariance[still][:, [2, 3]] == 0).all()
    assert (fit.shape[still] == 2.0).all()
    assert fit.converged.all()


# Spread of the estimates


def test_estimates_of_simulation_1_reach_the_cramer_rao_bound():
    n, n_items = 10_000, 300
    generator = seeded(10)
    signal = NOISE.simulate(n, batch=(n_items,), generator=generator)
    signal += Sinusoid(AMPLITUDE, BETA).simulate(n, batch=(n_items,), generator=generator)
    fit = refine_whittle(signal, WITH_TONE, rows([1.2, 0.02, 8e-4, 1.0], n_items), rows([X - 0.2, 0.0], n_items))
    assert fit.converged.all()
    assert fit.tones is not None

    # Bound from the Fisher information of all ordinates
    h, phi = 1e-5, math.tanh
    ar1 = spectrum(AR1(phi(X), 1.0), n)
    bend = (spectrum(AR1(phi(X + h), 1.0), n) - spectrum(AR1(phi(X - h), 1.0), n)) / (2 * h)
    parts = np.stack([np.ones(n - 1), ar1, spectrum(RandomWalk(), n), bend])
    parts = parts * np.array([*LINEAR, LINEAR[1]])[:, None]
    jacobian = parts / parts[:3].sum(0)
    bound = torch.from_numpy(np.sqrt(np.diag(np.linalg.inv(jacobian @ jacobian.T / 2))))
    found = torch.cat([fit.linear[:, :3] / torch.tensor(LINEAR), fit.shape[:, :1] - X + 1], -1) - 1
    for errors in (found / bound).unbind(-1):
        assert_rms(errors, most=1.1)
    s = float(NOISE.spectrum(BETA / (2 * math.pi)))
    assert_rms((fit.tones.beta[:, 0] - BETA) / math.sqrt(24 * s / n**3) * AMPLITUDE, most=1.05)
    assert_rms((fit.tones.amplitude[:, 0] - AMPLITUDE) / math.sqrt(2 * s / n), most=1.05)

    # 95 % intervals of logs of variances and squared amplitudes, of atanh phi and of the frequency
    truth = [math.log(v) for v in (*LINEAR, AMPLITUDE**2)] + [X, math.log(BETA / (math.pi - BETA))]
    error = torch.cat([fit.linear.log(), fit.shape], -1) - rows(truth, n_items)
    inside = error.abs() < 1.96 * sds(fit)
    present = fit.linear[:, 2] > 0
    assert present.double().mean() > 0.95
    low, high = scipy.stats.binom.ppf([5e-4, 1 - 5e-4], int(present.sum()), 0.95)
    for covered in inside[present].sum(0).tolist():
        assert low - 0.01 * n_items <= covered <= high + 0.01 * n_items  # normal theory is that of long records


@pytest.mark.parametrize("tone", [False, True])
def test_a_ramp_is_measured_and_taken_out(tone):
    n, n_items, slope = 3001, 300, -0.01
    generator = seeded(12)
    model: Model = WhiteNoise(1.0) + RandomWalk(1e-3) + Drift(slope)
    signal = model.simulate(n, batch=(n_items,), generator=generator)
    processes, linear, x = [WhiteNoise(), RandomWalk(), Drift()], [1.0, 2e-3, slope**2], []
    if tone:  # of six cycles
        beta = 2 * math.pi * 6.3 / n
        signal += Sinusoid(1.5, beta).simulate(n, batch=(n_items,), generator=generator)
        processes, linear, x = [*processes, Sinusoid()], [*linear, 2.25], [0.0]
    fit = refine_whittle(signal, ModelStructure(tuple(processes), True), rows(linear, n_items), rows(x, n_items))
    assert fit.converged.all()
    assert_rms((fit.slope - slope) / fit.slope_sd, most=1.1)
    torch.testing.assert_close(fit.linear[:, 2], fit.slope**2)
    assert_rms((fit.linear[:, 0] - 1) / sds(fit)[:, 0], most=1.1)
    # The ramp takes most of the ordinate in which the random walk shows most.
    walk = fit.linear[:, 1] / 1e-3
    assert abs(walk.mean().item() - 1) < 4 * walk.std().item() / math.sqrt(n_items)
    if tone:
        assert fit.tones is not None
        assert_rms((fit.tones.beta[:, 0] - beta) / fit.tones.beta_sd[:, 0], most=1.1)


def test_two_ar1s_and_two_tones_come_in_order():
    """Simulation 2 with time compressed a hundredfold."""
    n, n_items = 100_000, 5
    noise = AR1(0.9995, 3e-7) + AR1(0.1107083, 0.0005278666)
    generator = seeded(13)
    signal = noise.simulate(n, batch=(n_items,), generator=generator)
    for amplitude, beta in ((0.015, 8e-3), (0.25, 0.056)):
        signal += Sinusoid(amplitude, beta).simulate(n, batch=(n_items,), generator=generator)
    structure = ModelStructure((AR1(), AR1(), Sinusoid(), Sinusoid()), True)
    x = [math.atanh(0.2), math.atanh(0.999), 0.0, 0.0]
    fit = refine_whittle(signal, structure, rows([5e-4, 3e-7, 1.0, 1.0], n_items), rows(x, n_items))
    assert fit.converged.all()
    assert fit.tones is not None
    torch.testing.assert_close(fit.tones.beta, torch.pi * fit.shape[:, 2:].sigmoid())
    torch.testing.assert_close(fit.tones.amplitude.square(), fit.linear[:, 2:])
    truth = [math.log(v) for v in (3e-7, 0.0005278666, 0.25**2, 0.015**2)]
    truth += [math.atanh(0.9995), math.atanh(0.1107083)] + [math.log(b / (math.pi - b)) for b in (0.056, 8e-3)]
    error = torch.cat([fit.linear.log(), fit.shape], -1) - rows(truth, n_items)
    assert (error.abs() < 5 * sds(fit)).all()


# Contracts


def example() -> Tensor:
    generator = seeded(14)
    signal = NOISE.simulate(2000, batch=(4,), generator=generator)
    return signal + Sinusoid(AMPLITUDE, BETA).simulate(2000, batch=(4,), generator=generator)


def start(n_items: int) -> tuple[Tensor, Tensor]:
    return rows([*LINEAR, 1.0], n_items), rows([X, 0.0], n_items)


def assert_same(found: WhittleFit, expected: WhittleFit, which: slice | list[int], rtol: float = 1e-9) -> None:
    for name in ("linear", "shape", "covariance", "edge_sd", "slope", "log_likelihood", "converged"):
        got, wanted = getattr(found, name), getattr(expected, name)[which]
        torch.testing.assert_close(got, wanted, rtol=rtol, atol=0, equal_nan=True)


def test_batch_is_stacked_items():
    whole = refine_whittle(example(), WITH_TONE, *start(4))
    for i in range(4):
        one = refine_whittle(example()[i : i + 1], WITH_TONE, *start(1))
        assert_same(one, whole, [i], rtol=1e-6)


def test_layout_and_inputs_are_left_alone():
    signal, (linear, x) = example(), start(4)
    copies = signal.clone(), linear.clone(), x.clone()
    whole = refine_whittle(signal, WITH_TONE, linear, x)
    for given, copy in zip((signal, linear, x), copies, strict=True):
        assert torch.equal(given, copy)
    assert_same(refine_whittle(signal.mT.contiguous().mT, WITH_TONE, linear, x), whole, slice(None), rtol=1e-6)
    single = refine_whittle(signal.float(), WITH_TONE, linear, x)
    assert single.linear.dtype == torch.float64
    torch.testing.assert_close(single.linear, whole.linear, rtol=1e-3, atol=0)


@pytest.mark.parametrize("unit", [1e-8, 1e8])
def test_units_do_not_matter(unit):
    linear, x = start(4)
    whole = refine_whittle(example(), WITH_TONE, linear, x)
    scaled = refine_whittle(example() * unit, WITH_TONE, linear * unit**2, x)
    torch.testing.assert_close(scaled.linear, whole.linear * unit**2, rtol=1e-6, atol=0)
    torch.testing.assert_close(scaled.covariance, whole.covariance, rtol=1e-6, atol=1e-12)


def test_items_that_cannot_be_fitted_are_marked():
    signal, (linear, x) = torch.cat([example(), example()[:2]]), start(6)
    linear = linear.clone()
    signal[1, 7] = torch.nan
    signal[3] = 4.0
    linear[4, 1] = torch.nan
    linear[5, :3] = 0.0
    fit = refine_whittle(signal, WITH_TONE, linear, x)
    assert fit.converged.tolist() == [True, False, True, False, False, False]
    assert fit.linear[[1, 3, 4, 5]].isnan().all()
    assert fit.tones is not None
    assert fit.tones.beta[[1, 3, 4, 5]].isnan().all()
    kept = [0, 2]
    expected = refine_whittle(signal[kept], WITH_TONE, linear[kept], x[kept])
    torch.testing.assert_close(fit.linear[kept], expected.linear, rtol=1e-6, atol=0)
    torch.testing.assert_close(fit.covariance[kept], expected.covariance, rtol=1e-6, atol=0)
    nothing = refine_whittle(torch.full((2, 100), torch.nan), WITH_TONE, *start(2))
    assert nothing.linear.shape == (2, 4)
    assert not nothing.converged.any()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_device_is_kept():
    linear, x = start(4)
    fit = refine_whittle(example().cuda(), WITH_TONE, linear.cuda(), x.cuda())
    assert fit.linear.is_cuda
    expected = refine_whittle(example(), WITH_TONE, linear, x)
    torch.testing.assert_close(fit.linear.cpu(), expected.linear, rtol=1e-6, atol=0)


def test_arguments_that_cannot_be_used():
    signal, (linear, x) = example(), start(4)
    with pytest.raises(TypeError, match="`signal`: expected a torch tensor"):
        refine_whittle([1.0], WITH_TONE, linear, x)
    with pytest.raises(ValueError, match=r"`signal`: expected \(item, time\) .*got shape \(2000,\); flatten"):
        refine_whittle(signal[0], WITH_TONE, linear, x)
    with pytest.raises(ValueError, match=r"`signal`: expected .*at least 32 samples, got shape \(4, 31\)"):
        refine_whittle(signal[:, :31], WITH_TONE, linear, x)
    with pytest.raises(ValueError, match=r"`linear`: expected \(4, 4\) for WN \+ AR1 \+ RW \+ SIN .*got \(4, 3\)"):
        refine_whittle(signal, WITH_TONE, linear[:, :3], x)
    with pytest.raises(ValueError, match=r"`shape`: expected \(4, 2\) .*got \(3, 2\); give what"):
        refine_whittle(signal, WITH_TONE, linear, x[:3])
    with pytest.raises(ValueError, match="`structure`: expected a noise such as WN, got SIN; add WhiteNoise"):
        refine_whittle(signal, ModelStructure((Sinusoid(),), True), linear[:, :1], x[:, :1])
    with pytest.raises(ValueError, match="`n_rounds`: expected a whole number >= 1, got 0"):
        refine_whittle(signal, WITH_TONE, linear, x, n_rounds=0)
