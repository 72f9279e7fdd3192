"""Knocks after which something rings: found, measured, told from what looks like them, taken off and drawn again."""

from __future__ import annotations

import math

import pytest
import torch
from bounds import at_most
from matplotlib.figure import Figure
from mismatch_draws import normal
from scipy import signal
from slow_cases import slow_but_for
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.detectors.lines.ring_cells import in_another_order, p_value_beside
from gyrofuse.mismatch.detectors.lines.ring_downs import ring_down_test, scanned_ring_downs
from gyrofuse.mismatch.likelihoods.damped_tone import DampedTone, Surroundings
from gyrofuse.mismatch.mechanisms.transients.ring_down import RingDown
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.stats.multiplicity import p_value_beyond_largest

N, RATE = 8192, 200.0
GAINS = torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def struck(onset: float, frequency: float, tau: float) -> Tensor:
    """An oscillator that is struck while it is at rest, `(time,)`; onset and time constant in samples."""
    since = (torch.arange(N, dtype=torch.float64) - onset).clamp(min=0)
    return torch.exp(-since / tau) * torch.sin(2 * math.pi * frequency * since)


def of_nats(path: Tensor, nats: float) -> Tensor:
    """In three sensors of white noise of variance one, `(sensor, time)`."""
    signal = GAINS[:, None] * path
    return signal * math.sqrt(2 * nats / float(signal.square().sum()))


def compared(effect: Tensor, seed: int) -> Comparison:
    g = generator(seed)
    return Comparison.of(
        RecordingInfo(RATE, "deg/s", ("1", "2", "3")), normal(3, N, g=g) + effect, normal(4, 3, N, g=g)
    )


def test_noise_rings_as_often_as_its_p_value_says():
    g, n_runs = generator(1), 200
    p_values = [scanned_ring_downs(normal(p, 4096, g=g)).p_value for p in (1, 3) for _ in range(n_runs // 2)]
    for level in (0.1, 0.01):
        assert sum(p < level for p in p_values) <= at_most(n_runs, level)


@pytest.mark.parametrize("kind", ["Laplace", "wanders"])
def test_noise_of_both_that_is_heavy_tailed_or_wanders_rings_no_more_often(kind: str):
    """By Ville's bound alone one in three of those that wander has a p value below a hundredth."""
    g, n_runs, p, n = generator(8), 16, 2, 4096

    def drawn() -> Tensor:
        if kind == "Laplace":
            return normal(p, n, g=g) * (-torch.rand(p, n, generator=g, dtype=torch.float64).log()).sqrt()
        steadiness = math.exp(-1 / 200)
        course = signal.lfilter([math.sqrt(1 - steadiness**2)], [1, -steadiness], normal(p, n, g=g).numpy())
        return normal(p, n, g=g) * torch.from_numpy(course / 2).exp()

    records = [drawn() for _ in range(n_runs)]
    scans = [(scanned_ring_downs(one), scanned_ring_downs(in_another_order(one))) for one in records]
    p_values = [
        p_value_beside(own, other, disordered) for own, disordered in scans for other, _ in scans if own is not other
    ]
    assert sum(p < 0.01 for p in p_values) <= 0.02 * len(p_values)
    assert min(p_values) > 1e-4


@pytest.mark.slow
def test_a_line_that_wanders_and_comes_and_goes_is_no_knock_and_hides_none():
    n, n_runs, alarms = 65536, 8, 0
    t, steadiness = torch.arange(n, dtype=torch.float64), math.exp(-1 / 500)
    there = torch.sin(2 * math.pi * t / 8000).clamp(min=0)
    angle = 2 * math.pi * (0.18 * t + 12.7 * torch.sin(2 * math.pi * t / 11000))  # within 4 % of 0.18
    since = (t - 20000).clamp(min=0)
    knock = 1.8 * torch.exp(-since / 300) * torch.sin(2 * math.pi * 0.09 * since)
    for seed in range(n_runs):
        g = generator(seed)
        noise = normal(3, n, g=g)
        drawn = signal.lfilter([math.sqrt(1 - steadiness**2)], [1, -steadiness], normal(2, n, g=g).numpy())
        a, b = torch.from_numpy(drawn)
        noise[2] += 0.6 * there * (a * angle.cos() - b * angle.sin())
        alarms += scanned_ring_downs(noise).p_value < 0.01
        noise[1] += knock
        found = scanned_ring_downs(noise)
        assert found.p_value < 1e-6
        assert any(abs(cell.onset - 20000) < 100 and abs(cell.frequency - 0.09) < 0.005 for cell in found.cells[:8])
    assert alarms <= 3  # where the strong ones of eight spells all come at once, by chance


def test_the_picture_shows_the_knock_of_the_sentence():
    """Even where another one, which the other sensors do not have, is larger in the same sensor."""
    both = of_nats(struck(1500.3, 0.15, 60.0), 200.0)
    both[0] += 1.15 * both[0].abs().max() * struck(5000.8, 0.3, 60.0)
    comparison = compared(both, 2)
    found = RingDown.detect_and_fit(comparison, 1e-3)
    assert found is not None
    assert found.time_s == pytest.approx(1500 / RATE, abs=0.05)
    assert found.effect.amplitude[:, 0].argmax() == 1
    ax = Figure().subplots()
    found.effect.plot(comparison, ax, sensor=0, fitted=True)
    shown = ax.lines[0].get_xdata()
    assert shown[0] < found.time_s < shown[-1] < 5000 / RATE


@pytest.mark.parametrize(("frequency", "tau"), [(0.04, 60.0), (0.15, 25.0), (0.33, 120.0), (0.42, 12.0)])
def test_knocks_are_found_and_measured(frequency: float, tau: float):
    path = struck(1500.3, frequency, tau) - 0.8 * struck(5000.8, frequency, tau)
    found = RingDown.detect_and_fit(compared(of_nats(path, 300.0), 2), 1e-3)
    assert found is not None
    assert isinstance(found.effect, RingDown)
    assert found.sensors == (0, 1, 2)
    assert len(found.effect.knocks) == 2
    onsets = (found.effect.onset_s * RATE).sort().values.tolist()
    assert onsets == pytest.approx([1500.3, 5000.8], abs=3)
    for name, truth in (("frequency", frequency * RATE), ("decay_time", tau / RATE)):
        value, low, high, _ = found.parameters[name]
        assert abs(truth - value) < 2 * (high - low) / 2, name
    hours = N / RATE / 3600
    assert found.parameters["rate"].value == pytest.approx(2 / hours)
    # Exact Poisson limits of two events.
    assert found.parameters["rate"].low * hours == pytest.approx(0.2422, abs=1e-3)
    assert found.parameters["rate"].high * hours == pytest.approx(7.2247, abs=1e-3)


def test_a_very_loud_knock_is_one_too():
    """Over the level that it makes itself it hardly dies away."""
    knock = of_nats(struck(3000.0, 0.107, 140.0), 2e5) * torch.tensor([[1.0], [0.0], [0.0]], dtype=torch.float64)
    found = RingDown.detect_and_fit(compared(knock, 4), 1e-3)
    assert found is not None
    assert isinstance(found.effect, RingDown)
    assert abs(found.parameters["frequency"].value / RATE - 0.107) < 1e-4
    assert len(found.effect.knocks) == 1


def test_modes_that_set_in_together_are_one_knock():
    path = struck(3000.0, 0.11, 40.0) + 0.8 * struck(3000.0, 0.27, 40.0)
    found = RingDown.detect_and_fit(compared(of_nats(path, 500.0), 3), 1e-3)
    assert found is not None
    assert isinstance(found.effect, RingDown)
    assert len(found.effect.onset_s) == 2
    assert len(found.effect.knocks) == 1


def test_a_mode_that_is_struck_again_before_it_has_died_away_is_two_knocks_of_one_frequency():
    path = struck(3000.0, 0.384, 128.0) - 0.9 * struck(3583.4, 0.384, 128.0)
    strong = of_nats(path, 20_000.0) * torch.tensor([[1.0], [0.0], [0.0]], dtype=torch.float64)
    found = RingDown.detect_and_fit(compared(strong, 5), 1e-3)
    assert found is not None
    assert isinstance(found.effect, RingDown)
    onsets = (found.effect.onset_s * RATE).sort().values.tolist()
    assert onsets == pytest.approx([3000.0, 3583.4], abs=3)
    assert (found.effect.decay_s * RATE).tolist() == pytest.approx([128.0, 128.0], rel=0.1)
    assert (found.effect.frequency_hz / RATE).tolist() == pytest.approx([0.384, 0.384], abs=2e-4)


@pytest.mark.slow
def test_many_knocks_of_one_mode_are_each_found():
    """Seen from afar they are a line that comes and goes."""
    g = generator(9)
    onsets = (200 + 300 * torch.arange(24) + 200 * torch.rand(24, generator=g)).tolist()
    path = sum((0.4 + float(torch.rand((), generator=g))) * struck(onset, 0.155, 24.0) for onset in onsets)
    assert isinstance(path, Tensor)
    comparison = compared(20 * GAINS[:, None] * path, 9)
    found = RingDown.detect_and_fit(comparison, 1e-3)
    assert found is not None
    assert isinstance(found.effect, RingDown)
    known = found.effect.onset_s * RATE
    assert sum(float((known - onset).abs().min()) < 3 for onset in onsets) >= 20


def test_modes_that_beat_seem_to_grow():
    path = struck(3000.0, 0.2, 60.0) - struck(3000.0, 0.206, 60.0)
    found = RingDown.detect_and_fit(compared(of_nats(path, 2000.0), 4), 1e-3)
    assert found is not None
    assert isinstance(found.effect, RingDown)
    assert len(found.effect.knocks) == 1
    left = found.effect.remove(of_nats(path, 2000.0), RecordingInfo(RATE, "deg/s", ("1", "2", "3")))
    assert float(left.square().sum()) < 0.03 * 4000


def others(kind: str, g: torch.Generator) -> Tensor:
    """What is no ring-down, `(sensor, time)`."""
    t = torch.arange(N, dtype=torch.float64)
    if kind == "spike":
        return of_nats((t == 3000).to(torch.float64), 2000.0)
    if kind == "step":
        return of_nats((t > 3000).to(torch.float64), 2000.0)
    if kind == "louder":
        return 4 * normal(3, N, g=g) * ((t > 3000) & (t < 3100))
    if kind == "tone":
        return of_nats(torch.sin(2 * math.pi * 0.13 * t), 2000.0)
    if kind == "swelling":
        return of_nats(torch.exp(-((t - 3000) / 40).square()) * torch.sin(2 * math.pi * 0.13 * t), 300.0)
    steps = torch.nn.functional.interpolate(normal(1, 1, 40, g=g), N, mode="linear")[0, 0]
    return of_nats(torch.sin(2 * math.pi * (0.2 * t + (0.01 * steps).cumsum(-1))), 2000.0)


LIKE_ONE = ("spike", "step", "louder", "tone", "swelling", "wandering tone")


@pytest.mark.parametrize("kind", slow_but_for(("step",), LIKE_ONE))
def test_what_looks_like_one_has_another_name(kind: str):
    for seed in range(2):
        g = generator(seed)
        signal = normal(3, N, g=g) + others(kind, g)
        model = gf.ArrayModel.from_sensors([gf.Model([gf.WhiteNoise(1.0)])] * 3)
        report = gf.diagnose(gf.Recording(signal, rate=RATE, unit="deg/s"), model)
        assert report.mismatch
        assert "ring_down" not in [finding.mechanism for finding in report.findings]


def test_what_the_simulation_has_itself_is_no_mismatch():
    g = generator(5)
    both = [normal(3, N, g=g) + of_nats(struck(at, 0.2, 40.0), 400.0) for at in (2000.0, 6000.0)]
    given = Comparison.of(RecordingInfo(RATE, "deg/s", ("1", "2", "3")), both[0], both[1][None])
    assert ring_down_test(given).p_value > 0.05


def test_samples_that_are_held_out_confirm_a_knock_and_no_noise():
    comparison = compared(of_nats(struck(3000.0, 0.2, 40.0), 100.0), 6)
    found = RingDown.detect_and_fit(comparison, 1e-3)
    assert found is not None

    def held_out(effect: RingDown, given: Comparison) -> float:
        folds = (effect.fit_without(given, fold).held_out_scores(given, fold) for fold in range(4))
        return float(torch.stack(list(folds)).sum())

    assert isinstance(found.effect, RingDown)
    assert held_out(found.effect, comparison) > 60
    noise = compared(torch.zeros(3, N, dtype=torch.float64), 7)
    around = Surroundings.of(noise.recording, noise.base, 3000, 40.0)
    by_chance = RingDown.of([around.fitted(DampedTone(3000, 0.2, 40.0))], noise)
    assert held_out(by_chance, noise) < 3


def test_a_repaired_simulation_has_knocks_at_random():
    model = gf.ArrayModel.from_sensors([gf.Model([gf.WhiteNoise(1.0)])] * 3)
    signal = normal(3, N, g=generator(8)) + of_nats(struck(3000.0, 0.2, 40.0) + struck(6000.0, 0.2, 40.0), 4000.0)
    report = gf.diagnose(gf.Recording(signal, rate=RATE, unit="deg/s"), model)
    assert [finding.mechanism for finding in report.findings] == ["ring_down"]
    assert report.held_out.after < 1.3 < report.held_out.before
    loudest = report.model.simulate(N, batch=(40,), generator=generator(9)).abs().amax((-1, -2))
    # Of two in a record on the average, none has a probability of 14 %.
    assert 0.6 < float((loudest > 7).to(torch.float64).mean()) < 1


def test_several_log_ratios_together_are_rarer_than_the_largest():
    """Of exponential tails: never more often than the p value says, in 2000 records of 1000 cells."""
    g, n_runs = generator(9), 2000
    cells = -torch.rand(n_runs, 2, 1000, generator=g, dtype=torch.float64).log()
    largest = cells.topk(40).values
    p_values = torch.tensor([p_value_beyond_largest(own, other) for own, other in largest])
    for level in (0.1, 0.01):
        assert int((p_values < level).sum()) <= at_most(n_runs, level)
    other, knocks = largest[0, 1], torch.tensor([22.0, 21.0, 20.0, 19.0], dtype=torch.float64)
    assert p_value_beyond_largest(knocks, other) < p_value_beyond_largest(knocks[:1], other) / 10


def test_a_bias_that_is_lost_and_found_rings_no_more_than_a_step():
    """Two tones, or two knocks, fitted to a step at the end of a gap: none of them goes up and down."""
    path = torch.zeros(N, dtype=torch.float64)
    path[3000:] = 1.0
    path[3000:3060] = -2.5
    found = RingDown.detect_and_fit(compared(3.0 * GAINS[:, None] * path, 12), 1e-3)
    assert found is None or float((found.effect.frequency_hz * found.effect.decay_s).min()) >= 0.3
