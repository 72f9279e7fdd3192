"""What every mechanism of the catalogue has to do, on drawn instances of it."""

from __future__ import annotations

import itertools
import json
import math
import random
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.cli.reading import read_model
from gyrofuse.mismatch.mechanisms.catalogue import CATALOGUE
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.regimes.gradual_change import GradualChange
from gyrofuse.mismatch.mechanisms.remainders.coherence import CoherenceRemainder
from gyrofuse.mismatch.mechanisms.remainders.slow import SlowRemainder
from gyrofuse.mismatch.mechanisms.signals.time_scale import TimeScale
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone
from gyrofuse.mismatch.mechanisms.signals.tone_amplitude import ToneSize
from gyrofuse.mismatch.mechanisms.values.rounding.dead_band import DeadBand
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.mechanisms.values.sensor_order import SensorOrder
from gyrofuse.mismatch.mechanisms.values.stuck_samples import StuckSamples
from gyrofuse.mismatch.mechanisms.values.unit_scale import UnitScale
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.signals.comparison import Comparison
from tests import mechanism_draws  # noqa: F401  # which draws every mechanism
from tests.mechanism_settings import (
    NOISE,
    RATE,
    RECORDS,
    Drawn,
    Setting,
    array,
    compared,
    concealed,
    draw_of,
    drawn_in,
    generator,
    info,
    tone,
)

LEVEL = 1e-3  # p value at which mechanisms are looked for
ROUNDING = 1e-12  # of the largest value of a signal
SHORT = 2048  # samples, where a mechanism acts and is not looked for
SHORTEST = 4096  # samples that are diagnosed
MANY = 100  # records, whose mean spectra are known to a few per cent in each band
# Draws of each mechanism that it is looked for in by itself, by a diagnosis, and nulls; by default, and with `--full`.
DRAWN, DIAGNOSED, NULLS = (4, 100), (1, 20), (30, 200)
# Sensors of the array, those concerned, and the size of the effect over one that is plainly seen.
VARIANTS = {
    "all sensors": (3, (0, 1, 2), 1.0),
    "one sensor": (3, (1,), 1.0),
    "a single sensor": (1, (0,), 1.0),
    "strong": (3, (0, 1, 2), 20.0),
    "weak": (2, (0, 1), 0.01),
}
PHYSICS = [kind for kind in CATALOGUE if kind.identified]
PROMISE_SPECTRA = [kind for kind in CATALOGUE if kind.spectra is not Mechanism.spectra]
ADD_A_KNOWN_PATH = [kind for kind in CATALOGUE if kind.known_path or kind is SlowRemainder]
QUICK = (UnitScale, Quantization, DeadBand, StuckSamples, VibrationTone)  # diagnosed in a second


def name_of(kind: type[Mechanism]) -> str:
    return kind.__name__


every_physics = pytest.mark.parametrize("kind", PHYSICS, ids=name_of)
every_mechanism = pytest.mark.parametrize("kind", CATALOGUE, ids=name_of)
every_variant = pytest.mark.parametrize("variant", VARIANTS)


def instance(kind: type[Mechanism], variant: str, *seed: object) -> tuple[Drawn, Setting]:
    n_sensors, concerned, size = VARIANTS[variant]
    return drawn_in(kind, variant, *seed, n_sensors=n_sensors, concerned=concerned, size=size, n_samples=SHORT)


def act(drawn: Drawn, signal: Tensor, *seed: object) -> Tensor:
    return drawn.effect.apply(signal, info(signal.shape[-2], drawn.channels), generator(*seed))


def overrides(kind: type[Mechanism], method: str) -> bool:
    return getattr(kind, method) is not getattr(Mechanism, method)


def is_random(drawn: Drawn, signal: Tensor) -> bool:
    return not torch.equal(act(drawn, signal, 1), act(drawn, signal, 2))


def global_state() -> tuple[object, ...]:
    return torch.get_rng_state().tolist(), random.getstate(), str(np.random.get_state())  # noqa: NPY002


# Saved and read back.


def check_the_same_bits_after_a_file(setting: Setting, all_drawn: Sequence[Drawn], file: Path) -> None:
    channels = {name: values for drawn in all_drawn for name, values in drawn.channels.items()}
    effects = tuple(drawn.effect for drawn in all_drawn)
    first = RepairedModel(array(setting.n_sensors), info(setting.n_sensors), effects)
    file.write_text(json.dumps(first.to_dict(), allow_nan=False))
    again = read_model(file)
    assert isinstance(again, RepairedModel)
    assert again.to_dict() == first.to_dict()
    signals = [
        model.simulate(setting.n_samples, batch=(2,), channels=channels, generator=generator(3))
        for model in (first, again)
    ]
    assert torch.equal(*signals)
    assert bool(signals[0].isfinite().all())


@every_variant
@every_mechanism
def test_simulates_the_same_bits_after_a_file(kind: type[Mechanism], variant: str, tmp_path: Path):
    drawn, setting = instance(kind, variant)
    check_the_same_bits_after_a_file(setting, [drawn], tmp_path / "model.json")


@every_variant
def test_all_together_simulate_the_same_bits_after_a_file(variant: str, tmp_path: Path):
    _, setting = instance(UnitScale, variant)
    check_the_same_bits_after_a_file(setting, [draw_of(kind)(setting) for kind in CATALOGUE], tmp_path / "model.json")


def test_says_what_to_add_for_a_mechanism_that_is_not_drawn():
    class Gremlin(Mechanism):
        pass

    with pytest.raises(LookupError, match=r"got none; add a function marked with @draws\(Gremlin\) to tests/mechanis"):
        draw_of(Gremlin)


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
    signal = setting.clean
    if drawn.simulated is not None:  # it acts where there is something to take off
        signal = drawn.simulated.apply(signal, info(setting.n_sensors), generator(variant))
    change = (act(drawn, signal, 1) - signal).abs().amax(-1)
    moved = tuple((change > ROUNDING * setting.clean.abs().max()).nonzero()[:, 0].tolist())
    concerned = tuple(range(setting.n_sensors)) if kind in (UnitScale, ToneSize, TimeScale) else setting.concerned
    if kind in (CoherenceRemainder, SensorOrder) and len(concerned) < 2:
        concerned = ()  # one shares nothing, and has no other place
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
@pytest.mark.parametrize("kind", ADD_A_KNOWN_PATH, ids=name_of)
def test_takes_off_what_it_adds(kind: type[Mechanism], variant: str):
    drawn, setting = instance(kind, variant)
    whole = act(drawn, setting.clean, 1)
    left = drawn.effect.remove(whole, info(setting.n_sensors, drawn.channels))
    torch.testing.assert_close(left, setting.clean, rtol=0, atol=ROUNDING * float(whole.abs().max()))


# The spectra that it promises.


def periodograms(signal: Tensor) -> Tensor:
    """Cross-spectral density of records `(record, sensor, time)` at each frequency, `(record, frequency, ...)`."""
    window = torch.hann_window(signal.shape[-1], dtype=torch.float64)
    transform = torch.fft.rfft(signal * window / window.norm()).mT
    return transform[..., :, None] * transform[..., None, :].conj()


def of_bands(values: Tensor, dim: int) -> Tensor:
    """Real and imaginary parts of means over bands of frequency, from the eighth bin up to half the rate."""
    edges = torch.logspace(3, math.log2(values.shape[dim] - 1), 12, base=2.0).long().tolist()
    means = [values.narrow(dim, a, b - a).mean(dim) for a, b in itertools.pairwise(edges)]
    return torch.view_as_real(torch.stack(means, dim).to(torch.complex128))


@pytest.mark.parametrize("kind", PROMISE_SPECTRA, ids=name_of)
@pytest.mark.parametrize("seed", range(2))
def test_has_the_spectra_that_it_promises(kind: type[Mechanism], seed: int):
    """Means over records in each band, cross-spectra included, within what 999 of 1000 studies of them all have."""
    drawn, setting = instance(kind, "all sensors", seed)
    clean = array(setting.n_sensors).simulate(SHORT, batch=(MANY,), generator=generator(5, seed))
    seen = of_bands(periodograms(act(drawn, clean, seed)), 1)
    f = (torch.arange(SHORT // 2 + 1, dtype=torch.float64) / SHORT).clamp(min=1 / SHORT)
    promised = of_bands(drawn.effect.spectra(array(setting.n_sensors).spectrum(f).to(torch.complex128), f), 0)
    varies = seen.std(0) > 0  # imaginary parts of powers are zero
    away = ((seen.mean(0) - promised) / seen.std(0) * math.sqrt(MANY))[varies].abs()
    assert float(away.max()) < stats.t.isf(5e-4 / len(away), MANY - 1)


@pytest.mark.parametrize("kind", [kind for kind in PHYSICS if kind not in PROMISE_SPECTRA], ids=name_of)
def test_what_promises_no_spectra_is_scored_otherwise(kind: type[Mechanism]):
    """By a likelihood of its own, or as a signal that is taken off the recording."""
    assert overrides(kind, "held_out_scores") or (kind.additive and overrides(kind, "remove"))


# What is found of it.


def found(kind: type[Mechanism], *seed: object) -> tuple[Finding | None, Drawn]:
    """What a mechanism finds of itself in a recording that conceals it."""
    recording, simulation, drawn = concealed(kind, *seed)
    return kind.detect_and_fit(compared(recording, simulation, *seed), LEVEL), drawn


def distance(kind: type[Mechanism], limits: Parameter, truth: float) -> float:
    """Of a truth from the value, over that of the limit on its side: at most 1 where it is covered, to rounding."""
    if kind is GradualChange and (limits.value - 1) * (truth - 1) < 0:  # a course is told from either of its ends
        truth = 1 / truth
    reach = limits.high - limits.value if truth > limits.value else limits.value - limits.low
    return abs(truth - limits.value) / (reach + ROUNDING * abs(truth))


class Coverage(NamedTuple):
    """Draws in which a mechanism was found, of how many, and the truth's distances for each kind of parameter."""

    found: int
    n: int
    distances: dict[str, list[float]]

    def covered(self, name: str) -> int:
        return sum(d <= 1 for d in self.distances[name])


def coverage(kind: type[Mechanism], n: int) -> Coverage:
    distances: dict[str, list[float]] = {}
    n_found = 0
    for seed in range(n):
        finding, drawn = found(kind, seed)
        if finding is None:
            continue
        n_found += 1
        assert finding.gain > 0
        for name in drawn.truth.keys() & finding.parameters.keys():
            family = name.split("[")[0]
            distances.setdefault(family, []).append(distance(kind, finding.parameters[name], drawn.truth[name]))
    return Coverage(n_found, n, distances)


@every_physics
def test_limits_are_near_the_truth(kind: type[Mechanism]):
    """Of one draw each."""
    finding, drawn = found(kind, "near")
    assert finding is not None
    assert finding.gain > 0
    for name in drawn.truth.keys() & finding.parameters.keys():
        assert distance(kind, finding.parameters[name], drawn.truth[name]) < 3, name


@pytest.mark.statistical
@every_physics
def test_limits_cover(kind: type[Mechanism], draws: Callable[[int, int], int]):
    """As often as limits that hold in 90 of 100 do in 999 of 1000 studies."""
    drawn = draws(*DRAWN)
    seen = coverage(kind, drawn)
    print(name_of(kind), seen.found, {k: (seen.covered(k), len(d)) for k, d in seen.distances.items()})
    assert seen.found >= drawn / 4  # elsewhere a look-alike is found in its place
    for name, distances in seen.distances.items():
        assert seen.covered(name) >= stats.binom.ppf(1e-3, len(distances), 0.90), name


# Where nothing is missing.


def null(seed: int) -> Comparison:
    """Noise of one law on both sides: white, coloured or rounded, of 1 to 12 sensors, with channels and a tone."""
    rng = generator("null", seed)
    n_sensors = (1, 2, 3, 6, 12)[seed % 5]
    noise = (gf.WhiteNoise(1.0) + gf.RandomWalk(1e-9), NOISE, NOISE)[seed % 3]
    both = noise.simulate((1 + RECORDS) * SHORTEST, batch=(n_sensors,), generator=rng)
    both = both + (seed % 2) * tone(n_sensors, both.shape[-1], 0.0)
    if seed % 3 == 2:
        both = 0.4 * (both / 0.4).round()
    motion = torch.randn(5, SHORTEST, generator=rng, dtype=torch.float64)
    channels = {"acceleration": motion[:3] + 0.5, "rate": motion[3:4], "temperature": motion[4:].cumsum(-1) / 20}
    recording = gf.Recording(both[:, :SHORTEST], RATE, unit="deg/s", channels=channels)
    return compared(recording, gf.Recording(both[:, SHORTEST:], RATE, unit="deg/s"), seed)


def false_findings(n: int) -> Counter[str]:
    """How many of so many nulls each mechanism is found in."""
    count: Counter[str] = Counter()
    for seed in range(n):
        comparison = null(seed)
        count.update(name_of(kind) for kind in PHYSICS if kind.detect_and_fit(comparison, LEVEL) is not None)
    return count


def test_finds_nothing_in_few_nulls():
    assert not false_findings(3)


@pytest.mark.statistical
def test_finds_nothing_in_nulls(draws: Callable[[int, int], int]):
    """More than `LEVEL` says in no more of 1000 studies than one."""
    nulls = draws(*NULLS)
    count = false_findings(nulls)
    print(count)
    assert max(count.values(), default=0) <= stats.binom.isf(1e-3, nulls, LEVEL)


# Who is told from whom.


def named(kind: type[Mechanism], *seed: object) -> bool:
    """Whether a diagnosis names a mechanism that is concealed, or lists it with what it names."""
    recording, simulation, _ = concealed(kind, *seed)
    report = gf.diagnose(recording, simulation)
    return any(kind.name in (finding.mechanism, *finding.alternatives) for finding in report.findings)


@pytest.mark.parametrize("kind", QUICK, ids=name_of)
def test_is_named_or_listed(kind: type[Mechanism]):
    """Of one draw each."""
    assert named(kind, "named")


@pytest.mark.statistical
@every_physics
def test_is_named_or_listed_nearly_always(kind: type[Mechanism], draws: Callable[[int, int], int]):
    """As often as what is named in 9 of 10 diagnoses is in 999 of 1000 studies, and at least once."""
    diagnosed = draws(*DIAGNOSED)
    count = sum(named(kind, seed) for seed in range(diagnosed))
    print(name_of(kind), count, diagnosed)
    assert count >= max(stats.binom.ppf(1e-3, diagnosed, 0.90), 1)
