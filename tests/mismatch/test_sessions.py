"""Several recordings of one device: what is the device's, what a session's, and what happened once."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path

import pytest
import torch
from conftest import Run
from pages import Page

import gyrofuse as gf
from gyrofuse.mismatch import SessionsReport, diagnose_sessions
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.repair.serialise import sessions_from_dict
from gyrofuse.mismatch.several.recurrence import CommonParameter

N, RATE, STEP = 8192, 100.0, 0.5
NOISE = gf.ArrayModel.from_sensors([gf.WhiteNoise(1.0 + i / 10) + gf.AR1(0.98, 1e-3) for i in range(3)])
TONES = ((0.3, 13.0), (0.3, 13.3), (0.5, 12.9))  # amplitude, Hz


def recorded(seed: int, amplitude: float, frequency: float, *, onset: int | None = None) -> gf.Recording:
    """Rounded noise with a tone, and from an onset on a step in the second sensor."""
    signal = NOISE.simulate(N, generator=torch.Generator().manual_seed(seed))
    turn = 2 * math.pi * frequency / RATE * torch.arange(N, dtype=torch.float64) + seed
    signal = signal + amplitude * turn.cos()
    if onset is not None:
        signal[1, onset:] += 0.5
    return gf.Recording((signal / STEP).round() * STEP, rate=RATE, unit="deg/s")


def recordings() -> list[gf.Recording]:
    return [recorded(k + 1, *tone, onset=5000 if k == 1 else None) for k, tone in enumerate(TONES)]


@functools.cache
def report() -> SessionsReport:
    return diagnose_sessions(recordings(), NOISE, names=("may", "june", "july"), judge=recorded(9, 0.4, 13.1))


def test_causes_have_their_scope():
    scopes = {cause.mechanism: (cause.scope, sorted(cause.findings)) for cause in report().causes}
    assert scopes == {
        "quantization": ("device", [0, 1, 2]),
        "vibration_tone": ("session", [0, 1, 2]),
        "step": ("recording", [1]),
    }
    tone = next(cause for cause in report().causes if cause.mechanism == "vibration_tone")
    frequency = tone.parameters["frequency"]
    assert "frequency" in tone.varying
    assert [entry.value for entry in frequency.by_recording] == pytest.approx([13.0, 13.3, 12.9], abs=0.01)
    assert frequency.low < 13.07 < frequency.high
    assert frequency.between_sd == pytest.approx(0.21, abs=0.05)


def test_the_model_draws_sessions():
    """Every record has the tone of one of the sessions, all come as often, and the step is in none."""
    drawn = report().model.simulate(N, batch=(6,), generator=torch.Generator().manual_seed(3))
    assert drawn.shape == (6, 3, N)
    f = torch.fft.rfftfreq(N, 1 / RATE, dtype=torch.float64)
    near = (f > 12) & (f < 14)
    found = f[near][torch.fft.rfft(drawn.sum(-2))[..., near].abs().argmax(-1)]
    assert sorted(round(value, 1) for value in found.tolist()) == [12.9, 12.9, 13.0, 13.0, 13.3, 13.3]
    assert float((drawn[..., 5000:].mean(-1) - drawn[..., :5000].mean(-1))[:, 1].abs().max()) < 0.3
    assert torch.equal((drawn / STEP).round() * STEP, drawn)
    assert report().model.simulate(100, generator=torch.Generator().manual_seed(3)).shape == (3, 100)
    assert report().model.simulate(100, batch=(0,)).shape == (0, 3, 100)


def test_it_is_judged_by_all_sessions_together():
    j = report().judged
    assert j is not None
    assert j.helps
    assert j.before > 5 > 2 > j.after
    assert "the repair helps there" in str(report())


def test_it_comes_back_from_json_and_is_a_simulation():
    content = json.loads(json.dumps(report().to_dict(), allow_nan=False))
    again = sessions_from_dict(content["model"])
    drawn = [model.simulate(200, generator=torch.Generator().manual_seed(1)) for model in (again, report().model)]
    assert torch.equal(*drawn)
    fresh = gf.diagnose(recorded(9, 0.4, 13.1), again)
    assert "quantization" not in [finding.mechanism for finding in fresh.findings]
    with pytest.raises(ValueError, match=r"expected in sessions a list of repaired simulations, got \[\]"):
        sessions_from_dict({"sessions": []})


def test_what_agrees_is_no_cause():
    clean = [gf.Recording(NOISE.simulate(N, generator=torch.Generator().manual_seed(k)), rate=RATE) for k in (21, 22)]
    quiet = diagnose_sessions(clean, NOISE)
    assert not quiet.mismatch
    assert quiet.causes == ()
    assert str(quiet).startswith("All 2 recordings agree with the simulation (p = ")


def test_a_mean_of_recordings_has_their_scatter():
    """Moments by hand: weights 1, estimates 0 and 4: q = 8, between variance (8 - 1) / (2 - 1) = 7."""
    z = 1.959963984540054
    entries = [Parameter(value, value - z, value + z, "Hz") for value in (0.0, 4.0)]
    mean = CommonParameter.of(entries)
    assert mean.value == pytest.approx(2.0)
    assert mean.between_sd == pytest.approx(math.sqrt(7))
    assert mean.high - mean.value == pytest.approx(z * math.sqrt((1 + 7) / 2))
    assert mean.p_value == pytest.approx(math.erfc(math.sqrt(8 / 2)))
    alike = CommonParameter.of([entries[0], entries[0]])
    assert (alike.between_sd, alike.p_value) == (0.0, 1.0)


def test_what_does_not_fit_is_refused():
    one, other = recordings()[:2]
    with pytest.raises(TypeError, match="expected a sequence of two or more, got one Recording; use `diagnose`"):
        diagnose_sessions(one, NOISE)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`recordings`: expected two or more of one device, got 1; use `diagnose`"):
        diagnose_sessions([one], NOISE)
    with pytest.raises(ValueError, match=r"expected the 100 Hz of the first one in all, got 50 Hz in 2; resample it"):
        diagnose_sessions([one, gf.Recording(other.signal, rate=50.0, unit="deg/s")], NOISE)
    with pytest.raises(ValueError, match="expected the 3 sensors of the first one in all, got 2 in b"):
        diagnose_sessions([one, other.select(sensors=["1", "2"])], NOISE, names=("a", "b"))
    with pytest.raises(TypeError, match="expected all of one kind, got 2 as a Tensor"):
        diagnose_sessions([one, other.signal], NOISE)
    with pytest.raises(ValueError, match="`names`: expected 2, one of each recording, got 1"):
        diagnose_sessions([one, other], NOISE, names=("a",))


@pytest.mark.usefixtures("blank_images")
def test_the_page_says_whose_each_cause_is(tmp_path: Path):
    report().to_html(tmp_path / "sessions.html", title="<b>Three</b>", remarks=["A & B."])
    page = Page((tmp_path / "sessions.html").read_text(encoding="utf-8"))
    for words in ("Quantization: the device's", "Vibration tone: the session's", "Step: of one recording", "A & B."):
        assert words in page.text
    verdict = page.text[: page.text.index("1. Quantization")]
    assert f"Quantization, the device's, {report().cause_sentence(report().causes[0])}." in verdict
    n_causes = len(report().causes)
    assert [link for link in page.links if link.startswith("#")] == [f"#cause-{k + 1}" for k in range(n_causes)]
    html = (tmp_path / "sessions.html").read_text(encoding="utf-8")
    assert html.count('<section id="cause-') == n_causes


@pytest.mark.slow
@pytest.mark.usefixtures("blank_images")
def test_from_the_command_line(tmp_path: Path, run: Run):
    """Files that have all sensors of the simulation each are recordings; one device a file is one array."""
    for name, recording in zip(("may", "june", "july"), recordings(), strict=True):
        recording.save(tmp_path / f"{name}.npz")
    (tmp_path / "model.json").write_text(json.dumps({**NOISE.to_dict(), "rate": RATE, "unit": "deg/s"}))
    given = ("diagnose", "may.npz", "june.npz", "--simulation", "model.json")
    outputs = ("--json", "found.json", "--model-out", "sessions.json", "--report", "page.html")
    done = run(*given, "--judge", "july.npz", *outputs)
    assert (done.status, done.err) == (0, "")
    assert "quantization, the device's, in all 2 recordings" in done.out
    assert "step, of one recording, in recording june.npz" in done.out
    found = json.loads(Path("found.json").read_text())
    assert found["names"] == found["recording"] == ["may.npz", "june.npz"]
    assert run("simulate", "sessions.json", "--samples", "500", "--out", "drawn.npz").status == 0
    assert gf.read_recording("drawn.npz").signal.shape == (3, 500)
    refused = run(*given, "--twins", "60")
    assert refused.status == 2
    assert "`--twins`: expected with a single recording, got 2" in refused.err


@pytest.mark.slow
def test_one_device_a_file_is_one_array_unless_it_is_said(tmp_path: Path, run: Run):
    for k, name in enumerate(("left", "right")):
        gf.Recording(recordings()[k].signal[:1], rate=RATE, unit="deg/s").save(tmp_path / f"{name}.npz")
    (tmp_path / "model.json").write_text(json.dumps(gf.WhiteNoise(1.0).to_dict()))
    given = ("diagnose", "left.npz", "right.npz", "--simulation", "model.json", "--json", "found.json", "--force")
    assert run(*given).status == 0
    assert "findings" in json.loads(Path("found.json").read_text())
    assert run(*given, "--apart").status == 0
    assert "causes" in json.loads(Path("found.json").read_text())
