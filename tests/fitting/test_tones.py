"""Spectral lines: the transforms against plain sums, estimates against the Cramer-Rao bound, the test against its size.

Statistical bounds leave one chance in a thousand each and were fixed before looking.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse._base import transforms as _transforms
from gyrofuse.fitting.spectral import tones
from gyrofuse.fitting.spectral.tones import find_tones, line_p_value

# Voirol et al., Simulation 1
NOISE = gf.WhiteNoise(1.0) + gf.AR1(0.975, 0.03) + gf.RandomWalk(4e-4)
AMPLITUDE, BETA = 0.85, 0.35
N_RUNS = 300


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def bounds(noise: gf.Model, amplitude: float, beta: float, n: int) -> tuple[float, float]:
    """Cramer-Rao bounds of `beta` and the amplitude."""
    s = float(noise.spectrum(beta / (2 * math.pi)))
    return math.sqrt(24 * s / n**3) / amplitude, math.sqrt(2 * s / n)


def assert_rms(ratios: Tensor, most: float = 1.0) -> None:
    """Errors in units of their standard deviation, which may be `most` times what was expected."""
    low, high = scipy.stats.chi2.ppf([5e-4, 1 - 5e-4], len(ratios)) / len(ratios)
    assert low < ratios.square().mean() < high * most**2


def assert_size(p_values: Tensor, at_least: bool = True) -> None:
    for level in (0.01, 0.05, 0.1):
        low, high = scipy.stats.binom.ppf([5e-4, 1 - 5e-4], p_values.numel(), level)
        false = int((p_values < level).sum())
        assert false <= high, (level, false, high)
        assert not at_least or false >= low, (level, false, low)


def dct(signal: np.ndarray) -> np.ndarray:
    """Orthonormal DCT-II, term by term."""
    n = len(signal)
    k, t = np.arange(n)[:, None], np.arange(n)
    return math.sqrt(2 / n) * np.cos(math.pi * k * (t + 0.5) / n) @ signal


# The transforms


@pytest.mark.parametrize("n", [32, 257, 1000, 2003])
def test_coefficients_are_those_of_the_whole_transform(n):
    record = next(tones._records(torch.randn(3, n, generator=seeded(n), dtype=torch.float64).cumsum(-1), None))
    line = record._coefficients(torch.tensor([0.01, 1.3, 3.1], dtype=torch.float64))
    for signal, k, values, inside in zip(record._signal, line.k, line.values, line.inside, strict=True):
        whole = dct(signal.numpy())
        expected = whole[k[inside].long().numpy()]
        np.testing.assert_allclose(values[inside], expected, rtol=0, atol=1e-9 * np.abs(whole).max())
        assert inside.sum() == len([i for i in k.tolist() if 1 <= i < n])


@pytest.mark.parametrize("n", [64, 65])
@pytest.mark.parametrize("beta", [0.02, 0.7, 2.0, 3.1])
def test_templates_are_transforms_of_a_tone(n, beta):
    u = np.arange(n) - (n - 1) / 2
    k = torch.arange(1, n, dtype=torch.float64)[None]
    even, odd, slopes = _transforms.tone_in_cosines(torch.tensor([[beta]], dtype=torch.float64), k, n)
    np.testing.assert_allclose(even[0], dct(np.cos(beta * u))[1:], atol=1e-12)
    np.testing.assert_allclose(odd[0], dct(np.sin(beta * u))[1:], atol=1e-12)
    np.testing.assert_allclose(slopes[0][0], dct(-u * np.sin(beta * u))[1:], atol=1e-9)
    np.testing.assert_allclose(slopes[1][0], dct(u * np.cos(beta * u))[1:], atol=1e-9)


def test_dirichlet_kernel_is_smooth_where_its_series_takes_over():
    n = 1000
    x = torch.tensor([1.999e-5, 2.001e-5], dtype=torch.float64)  # n x / 2 = 0.01
    u = torch.arange(n, dtype=torch.float64) - (n - 1) / 2
    value, slope = _transforms.dirichlet(x, n)
    torch.testing.assert_close(value, torch.cos(x[:, None] * u).sum(-1), rtol=1e-9, atol=0)
    torch.testing.assert_close(slope, (-u * torch.sin(x[:, None] * u)).sum(-1), rtol=1e-5, atol=0)


@pytest.mark.parametrize("n", [64, 65])
def test_hann_kernel_is_the_transform_of_the_taper(n):
    u = torch.arange(n, dtype=torch.float64) - (n - 1) / 2
    taper = torch.sin(math.pi / n * (torch.arange(n, dtype=torch.float64) + 0.5)) ** 2
    x = torch.linspace(-6.2, 6.2, 41, dtype=torch.float64)
    expected = (taper * torch.cos(x[:, None] * u)).sum(-1)
    torch.testing.assert_close(_transforms.tone_in_hann(x, n), expected, rtol=0, atol=1e-11)


def test_fast_lengths_have_small_factors_and_no_smaller_one_would_do():
    def smooth(n: int) -> bool:
        for factor in (2, 3, 5):
            while n % factor == 0:
                n //= factor
        return n == 1

    for n in [*range(32, 600), 10_007, 99_991]:
        expected = next(m for m in range(n, 2 * n) if m % 2 == 0 and smooth(m))
        assert _transforms.fast_length(n) == expected


def test_what_the_taper_sees_of_a_steep_spectrum():
    """Mean Hann periodogram of 4000 random walks at the lowest bins, within four standard errors."""
    n, walk = 250, gf.RandomWalk(1.0)
    g, kernel = _transforms.taper_kernel(n, 270)
    t = torch.arange(n, dtype=torch.float64)
    taper = torch.sin(math.pi / n * (t + 0.5)) ** 2
    x = walk.simulate(n, batch=(4000,), generator=seeded(1))
    x = x - ((x @ taper) / taper.sum())[:, None]
    found = (torch.fft.rfft(x * taper, n=270).abs().square() / taper.square().sum()).mean(0)[3:13]
    expected = torch.from_numpy(kernel) @ walk.spectrum(torch.from_numpy(g))
    assert ((found / expected[2:12] - 1).abs() < 4 / math.sqrt(4000)).all()


# Estimates


@pytest.mark.statistical
@pytest.mark.parametrize("n", [10_000, 40_000])
def test_estimates_reach_the_cramer_rao_bound(n):
    generator = seeded(n)
    signal = NOISE.simulate(n, batch=(N_RUNS,), generator=generator)
    signal += gf.Sinusoid(AMPLITUDE, BETA).simulate(n, batch=(N_RUNS,), generator=generator)
    bound = bounds(NOISE, AMPLITUDE, BETA, n)
    for spectrum in (None, NOISE.spectrum):
        found = find_tones(signal, 1, spectrum)
        assert (found.p_value < 1e-12).all()
        errors = found.beta[:, 0] - BETA, found.amplitude[:, 0] - AMPLITUDE
        for error, sd, least in zip(errors, (found.beta_sd, found.amplitude_sd), bound, strict=True):
            assert_rms(error / least, most=1.03)
            assert_rms(error / sd[:, 0], most=1.03)
            # no bias
            assert abs(error.mean() / error.std()) * math.sqrt(N_RUNS) < scipy.stats.norm.ppf(1 - 5e-4)
            torch.testing.assert_close(sd.mean().item(), least, rtol=0.03, atol=0)


def test_fit_is_that_of_a_naive_search():
    """Weighted least squares on the 65 coefficients around the tone, by a general minimiser."""
    n = 500
    generator = seeded(3)
    noise = gf.WhiteNoise(1.0) + gf.AR1(0.9, 0.3)
    signal = noise.simulate(n, generator=generator) + gf.Sinusoid(1.0, 0.3).simulate(n, generator=generator)
    found = find_tones(signal, 1, noise.spectrum)
    values = dct(signal.numpy())
    k = np.arange(-32, 33) + round(found.beta.item() * n / math.pi)
    weight = noise.spectrum(torch.from_numpy(k / (2 * n))).numpy() ** -0.5
    t = np.arange(1, n + 1)

    def residual(p: np.ndarray) -> np.ndarray:
        return weight * (values - dct(p[0] * np.cos(p[2] * t) + p[1] * np.sin(p[2] * t)))[k]

    start = [np.mean(2 * signal.numpy() * np.cos(0.3 * t)), np.mean(2 * signal.numpy() * np.sin(0.3 * t)), 0.3]
    best = scipy.optimize.least_squares(residual, start, x_scale=[1, 1, 1 / n], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    # The bins around the first guess may be one further: hence not to rounding.
    assert abs(found.beta.item() - best.x[2]) < 0.02 * found.beta_sd.item()
    assert abs(found.amplitude.item() - math.hypot(*best.x[:2])) < 0.02 * found.amplitude_sd.item()
    expected = best.x[0] * np.cos(best.x[2] * t) + best.x[1] * np.sin(best.x[2] * t)
    np.testing.assert_allclose(found.waveform(n), expected, atol=0.02 * found.amplitude_sd.item())
    covariance = np.linalg.inv(best.jac.T @ best.jac)
    assert found.beta_sd.item() == pytest.approx(math.sqrt(covariance[2, 2]), rel=0.01)


@pytest.mark.parametrize("given", [False, True])
def test_two_tones_over_steep_noise(given):
    """Simulation 2 with time compressed a hundredfold: the slow tone makes the same 127 cycles."""
    n, n_runs = 100_000, 30
    noise = gf.AR1(0.9995, 3e-7) + gf.AR1(0.1107083, 0.0005278666)
    parts = (0.25, 0.056), (0.015, 8e-3)
    generator = seeded(5)
    signal = noise.simulate(n, batch=(n_runs,), generator=generator)
    for amplitude, beta in parts:
        signal += gf.Sinusoid(amplitude, beta).simulate(n, batch=(n_runs,), generator=generator)
    found = find_tones(signal, 3, noise.spectrum if given else None)
    assert (found.p_value[:, :2] < 1e-6).all()
    assert_size(found.p_value[:, 2], at_least=False)  # nothing is left of the two
    for i, (amplitude, beta) in enumerate(parts):
        for value, truth, sd, bound in zip(
            (found.beta, found.amplitude),
            (beta, amplitude),
            (found.beta_sd, found.amplitude_sd),
            bounds(noise, amplitude, beta, n),
            strict=True,
        ):
            assert_rms((value[:, i] - truth) / bound, most=1.06)
            torch.testing.assert_close(sd[:, i].mean().item(), bound, rtol=0.06, atol=0)


def test_neighbouring_tones_do_not_bias_each_other():
    """Six cycles apart, one ten times the other: `beta` within five standard deviations, in every one of 20 runs."""
    n = 6000
    generator = seeded(6)
    betas = torch.tensor([1.0, 1.0 + 6 * 2 * math.pi / n], dtype=torch.float64)
    signal = torch.randn(20, n, generator=generator, dtype=torch.float64)
    for amplitude, beta in zip((10.0, 1.0), betas.tolist(), strict=True):
        signal += gf.Sinusoid(amplitude, beta).simulate(n, batch=(20,), generator=generator)
    found = find_tones(signal, 2)
    assert ((found.beta - betas).abs() < 5 * found.beta_sd).all()
    assert ((found.amplitude - torch.tensor([10.0, 1.0])).abs() < 5 * found.amplitude_sd).all()


@pytest.mark.parametrize("cycles", [3.7, 8.2])
@pytest.mark.parametrize("from_top", [False, True])
def test_tones_near_the_ends_of_the_spectrum(cycles, from_top):
    n, n_runs = 3000, 200
    beta = 2 * math.pi * cycles / n
    beta = math.pi - beta if from_top else beta
    generator = seeded(7)
    noise = gf.WhiteNoise(1.0)
    signal = noise.simulate(n, batch=(n_runs,), generator=generator)
    signal += gf.Sinusoid(0.7, beta).simulate(n, batch=(n_runs,), generator=generator)
    found = find_tones(signal, 1, noise.spectrum)
    assert (found.p_value < 1e-3).all()
    assert_rms((found.beta[:, 0] - beta) / found.beta_sd[:, 0], most=1.05)
    assert_rms((found.amplitude[:, 0] - 0.7) / found.amplitude_sd[:, 0], most=1.05)


def test_standard_deviations_over_a_background_of_one_s_own():
    """Low in the spectrum the background is known to a few looks, and a line must not take noise with it."""
    n, n_runs, beta = 3000, 200, 2 * math.pi * 25.3 / 3000
    for noise in (gf.WhiteNoise(1.0), gf.WhiteNoise(1.0) + gf.RandomWalk(1e-3)):
        generator = seeded(15)
        signal = noise.simulate(n, batch=(n_runs,), generator=generator)
        signal += gf.Sinusoid(1.5, beta).simulate(n, batch=(n_runs,), generator=generator)
        found = find_tones(signal, 1)
        for sd, bound in zip((found.beta_sd, found.amplitude_sd), bounds(noise, 1.5, beta, n), strict=True):
            torch.testing.assert_close(sd.mean().item(), bound, rtol=0.1, atol=0)


@pytest.mark.parametrize("from_top", [False, True])
def test_below_three_cycles_nothing_is_claimed(from_top):
    n = 3000
    beta = 2 * math.pi * 2.4 / n
    beta = math.pi - beta if from_top else beta
    noise = gf.WhiteNoise(0.01)
    signal = noise.simulate(n, generator=seeded(8)) + gf.Sinusoid(1.0, beta).simulate(n, generator=seeded(9))
    found = find_tones(signal, 1, noise.spectrum)
    assert found.beta_sd.isnan().all()
    assert found.amplitude_sd.isnan().all()
    assert abs(found.beta.item() - beta) < 0.1 * 2 * math.pi / n


def test_waveform_is_the_tone():
    n = 2000
    tone = gf.Sinusoid(2.0, 0.9).simulate(n, batch=(3,), generator=seeded(2))
    found = find_tones(tone + 0.01 * torch.randn(3, n, generator=seeded(3), dtype=torch.float64), 1)
    torch.testing.assert_close(found.waveform(n), tone, rtol=0, atol=4e-3)


def test_tones_come_by_decreasing_power():
    generator = seeded(10)
    signal = NOISE.simulate(5000, batch=(4,), generator=generator)
    # A weak tone where the noise is low stands out more than a strong one where it is high.
    signal += gf.Sinusoid(1.5, 0.02).simulate(5000, batch=(4,), generator=generator)
    signal += gf.Sinusoid(1.0, 2.0).simulate(5000, batch=(4,), generator=generator)
    found = find_tones(signal, 2)
    assert (found.amplitude.diff(dim=-1) <= 0).all()
    torch.testing.assert_close(found.beta, torch.tensor([0.02, 2.0]).double().expand(4, 2), rtol=0, atol=1e-3)


# The test


MODELS = {
    "simulation 1": NOISE,
    "steep": gf.RandomWalk(1.0) + gf.WhiteNoise(1e-3),
    "rising": gf.QuantizationNoise(1.0) + gf.WhiteNoise(0.01),
    "high": gf.AR1(-0.8, 1.0),
}


@pytest.mark.parametrize("name", MODELS)
def test_size_of_the_line_test(name):
    """1000 records of noise alone: with the true spectrum as stated, with one's own background at most so."""
    signal = MODELS[name].simulate(2003, batch=(1000,), generator=seeded(11))
    assert_size(line_p_value(signal, MODELS[name].spectrum))
    assert_size(line_p_value(signal), at_least=False)


def test_power_of_the_line_test():
    """A tone of 0.05 sd in 2^16 samples, which the wavelet variance hardly shows."""
    n = 2**16
    generator = seeded(12)
    signal = torch.randn(40, n, generator=generator, dtype=torch.float64)
    signal += gf.Sinusoid(0.05, 0.8).simulate(n, batch=(40,), generator=generator)
    assert (line_p_value(signal) < 0.01).sum() >= 34


def test_p_value_of_the_first_tone_is_that_of_the_test():
    signal = NOISE.simulate(1000, batch=(5,), generator=seeded(13))
    torch.testing.assert_close(find_tones(signal, 1).p_value[:, 0], line_p_value(signal))
    given = find_tones(signal, 1, NOISE.spectrum).p_value[:, 0]
    torch.testing.assert_close(given, line_p_value(signal, NOISE.spectrum))


# Contracts


def assert_same(found: tones.Tones, expected: tones.Tones, **tolerance: float) -> None:
    for name in ("beta", "amplitude", "beta_sd", "amplitude_sd", "p_value"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), **tolerance, equal_nan=True)


def example(n: int = 1500) -> Tensor:
    generator = seeded(14)
    signal = NOISE.simulate(n, batch=(2, 3), generator=generator)
    return signal + gf.Sinusoid(AMPLITUDE, BETA).simulate(n, batch=(2, 3), generator=generator)


def test_a_batch_is_its_items(monkeypatch):
    signal = example()
    models = gf.WhiteNoise(torch.linspace(1, 2, 6).reshape(2, 3).double()) + gf.RandomWalk(4e-4)
    for spectrum in (None, models.spectrum):
        together = find_tones(signal, 2, spectrum)
        assert together.beta.shape == (2, 3, 2)
        with monkeypatch.context() as patch:
            patch.setattr(tones, "CACHE", 4 * signal.shape[-1])  # in two parts
            assert_same(find_tones(signal, 2, spectrum), together, rtol=1e-8, atol=1e-300)
        own = None if spectrum is None else (lambda f: models.spectrum(f)[1, 2])
        alone = find_tones(signal[1, 2], 2, own)
        for name in ("beta", "amplitude", "beta_sd", "amplitude_sd", "p_value"):
            torch.testing.assert_close(getattr(together, name)[1, 2], getattr(alone, name), rtol=1e-8, atol=1e-300)


@pytest.mark.parametrize("scale", [2.0**-30, 1e-150, 1e150, -3.0])
def test_units_do_not_matter(scale):
    signal = example()
    for given in (False, True):
        found = find_tones(scale * signal, 1, (lambda f: scale**2 * NOISE.spectrum(f)) if given else None)
        expected = find_tones(signal, 1, NOISE.spectrum if given else None)
        for name in ("amplitude", "amplitude_sd"):
            torch.testing.assert_close(getattr(found, name) / abs(scale), getattr(expected, name), rtol=1e-9, atol=0)
        for name in ("beta", "beta_sd", "p_value"):
            torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-8, atol=1e-300)


def test_a_constant_does_not_matter():
    assert_same(find_tones(example() + 100, 1), find_tones(example(), 1), rtol=1e-7, atol=1e-300)


def test_float32_is_computed_in_float64():
    signal = example().float()
    assert_same(find_tones(signal, 1), find_tones(signal.double(), 1), rtol=0, atol=0)
    assert find_tones(signal, 1).beta.dtype == torch.float64


def test_layout_and_gradients_do_not_matter():
    signal = example()
    strided = signal.mT.contiguous().mT.requires_grad_()
    found = find_tones(strided, 1)
    assert not found.beta.requires_grad
    assert_same(found, find_tones(signal, 1), rtol=0, atol=0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_device_is_kept():
    for spectrum in (None, NOISE.spectrum):
        found = find_tones(example().cuda(), 2, spectrum)
        assert found.beta.is_cuda
        expected = find_tones(example(), 2, spectrum)
        torch.testing.assert_close(found.beta.cpu(), expected.beta, rtol=1e-8, atol=0)
        torch.testing.assert_close(found.amplitude_sd.cpu(), expected.amplitude_sd, rtol=1e-6, atol=0)


@pytest.mark.parametrize("n", [32, 33, 47, 100])
def test_short_signals(n):
    generator = seeded(n)
    signal = torch.randn(50, n, generator=generator, dtype=torch.float64)
    signal += gf.Sinusoid(4.0, 1.1).simulate(n, batch=(50,), generator=generator)
    found = find_tones(signal, 1, gf.WhiteNoise(1.0).spectrum)
    assert ((found.beta - 1.1).abs() < 5 * found.beta_sd).all()
    assert ((found.amplitude - 4).abs() < 5 * found.amplitude_sd).all()
    assert find_tones(signal, 2).amplitude.isfinite().all()


def test_a_tone_without_noise():
    n = 4096
    found = find_tones(torch.sin(0.123 * torch.arange(1, n + 1).double()), 1)
    assert found.beta.item() == pytest.approx(0.123, rel=1e-9)
    assert found.amplitude.item() == pytest.approx(1.0, rel=1e-6)
    assert found.p_value.item() < 1e-12


@pytest.mark.parametrize(
    ("signal", "message"),
    [
        (torch.zeros(31), r"`signal`: expected .* at least 32 samples, got shape \(31,\)"),
        (torch.tensor(1.0), r"`signal`: expected .*got shape \(\)"),
        (torch.zeros(0, 100), r"`signal`: expected .* at least one record .*got shape \(0, 100\)"),
        (torch.full((100,), torch.nan), "`signal`: expected finite samples, got NaN or infinity; cut"),
        (torch.tensor([1.0, torch.inf] * 50), "`signal`: expected finite samples"),
        (torch.ones(2, 100), "`signal`: expected records that vary, got 2 constant; leave out"),
    ],
)
def test_signals_that_cannot_be_used(signal, message):
    with pytest.raises(ValueError, match=message):
        find_tones(signal, 1)
    with pytest.raises(ValueError, match=message):
        line_p_value(signal)


def test_arguments_that_cannot_be_used():
    signal = example(200)
    with pytest.raises(TypeError, match="`signal`: expected a torch tensor"):
        find_tones([1.0, 2.0], 1)
    with pytest.raises(ValueError, match="`n_tones`: expected a whole number >= 1, got 0"):
        find_tones(signal, 0)
    with pytest.raises(ValueError, match=r"`n_tones`: expected at most 12 for 200 samples .*got 13; ask for fewer"):
        find_tones(signal, 13)
    with pytest.raises(ValueError, match="`noise_spectrum`: expected a finite density > 0"):
        find_tones(signal, 1, gf.WhiteNoise(0.0).spectrum)
    with pytest.raises(ValueError, match=r"`noise_spectrum`: expected a density \(2, 3, 100\) .*got shape \(5, 100\)"):
        find_tones(signal, 1, gf.WhiteNoise(torch.ones(5)).spectrum)
