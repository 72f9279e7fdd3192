"""Clocks that differ: slopes and steps of the phase of a shared tone, against direct sums, size, power and limits."""

from __future__ import annotations

import math
import sys

import pytest
import torch
from mismatch_draws import normal
from scipy import signal, stats

import gyrofuse as gf
from gyrofuse.mismatch.detectors.lines.clocks import clock_test, strongest_slip
from gyrofuse.mismatch.detectors.lines.demodulation import BLOCKS, best_slope, demodulated
from gyrofuse.mismatch.detectors.spectra.band_tests import line_test
from gyrofuse.mismatch.mechanisms.signals.clock import ClockSkew
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode
from gyrofuse.mismatch.mechanisms.spectra.bumps.resonance import Resonance
from gyrofuse.mismatch.selection.held_out import score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.filters import resampled
from gyrofuse.mismatch.signals.folds import sd_of_sum

N = 2**14
NOISE = gf.WhiteNoise(1.0) + gf.AR1(0.99, 1e-3)
TONE = 0.1817
LEVEL = 1e-4


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def comparison(g: torch.Generator, ahead: torch.Tensor, amplitude: float = 0.3, *, channel: bool = False) -> Comparison:
    """Four sensors with a tone, which `(sensor, time)` or fewer samples ahead of the others, and a simulation of it."""
    t = torch.arange(N, dtype=torch.float64)
    x = NOISE.simulate(N, batch=(2, 4), generator=g)
    turn = 2 * math.pi * torch.rand(2, 4, 1, generator=g, dtype=torch.float64)
    x[0] += amplitude * torch.cos(2 * math.pi * TONE * (t + ahead) + turn[0])
    x[1] += amplitude * torch.cos(2 * math.pi * TONE * t + turn[1])
    channels = {"acceleration": torch.cos(2 * math.pi * TONE * t)[None]} if channel else {}
    return Comparison.of(RecordingInfo(100.0, "deg/s", ("1", "2", "3", "4"), channels), x[0], x[1:])


def skewed(skew: float, *sensors: int) -> torch.Tensor:
    ahead = torch.zeros(4, N, dtype=torch.float64)
    ahead[list(sensors)] = skew * torch.arange(N, dtype=torch.float64)
    return ahead


def lost(losses: dict[int, int], *sensors: int) -> torch.Tensor:
    ahead = torch.zeros(4, N, dtype=torch.float64)
    for at, count in losses.items():
        ahead[list(sensors), at:] += count
    return ahead


def test_blocks_turn_with_the_tone_and_have_noise_of_one():
    g = generator(1)
    x = torch.randn(3, N, generator=g, dtype=torch.float64)
    z = demodulated(x, TONE)
    t = torch.arange(N, dtype=torch.float64)
    block = N // BLOCKS
    here = slice(7 * block, 8 * block)
    angle = 2 * math.pi * TONE * t[here]
    direct = torch.linalg.lstsq(torch.stack([angle.cos(), angle.sin()], 1), x[1, here, None]).solution[:, 0]
    scale = z[1, 7] / torch.complex(direct[0], -direct[1])
    assert abs(scale.imag) < 1e-9
    assert abs(float(scale.real) * 2 / math.sqrt(block) - 1) < 0.1
    assert abs(float(z.abs().square().mean()) - 1) < 5 / math.sqrt(3 * BLOCKS)


def test_the_best_slope_is_the_frequency_of_the_tone():
    t = torch.arange(N, dtype=torch.float64)
    g = generator(2)
    x = torch.cos(2 * math.pi * (TONE + 1.234 / N) * t)[None] + 0.1 * torch.randn(1, N, generator=g).double()
    slope, energy = best_slope(demodulated(x, TONE))
    assert abs(slope - 1.234) < 0.01
    assert abs(energy / (N / 4 / 0.01) - 1) < 0.2


@pytest.mark.statistical
@pytest.mark.parametrize("channel", [False, True])
def test_one_clock_does_not_slip(channel, draws):
    g, n_runs = generator(3), draws(20, 40)
    values = [clock_test(comparison(g, torch.zeros(4, N), channel=channel)).p_value for _ in range(n_runs)]
    hits = sum(p < 0.05 for p in values)
    assert stats.binom.sf(hits - 1, n_runs, 0.05) > 1e-3, f"{hits} of {n_runs}"
    assert min(values) > 1e-4


@pytest.mark.statistical
@pytest.mark.parametrize("channel", [False, True])
def test_a_skew_is_found_in_its_sensors_with_limits_that_hold(channel):
    g, held, n_runs, true = generator(4), 0, 15, 80e-6
    for _ in range(n_runs):
        finding = ClockSkew.detect_and_fit(comparison(g, skewed(true, 2), channel=channel), LEVEL)
        assert finding.sensors == (2,)
        assert finding.channel == ("acceleration" if channel else None)
        entry = finding.parameters["skew"]
        held += entry.low <= 1e6 * true <= entry.high
    assert stats.binom.cdf(held, n_runs, 0.95) > 1e-3, f"{held} of {n_runs}"
    assert "sensor 3 differs by" in finding.sentence


def test_lost_samples_are_counted_and_found_in_time():
    g, n_runs, right, held = generator(5), 10, 0, 0
    true = {N // 3: 1, 3 * N // 5: 2}
    for _ in range(n_runs):
        finding = ClockSkew.detect_and_fit(comparison(g, lost(true, 0, 3), channel=True), LEVEL)
        assert finding.sensors == (0, 3)
        right += finding.parameters["lost"].value == 3
        for j, at in enumerate(true):
            entry = finding.parameters.get(f"time_of_loss_{j + 1}")
            held += entry is not None and entry.low <= at / 100 <= entry.high
    assert right >= 9
    assert stats.binom.cdf(held, 2 * n_runs, 0.95) > 1e-3, f"{held} of {2 * n_runs}"


@pytest.mark.parametrize("losses", [{5000: 1}, {4000: 2, 9000: 1}])
def test_what_all_lose_at_once_is_told_by_the_simulation_s_tone(losses):
    case = comparison(generator(61), lost(losses, 0, 1, 2, 3), 0.6)
    slip = strongest_slip(case)
    assert slip.p_value < 1e-12
    assert (slip.sensors, [loss.count for loss in slip.losses]) == ((0, 1, 2, 3), list(losses.values()))
    found = ClockSkew.detect_and_fit(case, LEVEL)
    assert "against a tone at 18.17 Hz that keeps its phase" in found.sentence
    assert all(abs(at - true) < 200 for (at, _), true in zip(found.effect.losses, losses, strict=True))
    after = found.repair(case, generator(1))
    assert clock_test(after).p_value > LEVEL
    assert line_test(after).p_value > LEVEL


def test_many_losses_of_all_sensors_are_one_finding():
    """More than are found at once, and more at a time: what is left once some are made room for is added to them."""
    losses = {2000: 7, 5000: 12, 8000: 31, 11000: 5, 14000: 9}
    case = comparison(generator(62), lost(losses, 0, 1, 2, 3), 2.0)
    found = ClockSkew.detect_and_fit(case, LEVEL)
    assert len(found.effect.losses) == len(losses)
    assert all(abs(at - true) < 20 for (at, _), true in zip(found.effect.losses, losses, strict=True))
    after = found.repair(case, generator(1))
    assert clock_test(after).p_value > LEVEL
    assert line_test(after).p_value > LEVEL


def test_a_slow_tone_tells_as_well(monkeypatch):
    """Of hardly more than a cycle in a block."""
    monkeypatch.setattr(sys.modules[__name__], "TONE", 1.1 * BLOCKS / N)
    finding = ClockSkew.detect_and_fit(comparison(generator(10), skewed(4e-4, 1), 0.5), LEVEL)
    assert finding.sensors == (1,)
    assert finding.parameters["skew"].low < 400 < finding.parameters["skew"].high


def test_samples_lost_by_one_sensor_need_no_channel():
    finding = ClockSkew.detect_and_fit(comparison(generator(6), lost({N // 2: 1}, 1)), LEVEL)
    assert finding.sensors == (1,)
    assert abs(finding.time_s - N / 200) < 2


@pytest.mark.parametrize("true", [{5003: 1}, {3001: 1, 4000: 1, 9777: 1, 12345: 1}, {2222: 2, 10001: 1}])
@pytest.mark.parametrize("amplitude", [2.0, 6.0])
def test_a_loud_tone_tells_losses_to_a_few_samples(true, amplitude):
    """And nothing else is left: a tone of so many nats, an interval wrong, would be a tone of its own."""
    g = generator(len(true))
    both = comparison(g, lost(true, 1), amplitude, channel=True)
    finding = ClockSkew.detect_and_fit(both, LEVEL)
    assert finding.sensors == (1,)
    assert finding.parameters["lost"].value == sum(true.values())
    assert [count for _, count in finding.effect.losses] == list(true.values())
    for (at, _), expected in zip(finding.effect.losses, true, strict=True):
        assert abs(at - expected) <= 6 / amplitude + 1
    left = finding.repair(both, g)
    assert clock_test(left).p_value > 1e-3
    assert line_test(left).p_value > 1e-3


def test_of_many_sensors_those_of_one_clock_are_one_finding():
    g, n_sensors = generator(9), 12
    t = torch.arange(N, dtype=torch.float64)
    ahead = torch.zeros(n_sensors, N, dtype=torch.float64)
    ahead[[2, 5, 11], N // 3 :] += 1
    ahead[[2, 5, 11], N // 2 :] += 1
    x = NOISE.simulate(N, batch=(2, n_sensors), generator=g)
    x[0] += torch.cos(2 * math.pi * TONE * (t + ahead))
    x[1] += torch.cos(2 * math.pi * TONE * t)
    info = RecordingInfo(
        100.0, "deg/s", tuple(map(str, range(n_sensors))), {"acceleration": torch.cos(2 * math.pi * TONE * t)[None]}
    )
    finding = ClockSkew.detect_and_fit(Comparison.of(info, x[0], x[1:]), LEVEL)
    assert finding.sensors == (2, 5, 11)
    assert finding.parameters["lost"].value == 2


@pytest.mark.parametrize("ahead", [skewed(80e-6, 1), lost({5000: 1, 11000: 1}, 1)])
def test_what_was_found_is_put_right_and_confirmed(ahead):
    g = generator(7)
    both = comparison(g, ahead, channel=True)
    effect = ClockSkew.detect_and_fit(both, LEVEL).effect
    gain = score_held_out(both, effect)
    assert gain.total > 3 * sd_of_sum(gain.blocks)
    assert clock_test(effect.repair(both, g)).p_value > 0.01
    assert clock_test(both.with_recording(effect.remove(both.recording, both.info))).p_value > 0.01


def test_removed_undoes_simulated():
    g = generator(8)
    smooth = gf.AR1(0.9, 1.0).simulate(N, batch=(4,), generator=g)
    smooth = torch.fft.irfft(torch.fft.rfft(smooth)[:, : N // 8], n=N)
    info = RecordingInfo(100.0, "deg/s", ("1", "2", "3", "4"))
    none = torch.zeros(2, dtype=torch.complex128)
    skew = ClockSkew((0, 2), 50e-6, (), TONE, none, none)
    back = skew.remove(skew.apply(smooth, info, g), info)
    assert (back - smooth)[:, 100:-100].abs().max() < 1e-3 * smooth.std()
    assert torch.equal(back[1], smooth[1])
    drop = ClockSkew((0, 2), 0.0, ((4000, 3),), TONE, none, none)
    dropped = drop.apply(smooth, info, g)
    assert torch.allclose(dropped[0, 4000 : N - 3], smooth[0, 4003:])
    back = drop.remove(dropped, info)
    keep = torch.ones(N, dtype=torch.bool)
    keep[4000:4003] = False
    keep[-3:] = False
    assert torch.allclose(back[:, keep], smooth[:, keep])


def test_resampling_is_exact_at_samples_and_right_between():
    t = torch.arange(400, dtype=torch.float64)
    tone = torch.cos(0.9 * t)[None]
    assert torch.allclose(resampled(tone, t + 2)[:, :398], tone[:, 2:])
    between = resampled(tone, t + 0.37)[0, 50:-50]
    assert (between - torch.cos(0.9 * (t + 0.37))[50:-50]).abs().max() < 1e-3


def test_without_a_shared_tone_nothing_is_said():
    g = generator(9)
    x = NOISE.simulate(N, batch=(2, 4), generator=g)
    both = Comparison.of(RecordingInfo(100.0, "deg/s", ("1", "2", "3", "4")), x[0], x[1:])
    assert strongest_slip(both) is None
    assert clock_test(both).p_value == 1.0


def test_what_rings_tells_no_time():
    """A mode nearly as narrow as a line, built in where the recording has a tone for some of the time."""
    g, t = generator(30), torch.arange(N, dtype=torch.float64)
    x = NOISE.simulate(N, batch=(3, 2), generator=g).double()
    on = ((t > 2000) & (t < 4000) | (t > 9000) & (t < 12000)).double()
    x[0] += torch.tensor([[1.0], [0.6]]) * on * torch.cos(2 * math.pi * TONE * t)
    given = Comparison.of(RecordingInfo(100.0, "deg/s", ("1", "2")), x[0], x[1:])
    gain = torch.tensor([0.5, 0.3], dtype=torch.complex128)
    rung = Resonance(Mode(TONE, 1.5 / N, gain, True)).repair(given, g)
    assert clock_test(rung).p_value > 1e-3


@pytest.mark.parametrize("wanders", [1e-5, 5e-6])
def test_a_tone_that_wanders_in_all_sensors_alike_slips_in_none(wanders: float):
    """The mains' frequency wanders by some mHz: phases of their own, and one course for all."""
    n, rate, g = 32_768, 1000.0, torch.Generator().manual_seed(3)
    wander = torch.from_numpy(signal.lfilter([1.0], [1, -math.exp(-1 / 20_000)], normal(n, g=g).numpy()))
    phase = 2 * math.pi * torch.cumsum(0.05 + wanders * wander / wander.std(), 0)
    turns = 2 * math.pi * torch.rand(3, 1, generator=g, dtype=torch.float64)
    given = Comparison.of(
        RecordingInfo(rate, "deg/s", ("1", "2", "3")),
        normal(3, n, g=g) + 0.8 * (phase + turns).sin(),
        normal(1, 3, n, g=g),
    )
    assert clock_test(given).p_value > 1e-3
