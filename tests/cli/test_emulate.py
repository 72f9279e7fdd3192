"""`gyrofuse emulate`: what two noise models cost in the air."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Run

import gyrofuse as gf


@pytest.fixture
def models(tmp_path: Path) -> Path:
    truth = gf.parse_model("AR1(phi=0.18,variance=0.03) + RW(variance=1e-9)")
    wrong = gf.parse_model("AR1(phi=0.18,variance=0.03) + RW(variance=1e-6)")
    for name, model in (("b", truth), ("a", wrong)):
        (tmp_path / f"{name}.json").write_text(json.dumps({**model.to_dict(), "rate": 10.0, "unit": "deg/s"}))
    accelerometer = gf.WhiteNoise(1e-4).to_dict()
    for name, told in (("fast", {"rate": 20.0}), ("metres", {"unit": "m/s^2"}), ("g", {"unit": "g"})):
        (tmp_path / f"{name}.json").write_text(json.dumps({**accelerometer, **told}))
    rows = [f"{15 * i},{250 * i},{40 * (i % 2)},{-100 - i}" for i in range(8)]
    (tmp_path / "path.csv").write_text("\n".join(["time,north,east,down", *rows]))
    return tmp_path


def test_two_models_are_compared(run: Run, models: Path):
    asked = ("emulate", "--model", "a.json", "--against", "b.json", "--trajectory", "path.csv", "--flights", 8)
    done = run(*asked, "--json", "e.json", "--figure", "e.png")
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith("8 flights of 105 s\nPosition error of the first model over that of the second")
    told = json.loads(Path("e.json").read_text())
    assert len(told["time"]) == len(told["ratio"]) == len(told["low"])
    assert told["peak"]["low"] <= told["peak"]["ratio"] <= told["peak"]["high"]
    assert Path("e.png").stat().st_size > 5000
    formulas = [f"AR1(phi=0.18,variance=0.03) + RW(variance={q})" for q in (1e-6, 1e-9)]
    written = ("--model", formulas[0], "--against", formulas[1], "--rate", 10, "--unit", "deg/s")
    again = run("emulate", *written, *asked[5:], "--json", "f.json")
    assert again.status == 0
    assert json.loads(Path("f.json").read_text())["ratio"] == told["ratio"]


def test_accelerometers_are_in_their_unit(run: Run, models: Path):
    asked = ("emulate", "--model", "a.json", "--against", "b.json", "--trajectory", "path.csv", "--flights", 8)
    for name in ("metres", "g"):
        assert run(*asked, "--accelerometer", f"{name}.json", "--json", f"{name}-out.json").status == 0
    metres, g = (json.loads(Path(f"{name}-out.json").read_text())["position"][1][-1] for name in ("metres", "g"))
    assert g > 1.1 * metres  # with a fix every second


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--model", "a.json", "--against", "gone.json"), "gone.json"),
        (("--model", "WN + RW", "--against", "b.json"), "`--model`: expected a file in JSON, or a formula"),
        (("--model", "a.json", "--against", "WN + RW(variance=1)"), "`--against`: `white_noise.variance`: expected a"),
        (("--model", "WM(variance=1)", "--against", "b.json"), "did you mean WN?"),
        (("--model", "a.json", "--against", "b.json", "--rate", "100"), "Hz, for which the model was fitted, got 100"),
        (("--model", "a.json", "--against", "b.json", "--unit", "rad/s"), "`--unit`: expected deg/s"),
        (("--model", "a.json", "--against", "b.json", "--flights", "0"), "`--flights`"),
        (("--model", "a.json", "--against", "path.csv"), "path.csv: expected a model in JSON"),
        (("--model", "a.json", "--against", "b.json", "--trajectory", "a.json"), "a.json: expected"),
        (("--model", "a.json", "--against", "b.json", "--accelerometer", "a.json"), "m/s^2 or g, found one in deg/s"),
        (("--model", "a.json", "--against", "b.json", "--accelerometer", "fast.json"), "expected 20 Hz, for which"),
    ],
)
def test_bad_requests_are_refused(run: Run, models: Path, arguments, says):
    done = run("emulate", *arguments)
    assert done.status == 2
    assert says in done.err
    assert done.err.count("\n") == 1
