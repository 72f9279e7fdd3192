"""Another recording as the judge of a repair."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Run
from pages import Page
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.reporting.judge import judged
from gyrofuse.mismatch.signals.comparison import RecordingInfo

N, RATE = 5003, 50.0
NOISE = gf.ArrayModel.from_sensors([gf.WhiteNoise(1.0 + i / 10) + gf.AR1(0.98, 1e-3) for i in range(2)])


def drawn(seed: int, n: int = N) -> Tensor:
    return NOISE.simulate(n, generator=torch.Generator().manual_seed(seed))


def tone(n: int = N, phase: float = 0.0) -> Tensor:
    return 0.4 * torch.cos(2 * math.pi * 0.11 * torch.arange(n, dtype=torch.float64) + phase)


def recording(signal: Tensor, rate: float = RATE, unit: str = "deg/s", **channels: Tensor) -> gf.Recording:
    return gf.Recording(signal, rate=rate, unit=unit, channels=channels)


def test_a_repair_that_holds_helps_there_too():
    report = gf.diagnose(recording(drawn(1) + tone()), NOISE, judge=recording(drawn(2, 6007) + tone(6007, 2.0)))
    j = report.judged
    assert j is not None
    assert j.before > 3 > 1.5 > max(j.after, j.repeatability)
    assert j.auc_before > max(j.auc_after, j.auc_repeatability)
    assert j.helps
    assert "the repair helps there" in str(report)
    told = report.to_dict()["judged"]
    assert (told["before"], told["after"], told["repeatability"]) == (j.before, j.after, j.repeatability)
    assert told["classifier"] == {"before": j.auc_before, "after": j.auc_after, "repeatability": j.auc_repeatability}


@pytest.mark.slow
def test_shares_say_what_carries_the_discrepancy():
    """Each from where the one before it ends, on the judge and on blocks held out alike; what is left is the rest."""
    loud = gf.ArrayModel.from_sensors([gf.WhiteNoise(2.0) + gf.AR1(0.98, 1e-3) for _ in range(2)])
    signal = [loud.simulate(n, generator=torch.Generator().manual_seed(n)) + tone(n, n) for n in (N, 6007)]
    report = gf.diagnose(recording(signal[0]), NOISE, judge=recording(signal[1]))
    j = report.judged
    assert j is not None
    for before, after, shares in ((report.held_out.before, report.held_out.after, report.held_out.shares),
                                  (j.before, j.after, j.shares)):  # fmt: skip
        assert sorted(share.name for share in shares) == ["parameter_shift", "vibration_tone"]
        ends = [before, *(share.discrepancy for share in shares)]
        assert ends[-1] == pytest.approx(after)
        for k, share in enumerate(shares):
            assert share.share == pytest.approx((ends[k] - ends[k + 1]) / (before - 1))
            assert share.share > 0.05
        assert sum(share.share for share in shares) + (after - 1) / (before - 1) == pytest.approx(1)
    named = 100 * sum(share.share for share in j.shares)
    assert f"on the other recording, mechanisms with names carry {named:.3g} %" in str(report)
    assert report.to_dict()["judged"]["shares"][0]["name"] == j.shares[0].name


def test_what_does_next_to_nothing_carries_nothing():
    """Every repair is judged with the same noise: else each would carry the chance of another draw."""
    faint = VibrationTone(5.5, torch.full((2,), 1e-4, dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
    info = RecordingInfo(RATE, "deg/s", ("1", "2"))
    model, judge = RepairedModel(NOISE, info, (faint, faint)), recording(drawn(2) + tone())
    j = judged(judge, [recording(drawn(1) + tone())], NOISE, [model], None)
    assert [share.name for share in j.shares] == 2 * ["vibration_tone"]
    assert abs(j.shares[1].share) < 1e-4


@pytest.mark.slow
def test_a_repair_of_what_was_there_once_does_not():
    """A tone in the recording alone: the device does not have it elsewhere, and does not repeat itself either."""
    report = gf.diagnose(recording(drawn(1) + tone()), NOISE, judge=recording(drawn(2)))
    j = report.judged
    assert report.findings
    assert j is not None
    assert j.before < 1.5 < 3 < min(j.after, j.repeatability)
    assert not j.helps
    assert "the repair does not help there" in str(report)


def test_what_is_right_is_judged_as_it_came():
    report = gf.diagnose(drawn(1), NOISE, rate=RATE, judge=drawn(2))
    j = report.judged
    assert not report.mismatch
    assert j is not None
    assert j.before == j.after < 1.5
    assert not j.helps
    assert "there was nothing to repair" in str(report)
    assert gf.diagnose(drawn(1), NOISE, rate=RATE).to_dict()["judged"] is None


def test_the_discrepancy_before_is_that_of_the_simulation():
    simulation, judge = recording(drawn(4, 2 * N)), recording(drawn(2))
    j = gf.diagnose(recording(drawn(1)), simulation, judge=judge.to("rad/s")).judged
    assert j is not None
    assert j.before == pytest.approx(gf.mismatch.discrepancy(judge, simulation), rel=1e-9)
    assert j.repeatability == pytest.approx(gf.mismatch.discrepancy(judge, recording(drawn(1))), rel=1e-9)


@pytest.mark.slow
def test_what_follows_a_channel_that_the_judge_lacks_is_left_out():
    shake = torch.randn(3, N, generator=torch.Generator().manual_seed(7), dtype=torch.float64) + torch.eye(3)[2:].mT
    moved = recording(drawn(1) + 0.3 * shake[:1] + tone(), acceleration=shake)
    report = gf.diagnose(moved, NOISE, judge=recording(drawn(2) + tone()))
    assert {f.mechanism for f in report.findings} == {"g_sensitivity", "vibration_tone"}
    j = report.judged
    assert j is not None
    assert j.lacks == ("acceleration",)
    assert j.after < 1.5 < j.before
    assert "without what follows acceleration, which it has not" in str(report)
    assert "acceleration" in report.to_dict()["judged"]["lacks"]


@pytest.mark.parametrize(
    ("judge", "error", "says"),
    [
        (recording(drawn(2), rate=25.0), ValueError, "`judge`: expected the 50 Hz of the recording, got 25 Hz"),
        (recording(drawn(2)[:1]), ValueError, "`judge`: expected (sensor, time) with 2 sensors as in the recording"),
        (recording(drawn(2)[None]), ValueError, "`judge`: expected (sensor, time) with 2 sensors as in the recording"),
        (recording(drawn(2), unit="counts"), ValueError, "`judge`: expected the recording's unit deg/s, or one that"),
        (recording(drawn(2, 100)), ValueError, "`judge`: expected at least 4096 samples for a diagnosis, got 100"),
        (recording(drawn(2).fill_(1.0)), ValueError, "`judge`: expected sensors that move, got constant ones"),
        (
            recording(drawn(2), heat=torch.zeros(2, N)),
            ValueError,
            "`judge`: expected the channel heat with the rows ()",
        ),
        (drawn(2), TypeError, "`judge`: expected a recording as `recording` is one, got Tensor"),
        (NOISE, TypeError, "`judge`: expected a recording as `recording` is one, got ArrayModel"),
    ],
)
def test_refuses_what_is_no_recording_of_the_same_device(judge: Any, error: type[Exception], says: str):
    with pytest.raises(error, match=re.escape(says)):
        gf.diagnose(recording(drawn(1), heat=torch.zeros(N)), NOISE, judge=judge)


@pytest.mark.slow
def test_from_the_command_line(run: Run, tmp_path: Path):
    recording(drawn(1) + tone()).save(tmp_path / "log.npz")
    gapped = drawn(2, 6007) + tone(6007, 1.0)
    gapped[:, :100] = math.nan
    recording(gapped).save(tmp_path / "other.npz")
    recording(drawn(3), rate=25.0).save(tmp_path / "slow.npz")
    (tmp_path / "model.json").write_text(json.dumps(NOISE.to_dict()))
    given = ("diagnose", "log.npz", "--simulation", "model.json", "--judge")
    done = run(*given, "other.npz", "--json", "r.json", "--report", "r.html")
    assert (done.status, done.err) == (0, "")
    assert "the repair helps there" in done.out
    assert "other.npz: judged on 2 to 120.14 s alone" in done.out
    told = json.loads(Path("r.json").read_text())
    assert told["judge"] == "other.npz"
    assert set(told["judged"]) == {"before", "after", "repeatability", "classifier", "helps", "lacks", "shares"}
    page = Page(Path("r.html").read_text())
    assert "On another recording" in page.text
    assert "the repair helps there" in page.text
    refused = run(*given, "slow.npz")
    assert refused.status == 2
    assert "slow.npz: expected the 50 Hz of the recording, got 25 Hz" in refused.err
