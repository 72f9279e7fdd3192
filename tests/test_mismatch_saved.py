"""A repaired simulation as plain numbers and back."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch import saved
from gyrofuse.mismatch.base import Base
from gyrofuse.mismatch.case import Scene
from gyrofuse.mismatch.mechanism import Mechanism
from gyrofuse.mismatch.mechanisms.vibration_tone import VibrationTone
from gyrofuse.mismatch.repaired import RepairedModel
from gyrofuse.mismatch.saved import repaired_from_dict

NOISE = gf.ArrayModel.from_sensors([gf.WhiteNoise(1.0) + gf.AR1(0.9, 0.1), gf.WhiteNoise(2.0) + gf.AR1(0.8, 0.2)])
SCENE = Scene(50.0, "deg/s", ("a", "b"))


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Odd(Mechanism):
    name: ClassVar[str] = "odd"
    base: Base
    limits: Tensor
    which: Tensor
    spans: tuple[tuple[float, float], ...]
    channel: str
    together: bool


def model(*effects: Mechanism) -> RepairedModel:
    return RepairedModel(NOISE, SCENE, effects)


def test_simulates_the_same_after_json():
    first = model(VibrationTone(7.3, numbers(0.3, 0.0), numbers(0.1, 0.2)))
    again = repaired_from_dict(json.loads(json.dumps(first.to_dict(), allow_nan=False)))
    drawn = [m.simulate(500, generator=torch.Generator().manual_seed(1)) for m in (first, again)]
    torch.testing.assert_close(*drawn, rtol=0, atol=0)
    assert (again.scene.rate, again.scene.unit, again.scene.sensors) == (50.0, "deg/s", ("a", "b"))
    assert str(again) == f"{again.noise} + vibration_tone"


def test_every_kind_of_number_comes_back(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(saved, "STAGES", ((Odd,),))
    base = Base(4096, numbers(1.0, 2.0)[:, None])
    effect = Odd(base, numbers(-math.inf, 2.0), torch.tensor([True, False]), ((0.0, math.inf),), "temperature", True)
    first = model(effect)
    again = repaired_from_dict(json.loads(json.dumps(first.to_dict(), allow_nan=False)))
    (found,) = again.effects
    assert isinstance(found, Odd)
    assert (found.base.n_samples, found.spans, found.channel, found.together) == (
        4096,
        *((effect.spans),),
        "temperature",
        True,
    )
    for got, expected in (
        (found.base.coefficients, base.coefficients),
        (found.limits, effect.limits),
        (found.which, effect.which),
    ):
        torch.testing.assert_close(got, expected, rtol=0, atol=0)
    with pytest.raises(ValueError, match="`channels`: expected temperature, which the simulation follows, got none"):
        again.check(50.0, "deg/s")


def test_check_refuses_another_rate_or_unit():
    model().check(50.0, "unknown")
    with pytest.raises(ValueError, match="`rate`: expected that of the repaired simulation, 50 Hz, got 25 Hz"):
        model().check(25.0, "deg/s")
    with pytest.raises(ValueError, match="`unit`: expected that of the repaired simulation, 'deg/s', got 'rad/s'"):
        model().check(50.0, "rad/s")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"effects": [{"mechanism": "x", "kind": "Gremlin", "numbers": {}}]}, "expected a mechanism among .*'Gremlin'"),
        ({"effects": [{"mechanism": "x"}]}, "expected the entries noise, effects, rate, unit and sensors"),
        ({"rate": None}, "expected the entries noise, effects, rate, unit and sensors"),
        ({"noise": gf.WhiteNoise(1.0).to_dict()}, "expected the noise of an array, got that of a sensor"),
    ],
)
def test_refuses_what_is_no_repaired_simulation(change: dict[str, object], says: str):
    with pytest.raises(ValueError, match=says):
        repaired_from_dict({**model().to_dict(), **change})
