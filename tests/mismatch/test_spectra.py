"""Cross-spectra in bands, the dictionary of noises, and lines, against direct sums, theory and simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import signal, stats

import gyrofuse as gf
from gyrofuse._base.transforms import cosine_ordinates
from gyrofuse.mismatch.detectors.spectra import shape_scan
from gyrofuse.mismatch.detectors.spectra.shape_scan import scanned, shape_test
from gyrofuse.mismatch.likelihoods.spectra.data import block_bands, ratios, reference_noise
from gyrofuse.mismatch.likelihoods.spectra.nuisance import Nuisance
from gyrofuse.mismatch.likelihoods.spectra.ratios import power_gains
from gyrofuse.mismatch.likelihoods.spectra.slow_ordinates import N_SLOW, slow_gains, slow_ordinates
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import N_FOLDS, seen_in_block
from gyrofuse.mismatch.signals.known_lines import without_lines
from gyrofuse.mismatch.signals.lines import log_hotelling, sets_of, simulated_lines, strongest_line
from gyrofuse.mismatch.signals.noise_spectrum import ar1_time_constants, fit_base
from gyrofuse.mismatch.signals.psd import bands, cross_spectra, hann_transform
from gyrofuse.mismatch.signals.records import Records


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def comparison(recording: torch.Tensor, simulation: torch.Tensor, rate: float = 100.0) -> Comparison:
    return Comparison.of(
        RecordingInfo(rate, "deg/s", tuple(map(str, range(recording.shape[-2])))), recording, simulation
    )


def test_cross_spectra_are_those_of_sine_tapers():
    n, n_sensors = 128, 3
    x = torch.randn(n_sensors, n, generator=generator(1), dtype=torch.float64)
    wanted = bands(n)
    found = cross_spectra(x, wanted).numpy()
    centred = x.numpy() - x.numpy().mean(-1, keepdims=True)
    t = np.arange(n)
    for b, (first, end) in enumerate(zip(wanted.edges[:-1], wanted.edges[1:], strict=True)):
        total = np.zeros((n_sensors, n_sensors), complex)
        for m in range(first, end):
            for k in range(1, 5):
                taper = math.sqrt(2 / n) * np.sin(math.pi * k * t / n)
                y = (centred * taper * np.exp(-2j * math.pi * m * t / n)).sum(-1)
                total += np.outer(y, y.conj())
        np.testing.assert_allclose(found[b], total / (4 * (end - first)), rtol=1e-10, atol=1e-12)


def test_bands_cover_the_bins_once_and_are_wide_enough():
    for n in (64, 1000, 4096, 2**18):
        edges = bands(n).edges
        widths = np.diff(edges)
        assert edges[0] == 3
        assert edges[-1] == (n - 4) // 2
        assert (widths > 4).all()
        if n > 1000:
            assert widths[-1] < 0.3 * edges[-1]


def test_degrees_of_freedom_of_bands_hold():
    wanted, n_runs = bands(512), 4000
    x = torch.randn(n_runs, 1, 512, generator=generator(2), dtype=torch.float64)
    power = cross_spectra(x, wanted)[..., 0, 0].real
    found = power.mean(0).square() / power.var(0)
    # The relative error of a variance from n runs of a gamma variable is some sqrt((2 + 6/d)/n); five of them.
    error = 5 * torch.sqrt((2 + 6 / wanted.dof) / n_runs)
    assert ((found / wanted.dof).log().abs() < error).all()
    assert (power.mean(0) - 1).abs().max() < 5 / math.sqrt(n_runs * float(wanted.dof.min()))


def test_the_dictionary_describes_the_noise_of_sensors():
    n = 2**14
    model = gf.WhiteNoise(1.0) + gf.AR1(0.99, 1e-3) + gf.RandomWalk(1e-7)
    side = Records(model.simulate(n, batch=(64, 1), generator=generator(3)), bands(n))
    f = side.bands.frequency
    ratio = side.base.spectrum(f)[0] / model.spectrum(f)
    assert (ratio - 1).abs()[2:].max() < 0.06
    assert (side.base.coefficients >= 0).all()
    assert (side.base.coefficients > 0).sum() <= 8, "most of the dictionary is not needed"


def test_covariance_of_block_means_is_that_of_the_noise():
    model = gf.WhiteNoise(0.5) + gf.QuantizationNoise(2.0) + gf.AR1(0.9, 0.3)
    n, block, n_blocks = 1024, 16, 64
    f = bands(n).frequency
    base = fit_base(model.spectrum(f)[None], bands(n), n, bands(n).dof)
    coefficients = torch.zeros_like(base.coefficients)
    coefficients[0, :2] = torch.tensor([0.5, 2.0])
    slow = int((coefficients.shape[1] - 3) / 2) + 2
    phi = math.exp(-1 / ar1_time_constants(n)[slow - 2])
    coefficients[0, slow] = 0.3
    exact = type(base)(n, coefficients).block_covariance(block, n_blocks)[0]
    model = gf.WhiteNoise(0.5) + gf.QuantizationNoise(2.0) + gf.AR1(phi, 0.3)
    x = model.simulate(n, batch=(4000,), generator=generator(4))
    means = x.unflatten(-1, (n_blocks, block)).mean(-1)
    found = means.mT @ means / len(means)
    error = 5 * math.sqrt(2 / 4000) * float(exact[0, 0])
    assert (found - exact).abs().max() < error


def test_the_model_of_a_dictionary_has_its_spectrum():
    n = 2**13
    model = gf.WhiteNoise(1.0) + gf.AR1(0.999, 1e-4)
    side = Records(model.simulate(n, batch=(4, 2), generator=generator(5)), bands(n))
    drawn = side.base.model().simulate(n, batch=(200,), generator=generator(6))
    again = cross_spectra(drawn, side.bands).mean(0).diagonal(dim1=-1, dim2=-2).real.mT
    fitted = side.bands.mean_of(side.base.spectrum(side.bands.nodes))
    sd = 1 / torch.sqrt(200 * side.bands.dof)
    # Leakage of what is slower than the record adds to the lowest bands.
    assert ((again / fitted - 1).abs() / sd)[:, 3:].max() < 5


@pytest.mark.statistical
@pytest.mark.parametrize("shared_noise", [0.0, 0.9])
def test_lines_are_not_found_where_there_are_none(shared_noise, draws):
    n, n_runs = 4096, draws(100, 200)
    model = gf.WhiteNoise(1.0) + gf.AR1(0.98, 1e-2)
    g, values = generator(7), []
    for _ in range(n_runs):
        own = model.simulate(n, batch=(2, 4), generator=g)
        common = model.simulate(n, batch=(2, 1), generator=g)
        x = math.sqrt(1 - shared_noise) * own + math.sqrt(shared_noise) * common
        values.append(comparison(x[0], x[1:]).line.p_value)
    hits = sum(p < 0.05 for p in values)
    assert stats.binom.sf(hits - 1, n_runs, 0.05) > 1e-3, f"{hits} of {n_runs}"


def test_a_line_is_found_between_bins_and_in_its_sensors():
    n = 2**13
    x = gf.WhiteNoise(1.0).simulate(n, batch=(2, 4), generator=generator(8))
    f = 700.4 / n
    x[0, 1:3] += 0.2 * torch.sin(2 * math.pi * f * torch.arange(n))
    line = comparison(x[0], x[1:]).line
    assert line.p_value < 1e-6
    assert abs(line.frequency - f) * n < 1
    assert line.sensors == (1, 2)


def test_a_line_of_the_simulation_is_no_news():
    n = 2**13
    x = gf.WhiteNoise(1.0).simulate(n, batch=(2, 4), generator=generator(9))
    x += 0.3 * torch.sin(2 * math.pi * 700.4 / n * torch.arange(n))
    both = comparison(x[0], x[1:])
    assert strongest_line(both.observed, Records(x[1:], bands(n))).p_value > 0.01
    assert abs(both.line.frequency * n - 700.4) > 3


def test_a_set_of_sensors_is_judged_by_hotelling():
    g = generator(21)
    z = torch.randn(3, 5, generator=g, dtype=torch.complex128)
    root = torch.randn(3, 5, 5, generator=g, dtype=torch.complex128)
    matrices = root @ root.mH + torch.eye(5)
    sets, log_chance = sets_of(5)
    m = torch.full((3, 1), 40.0, dtype=torch.float64)
    values = log_hotelling(z, matrices, sets, m)
    for which in (0, 4, 17, 30):
        k = [i for i in range(5) if sets[which, i]]
        for c in range(3):
            own, matrix = z[c, k].numpy(), matrices[c].numpy()[np.ix_(k, k)]
            t2 = (own.conj() @ np.linalg.solve(matrix, own)).real
            f = t2 * (40 - len(k) + 1) / (40 * len(k))
            direct = stats.f.logsf(f, 2 * len(k), 2 * (40 - len(k) + 1))
            assert abs(float(values[c, which]) - direct) < 1e-8
    assert abs(float(log_chance.exp().sum()) - 1) < 1e-12


def test_a_tone_of_forty_nats_in_two_of_six_sensors_is_found():
    # 26 nats are wanted of a pair among 10^4 places and 15 pairs, with a scatter of 9: found in 95 %.
    g, found, n_runs, n = generator(22), 0, 20, 2**13
    t = torch.arange(n, dtype=torch.float64)
    for _ in range(n_runs):
        x = torch.randn(3, 6, n, generator=g, dtype=torch.float64)
        f = 0.05 + 0.4 * float(torch.rand((), generator=g))
        turn = 2 * math.pi * torch.rand(2, 1, generator=g, dtype=torch.float64)
        x[0, [1, 4]] += math.sqrt(4 * 20 / n) * torch.cos(2 * math.pi * f * t + turn)
        line = comparison(x[0], x[1:]).line
        found += line.p_value < 8e-4 and abs(line.frequency - f) * n < 1
    assert found >= 16


def test_side_lobes_of_a_known_line_are_no_lines():
    g, n = generator(23), 2**13
    t = torch.arange(n, dtype=torch.float64)
    x = torch.randn(3, 4, n, generator=g, dtype=torch.float64)
    x += torch.cos(2 * math.pi * 700.4 / n * t + torch.tensor([0.3, 1.0, 2.0])[:, None, None])
    both = comparison(x[0], x[1:])
    assert len(simulated_lines(both.reference)) == 1
    assert abs(simulated_lines(both.reference)[0] * n - 700.4) < 0.3
    assert both.line.p_value > 0.01
    cleaned = without_lines(x[0], simulated_lines(both.reference))
    assert (cleaned - x[0]).square().sum() > 0.45 * 4 * n
    assert abs(float(cleaned.square().mean()) - 1) < 0.05


def test_hann_transform_has_the_density_as_mean_square():
    x = gf.AR1(0.9, 1.0).simulate(1000, batch=(800,), generator=generator(10))
    transform, length = hann_transform(x)
    at = torch.tensor([0.05, 0.2, 0.4])
    found = transform.abs().square().mean(0)[(at * length).round().long()]
    assert ((found / gf.AR1(0.9, 1.0).spectrum(at) - 1).abs() < 0.2).all()


# Down to the slowest ordinates ---------------------------------------------------------------------------------------


def walking(seed: int, factor: float = 1.0, n: int = 4096) -> Comparison:
    g = generator(seed)
    one, other = (gf.WhiteNoise(1.0) + gf.RandomWalk(1e-5 * x) for x in (factor, 1.0))
    return comparison(one.simulate(n, batch=(3,), generator=g), other.simulate(n, batch=(4, 3), generator=g))


def test_ordinates_of_a_block_s_bands_add_up_to_those_of_all_bins():
    wanted, n_runs = block_bands(512), 4000
    x = torch.randn(n_runs, 1, 512, generator=generator(20), dtype=torch.float64)
    power = cross_spectra(x, wanted)[..., 0, 0].real
    total = (power * torch.from_numpy(np.diff(wanted.edges))).sum(-1)
    found = float(total.mean().square() / total.var())
    # The relative error of a variance of 4000 runs is 0.022.
    assert float(wanted.dof.sum()) == pytest.approx(found, rel=0.1)


def test_gains_of_powers_are_those_of_the_law_of_f():
    given = walking(21)
    data = ratios(given)
    factors = torch.linspace(-1.0, 2.0, len(data.d), dtype=torch.float64)[:, None].expand(-1, given.n_sensors)
    found = power_gains(data, factors.exp()) / data.weight
    for b in (0, 3, 20, 40):
        law = stats.f(2 * float(data.d[b]), 2 * float(data.s[b]))
        r, h = data.ratio[b].numpy(), float(factors[b, 0])
        expected = law.logpdf(r * math.exp(-h)) - h - law.logpdf(r)
        np.testing.assert_allclose(found[b].numpy(), expected, rtol=1e-3)  # but for the floor


def test_the_scan_of_shapes_is_the_mean_over_all_of_them():
    given = walking(22)
    data = ratios(given)
    shapes = shape_scan._shapes(data, given.n_samples)
    total = 0.0
    for h, log_factor in enumerate(shapes.log_factors):
        up, down = (np.exp(power_gains(data, (w * log_factor).exp().mT).sum(0).numpy()) for w in (1, -1))
        for ratio in (up, down, (up + down) / 2):
            chance = math.exp(float(shapes.log_prior[h])) / 3
            total += chance * np.mean([np.prod(1 - e + e * ratio) for e in shape_scan.SHARES])
    found = scanned(given)
    assert found is not None
    assert found.log_ratio == pytest.approx(math.log(total), abs=1e-9)


def test_chances_of_shapes_add_up_to_one():
    given = walking(23)
    prior = shape_scan._shapes(ratios(given), given.n_samples).log_prior
    assert float(prior.exp().sum()) == pytest.approx(1.0, abs=1e-9)


def test_gains_beside_a_nuisance_are_those_of_likelihoods_integrated_over_it():
    given = walking(26)
    data = ratios(given)
    g = generator(27)
    rows = 0.05 * torch.randn(given.n_sensors, len(data.d), 1, generator=g, dtype=torch.float64)
    shape = 0.05 * torch.randn(given.n_sensors, len(data.d), generator=g, dtype=torch.float64)
    y = torch.linspace(-8, 8, 4001, dtype=torch.float64)
    logs = []
    for moved in (shape, torch.zeros_like(shape)):
        gains = power_gains(data, (moved + y[:, None, None] * rows[..., 0]).exp().mT).sum(-2)
        logs.append((gains - y[:, None].square() / 2).logsumexp(0))
    expected = logs[0] - logs[1]
    assert float(expected.abs().min()) > 0.01
    torch.testing.assert_close(Nuisance(data, rows).gains(shape), expected, atol=0.05, rtol=0.05)
    # Whatever a free nuisance can make is no difference.
    free = Nuisance(data, 1e6 * rows)
    assert float(free.gains(0.5 * rows[..., 0]).abs().max()) < 0.05


def test_a_larger_walk_is_seen_in_its_slowest_ordinates():
    n_runs = 20
    seen = sum(shape_test(walking(100 + s, 40.0)).p_value < 1e-3 for s in range(n_runs))
    false = sum(shape_test(walking(200 + s)).p_value < 0.05 for s in range(n_runs))
    assert seen >= stats.binom.ppf(1e-3, n_runs, 0.8)
    assert false <= stats.binom.isf(1e-3, n_runs, 0.05)


def test_slow_ordinates_are_held_out_once_and_gain_what_their_likelihood_does():
    given = walking(24, 40.0)

    def spectra(matrices: torch.Tensor, f: torch.Tensor) -> torch.Tensor:
        return matrices * (1 + 1e-3 / f.to(matrices.dtype))[:, None, None]

    y = slow_ordinates(given.observed)[0].numpy()
    f = np.arange(1, N_SLOW + 1) / (2 * given.n_samples)
    power = reference_noise(given).spectrum(torch.from_numpy(f)).numpy()
    factor = 1 + 1e-3 / f
    expected = (stats.norm.logpdf(y, scale=np.sqrt(power * factor)) - stats.norm.logpdf(y, scale=np.sqrt(power))).sum(0)
    for fold in range(N_FOLDS):
        own = [k for k in range(1, N_SLOW + 1) if (k - 1) % N_FOLDS == fold]
        assert float(slow_gains(given, spectra, fold).sum()) == pytest.approx(expected[[k - 1 for k in own]].sum())


def test_blocks_show_what_leaks_into_a_stop_band():
    sections = signal.ellip(4, 0.5, 50, 0.8, output="sos")
    n, g = 96, np.random.default_rng(0)
    blocks = signal.sosfilt(sections, g.standard_normal((10000, n + 200)))[:, 200:]
    power = torch.from_numpy(np.abs(signal.sosfreqz(sections, worN=math.pi * np.arange(n + 1) / n)[1]) ** 2)
    seen = cosine_ordinates(torch.from_numpy(blocks)).square().mean(0)
    torch.testing.assert_close(seen_in_block(power)[1:], seen[1:], rtol=0.06, atol=0)  # 0.014 each, of 95
    # White noise has nothing that leaks.
    torch.testing.assert_close(seen_in_block(torch.ones_like(power))[1:], torch.ones(n - 1, dtype=torch.float64))


def test_shorter_simulations_say_nothing_of_the_slowest_ordinates():
    g = generator(25)
    noise = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-5)
    given = comparison(noise.simulate(4096, batch=(2,), generator=g), noise.simulate(2048, batch=(1, 2), generator=g))
    assert not slow_gains(given, lambda m, f: 2 * m, 0).any()
    assert shape_test(given).p_value > 1e-3


def test_coherences_of_noise_that_is_loud_in_all_sensors_at_once_vary_more() -> None:
    """Squared coherences of independent sensors have the mean `1 / dof`."""
    g, n, p = torch.Generator().manual_seed(3), 16384, 12
    course = gf.AR1(math.exp(-1 / 300), 0.5 * -math.expm1(-2 / 300)).simulate(n, generator=g)  # of the log variance
    noise = torch.randn(p, n, generator=g, dtype=torch.float64)
    for samples, largest in ((noise, 0.02), (noise * torch.exp(course / 2), 1.2)):
        side = Records(samples[None], bands(n))
        high = side.bands.dof > 100
        pairs = torch.triu_indices(p, p, 1)
        mean = (side.coherence.abs().square()[:, pairs[0], pairs[1]].mean(-1) * side.coherence_dof)[high].mean()
        assert float(mean) == pytest.approx(1.0, abs=0.12)
        assert float((side.dof / side.coherence_dof)[high].max()) < 1 + largest
    assert float((side.dof / side.coherence_dof)[high].min()) > 1.4


def test_noise_in_common_varies_as_other_noise_and_shocks_in_common_more() -> None:
    g, n = torch.Generator().manual_seed(4), 16384
    root = torch.linalg.cholesky(0.5 * torch.eye(3, dtype=torch.float64) + 0.5)
    noise = root @ torch.randn(3, n, generator=g, dtype=torch.float64)
    shocks = 15 * (torch.rand(n, generator=g, dtype=torch.float64) < 1e-3) * torch.randn(3, n, generator=g).double()
    plain, shocked = (Records(x[None], bands(n)) for x in (noise, noise + shocks))
    # 0.5^2 times 1.5 by what differences repeat, twice over, in a mean over 16 samples
    assert float((plain.dof / plain.coherence_dof).max()) < 1.06
    assert float((shocked.dof / shocked.coherence_dof)[plain.dof > 100].min()) > 3.0
