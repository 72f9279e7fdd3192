"""Responses to channels: found where each sensor has its own, left to plain gains where these do, with limits."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.likelihoods.finite_response import ResponseSums, responded
from gyrofuse.mismatch.mechanisms.signals.channel_transfer import ChannelTransfer
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

N, P = 16384, 3
NOISE = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-7)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def motion(seed: int) -> Tensor:
    """Of three axes, `(3, time)`."""
    return gf.AR1(0.9, 4.0).simulate(N, batch=(3,), generator=generator(seed))


def comparison(taps: Tensor, seed: int = 1, extra: Tensor | float = 0.0) -> Comparison:
    """Sensors that follow acceleration by responses `(sensor, row, lag)`."""
    rows = motion(seed)
    recording = NOISE.simulate(N, batch=(P,), generator=generator(seed + 100)) + responded(taps, rows) + extra
    simulation = NOISE.simulate(N, batch=(4, P), generator=generator(seed + 200))
    info = RecordingInfo(100.0, "deg/s", ("x", "y", "z"), {"acceleration": rows + torch.tensor([[0.0], [0.0], [1.0]])})
    return Comparison.of(info, recording, simulation)


def own_responses() -> Tensor:
    """Gains of 0.3 on one axis each, late by -1, 0 and 2 samples."""
    taps = torch.zeros(P, 3, 5, dtype=torch.float64)
    for sensor, late in enumerate((-1, 0, 2)):
        taps[sensor, sensor, 2 + late] = 0.3
    return taps


def test_a_response_moves_rows_to_later_samples():
    rows = motion(3)
    taps = torch.zeros(1, 3, 5, dtype=torch.float64)
    taps[0, 1, 4] = 2.0  # two samples late
    assert torch.allclose(responded(taps, rows)[0, 2:], 2 * rows[1, :-2])
    assert torch.allclose(responded(taps, rows)[0, :2], 2 * rows[1, :1].expand(2))  # as it was before


def test_least_squares_finds_the_responses_within_their_limits():
    truth, distances = own_responses(), []
    for seed in range(8):
        case = comparison(truth, seed)
        found = ResponseSums.of(case, case.info.channels["acceleration"], 2).solved(range(3), 2)
        sd = (found.inverse.diagonal() * found.variance[:, None]).sqrt().view_as(found.taps)
        distances.append((found.taps - truth) / sd)
    squares = torch.stack(distances).square()
    assert 0.85 < float(squares.mean()) < 1.15  # of 360, sd 0.075


def test_responses_that_differ_from_sensor_to_sensor_are_named():
    case = comparison(own_responses())
    finding = ChannelTransfer.detect_and_fit(case, 1e-3)
    assert finding is not None
    assert finding.sensors == (0, 1, 2)
    for sensor, late in enumerate((-10.0, 0.0, 20.0)):
        gain, delay = finding.parameters[f"gain[{sensor}]"], finding.parameters[f"delay[{sensor}]"]
        assert gain.value == pytest.approx(0.3, abs=3 * (gain.high - gain.low) / 4)
        assert delay.value == pytest.approx(late, abs=3 * (delay.high - delay.low) / 4)
    after = finding.repair(case, generator(0))
    assert float((after.recording.std(-1) / NOISE.simulate(N, generator=generator(9)).std() - 1).abs().max()) < 0.2


def test_a_diagnosis_names_them_and_the_repair_follows_another_motion():
    case = comparison(own_responses())
    recording = gf.Recording(case.recording, 100.0, unit="deg/s", channels=dict(case.info.channels))
    report = gf.diagnose(recording, NOISE.simulate(4 * N, batch=(P,), generator=generator(5)))
    assert [finding.mechanism for finding in report.findings] == ["channel_transfer"]
    assert report.held_out.paired is not None
    assert report.held_out.paired < 1.5
    assert report.held_out.after < 1.5
    other = {"acceleration": motion(11)}
    drawn = report.model.simulate(N, channels=other, generator=generator(6))
    wanted = responded(own_responses(), other["acceleration"])
    left = drawn - wanted
    assert float(left.std(-1).max()) < 1.1 * float(NOISE.simulate(N, generator=generator(9)).std())
    with pytest.raises(ValueError, match="`channels`: expected 16384 samples of 'acceleration'"):
        report.model.simulate(N, channels={"acceleration": motion(11)[:, :100]}, generator=generator(6))


@pytest.mark.slow
def test_one_gain_at_all_frequencies_has_a_name_of_its_own():
    taps = torch.zeros(P, 3, 1, dtype=torch.float64)
    taps[0, 0] = taps[2, 1] = 0.1
    case = comparison(taps)
    recording = gf.Recording(case.recording, 100.0, unit="deg/s", channels=dict(case.info.channels))
    report = gf.diagnose(recording, NOISE.simulate(4 * N, batch=(P,), generator=generator(5)))
    assert [finding.mechanism for finding in report.findings] == ["g_sensitivity"]


def test_a_line_that_both_feel_is_no_response():
    """Of one frequency, each sensor with a gain and a phase of its own."""
    t = torch.arange(N, dtype=torch.float64)
    line = torch.stack([torch.sin(0.9 * t + phase) for phase in (0.0, 1.0, 2.0)])
    rows = 0.01 * motion(1) + 5 * line[:1]
    info = RecordingInfo(100.0, "deg/s", ("x", "y", "z"), {"acceleration": rows})
    recording = NOISE.simulate(N, batch=(P,), generator=generator(3)) + line
    case = Comparison.of(info, recording, NOISE.simulate(N, batch=(4, P), generator=generator(4)))
    assert ChannelTransfer.detect_and_fit(case, 1e-3) is None


@pytest.mark.statistical
def test_channels_that_move_nothing_are_not_followed():
    """The score held out is an e-value: below 5 % in few of 100 nulls."""
    small = 0
    for seed in range(100):
        case = comparison(torch.zeros(P, 3, 1, dtype=torch.float64), seed)
        scores = ResponseSums.of(case, case.info.channels["acceleration"], 8).held_out(range(3), 8)
        small += float(scores.flatten().logsumexp(0).exp()) / scores.numel() > 20
    assert small <= 5
