"""What every mechanism of the catalogue has to do, on drawn instances of it."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from gyrofuse.cli.reading import read_model
from gyrofuse.mismatch.mechanisms.catalogue import CATALOGUE
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.mechanisms.signals.tone_amplitude import ToneSize
from gyrofuse.mismatch.mechanisms.slow_remainder import SlowRemainder
from gyrofuse.mismatch.mechanisms.values.unit_scale import UnitScale
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from tests.mechanism_draws import (
    Drawn,
    Setting,
    array,
    draw_of,
    drawn_in,
    generator,
    info,
)

SHORT = 2048  # samples, where a mechanism acts and is not looked for
# Sensors of the array, those concerned, and the size of the effect over one that is plainly seen.
VARIANTS = {
    "all sensors": (3, (0, 1, 2), 1.0),
    "one sensor": (3, (1,), 1.0),
    "a single sensor": (1, (0,), 1.0),
    "strong": (3, (0, 1, 2), 20.0),
    "weak": (2, (0, 1), 0.01),
}

ROUNDING = 1e-12  # of the largest value


def name_of(kind: type[Mechanism]) -> str:
    return kind.__name__


every_mechanism = pytest.mark.parametrize("kind", CATALOGUE, ids=name_of)
every_variant = pytest.mark.parametrize("variant", VARIANTS)


def instance(kind: type[Mechanism], variant: str, *seed: object, n_samples: int = SHORT) -> tuple[Drawn, Setting]:
    n_sensors, concerned, size = VARIANTS[variant]
    return drawn_in(kind, variant, *seed, n_sensors=n_sensors, concerned=concerned, size=size, n_samples=n_samples)


def act(drawn: Drawn, signal: Tensor, *seed: object) -> Tensor:
    return drawn.effect.apply(signal, info(signal.shape[-2], drawn.channels), generator(*seed))


def overrides(kind: type[Mechanism], method: str) -> bool:
    return getattr(kind, method) is not getattr(Mechanism, method)


def is_random(drawn: Drawn, signal: Tensor) -> bool:
    return not torch.equal(act(drawn, signal, 1), act(drawn, signal, 2))


def global_state() -> tuple[object, ...]:
    return torch.get_rng_state().tolist(), random.getstate(), str(np.random.get_state())  # noqa: NPY002


# Saved and read back.


@every_variant
@every_mechanism
def test_simulates_the_same_bits_after_a_file(kind: type[Mechanism], variant: str, tmp_path: Path):
    """Alone, and on top of an instance of every kind."""
    drawn, setting = instance(kind, variant)
    p, n = setting.n_sensors, setting.n_samples
    company = [draw_of(other)(setting) for other in CATALOGUE if variant == "all sensors"]
    channels = dict(drawn.channels)
    for other in company:
        channels |= other.channels
    for effects in ((drawn.effect,), (*(other.effect for other in company), drawn.effect)):
        first = RepairedModel(array(p), info(p), effects)
        file = tmp_path / "model.json"
        file.write_text(json.dumps(first.to_dict(), allow_nan=False))
        again = read_model(file)
        assert isinstance(again, RepairedModel)
        assert again.to_dict() == first.to_dict()
        signals = [m.simulate(n, batch=(2,), channels=channels, generator=generator(3)) for m in (first, again)]
        assert torch.equal(*signals)
        assert bool(signals[0].isfinite().all())


# What it does to signals.


@every_variant
@every_mechanism
def test_acts_on_each_record_of_a_batch_by_itself(kind: type[Mechanism], variant: str):
    """Shape, dtype and device are kept; a mechanism that draws nothing makes of a batch what it makes of its items."""
    drawn, setting = instance(kind, variant)
    batch = array(setting.n_sensors).simulate(setting.n_samples, batch=(2, 2), generator=generator(4))
    changed = act(drawn, batch, 1)
    assert (changed.shape, changed.dtype, changed.device) == (batch.shape, batch.dtype, batch.device)
    assert bool(changed.isfinite().all())
    if is_random(drawn, setting.clean):
        added = (changed - batch).flatten(0, 1)
        assert not any(torch.equal(added[0], other) for other in added[1:])
        return
    items = torch.stack([act(drawn, item, 1) for item in batch.flatten(0, 1)]).view_as(batch)
    torch.testing.assert_close(changed, items, rtol=1e-9, atol=1e-9 * float(items.abs().max()))


@every_mechanism
def test_removes_from_each_record_of_a_batch_by_itself(kind: type[Mechanism]):
    drawn, setting = instance(kind, "all sensors")
    where = info(setting.n_sensors, drawn.channels)
    batch = act(drawn, array(setting.n_sensors).simulate(setting.n_samples, batch=(2, 2), generator=generator(4)), 1)
    left = drawn.effect.remove(batch, where)
    assert (left.shape, left.dtype, left.device) == (batch.shape, batch.dtype, batch.device)
    items = torch.stack([drawn.effect.remove(item, where) for item in batch.flatten(0, 1)]).view_as(batch)
    torch.testing.assert_close(left, items, rtol=1e-9, atol=1e-9 * float(items.abs().max()))


@every_variant
@every_mechanism
def test_changes_the_sensors_concerned_alone(kind: type[Mechanism], variant: str):
    """What is rare need not happen in a short record where there is little of it."""
    drawn, setting = instance(kind, variant)
    change = (act(drawn, setting.clean, 1) - setting.clean).abs().amax(-1)
    moved = tuple((change > ROUNDING * setting.clean.abs().max()).nonzero()[:, 0].tolist())
    concerned = tuple(range(setting.n_sensors)) if kind in (UnitScale, ToneSize) else setting.concerned
    assert moved == concerned or (variant == "weak" and set(moved) < set(concerned))


@every_variant
@every_mechanism
def test_takes_all_numbers_from_the_generator_that_it_is_given(kind: type[Mechanism], variant: str):
    """And leaves the signal and global random states alone."""
    drawn, setting = instance(kind, variant)
    signal = setting.clean.clone()
    before, first = global_state(), act(drawn, signal, 1)
    left = drawn.effect.remove(first, info(setting.n_sensors, drawn.channels))
    assert global_state() == before
    assert torch.equal(signal, setting.clean)
    assert left is first or torch.equal(first, act(drawn, signal, 1))
    with torch.random.fork_rng():
        torch.manual_seed(11)
        assert torch.equal(first, act(drawn, signal, 1))


@every_variant
@pytest.mark.parametrize("kind", [k for k in CATALOGUE if k.proportional_to or k is SlowRemainder], ids=name_of)
def test_takes_off_what_it_adds(kind: type[Mechanism], variant: str):
    drawn, setting = instance(kind, variant)
    whole = act(drawn, setting.clean, 1)
    left = drawn.effect.remove(whole, info(setting.n_sensors, drawn.channels))
    torch.testing.assert_close(left, setting.clean, rtol=0, atol=ROUNDING * float(whole.abs().max()))
