"""Steps, warm-ups and temperature drifts: covariances and scans against direct sums and theory, and what is found."""

from __future__ import annotations

import functools
import gc
import math
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

import gyrofuse as gf
from gyrofuse.mismatch.detectors.slow.estimates import quantiles
from gyrofuse.mismatch.detectors.slow.scans import Scan, SlowAnalysis, jumps_to_and_fro, slow_analysis, slow_test
from gyrofuse.mismatch.detectors.slow.surrogates import beats_surrogates
from gyrofuse.mismatch.likelihoods.slow_noise import (
    Fit,
    SlowNoise,
    SlowPowers,
    best_fit,
    cell_differences,
    cosines,
    ordinates,
    simulated_slow_noise,
    slow_ordinates,
    slow_powers,
)
from gyrofuse.mismatch.likelihoods.slow_templates import Family, lagged, steps, temperatures, warm_ups
from gyrofuse.mismatch.mechanisms.slow.step import Step
from gyrofuse.mismatch.mechanisms.slow.temperature import TemperatureDrift
from gyrofuse.mismatch.mechanisms.slow.warm_up import WarmUpTransient
from gyrofuse.mismatch.selection.held_out import score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo, block_means
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum, ar1_time_constants
from gyrofuse.mismatch.stats.curve_maximum import curve_length, expected_exceedances
from gyrofuse.mismatch.stats.gls import least_squares
from gyrofuse.mismatch.stats.multiplicity import monte_carlo_p_value

N, RATE, SENSORS = 16384, 100.0, 4
LEVEL = 5e-4
T = torch.arange(N, dtype=torch.float64)
TEMPERATURE = 25 + 3 * (1 - (-T / 4000).exp()) + (2 * math.pi * T / 6000 + 1).cos()
ALL = (Step, WarmUpTransient, TemperatureDrift)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@functools.cache
def noise(seed: int, n_records: int) -> torch.Tensor:
    model = gf.WhiteNoise(1.0) + gf.AR1(0.99, 1e-3) + gf.RandomWalk(1e-7)
    return model.simulate(N, batch=(n_records, SENSORS), generator=generator(seed)).double()


def comparison(effect: torch.Tensor | float = 0.0, seed: int = 1) -> Comparison:
    info = RecordingInfo(RATE, "deg/s", ("a", "b", "c", "d"), {"temperature[imu2]": TEMPERATURE})
    return Comparison.of(info, noise(seed, 1)[0] + effect, noise(100 + seed, 3))


def test_covariance_of_cells_is_that_of_the_samples():
    n, cell, n_cells = 512, 8, 5
    constants = np.array(ar1_time_constants(n))
    coefficients = torch.rand(2, len(constants) + 3, generator=generator(2), dtype=torch.float64)
    found = cell_differences(NoiseSpectrum(n, coefficients), cell, n_cells).numpy()
    t = np.arange(cell * n_cells)
    apart = np.abs(t[:, None] - t)
    phi = np.exp(-1 / constants)[:, None, None]
    angle = np.diff(np.eye(len(t) + 1), axis=0)
    atoms = [np.eye(len(t)), angle @ angle.T, *(phi**apart / (1 - phi**2)), np.minimum(t[:, None], t)]
    means = np.kron(np.eye(n_cells), np.ones(cell) / cell)
    to_differences = np.diff(means, axis=0)
    for row, own in zip(coefficients.numpy(), found, strict=True):
        direct = sum(c * to_differences @ atom @ to_differences.T for c, atom in zip(row, atoms, strict=True))
        np.testing.assert_allclose(own, direct, rtol=1e-8, atol=1e-9 * np.abs(direct).max())


def test_ordinates_are_cosines_of_block_means():
    signal = torch.randn(3, 1024, generator=generator(7), dtype=torch.float64)
    t = np.arange(256) + 0.5
    means = signal.numpy().reshape(3, 256, 4).mean(-1)
    direct = [[math.sqrt(2 / 256) * (m * np.cos(math.pi * k * t / 256)).sum() for k in range(1, 256)] for m in means]
    np.testing.assert_allclose(slow_ordinates(signal + 5).numpy(), direct, atol=1e-12)
    assert torch.allclose(ordinates(cosines()), torch.eye(255, dtype=torch.float64), atol=1e-12)


def test_the_spectra_of_ordinates_are_those_of_the_covariance():
    noise = simulated_slow_noise(comparison())
    factors = torch.randn(SENSORS, 4, generator=generator(3), dtype=torch.float64)
    full = cosines() @ noise.covariance(factors) @ cosines().mT
    spectra = (factors.exp()[..., None] * noise.parts).sum(1)
    np.testing.assert_allclose(spectra, full.diagonal(dim1=-1, dim2=-2), rtol=1e-9)
    beside = full / (spectra[:, :, None] * spectra[:, None, :]).sqrt() - torch.eye(255, dtype=torch.float64)
    assert float(beside.abs().max()) < 0.1, "nearly independent"


def test_sizes_are_weighted_least_squares():
    now = comparison()
    y, variance = slow_ordinates(now.recording), simulated_slow_noise(now).own
    designs = warm_ups(now, 2).designs[[0, 90]]
    size, spread, z = least_squares(y, variance, designs)
    for i in range(SENSORS):
        for k, design in enumerate(designs):
            weighted, data = (design / variance[i].sqrt()).mT, y[i] / variance[i].sqrt()
            direct = torch.linalg.lstsq(weighted, data[:, None]).solution[:, 0]
            np.testing.assert_allclose(size[k, i], direct, rtol=1e-6)
            np.testing.assert_allclose(spread[k, i], torch.linalg.inv(weighted.mT @ weighted).diagonal(), rtol=1e-6)
            explained = data.square().sum() - (data - weighted @ direct).square().sum()
            assert float(z[k, i].square().sum()) == pytest.approx(float(explained), rel=1e-6)


def test_slow_noise_is_told_to_the_lowest_frequencies():
    """Pooled over sensors alike, the power of the first ordinates is known to a fraction of itself."""
    model = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-6)
    ratios = []
    for seed in range(12):
        signal = model.simulate(N, batch=(2, SENSORS), generator=generator(50 + seed)).double()
        now = Comparison.of(RecordingInfo(RATE, "deg/s", ("a", "b", "c", "d")), signal[0], signal[1:])
        walk = 1e-6 * torch.from_numpy(np.minimum(*np.indices((256, 256)))).double() * now.block
        exact = (cosines() @ walk @ cosines().mT).diagonal()[:3] + 1 / now.block
        ratios.append((simulated_slow_noise(now).own[:, :3] / exact).log())
    ratio = torch.stack(ratios)
    assert float(ratio.mean().abs()) < 0.35
    assert float(ratio.std()) < 0.8, "2.2 from bands alone"


def test_the_fit_is_a_maximum():
    now = comparison()
    noise, y = simulated_slow_noise(now), slow_ordinates(now.recording)
    fit = best_fit(noise, y)

    def value(theta: torch.Tensor) -> float:
        v = (theta.exp()[..., None] * noise.parts).sum(1)
        own = (((theta - noise.centre) / noise.spread).square()[:, :2]).sum()
        beside = (((theta - noise.centre) / noise.spread).square()[0, 2:]).sum()
        return -float((y.square() / v + v.log()).sum() + own + beside) / 2

    assert value(fit.log_factors) == pytest.approx(float(fit.value.sum()), rel=1e-9)
    for part in range(4):
        for change in (-0.2, 0.2):
            other = fit.log_factors.clone()
            other[:, part] += change
            assert value(other) < value(fit.log_factors) + 0.05, "to a twentieth of a nat"


def test_templates_are_those_of_the_paths():
    now = comparison()
    tau = 700.0
    path = (-T / tau).exp()
    assert torch.allclose(
        warm_ups(now, 1).at(torch.tensor([[tau]], dtype=torch.float64)).designs[0, 0], slow_ordinates(path), atol=1e-12
    )
    family = steps(now)
    for place in (0, 101, 500):
        path = (family.points[place] <= T).double()
        assert torch.allclose(family.designs[place, 0], slow_ordinates(path))


def test_a_lag_is_a_low_pass_of_first_order():
    info = RecordingInfo(RATE, "deg/s", ("a",), {"temperature": TEMPERATURE})
    lag, y = 50.0, [float(TEMPERATURE[0])]
    for x in TEMPERATURE[1:300].tolist():
        y.append(y[-1] + (1 - math.exp(-1 / lag)) * (x - y[-1]))
    np.testing.assert_allclose(lagged(info, "temperature", 0, lag, N)[:300].numpy(), y, rtol=1e-12)
    with pytest.raises(ValueError, match=r"`channels`: expected 'temperature' at 20000 samples or more, got 16384"):
        lagged(info, "temperature", 0, lag, 20000)


def test_the_tail_of_a_scan_is_that_of_its_maximum():
    n, n_templates, n_runs, n_sensors = 60, 40, 20000, 3
    angle = torch.linspace(0, 1, n_templates, dtype=torch.float64)[:, None] * 6
    k = torch.arange(n, dtype=torch.float64)
    templates = torch.exp(-0.5 * ((k - 10 - angle * 6) / 4).square())
    information = templates.square().sum(-1)
    length = curve_length(torch.ones(1, n, dtype=torch.float64), templates, information[None])
    unit = templates / information.sqrt()[:, None]
    assert float(length) == pytest.approx(float((unit[1:] * unit[:-1]).sum(-1).arccos().sum()))
    z = torch.randn(n_runs, n_sensors, n, generator=generator(4), dtype=torch.float64) @ unit.T
    largest = z.square().sum(1).amax(-1)
    q = torch.tensor([14.0], dtype=torch.float64)
    expected = -math.expm1(-float(expected_exceedances(q, n_sensors, length, n_templates)))
    found = int((largest > 14).sum())
    # Davies' bound is close far out: between the law and a quarter more.
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], n_runs, expected)
    assert 0.75 * low <= found <= high


def test_a_p_value_is_held_against_twins():
    honest = torch.linspace(0.0005, 0.9995, 1000, dtype=torch.float64)
    # The next of 1000 is less extreme than a law that is known: `(1 + L/k)^-k` instead of `exp(-L)`.
    assert monte_carlo_p_value(1e-6, honest) == pytest.approx(0.25 * (1 + math.log(0.25e6) / 250) ** -250, rel=0.03)
    assert monte_carlo_p_value(0.5, honest) == pytest.approx(0.5, abs=0.01)
    boastful = honest**2
    assert monte_carlo_p_value(1e-6, boastful) == pytest.approx(1e-3, rel=0.3)
    assert monte_carlo_p_value(0.1, honest.sqrt()) == pytest.approx(0.01, abs=0.002)


def twins(given: SlowPowers, n_twins: int, g: torch.Generator, dof: float) -> list[SlowAnalysis]:
    """Ordinates of noise that may be behind a simulation, beside simulations that show of it no more than that one."""

    def drawn(coefficients: torch.Tensor) -> torch.Tensor:
        expected = coefficients @ given.atoms
        gamma = torch.from_numpy(stats.gamma(given.dof.numpy()).rvs(expected.shape, random_state=numpy))
        return given._replace(values=expected * gamma / given.dof).coefficients(N)

    numpy = np.random.default_rng(int(torch.randint(2**31, (), generator=g)))
    families = (warm_ups(comparison(), 1), steps(comparison()), temperatures(comparison())[0])
    analyses = []
    for _ in range(n_twins):
        behind = drawn(given.coefficients(N))
        noise, true = (SlowNoise.around(NoiseSpectrum(N, c), 1 / dof, 0.0, dof) for c in (drawn(behind), behind))
        y = true.own.sqrt() * torch.randn(SENSORS, 255, generator=g, dtype=torch.float64)
        analyses.append(SlowAnalysis(noise, y, best_fit(noise, y), families))
    return analyses


@pytest.mark.statistical
@pytest.mark.parametrize("walk", [1e-7, 1e-5])
def test_p_values_of_scans_hold_among_twins(walk: float):
    """Where the slow noise is known from one record, white noise or a walk, hardly more than 5 % are found at 5 %."""
    signal = (
        (gf.WhiteNoise(1.0) + gf.RandomWalk(walk)).simulate(N, batch=(1, SENSORS), generator=generator(31)).double()
    )
    side = Comparison.of(RecordingInfo(RATE, "deg/s", ("a", "b", "c", "d")), signal[0], signal)
    given, dof = slow_powers(side), float(side.reference.dof[:3].sum())
    n_twins = 80
    analyses = twins(given, n_twins, generator(32), dof)
    for k in range(len(analyses[0].families)):
        p = np.array(
            [replace(analysis, families=analysis.families[k : k + 1]).scans[0].p_value for analysis in analyses]
        )
        assert (p < 0.05).sum() <= stats.binom.ppf(0.999, n_twins, 0.08)
        assert (p < 0.005).sum() <= stats.binom.ppf(0.999, n_twins, 0.01)
        assert p.min() > 1e-5


def test_quantiles_of_places():
    places = torch.linspace(0, 100, 2001, dtype=torch.float64)
    weight = torch.softmax(-((places - 40) / 5).square() / 2, 0)
    middle, low, high = quantiles(places, weight)
    assert (middle, low, high) == pytest.approx((40, 40 - 9.8, 40 + 9.8), abs=0.1)


@pytest.mark.parametrize("mirrored", [1, -1])
def test_limits_of_places_reach_an_end_that_is_likely(mirrored: int):
    """A lag of zero is at the end of all lags: of a normal law cut off there, up to two of its sds from the middle."""
    places = torch.linspace(0, 10, 1001, dtype=torch.float64)
    for middle, reached in ((0.0, True), (1.9, True), (2.1, False)):
        weight = torch.softmax(-(places - middle).square() / 2, 0)
        _, *limits = quantiles(mirrored * places, weight)
        assert (0.0 in limits) == reached


def test_sensors_that_jump_to_and_fro_are_known():
    beside = torch.diag(torch.ones(254, dtype=torch.float64), 1)
    inverse = torch.linalg.inv(2 * torch.eye(255, dtype=torch.float64) - beside - beside.mT)
    y = torch.randn(256, generator=generator(5), dtype=torch.float64).diff()
    telegraph, staircase, single = y.clone(), y.clone(), y.clone()
    telegraph[[20, 70, 120, 150, 220]] += 4 * torch.tensor([1.0, -1, 1, -1, 1])
    staircase[[20, 70, 120, 150, 220]] += 4
    single[70] += 8
    found = [jumps_to_and_fro(inverse @ x, inverse) for x in (telegraph, staircase, single, y)]
    assert found == [True, False, False, False]


def test_a_look_does_not_keep_its_case():
    now = comparison()
    slow_analysis(now)
    gone = weakref.ref(now)
    del now
    gc.collect()
    assert gone() is None


@pytest.mark.parametrize("seed", range(1, 9))
def test_nothing_is_found_where_nothing_is_missing(seed: int):
    now = comparison(seed=seed)
    assert slow_test(now).p_value > 1e-3
    assert all(mechanism.detect_and_fit(now, LEVEL) is None for mechanism in ALL)


def best(now: Comparison):
    found = [f for f in (mechanism.detect_and_fit(now, LEVEL) for mechanism in ALL) if f is not None]
    return max(found, key=lambda f: f.gain)


SIZE = torch.tensor([0.8, 0.0, -0.5, 0.4], dtype=torch.float64)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("mechanism", "path", "place", "at", "size"),
    [
        (Step, (T >= 9000).double(), "onset", 90.0, "size"),
        (WarmUpTransient, 2 * (-T / 1500).exp(), "time_constant", 15.0, "size"),
        (TemperatureDrift, TEMPERATURE / 2, "lag", 0.0, "coefficient"),
    ],
)
def test_an_effect_is_found_by_its_name(mechanism, path: torch.Tensor, place: str, at: float, size: str):
    now = comparison(SIZE[:, None] * path)
    assert slow_test(now).p_value < 1e-6
    finding = best(now)
    assert finding.mechanism == mechanism.name
    assert finding.alternatives == ()
    assert {0, 2} <= set(finding.sensors)
    p = finding.parameters[place]
    assert abs(p.value - at) <= p.high - p.low
    assert p.unit == "s"
    scale = 2.0 if mechanism is WarmUpTransient else 0.5 if mechanism is TemperatureDrift else 1.0
    for i in (0, 2):
        entry = finding.parameters[f"{size}[{i}]"]
        sd = (entry.high - entry.low) / 3.92
        assert abs(entry.value - scale * float(SIZE[i])) < 4 * sd
    assert score_held_out(now, finding.effect).confirms(finding.p_value)
    after = finding.effect.repair(now, generator(1))
    assert slow_test(after).p_value > 0.01
    back = finding.effect.apply(finding.effect.remove(now.recording, now.info), now.info, generator(1))
    assert torch.allclose(back, now.recording)
    refitted = finding.effect.fit_without(now, 0)
    assert refitted.held_out_scores(now, 0).shape == (8,)
    assert float((refitted.size - scale * SIZE)[[0, 2]].abs().max()) < 0.5 * scale


def lag_of(seconds: float) -> torch.Tensor:
    info = RecordingInfo(RATE, "deg/s", ("a",), {"temperature": TEMPERATURE})
    path = lagged(info, "temperature", 0, seconds * RATE, N)
    return path - path[0]


BENT = lag_of(7.0) + 0.4 * lag_of(7.0).square()
DOUBLE = (-T / 400).exp() + 0.6 * (-T / 3000).exp()


@pytest.mark.statistical
@pytest.mark.parametrize("strength", [3.0, 30.0, 100.0])
@pytest.mark.parametrize(
    ("mechanism", "path", "numbers"),
    [
        (TemperatureDrift, BENT, {"coefficient": 1.0, "curvature": 0.4}),
        (WarmUpTransient, 2 * DOUBLE, {"size": 2.0, "second_size": 1.2}),
    ],
)
def test_an_effect_of_another_form_is_found_with_that_form(mechanism, path, numbers, strength: float):
    """A bent line, and two time constants: nothing else is made of what one straight line or one decay would leave."""
    now = comparison(strength * SIZE[:, None] * path)
    assert slow_test(now).p_value < 1e-6
    finding = best(now)
    assert finding.mechanism == mechanism.name
    for name, value in numbers.items():
        for i in (0, 2, 3):
            entry = finding.parameters[f"{name}[{i}]"]
            sd = (entry.high - entry.low) / 3.92
            assert abs(entry.value - strength * value * float(SIZE[i])) < 4.5 * sd
    if mechanism is WarmUpTransient:
        for name, tau in (("time_constant", 4.0), ("second_time_constant", 30.0)):
            entry = finding.parameters[name]
            assert abs(entry.value - tau) <= entry.high - entry.low
        assert "time constants of" in finding.sentence
    else:
        assert "in a line that is bent" in finding.sentence
    assert score_held_out(now, finding.effect).confirms(finding.p_value)
    after = finding.effect.repair(now, generator(1))
    assert slow_test(after).p_value > 0.01
    back = finding.effect.apply(finding.effect.remove(now.recording, now.info), now.info, generator(1))
    assert torch.allclose(back, now.recording)


@pytest.mark.statistical
@pytest.mark.parametrize(("mechanism", "path"), [(WarmUpTransient, (-T / 1500).exp()), (TemperatureDrift, lag_of(7.0))])
def test_of_a_strong_effect_nothing_is_left(mechanism, path: torch.Tensor):
    """Its place is known far more closely than any grid that is searched to begin with."""
    now = comparison(300 * SIZE[:, None] * path)
    finding = best(now)
    assert finding.mechanism == mechanism.name
    assert not {"curvature[0]", "second_size[0]"} & set(finding.parameters)
    assert slow_test(finding.effect.repair(now, generator(1))).p_value > 0.01


def test_the_channel_is_named_and_the_unit_is_by_kelvin():
    finding = best(comparison(SIZE[:, None] * TEMPERATURE))
    assert finding.channel == "temperature[imu2]"
    assert finding.parameters["coefficient[0]"].unit == "deg/s/K"


def of_few_waves(n_sensors: int, nats: float, seed: int, *, follows: bool) -> tuple[SlowAnalysis, Scan]:
    """Sensors with one path beside white ordinates, and the scan of a channel, which it is or not; both smooth."""
    g = generator(seed)
    t = torch.arange(256, dtype=torch.float64) / 256
    turns = 2 * math.pi * torch.rand(2, 3, generator=g, dtype=torch.float64)
    sizes = zip((1.0, 0.35, 0.2), turns.mT, strict=True)
    waves = sum(a * (2 * math.pi * k * t + turn[:, None]).cos() for k, (a, turn) in enumerate(sizes, 1))
    channel, other = ordinates(torch.as_tensor(waves))
    path = channel if follows else other
    sign = 2.0 * torch.randint(2, (n_sensors, 1), generator=g) - 1
    noise = torch.randn(n_sensors, 255, generator=g, dtype=torch.float64)
    y = sign * path / path.norm() * math.sqrt(2 * nats / n_sensors) + noise
    size = (y @ channel / channel.square().sum())[:, None]
    z = size * channel.norm()
    fit = Fit(torch.zeros(n_sensors, 0), torch.zeros(n_sensors), torch.ones_like(y), size)
    family = Family("temperature_drift", torch.zeros(1, 1), channel[None, None], "the bias follows it")
    there = torch.full_like(z, 9.0)  # in every sensor
    scan = Scan(family, 0, fit, there, z, nats, 0.0, torch.eye(n_sensors), torch.ones(n_sensors), 1)
    return SlowAnalysis(None, y, fit, (family,)), scan  # type: ignore[arg-type]


@pytest.mark.parametrize(("n_sensors", "nats"), [(1, 15.0), (12, 15.0)])
def test_a_channel_that_is_nearly_one_wave_or_in_many_sensors_can_be_followed(n_sensors: int, nats: float):
    held = sum(beats_surrogates(*of_few_waves(n_sensors, nats, seed, follows=True), generator(0)) for seed in range(20))
    assert held >= 17


def test_a_channel_that_many_sensors_do_not_follow_is_no_better_than_its_surrogates():
    held = sum(beats_surrogates(*of_few_waves(12, 100.0, seed, follows=False), generator(0)) for seed in range(20))
    assert held <= 7


def test_the_search_for_an_onset_ends_where_two_places_are_likely():
    """Two halves of a step 1.5 s apart: cells that hold both places in so many do not get finer."""
    halves = (0.5 * (T >= 9000) + 0.5 * (T >= 9150)).double()
    found = Step.detect_and_fit(comparison(halves, seed=2), LEVEL)
    assert found is not None
    assert 89.5 < found.time_s < 92
    onset = found.parameters["onset"]
    assert onset.low <= onset.value <= onset.high


def test_the_onset_of_a_large_step_is_known_to_samples():
    at = 6345
    finding = best(comparison(torch.tensor([8.0, 0, 6, 0])[:, None] * (at <= T).double()))
    assert finding.mechanism == "step"
    assert abs(finding.time_s * RATE - at) <= 2
    p = finding.parameters["onset"]
    assert p.low * RATE <= at <= p.high * RATE


@pytest.mark.statistical
def test_steps_are_found_one_after_the_other():
    one, other = (T >= 4000).double(), (T >= 12000).double()
    effect = torch.stack([2 * one, 1.5 * other, 0 * T, -1.5 * one])
    now = comparison(effect)
    onsets = []
    for _ in range(2):
        finding = Step.detect_and_fit(now, LEVEL)
        assert finding is not None
        onsets.append(finding.time_s)
        now = finding.effect.repair(now, generator(1))
    assert sorted(onsets) == pytest.approx([40, 120], abs=2)
    assert Step.detect_and_fit(now, LEVEL) is None


@pytest.mark.statistical
def test_several_large_steps_are_no_walk():
    """To and fro in one sensor: no single one of them beats more slow noise, all of them do by far."""
    sizes = {2345: 4.0, 6789: -5.5, 9700: 3.0, 13131: 1.5}
    effect = torch.zeros(SENSORS, N, dtype=torch.float64)
    effect[2] = torch.stack([size * (at <= T) for at, size in sizes.items()]).sum(0)
    now = comparison(effect, seed=3)
    found = {}
    for _ in sizes:
        finding = Step.detect_and_fit(now, LEVEL)
        assert finding is not None
        assert finding.sensors == (2,)
        assert finding.alternatives == ()
        assert score_held_out(now, finding.effect).confirms(finding.p_value)
        found[round(finding.time_s * RATE)] = float(finding.effect.size[2])
        now = finding.effect.repair(now, generator(1))
    for (at, size), (true, jump) in zip(sorted(found.items()), sizes.items(), strict=True):
        assert abs(at - true) <= 12
        assert size == pytest.approx(jump, abs=0.3)
    assert Step.detect_and_fit(now, LEVEL) is None


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_walk_or_a_path_that_bends_is_not_several_steps(seed: int):
    walk = gf.RandomWalk(1e-3).simulate(N, batch=(SENSORS,), generator=generator(seed)).double()
    bends = torch.outer(torch.tensor([3.0, 0, 0, 4.0], dtype=torch.float64), (2 * math.pi * T / 9000 + seed).sin())
    for effect in (walk, bends):
        several = slow_analysis(comparison(effect, seed=seed)).several_steps
        assert several is None or several.gain < slow_analysis(comparison(effect, seed=seed)).wandering


def test_a_stationary_telegraph_is_no_step():
    state = torch.ones(N, dtype=torch.float64)
    for at in (2000, 4500, 6000, 9000, 11000, 14500):
        state[at:] *= -1
    effect = torch.zeros(SENSORS, N, dtype=torch.float64)
    effect[1] = state
    assert Step.detect_and_fit(comparison(effect), LEVEL) is None


def test_a_loud_source_of_all_sensors_is_no_step():
    # Where they differ is a hundred-thousandth of it, and falls off otherwise.
    gains = torch.tensor([1.0, -0.8, 1.3, 0.9], dtype=torch.float64)[:, None]
    for seed in (21, 22, 23):
        source = gf.AR1(0.97, 1.0).simulate(N, generator=generator(seed))
        scan = slow_analysis(comparison(300 * gains * source)).scan("step")
        assert scan.p_value > 1e-3
        assert scan.gain < 20


def test_block_means_of_the_effect_are_gone():
    now = comparison(SIZE[:, None] * (T >= 9000).double() * 4)
    finding = best(now)
    left = block_means(finding.effect.remove(now.recording, now.info))
    assert float((left[0, 150:].mean() - left[0, :130].mean()).abs()) < 0.3


def test_a_slow_course_has_to_stand_out_of_noise_that_was_found_later():
    """A step is seen beside the simulation's noise, and of a walk of that size one in some records has as much."""
    effect = 0.5 * (T > N / 2)
    seen = comparison(effect)
    found = Step.detect_and_fit(seen, LEVEL)
    assert found is not None
    assert found.effect.is_seen(seen)
    walk = gf.RandomWalk(1e-2).simulate(N, batch=(3, SENSORS), generator=generator(5)).double()
    louder = Comparison.of(seen.info, seen.recording, noise(101, 3) + walk)
    assert not found.effect.is_seen(louder)
