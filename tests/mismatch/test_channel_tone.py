"""Tones whose frequencies follow a channel."""

from __future__ import annotations

import math
import re

import pytest
import torch
from scipy.signal import lfilter
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.detectors.moving.channel_tracks import as_it_moves, busiest, channel_track
from gyrofuse.mismatch.mechanisms.transients.carrier import Carrier
from gyrofuse.mismatch.mechanisms.transients.channel_tone import ChannelTone
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.signals.comparison import Comparison

N, P, RATE = 9_003, 2, 400.0
NOISE = gf.ArrayModel.from_sensors([gf.WhiteNoise(0.01 * (1 + i / 3)) + gf.AR1(0.99, 1e-6) for i in range(P)])


def wandering(g: torch.Generator, seconds: float, rows: int = 1) -> Tensor:
    """Rows `(row, time)` of variance one that forget in so many seconds."""
    phi = math.exp(-1 / (seconds * RATE))
    steps = torch.randn(rows, N, generator=g, dtype=torch.float64) * math.sqrt(1 - phi**2)
    return torch.from_numpy(lfilter([1.0], [1.0, -phi], steps.numpy()))


def tone(frequency: Tensor, size: Tensor | float) -> Tensor:
    return size * torch.sin(2 * math.pi * frequency.cumsum(-1) / RATE)


def sides(seed: int, effect: Tensor | float, channel: Tensor) -> tuple[gf.Recording, gf.Recording]:
    g = torch.Generator().manual_seed(seed)
    recorded, simulated = NOISE.simulate(N, generator=g), NOISE.simulate(2 * N, generator=g)
    return (
        gf.Recording(recorded + effect, rate=RATE, unit="deg/s", channels={"throttle": channel}),
        gf.Recording(simulated, rate=RATE, unit="deg/s"),
    )


def comparison(seed: int, effect: Tensor | float, channel: Tensor) -> Comparison:
    return prepared(*sides(seed, effect, channel), None, torch.Generator().manual_seed(0))


def throttle(seed: int) -> Tensor:
    return (0.5 + 0.1 * wandering(torch.Generator().manual_seed(seed), 3.0)[0]).clamp(0.1, 1.0)


SIZE = torch.tensor([[0.05], [0.03]], dtype=torch.float64)


def test_a_tone_that_follows_a_command_is_one_finding_with_its_law():
    u = throttle(1)
    report = gf.diagnose(*sides(1, tone(40 + 200 * u, SIZE * u.square() / 0.25), u))
    assert [f.mechanism for f in report.findings] == ["drifting_tone"]
    finding, middle = report.findings[0], 40 + 200 * float(u.median())
    assert finding.channel == "throttle"
    assert finding.sensors == (0, 1)
    law = r"follows throttle, \S+ Hz and \S+ Hz for each unit of it, its size growing as the square of it"
    assert re.search(law, str(report))
    for name, true in (("frequency", middle), ("slope", 200.0)):
        parameter = finding.parameters[name]
        assert parameter.value == pytest.approx(true, rel=1e-3)
        assert parameter.high - parameter.low < 1e-2 * true
    assert not report.unexplained
    assert report.held_out.before > 8 > 1.5 > report.held_out.after


@pytest.mark.slow
def test_the_repaired_simulation_follows_the_channel_of_another_recording():
    u, other = throttle(2), throttle(3)
    one, simulation = sides(2, tone(40 + 200 * u, SIZE), u)
    judge, _ = sides(3, tone(40 + 200 * other + 0.0, SIZE), other)
    report = gf.diagnose(one, simulation, judge=judge)
    assert report.judged is not None
    assert report.judged.before > 3 > 1.5 > report.judged.after
    drawn = report.model.simulate(N, channels={"throttle": other}, generator=torch.Generator().manual_seed(1))
    turned = drawn * torch.exp(-2j * math.pi * ((40 + 200 * other).cumsum(0) / RATE))
    size = 2 * turned.mean(-1).abs()  # none if the frequency were another one
    torch.testing.assert_close(size, SIZE[:, 0], rtol=0.15, atol=0.0)
    with pytest.raises(ValueError, match=r"`channels`: expected 9003 samples of throttle, .* got 100"):
        report.model.simulate(N, channels={"throttle": other[:100]})


@pytest.mark.slow
def test_two_motors_and_a_harmonic_are_told_apart():
    g = torch.Generator().manual_seed(4)
    command = (0.5 + 0.08 * wandering(g, 3.0) + 0.03 * wandering(g, 0.5, 2)).clamp(0.1, 1.0)
    lines = [tone(20 + 150 * u, SIZE) for u in command]
    harmonic = tone(2 * (20 + 150 * command[0]), SIZE / 2)
    found = ChannelTone.detect_and_fit(comparison(4, sum(lines) + harmonic, command), 1e-3)
    assert found is not None
    assert isinstance(found.effect, ChannelTone)
    laws = sorted((line.row, round(line.offset_hz), round(line.slope)) for line in found.effect.lines)
    assert laws == [(0, 20, 150), (0, 40, 300), (1, 20, 150)]
    assert found.sentence.startswith("3 tones whose frequencies follow throttle, row ")


@pytest.mark.slow
def test_what_turns_comes_late():
    u, late_s = throttle(5), 0.06
    keeps = math.exp(-1 / (late_s * RATE))
    follows = torch.from_numpy(lfilter([1 - keeps], [1, -keeps], u.numpy(), zi=[float(u[0]) * keeps])[0])
    found = ChannelTone.detect_and_fit(comparison(5, tone(40 + 200 * follows, SIZE), u), 1e-3)
    assert found is not None
    assert isinstance(found.effect, ChannelTone)
    assert found.effect.lines[0].late_s == pytest.approx(late_s, rel=0.2)
    assert "ms late" in found.sentence


def test_a_law_that_bends_is_fitted():
    u = throttle(6)
    found = ChannelTone.detect_and_fit(comparison(6, tone(180 * u.sqrt(), SIZE), u), 1e-3)
    assert found is not None
    assert isinstance(found.effect, ChannelTone)
    line, middle = found.effect.lines[0], float(u.median())
    assert line.middle_hz == pytest.approx(180 * math.sqrt(middle), rel=5e-3)
    assert line.rise == pytest.approx(90 / math.sqrt(middle), rel=0.05)


@pytest.mark.slow
def test_values_that_a_slower_source_sent_lie_on_straight_lines():
    u, held = throttle(7), 20  # samples
    sent = u[::held].repeat_interleave(held)[:N]
    between = as_it_moves(sent)
    assert float((between - u)[: -2 * held].std()) < 0.7 * float((sent - u).std())
    assert as_it_moves(u) is u
    steps = torch.rand(30, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    lengths = torch.randint(50, 900, (30,), generator=torch.Generator().manual_seed(9))
    assert (command := steps.repeat_interleave(lengths)) is as_it_moves(command)  # a command that someone sets
    found = ChannelTone.detect_and_fit(comparison(7, tone(40 + 200 * u, SIZE), sent), 1e-3)
    assert found is not None
    assert isinstance(found.effect, ChannelTone)
    assert found.effect.lines[0].straight


def test_of_a_long_record_the_stretch_counts_in_which_the_channel_moves():
    still = torch.zeros(1000, dtype=torch.float64)
    still[600:900] = torch.sin(torch.arange(300, dtype=torch.float64))
    part = busiest([still], 400)
    assert part.stop - part.start == 400
    assert part.start <= 600
    assert part.stop >= 900
    assert busiest([still], 1000) == slice(0, 1000)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["nothing", "wandering tone", "steady tone", "sag", "louder"])
def test_what_does_not_follow_the_channel_is_none(what: str):
    u = throttle(10)
    course = 90 + 3 * wandering(torch.Generator().manual_seed(11), 1.0)[0]
    noise = NOISE.simulate(N, generator=torch.Generator().manual_seed(12))
    effect = {
        "nothing": 0.0,
        "wandering tone": tone(course, SIZE),
        "steady tone": tone(torch.full((N,), 90.0, dtype=torch.float64), SIZE),
        "sag": SIZE * u,
        "louder": 2 * u * noise,
    }[what]
    assert ChannelTone.detect_and_fit(comparison(10, effect, u), 1e-3) is None


@pytest.mark.statistical
def test_the_ratio_has_no_larger_mean_than_one_in_noise():
    """An e-value: it exceeds 20 in a twentieth of nulls at most, whatever the channel does."""
    n_runs, exceeded = 40, 0
    for seed in range(n_runs):
        found = channel_track(comparison(1000 + seed, 0.0, throttle(2000 + seed)))
        exceeded += found is not None and found.log_ratio > math.log(20)
    assert exceeded <= 5  # 2 expected at most; more than 5 come in one of 70


@pytest.mark.parametrize("n_knots", [1, 2, 9])
def test_amplitudes_at_knots_are_those_of_a_record_that_has_them(n_knots: int):
    g = torch.Generator().manual_seed(13)
    turn = torch.exp(2j * math.pi * torch.rand(4000, generator=g, dtype=torch.float64).cumsum(0))
    carrier = Carrier.even(turn, n_knots)
    course = torch.randn(n_knots, 2, generator=g, dtype=torch.float64)
    amplitude = torch.complex(course[:, :1], course[:, 1:]) * torch.tensor([[1.0, -0.5, 0.3]])
    signal = carrier.path(amplitude, 4000)
    found = carrier.amplitudes(signal, torch.ones(3, dtype=torch.float64))
    assert float((found - amplitude).abs().max()) < 0.15 * float(amplitude.abs().max())
