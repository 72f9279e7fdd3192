"""A whole board: gyros and accelerometers of all axes and devices, a cause that they share told once."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from bounds import at_least
from conftest import Run
from pages import Page
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch import BoardReport, diagnose_board

N = {"rate": 16384, "acceleration": 8192}
RATES = {"rate": 200.0, "acceleration": 100.0}
UNITS = {"rate": "deg/s", "acceleration": "m/s^2"}
KINDS = ("vibration_tone", "step", "temperature_drift", "variance_change", "low_pass")


def models(g: torch.Generator) -> dict[str, gf.Model]:
    """Noise of two devices with three axes, of another size in each: parameters `(axis, device, parameter)`."""
    plain, made = gf.WhiteNoise(1.0) + gf.AR1(0.98, 1e-3), {}
    for quantity, size in (("rate", 1.0), ("acceleration", 1e-2)):
        factor = size * (1 + 0.3 * torch.rand(3, 2, 1, generator=g, dtype=torch.float64))
        params = torch.cat([factor, torch.full_like(factor, 0.98), 1e-3 * factor], -1)
        made[quantity] = plain.with_params(params)
    return made


def scene(kind: str, seed: int) -> tuple[dict[str, gf.Recording], dict[str, gf.Model]]:
    """A board with one cause in all its sensors, and what a simulator knows of it."""
    g = torch.Generator().manual_seed(seed)
    simulated = models(g)
    duration = N["rate"] / RATES["rate"]
    onset, frequency = (
        duration * (0.3 + 0.4 * float(torch.rand(1, generator=g))),
        5 + 40 * float(torch.rand(1, generator=g)),
    )
    heat = torch.randn(512, generator=g, dtype=torch.float64).cumsum(0)
    recordings = {}
    for quantity, model in simulated.items():
        n, rate = N[quantity], RATES[quantity]
        t = torch.arange(n, dtype=torch.float64) / rate

        def each(low: float, high: float) -> Tensor:
            return low + (high - low) * torch.rand(3, 2, 1, generator=g, dtype=torch.float64)

        signal = model.simulate(n, generator=g)
        unit = signal.diff().std(-1, keepdim=True) / math.sqrt(2)
        warmth = torch.nn.functional.interpolate(heat[None, None], size=n, mode="linear", align_corners=True)[0, 0]
        if kind == "vibration_tone":
            signal = signal + unit * each(0.15, 0.25) * torch.cos(2 * math.pi * frequency * t + each(0.0, 6.28))
        if kind == "step":
            signal = signal + unit * each(0.3, 0.6) * (t > onset)
        if kind == "temperature_drift":
            signal = signal + unit * each(0.3, 0.6) * (warmth - warmth.mean()) / warmth.std()
        if kind == "variance_change":
            louder = unit * torch.randn(signal.shape, generator=g, dtype=torch.float64)
            signal = torch.where((t > onset) & (t < onset + 8), signal + louder, signal)
        if kind == "low_pass":
            f = torch.fft.rfftfreq(2 * n, 1 / rate, dtype=torch.float64)
            longer = torch.cat([signal, signal.flip(-1)], -1)
            signal = torch.fft.irfft(torch.fft.rfft(longer) / (1 + 1j * f / 20), n=2 * n)[..., :n]
        channels = {"temperature": 25 + warmth} if kind == "temperature_drift" else {}
        recordings[quantity] = gf.Recording(
            signal, rate=rate, unit=UNITS[quantity], sensors=("imu1", "imu2"), axes=("x", "y", "z"), channels=channels
        )
    return recordings, simulated


def found(kind: str, seed: int) -> BoardReport:
    return diagnose_board(*scene(kind, seed))


def test_one_cause_is_one_finding():
    """Of one kind; of all kinds below."""
    kind = KINDS[0]
    report = found(kind, 1)
    assert [cause.mechanism for cause in report.causes] == [kind]
    assert report.causes[0].sensors == {"rate": tuple(range(6)), "acceleration": tuple(range(6))}
    assert f"1. {kind}, in rate: all sensors; acceleration: all sensors" in str(report)


@pytest.mark.statistical
def test_one_cause_is_one_finding_in_nearly_all_boards(draws: Callable[[int, int], int]):
    """Of each kind: 95 % and more, but for chance."""
    each = draws(1, 10)
    seeds = range(100, 100 + each)
    single = sum([c.mechanism for c in found(kind, seed).causes] == [kind] for kind in KINDS for seed in seeds)
    print(single, "of", each * len(KINDS))
    assert single >= at_least(each * len(KINDS), 0.95)


@pytest.mark.slow
def test_two_causes_are_two():
    """A tone of the rates and another of the accelerations, and a step a while after that of the other group."""
    recordings, simulated = scene("", 3)
    t = {name: torch.arange(N[name], dtype=torch.float64) / RATES[name] for name in N}
    added = {
        "rate": 0.3 * torch.cos(2 * math.pi * 11.0 * t["rate"]) + 0.6 * (t["rate"] > 30),
        "acceleration": 0.03 * torch.cos(2 * math.pi * 17.0 * t["acceleration"]) + 0.06 * (t["acceleration"] > 50),
    }
    moved = {name: replace(one, signal=one.signal + added[name]) for name, one in recordings.items()}
    report = diagnose_board(moved, simulated)
    assert sorted(cause.mechanism for cause in report.causes) == ["step", "step", "vibration_tone", "vibration_tone"]
    assert all(len(cause.members) == 1 for cause in report.causes)


def test_a_board_that_agrees_has_no_cause():
    report = found("", 4)
    assert not report.mismatch
    assert report.causes == ()
    assert str(report).startswith("All 2 groups agree with the simulation (p = ")


@pytest.mark.slow
def test_sensitivity_to_acceleration_is_a_matrix():
    """Gyros of one device that follow three accelerations: nine gains, told as rows of a matrix."""
    g = torch.Generator().manual_seed(5)
    simulated = models(g)["rate"]
    shake = torch.randn(3, N["rate"], generator=g, dtype=torch.float64)
    gains = torch.tensor([[0.3, 0.0, -0.2], [0.0, 0.25, 0.1], [0.2, -0.1, 0.3]], dtype=torch.float64)
    one = simulated.with_params(simulated.params[:, :1])
    signal = one.simulate(N["rate"], generator=g) + (gains @ shake)[:, None]
    recording = gf.Recording(
        signal, rate=200.0, unit="deg/s", sensors=("imu",), axes=("x", "y", "z"), channels={"acceleration": shake}
    )
    report = diagnose_board({"rate": recording}, {"rate": one})
    assert [cause.mechanism for cause in report.causes] == ["g_sensitivity"]
    assert torch.allclose(report.causes[0].clearest.finding.effect.amplitudes, gains, atol=0.03)
    assert "gains on the rows of the channel:" in str(report)


def test_what_does_not_fit_is_refused():
    recordings, simulated = scene("", 6)
    with pytest.raises(TypeError, match=r"`recordings`: expected a mapping from the names of groups.*got list"):
        diagnose_board([*recordings.values()], [*simulated.values()])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`recordings`: expected one group of sensors or more, got none"):
        diagnose_board({}, {})
    with pytest.raises(
        ValueError, match="`simulations`: expected the groups rate, acceleration of the recordings, got rate"
    ):
        diagnose_board(recordings, {"rate": simulated["rate"]})
    with pytest.raises(ValueError, match="rate: `simulation`: expected a model of one sensor, or with parameters"):
        diagnose_board(recordings, {**simulated, "rate": simulated["rate"].with_params(simulated["rate"].params[:2])})


def written(folder: Path, kind: str, seed: int) -> dict[str, Any]:
    """A table of a board's log, and its models in JSON."""
    recordings, simulated = scene(kind, seed)
    columns, names = [torch.arange(N["acceleration"], dtype=torch.float64) / 100], ["time [s]"]
    for quantity, prefix in (("rate", "gyro"), ("acceleration", "acc")):
        signal = recordings[quantity].signal[:, 0, :: N[quantity] // N["acceleration"]]
        columns += list(signal)
        names += [f"{prefix}_{axis} [{UNITS[quantity]}]" for axis in "xyz"]
    rows = [",".join(names), *(",".join(f"{value:.9g}" for value in row) for row in torch.stack(columns, -1).tolist())]
    (folder / "log.csv").write_text("\n".join(rows) + "\n")
    for quantity, model in simulated.items():
        own = model.with_params(model.params[:, :1])
        content = {**own.to_dict(), "rate": 100.0, "unit": UNITS[quantity]}
        (folder / f"{quantity}.json").write_text(json.dumps(content))
    return simulated


@pytest.mark.slow
@pytest.mark.usefixtures("blank_images")
def test_from_the_command_line(tmp_path: Path, run: Run):
    written(tmp_path, "step", 7)
    given = ("diagnose", "log.csv", "--quantity", "all", "--simulation")
    outputs = ("--json", "found.json", "--model-out", "board.json", "--report", "page.html")
    done = run(*given, "rate.json", "--simulation", "acceleration.json", *outputs)
    assert (done.status, done.err) == (0, "")
    told = json.loads(Path("found.json").read_text())
    assert "step" in [cause["mechanism"] for cause in told["causes"]]
    assert set(told["groups"]) == {"rate", "acceleration"}
    page = Page(Path("page.html").read_text())
    assert "Step, in " in page.text[: page.text.index("1. ")]
    assert "#cause-1" in page.links
    again = run(*given, "board.json", "--json", "again.json")
    assert (again.status, again.err) == (0, "")
    for arguments, says in (
        (("rate.json",), "expected models of rate and acceleration, got none of acceleration"),
        (
            ("rate.json", "--simulation", "rate.json"),
            "expected a model of the other quantity, got a second one of rate",
        ),
        (("board.json", "--twins", "60"), "`--twins`: expected with one --quantity, got it with all"),
    ):
        refused = run(*given, *arguments)
        assert refused.status == 2
        assert says in refused.err
    twice = run("diagnose", "log.csv", "--simulation", "rate.json", "--simulation", "rate.json")
    assert twice.status == 2
    assert "`--simulation`: expected one, got 2" in twice.err
