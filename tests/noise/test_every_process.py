"""What every process in the registry does by itself: a new one is tested by its line there."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.fft
import scipy.integrate
import scipy.stats
import torch
from reference import processes as naive

import gyrofuse as gf
from gyrofuse.noise.dct_bands import DCTBands
from gyrofuse.noise.processes import PROCESSES, FlickerNoise, Matern32, Process

TAU = 2.0 ** torch.arange(1, 13, dtype=torch.float64)


def unit(kind: type[Process], x: float = 0.8, p: float = 1.0) -> Process:
    """A process with this scale parameter and, where it has one, this unconstrained nonlinear one."""
    p_and_x = (torch.tensor(value, dtype=torch.float64) for value in (p, x))
    return kind(**{name: value.item() for name, value in kind.from_scale_and_shape(*p_and_x).items()})


every = pytest.mark.parametrize("kind", PROCESSES, ids=lambda kind: kind.key)
noises = pytest.mark.parametrize("kind", [k for k in PROCESSES if k.gaussian], ids=lambda kind: kind.key)
shaped = pytest.mark.parametrize("kind", [k for k in PROCESSES if k.shape_name], ids=lambda kind: kind.key)


@every
def test_text_and_dictionaries_know_it(kind):
    process = unit(kind)
    for name in (kind.symbol, kind.__name__, kind.key, *kind.spellings):
        assert type(gf.parse_model(name)) is kind
    assert str(gf.parse_model(str(process))) == str(process) == str(gf.model_from_dict(process.to_dict()))
    assert getattr(gf, kind.__name__) is kind


@every
def test_a_larger_unit_scales_its_wavelet_variance(kind):
    process = unit(kind)
    expected = 9 * process.wavelet_variance(6)
    torch.testing.assert_close(process.scaled(3.0).wavelet_variance(6), expected, rtol=1e-12, atol=0)


@shaped
@pytest.mark.parametrize("x", [-2.0, -0.3, 0.4, 3.0])
def test_constraints_are_inverse_and_have_their_slopes(kind, x):
    at, h = torch.tensor([x], dtype=torch.float64), 1e-6
    torch.testing.assert_close(kind.to_unconstrained(kind.from_unconstrained(at)), at, rtol=1e-10, atol=1e-10)
    numeric = (kind.from_unconstrained(at + h) - kind.from_unconstrained(at - h)) / (2 * h)
    torch.testing.assert_close(kind.unconstrained_slope(at), numeric, rtol=1e-7, atol=1e-9)
    above, below = (kind.unit_wavelet_variance(TAU, at + sign * h) for sign in (1, -1))
    numeric = (above - below) / (2 * h)
    slope = kind.unit_wavelet_variance_slope(TAU, at)
    torch.testing.assert_close(slope, numeric, rtol=1e-5, atol=1e-7 * numeric.abs().max().item())


@shaped
def test_searches_start_within_their_limits(kind):
    longest, shortest = kind.time_scales(4096.0)
    low, high = kind.unconstrained_limits(4096.0)
    ends = kind.from_time_scale(torch.tensor([longest, shortest], dtype=torch.float64)).sort().values
    assert low <= ends[0] < ends[1] <= high


@noises
@pytest.mark.parametrize("n_samples", [32, 49])
@pytest.mark.parametrize("x", [-1.5, 0.8, 3.5])
def test_cosine_ordinates_have_its_band_variances(kind, n_samples, x):
    # The ordinates' own variances from second differences of the spectrum's moments, by adaptive quadrature.
    process = unit(kind, x)
    bands = DCTBands(n_samples, torch.device("cpu"))
    found = kind.unit_band_variance(bands, torch.tensor([x], dtype=torch.float64))
    filters = scipy.fft.dct(np.eye(n_samples), axis=0, norm="ortho")
    for at in (0, 1, 2, n_samples // 2):

        def through(f: float, row=filters[bands.edges[at]]) -> float:
            gain = abs(np.exp(-2j * np.pi * f * np.arange(n_samples)) @ row) ** 2
            return 2 * gain * process.spectrum(f).item()

        edges = [1e-9, *np.logspace(-5, math.log10(0.5), 12)]
        expected = sum(scipy.integrate.quad(through, *ends, epsrel=1e-9)[0] for ends in itertools.pairwise(edges))
        value = found.value.reshape(-1, len(bands.count))[0, at].item()
        assert value == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("x", [-1.0, 0.5, 2.5, 6.0])
@pytest.mark.parametrize("kind", [k for k in PROCESSES if k.has_memory()], ids=lambda kind: kind.key)
def test_band_variances_have_their_slopes(kind, x):
    bands, h = DCTBands(3000, torch.device("cpu")), 1e-5
    own, above, below = (
        kind.unit_band_variance(bands, torch.tensor([x + d], dtype=torch.float64)) for d in (0.0, h, -h)
    )
    numeric = (above.value - below.value) / (2 * h) / own.value
    torch.testing.assert_close(own.slope / own.value, numeric, rtol=1e-5, atol=1e-6)
    if x > 3:
        return  # a memory longer than the record is all ends, which are left out of the curvature
    inner = bands.mean_of(bands.ends / bands.sine_squared) < 1e-4
    numeric = (above.slope - below.slope) / (2 * h) / own.value
    torch.testing.assert_close((own.curvature / own.value)[:, inner], numeric[:, inner], rtol=0.03, atol=0.05)


@noises
def test_its_state_space_has_its_spectrum(kind):
    process = unit(kind, 2.0)
    system = gf.state_space(process, 1.0)
    f = torch.logspace(math.log10(2e-7), math.log10(0.5), 300, dtype=torch.float64)
    density = system.R[0, 0].expand_as(f)
    if system.states:
        z = torch.exp(2j * math.pi * f)[:, None, None]
        response = system.H.to(z) @ torch.linalg.inv(z * torch.eye(len(system.states)).to(z) - system.F.to(z))
        density = density + (response @ system.Q.to(z) @ response.mH).real[:, 0, 0]
    tolerance = 0.02 if kind is FlickerNoise else 1e-6
    torch.testing.assert_close(density, process.spectrum(f), rtol=tolerance, atol=0)
    above = f > 2e-6
    torch.testing.assert_close(density[above], process.spectrum(f)[above], rtol=min(tolerance, 4e-3), atol=0)


@every
def test_paths_have_its_wavelet_variance(kind):
    process = unit(kind, 1.5)
    generator = torch.Generator().manual_seed(1)
    paths = process.simulate(128, batch=(4000,), generator=generator)
    assert torch.equal(paths, process.simulate(128, batch=(4000,), generator=torch.Generator().manual_seed(1)))
    squares = torch.from_numpy(naive.wavelet_variance(paths.numpy(), 6))
    error = squares.std(0) / 4000**0.5
    assert ((squares.mean(0) - process.wavelet_variance(6)).abs() <= 4.5 * error + 1e-12).all()


@every
def test_other_software_gets_it(kind):
    process = unit(kind)
    model = gf.WhiteNoise(0.5) + process if kind is not gf.WhiteNoise else process
    assert gf.datasheet(model, 100.0, "deg/s").entries
    kalibr = gf.to_kalibr(model, 100.0, "rad/s")
    assert f"#   {process!r}: " in kalibr
    assert f"{kind.key}" in gf.to_c_header(model, 100.0, "rad/s") or kind.white


@noises
def test_fits_and_ranking_find_it(kind):
    truth = unit(kind, 2.5) + (gf.WhiteNoise(0.01) if not kind.white else gf.RandomWalk(1e-4))
    signal = truth.simulate(6000, batch=(3,), generator=torch.Generator().manual_seed(2))
    structure = " + ".join(process.symbol for process in truth.processes)
    for fit in (gf.fit_gmwm(signal, structure), gf.fit_gmwm(signal, structure, refine=True)):
        assert fit.converged.all()
        assert str(fit.summary())
        own = truth.processes[0].wavelet_variance(5)
        found = type(truth.processes[0])(*fit.params[..., : len(truth.processes[0].parameters)].unbind(-1))
        assert (found.wavelet_variance(5) / own - 1).abs().max() < 0.6
    array = gf.fit_array_gmwm(signal, structure)
    assert array.converged
    assert array.model.to_dict()
    ranked = gf.rank_models(signal[:1], [structure, structure.split(" + ")[1]])
    assert all(set(name.split(" + ")) == set(structure.split(" + ")) for name in ranked.names)


# --- what flicker noise and the second-order process are ---------------------------------------------------


def test_flicker_noise_through_the_gain_gives_its_wavelet_variance():
    process = FlickerNoise(0.7)
    for level, nu in enumerate(process.wavelet_variance(8).tolist(), start=1):
        zeros = np.linspace(0, 0.5, 2**level // 2 + 1)

        def density(f: float, level: int = level) -> float:
            return 2 * naive.squared_gain(level, f) * process.spectrum(f).item()

        parts = [scipy.integrate.quad(density, max(a, 1e-15), b, epsrel=1e-12)[0] for a, b in itertools.pairwise(zeros)]
        assert nu == pytest.approx(sum(parts), rel=1e-10)
    assert process.wavelet_variance(40)[-1].item() == pytest.approx(0.7 * math.log(2) / math.pi, rel=1e-12)


def test_differences_of_flicker_paths_have_their_exact_law():
    generator = torch.Generator().manual_seed(3)
    paths = FlickerNoise(0.7).simulate(101, batch=(40000,), generator=generator).numpy()
    lag = np.arange(1, 101)
    expected = 4 * 0.7 / math.pi * naive.odd_harmonic(lag)
    got = ((paths[:, 1:] - paths[:, :1]) ** 2).mean(0)
    np.testing.assert_allclose(got, expected, rtol=5 * math.sqrt(2 / 40000))


def exact_matern32(phi: float, level: int) -> float:
    """Wavelet variance of unit variance from the autocovariance, with 50 digits."""
    mpmath = pytest.importorskip("mpmath")
    with mpmath.workdps(50):
        half, decay = 2**level // 2, -mpmath.log(mpmath.mpf(phi))
        correlation = [(1 + decay * k) * mpmath.exp(-decay * k) for k in range(2 * half)]
        within = sum((half - abs(k)) * correlation[abs(k)] for k in range(1 - half, half))
        between = sum((half - abs(k - half)) * correlation[k] for k in range(1, 2 * half))
        return float((within - between) / (2 * half**2))


@pytest.mark.parametrize("phi", [1e-6, 0.3, 0.6, 0.9, 0.99, 0.999999, 1 - 1e-10])
def test_second_order_wavelet_variance_keeps_its_digits(phi):
    expected = [exact_matern32(phi, level) for level in range(1, 9)]
    np.testing.assert_allclose(Matern32(phi, 1.0).wavelet_variance(8).numpy(), expected, rtol=1e-13)


def test_second_order_paths_have_their_autocovariance():
    generator = torch.Generator().manual_seed(4)
    paths = Matern32(0.9, 0.5).simulate(40, batch=(100000,), generator=generator)
    lag = (torch.arange(40)[:, None] - torch.arange(40)).abs().double()
    expected = 0.5 * (1 - math.log(0.9) * lag) * 0.9**lag
    error = ((paths.mT @ paths) / len(paths) - expected).abs().max()
    assert error < 5 * 0.5 * math.sqrt(2 / 100000)


@pytest.mark.statistical
@pytest.mark.parametrize(
    "truth",
    [
        gf.WhiteNoise(1.0) + FlickerNoise(0.01),
        gf.WhiteNoise(1.0) + FlickerNoise(0.01) + gf.RandomWalk(1e-6),
        gf.WhiteNoise(1.0) + Matern32(0.99, 1.0),
    ],
    ids=str,
)
@pytest.mark.parametrize("refine", [False, True])
def test_intervals_hold_the_truth(truth, refine):
    n_records = 200
    signal = truth.simulate(20000, batch=(n_records,), generator=torch.Generator().manual_seed(5))
    fit = gf.fit_gmwm(signal, " + ".join(process.symbol for process in truth.processes), refine=refine)
    hit = (fit.confidence_interval.low <= truth.params) & (truth.params <= fit.confidence_interval.high)
    low = scipy.stats.binom.ppf(5e-4, n_records, 0.95)
    assert (hit.sum(0) >= low).all()
    assert (fit.p_value < 0.05).sum() <= scipy.stats.binom.ppf(1 - 5e-4, n_records, 0.05)
