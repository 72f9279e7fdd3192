"""What no mechanism stands for: noise that goes up and down or is heavy-tailed throughout, sweeps, loops."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from mismatch_draws import LEVEL, even, normal
from scipy import integrate, stats
from torch import Tensor

from gyrofuse import AR1, RandomWalk, WhiteNoise
from gyrofuse.mismatch.detectors.moving import chirps as sweeps
from gyrofuse.mismatch.detectors.slow import hysteresis
from gyrofuse.mismatch.detectors.variance import modulation, noise_level
from gyrofuse.mismatch.detectors.variance import outliers as impulses
from gyrofuse.mismatch.likelihoods.laws import outlier_law as outliers
from gyrofuse.mismatch.likelihoods.laws.heavy_tails import HeavyTails, heavy_tailed
from gyrofuse.mismatch.mechanisms.regimes.spikes import Spikes
from gyrofuse.mismatch.mechanisms.regimes.variance_change import VarianceChange
from gyrofuse.mismatch.mechanisms.spectra import joint_fit as shapes
from gyrofuse.mismatch.mechanisms.spectra.bumps import oscillation as oscillating
from gyrofuse.mismatch.mechanisms.spectra.bumps.resonance import Resonance
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_tone import DriftingTone
from gyrofuse.mismatch.mechanisms.spectra.common_source import CommonMode
from gyrofuse.mismatch.mechanisms.spectra.parameter_change import ParameterShift
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.stats import segments as episodes

N, P, RATE = 2**14, 3, 100.0
NOISE = WhiteNoise(1.0) + AR1(0.999, 1e-4) + RandomWalk(1e-8)


def drawn(seed: int) -> tuple[Tensor, Tensor, torch.Generator]:
    g = torch.Generator().manual_seed(seed)
    return NOISE.simulate(N, batch=(P,), generator=g), NOISE.simulate(N, batch=(2, P), generator=g), g


def info(**channels: Tensor) -> RecordingInfo:
    return RecordingInfo(RATE, "deg/s", ("x", "y", "z"), channels)


def louder(recording: Tensor, log_sd: Tensor) -> Tensor:
    """With white noise that has `exp(log_sd)` times its standard deviation."""
    fast = recording - torch.nn.functional.avg_pool1d(recording, 65, 1, 32)
    return recording + fast * log_sd.expm1()


# Modulated noise.


def test_powers_are_those_of_the_definition() -> None:
    g = torch.Generator().manual_seed(0)
    squares = normal(1, 4096, g=g).square().clamp(max=9)
    found = modulation.strongest_modulation(squares)
    x = squares[0].numpy()
    x = (x - x.mean()) / x.std()
    power = np.abs(np.fft.rfft(x, n=8192)) ** 2 / 4096
    places = 2 * 2 * 0.8 * 4096  # lines or bands, one sensor or all
    best = min(stats.gamma.sf(power[8:-2].max(), 1) * places, 1.0)
    if found.period:
        assert found.p_value == pytest.approx(-math.expm1(-best), rel=0.02)
        assert found.low == pytest.approx(np.argmax(power[8:-2] + 8) / 8192, abs=1e-3)
    else:
        k = [round(f * 4096) for f in (found.low, found.high)]
        total = power[2 * k[0] : 2 * k[1] + 1 : 2].sum()
        own = stats.gamma.sf(total, k[1] - k[0] + 1) * 2 * 2 * 22
        assert found.p_value == pytest.approx(-math.expm1(-own), rel=0.1)


@pytest.mark.parametrize("p", [2, 8, 9, 12, 17])
def test_modulation_names_its_sensors_however_many_there_are(p: int) -> None:
    """Beyond eight sensors not all sets of them are tried."""
    generator = torch.Generator().manual_seed(p)
    squares = torch.randn(p, 4096, generator=generator, dtype=torch.float64).square()
    level = 1 + 0.4 * torch.cos(2 * math.pi * 0.1 * torch.arange(4096))
    for sensors in ((p - 1,), tuple(range(p))):
        louder = squares.clone()
        louder[list(sensors)] *= level
        found = modulation.strongest_modulation(louder)
        assert found.period
        assert found.sensors == sensors


def test_noise_with_a_period_is_seen_and_has_no_name() -> None:
    recording, simulation, _ = drawn(1)
    t = torch.arange(N, dtype=torch.float64)
    comparison = Comparison.of(info(), louder(recording, 0.1 * torch.sin(2 * math.pi * 0.0371 * t)), simulation)
    found = noise_level.variance_test(comparison)
    assert found.p_value < 1e-6
    assert found.frequency_hz == pytest.approx(3.71, abs=0.01)
    assert VarianceChange.detect_and_fit(comparison, LEVEL) is None
    assert Spikes.detect_and_fit(comparison, LEVEL) is None


def test_noise_that_wanders_is_seen_and_has_no_episode() -> None:
    recording, simulation, g = drawn(2)
    wander = AR1(0.997, 0.15**2 * (1 - 0.997**2)).simulate(N, generator=g)
    comparison = Comparison.of(info(), louder(recording, wander), simulation)
    assert noise_level.variance_test(comparison).p_value < 1e-6
    assert VarianceChange.detect_and_fit(comparison, LEVEL) is None


@pytest.mark.parametrize("seed", [700, 701])
def test_noise_that_wanders_slowly_is_no_episode_of_another_level(seed: int) -> None:
    """Louder for a while and nowhere as the simulation: one episode, and other numbers, would say as much."""
    recording, simulation, g = drawn(seed)
    phi = math.exp(-10 / N)
    wander = AR1(phi, 0.07**2 * (1 - phi**2)).simulate(N, generator=g)
    comparison = Comparison.of(info(), louder(recording, wander), simulation)
    assert noise_level.variance_test(comparison).p_value < 1e-6
    assert VarianceChange.detect_and_fit(comparison, LEVEL) is None


def test_noise_that_a_simulation_modulates_as_well_is_not_missing() -> None:
    recording, simulation, _ = drawn(3)
    wave = 0.1 * torch.sin(2 * math.pi * 0.0371 * torch.arange(N, dtype=torch.float64))
    comparison = Comparison.of(
        info(), louder(recording, wave), louder(simulation.flatten(0, 1), wave).view_as(simulation)
    )
    assert noise_level.modulation(comparison).p_value > 0.01


def test_witnesses_are_honest() -> None:
    low = np.zeros(3)
    for seed in range(10):
        recording, simulation, g = drawn(100 + seed)
        common = normal(1, N, g=g)
        recording, simulation = recording + common, simulation + normal(2, 1, N, g=g)
        t = torch.arange(N, dtype=torch.float64) / N
        comparison = Comparison.of(info(temperature=20 + torch.sin(14 * t + seed)), recording, simulation)
        values = (
            noise_level.modulation(comparison).p_value,
            sweeps.chirp_test(comparison).p_value,
            hysteresis.hysteresis_test(comparison).p_value,
        )
        low += np.array(values) < 0.05
    # More than 3 of 10 at 5 % have probability 1e-3.
    assert (low <= 3).all(), low


# Heavy tails.


def test_heavy_tailed_laws_are_normalised() -> None:
    for law in (HeavyTails(False, 4.0, 0.8), HeavyTails(True, 0.6, 0.8)):
        total, _ = integrate.quad(lambda x, law=law: math.exp(law.log_density(np.array(x))), -60, 60)
        assert total == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("law", [HeavyTails(False, 4.0, 0.8), HeavyTails(True, 0.6, 0.8)])
def test_heavy_tailed_laws_are_normal_with_the_variances_that_they_draw(law: HeavyTails) -> None:
    g = torch.Generator().manual_seed(3)
    z = normal(200_000, g=g)
    spread = law.scale * math.sqrt(1 + 2 * law.shape**2 if law.laplace else law.shape / (law.shape - 2))
    drawn = spread * law.factors(z, g) * z
    again = HeavyTails.of_kind(law.laplace, drawn)
    assert abs(math.log(again.shape / law.shape)) < 4 * again.log_shape_sd(drawn) < 0.2
    assert HeavyTails.fitted(drawn).laplace is law.laplace


def with_laplace(seed: int, size: float) -> Comparison:
    """Part of the white noise is a Laplace variable's, of `size` sd."""
    recording, simulation, g = drawn(seed)
    u = even(P, N, g=g) - 0.5
    laplace = -u.sign() * torch.log1p(-2 * u.abs()) / math.sqrt(2)
    return Comparison.of(info(), math.sqrt(1 - size**2) * recording + size * laplace, simulation)


@pytest.mark.parametrize(("size", "p_value"), [(0.8, 1e-30), (0.5, 1e-3)])
def test_noise_that_is_heavy_tailed_throughout_is_seen_and_is_no_spikes(size: float, p_value: float) -> None:
    """A law of outliers has two numbers more a sensor than one of heavy tails, and by chance gains more for them."""
    for comparison in (with_laplace(30 + seed, size) for seed in range(4, 14)):
        assert impulses.outliers_test(comparison).p_value < p_value
        assert Spikes.detect_and_fit(comparison, LEVEL) is None


def test_a_few_outliers_are_no_other_law_of_all_noise() -> None:
    g = torch.Generator().manual_seed(5)
    z = normal(N, g=g)
    rare = z + (even(N, g=g) < 1e-3) * 5.0
    law = outliers.fitted(rare)
    gain = float((outliers.mixture(rare, law) - outliers.free_gaussian(rare)).sum())
    assert gain > heavy_tailed(rare) + 10
    assert heavy_tailed(z) < 4  # half a chi-square but for one in a thousand


# Starts, stops and factors.


def test_limits_of_an_episode_hold() -> None:
    inside = np.zeros(3)
    for seed in range(40):
        g = torch.Generator().manual_seed(seed)
        start, stop, factor = 4000 + 37 * seed, 9000 + 53 * seed, 1.25
        white = normal(2, N, g=g)
        white[:, start:stop] *= math.sqrt(factor)
        found = episodes.episodes_of(white)
        assert found is not None
        told = episodes.first_segment_posterior(white, found.episodes)
        reach = 2 * told.log_factor_sd
        inside += [
            told.start.low <= start <= told.start.high,
            told.stop.low <= stop <= told.stop.high,
            bool(((told.log_factor - math.log(factor)).abs() < reach).double().mean() > 0.5),
        ]
    # Fewer than 33 of 40 at 95 % have probability 3e-4.
    assert (inside >= 33).all(), inside


def test_the_posterior_of_an_episode_is_that_of_every_start_and_stop() -> None:
    g = torch.Generator().manual_seed(1)
    white = normal(1, 150, g=g)
    white[:, 60:110] *= 2.0
    told = episodes.first_segment_posterior(white, (episodes.Episode(60, 110),))
    x, n, tau = white[0].numpy().clip(-5, 5) ** 2, 150, 0.5
    weight = np.zeros((n + 1, n + 1))
    for a in range(n + 1):
        for b in range(a + 16, min(a + n - 16, n) + 1):
            m = b - a
            inner, outer = x[a:b].sum() / m, (x.sum() - x[a:b].sum()) / (n - m)
            gain = n / 2 * math.log(x.sum() / n) - m / 2 * math.log(inner) - (n - m) / 2 * math.log(outer)
            spread = tau**2 * m * (n - m) / (2 * n)
            weight[a, b] = math.exp(gain * spread / (1 + spread)) / math.sqrt(1 + spread)
    weight /= weight.sum()
    for limits, share in ((told.start, weight.sum(1)), (told.stop, weight.sum(0))):
        total = np.cumsum(share) - share / 2
        for value, q in zip(limits, (0.5, 0.025, 0.975), strict=True):
            assert total[int(value) - 1] - 0.002 < q <= total[int(value)] + 0.002


# Sweeps.


def test_a_line_that_moves_is_seen_with_either_sign() -> None:
    recording, simulation, _ = drawn(20)
    t = torch.arange(N, dtype=torch.float64)
    phase = 2 * math.pi * (0.1 * t + 0.3 * t.square() / (2 * N))
    gains = torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64)[:, None]
    comparison = Comparison.of(info(), recording + 0.17 * gains * phase.cos(), simulation)
    found = sweeps.chirp_test(comparison)
    assert found.p_value < 1e-4
    assert found.sensors == (0, 1)
    assert "from 10 Hz to 40 Hz" in found.words
    both = Comparison.of(info(), comparison.recording, simulation + 0.17 * gains * phase.cos())
    assert sweeps.chirp_test(both).p_value > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [0.3, 1.0])
def test_a_strong_sweep_is_no_resonance(amplitude: float, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, simulation, _ = drawn(21)
    t = torch.arange(N, dtype=torch.float64)
    phase = 2 * math.pi * (0.1 * t + 0.3 * t.square() / (2 * N))
    comparison = Comparison.of(info(), recording + amplitude * phase.cos(), simulation)
    named = (Resonance, DriftingTone, CommonMode, ParameterShift)
    assert [m.name for m in named if m.detect_and_fit(comparison, LEVEL) is not None] == []
    for module in (shapes, oscillating):  # it is the sweep that tells
        monkeypatch.setattr(module, "swept", lambda *_: False)
    assert any(m.detect_and_fit(comparison, LEVEL) is not None for m in named)


# Hysteresis.


def test_relays_switch_at_their_thresholds() -> None:
    temperature = torch.cat([torch.linspace(0, 1, 50), torch.linspace(1, 0, 50), torch.linspace(0, 1, 50)]).double()
    found = hysteresis.relays(temperature)
    assert len(found) > 20
    assert set(found.unique().tolist()) == {-1.0, 1.0}
    for path in found:
        (switches,) = (path.diff() != 0).nonzero(as_tuple=True)
        up, down = temperature[switches[0] + 1], temperature[switches[1] + 1]
        assert path[0] == -1
        assert down < up  # it goes back later than it came
    assert len(hysteresis.relays(torch.linspace(0, 1, 99, dtype=torch.float64))) == 0


def test_a_bias_that_depends_on_the_way_is_seen() -> None:
    recording, simulation, _ = drawn(30)
    t = torch.arange(N, dtype=torch.float64) / N
    temperature = 25 + 3 * torch.sin(2 * math.pi * 2.2 * t)
    up = hysteresis.relays(temperature[:: N // 256])
    path = up[len(up) // 2].repeat_interleave(N // 256)
    channels = {"temperature": temperature}
    assert hysteresis.hysteresis_test(Comparison.of(info(**channels), recording, simulation)).p_value > 0.01
    recording[1] += 0.25 * path
    found = hysteresis.hysteresis_test(Comparison.of(info(**channels), recording, simulation))
    assert found.p_value < 1e-3
    assert found.channel == "temperature"
    assert 1 in found.sensors
    assert hysteresis.hysteresis_test(Comparison.of(info(), recording, simulation)).p_value == 1.0


@pytest.mark.slow
def test_a_loop_of_all_sensors_is_no_noise_in_common() -> None:
    recording, simulation, _ = drawn(31)
    t = torch.arange(N, dtype=torch.float64) / N
    temperature = 25 + 3 * torch.sin(2 * math.pi * 2.2 * t)
    path = hysteresis.relays(temperature[:: N // 256])
    recording += 0.3 * path[len(path) // 2].repeat_interleave(N // 256)
    comparison = Comparison.of(info(temperature=temperature), recording, simulation)
    without = Comparison.of(info(), recording, simulation)
    assert CommonMode.detect_and_fit(without, 1e-3) is not None
    assert CommonMode.detect_and_fit(comparison, 1e-3) is None
    assert hysteresis.hysteresis_test(comparison).p_value < 1e-3
