"""Mechanisms that are shapes of the spectrum: named, measured, explained, simulated."""

from __future__ import annotations

import pytest
import torch
from scipy import signal
from shape_draws import (
    CHANGES,
    RATE,
    SIGNS,
    WHITE,
    N,
    P,
    array,
    comparison,
    drawn,
    generator,
    nominated,
    tensor,
    wandering,
)
from slow_cases import slow_but_for
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.detectors.spectra.pooled_coherence import common_source_test
from gyrofuse.mismatch.detectors.spectra.shape_scan import shape_test
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import filter_response, filter_strength
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode
from gyrofuse.mismatch.mechanisms.spectra.bumps.resonance import Resonance
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_tone import DriftingTone
from gyrofuse.mismatch.mechanisms.spectra.common_source import CommonMode
from gyrofuse.mismatch.mechanisms.spectra.low_pass import LowPassFilter
from gyrofuse.mismatch.mechanisms.spectra.parameter_change import ParameterShift
from gyrofuse.mismatch.mechanisms.spectra.slopes.flicker import FlickerNoise
from gyrofuse.mismatch.mechanisms.values.unit_scale import GRAVITY, UnitScale
from gyrofuse.mismatch.selection.held_out import score_held_out
from gyrofuse.mismatch.signals.filters import filtered, noise
from gyrofuse.noise.array_model import ArrayModel


@pytest.mark.statistical
@pytest.mark.parametrize("share", [0.06, 0.75])
def test_white_noise_of_which_sensors_share_a_part_is_named_though_no_power_changes(share: float) -> None:
    g = generator(32)
    own, simulation = array((1 - share) * WHITE).simulate(N, generator=g), array().simulate(N, batch=(1,), generator=g)
    gain = (share * WHITE * torch.tensor([1 + i / 20 for i in range(P)], dtype=torch.float64)).sqrt()
    given = comparison(own + gain[:, None] * torch.randn(1, N, generator=g, dtype=torch.float64), simulation)
    found = CommonMode.detect_and_fit(given, 1e-4)
    assert found is not None
    assert isinstance(found.effect, CommonMode)
    assert found.effect.inside
    for i in found.sensors:
        entry = found.parameters[f"gain[{i}]"]
        assert abs(entry.value - float(gain[i])) < 2.1 * (entry.high - entry.low) / 2
    explained = found.effect.repair(given, g)
    assert shape_test(explained).p_value > 1e-4
    assert common_source_test(explained).p_value > 1e-4


@pytest.mark.slow
def test_noise_of_one_sensor_alone_is_of_no_common_source_and_may_be_two_levels() -> None:
    noise, g = gf.WhiteNoise(1.0) + gf.AR1(0.999, 1e-4) + gf.RandomWalk(1e-8), generator(7)
    recording, simulation = (noise.simulate(N, batch=(P,), generator=g) for _ in range(2))
    recording[0] += gf.AR1(0.9, 1e-2).simulate(N, generator=g)
    found = nominated(comparison(recording, simulation[None]), 1e-2)
    assert found is not None
    assert found.mechanism != "common_mode"
    assert found.sensors == (0,)
    assert "random_telegraph" in found.alternatives


@pytest.mark.statistical
@pytest.mark.parametrize("seed", [701, 708])
def test_a_number_that_pays_by_chance_makes_no_sensor_take_part(seed: int):
    """Three sensors of six have 30 nats each; a number of another one would gain more than its two nats."""
    given = drawn(seed, lambda x, g: torch.cat([1.05 * x[:3], x[3:]]))
    found = ParameterShift.detect_and_fit(given, 1e-3)
    assert found is not None
    assert found.sensors == (0, 1, 2)


@pytest.mark.statistical
@pytest.mark.parametrize("name", CHANGES)
def test_what_is_missing_is_named_measured_and_explained(name: str):
    mechanism, change, truth = CHANGES[name]
    given = drawn(sum(map(ord, name)), change)
    found = nominated(given)
    assert found is not None
    assert found.mechanism == mechanism
    assert set(found.alternatives) <= {"drifting_tone", "resonance", "random_telegraph"}
    assert found.sensors == tuple(range(P))
    assert found.p_value < 1e-6
    for key, value in truth.items():
        entry = found.parameters[key]
        assert entry.low < entry.value < entry.high
        # Four standard deviations; one estimate is no test of coverage.
        assert abs(entry.value - value) < 2.1 * (entry.high - entry.low) / 2, key
    assert score_held_out(given, found.effect).confirms(found.p_value)
    explained = found.effect.repair(given, generator(1))
    assert shape_test(explained).p_value > 1e-4
    assert nominated(explained, 1e-4) is None  # a tenth of the level that the first one was held to


@pytest.mark.statistical
def test_a_filter_and_what_it_acts_on_are_found_one_after_the_other():
    def change(x: Tensor, g: torch.Generator) -> Tensor:
        q = filter_strength("bilinear2", tensor(*(P * [0.3])))
        return filtered(x + 0.004 * wandering(g) * SIGNS[:, None], lambda f: filter_response("bilinear2", q, f))

    given, names = drawn(12, change), []
    while (found := nominated(given)) is not None:
        names.append(found.mechanism)
        given = found.effect.repair(given, generator(2))
        assert len(names) < 4
    assert names == ["drifting_tone", "low_pass"]


@pytest.mark.statistical
def test_one_sensor_of_many_that_is_louder_has_nothing_in_common_with_the_others():
    """Gains of eleven others follow chance, most of all in the few ordinates that show a walk."""
    g, sensor = generator(40), gf.WhiteNoise(0.1) + gf.AR1(0.9999, 1e-9) + gf.RandomWalk(5e-10)
    louder = gf.WhiteNoise(0.46) + gf.AR1(0.9999, 5e-9) + gf.RandomWalk(4e-9)
    observed = ArrayModel.from_sensors([louder, *[sensor] * 11]).simulate(11291, generator=g)
    found = nominated(
        comparison(observed, ArrayModel.from_sensors([sensor] * 12).simulate(11291, batch=(1,), generator=g))
    )
    assert found is not None
    assert (found.mechanism, found.sensors) == ("parameter_shift", (0,))


@pytest.mark.statistical
def test_two_sensors_of_many_that_share_a_third_of_their_noise_are_told_with_possible_gains() -> None:
    g, p, share = generator(43), 8, 0.35
    simulation = ArrayModel.from_sensors([gf.WhiteNoise(WHITE) + gf.RandomWalk(1e-9)] * p)
    observed = ArrayModel.from_sensors(
        [gf.WhiteNoise(WHITE * ((1 - share) if i in (2, 5) else 1)) + gf.RandomWalk(1e-9) for i in range(p)]
    ).simulate(N, generator=g)
    observed[[2, 5]] += (share * WHITE) ** 0.5 * torch.randn(1, N, generator=g, dtype=torch.float64)
    found = nominated(comparison(observed, simulation.simulate(N, batch=(1,), generator=g)))
    assert found is not None
    assert (found.mechanism, found.sensors) == ("common_mode", (2, 5))
    gains = [found.parameters[f"gain[{i}]"].value for i in found.sensors]
    assert max(gains) ** 2 < WHITE
    assert gains[0] * gains[1] == pytest.approx(share * WHITE, rel=0.2)


def test_less_white_noise_is_no_other_unit_though_it_has_most_bands():
    def sensors(white: float) -> ArrayModel:
        return ArrayModel.from_sensors([gf.WhiteNoise(white) + gf.RandomWalk(1e-9)] * 2)

    g = generator(41)
    simulation = sensors(1e-4).simulate(N, batch=(1,), generator=g)
    quieter = sensors(1e-4 / GRAVITY**2).simulate(N, generator=g)
    assert UnitScale.detect_and_fit(comparison(quieter, simulation), 1e-3) is None
    in_g = sensors(1e-4).simulate(N, generator=g) / GRAVITY
    assert UnitScale.detect_and_fit(comparison(in_g, simulation), 1e-3) is not None


@pytest.mark.slow
def test_noise_that_falls_almost_as_flicker_noise_does_has_one_name():
    """Strong `1/f` noise that is a tenth weaker at the highest frequencies: whatever bends a spectrum would mend it."""

    def almost(f: Tensor) -> Tensor:
        return (1 - 0.4 * f) / f

    given = drawn(12, lambda x, g: x + 0.05 * noise(N, almost, P, g))
    found = nominated(given)
    assert found is not None
    assert found.mechanism == "flicker"
    assert "its form is not quite one of the catalogue" in found.sentence
    assert nominated(found.effect.repair(given, generator(2))) is None


def effects() -> dict[str, Mechanism]:
    given = drawn(13)
    gain = torch.polar(SIGNS.abs() * 0.01, tensor(0.0, 0.5, 3.0, 1.0, 2.0, -1.0))
    factors = torch.zeros(4, P, dtype=torch.float64)
    factors[0], factors[1], factors[3] = 0.4, -0.5, 0.7
    return {
        "parameter_shift": ParameterShift(given.base, factors),
        "low_pass": LowPassFilter("pole", tensor(0.1, 0.2, 0.3, 0.2, 0.1, 0.0)),
        "resonance": Resonance(Mode(0.1, 0.01, gain, shared=False)),
        "resonance of all": Resonance(Mode(0.1, 0.01, gain, shared=True)),
        "drifting_tone": DriftingTone(Mode(0.1, 0.02, 0.3 * gain, shared=True), slow=False),
        "flicker": FlickerNoise(1e-6 * SIGNS.square()),
        "white in common": CommonMode("white", 0.0, gain, given.base, inside=False),
        "AR1 in common": CommonMode("ar1", 0.01, gain, given.base, inside=False),
        "walk in common": CommonMode("walk", 0.0, gain / 100, given.base, inside=False),
        "white of both": CommonMode("white", 0.0, gain / 2, given.base, inside=True),
    }


@pytest.mark.parametrize("name", list(effects()))
def test_signals_have_the_spectra_that_a_mechanism_promises(name: str):
    effect, given = effects()[name], drawn(14)
    n_records = 6
    plain = array().simulate(N, batch=(n_records,), generator=generator(15))
    built = effect.apply(plain, given.info, generator(16))
    assert built.shape == plain.shape
    before, after = comparison(given.recording, plain), comparison(given.recording, built)
    places = given.bands.nodes
    matrices = torch.diag_embed(before.base.spectrum(places).mT).to(torch.complex128)
    promised = effect.spectra(matrices, places).movedim(0, -1)
    expected = given.bands.mean_of(promised).movedim(-1, 0)
    high = given.bands.dof > 40
    level = expected.diagonal(dim1=-2, dim2=-1).real.sqrt()
    error = (after.reference.spectra - expected).abs() / (level[:, :, None] * level[:, None, :])
    spread = (n_records * given.bands.dof).rsqrt()
    # A source of one path is common: its errors in several sensors are one error.
    assert float((error.amax((-1, -2)) / spread)[high].median()) < 4.0
    assert float((error.amax((-1, -2)) / spread)[high].max()) < 12.0


REFITTED = ("levels", "filter", "own modes", "one mode", "flicker", "white in common")


@pytest.mark.parametrize("name", slow_but_for(("filter",), REFITTED))
def test_numbers_without_a_fold_are_near_those_of_all(name: str):
    _, change, _ = CHANGES[name]
    given = drawn(17, change)
    found = nominated(given)
    assert found is not None
    part = found.effect.fit_without(given, 0)
    f = torch.linspace(0.02, 0.45, 40, dtype=torch.float64)
    matrices = torch.diag_embed(given.base.spectrum(f).mT).to(torch.complex128)
    one, other = (e.spectra(matrices, f).diagonal(dim1=-2, dim2=-1).real for e in (found.effect, part))
    assert float((one / other).log().abs().mean()) < 0.1


def test_nothing_is_named_where_nothing_is_missing():
    named = [f.mechanism for s in range(3) if (f := nominated(drawn(500 + s))) is not None]
    assert named == []


@pytest.mark.slow
@pytest.mark.parametrize("corner", [0.125, 0.3, 0.4])
def test_a_strong_filter_of_one_sensor_of_three_is_named_with_its_form(corner: float):
    """Thousands of nats beside two sensors that differ in nothing; found nothing before."""
    g = generator(31)
    recording, simulation = (
        x[..., :3, :] for x in (array().simulate(N, generator=g), array().simulate(4 * N, generator=g))
    )
    recording = recording.clone()
    recording[0] = torch.from_numpy(signal.lfilter(*signal.butter(1, 2 * corner), recording[0].numpy()).copy())
    given = comparison(recording, simulation.unflatten(-1, (4, N)).movedim(-2, 0))
    found = nominated(given)
    assert found is not None
    assert (found.mechanism, found.sensors) == ("low_pass", (0,))
    assert "form" not in found.sentence
    entry = found.parameters["corner[0]"]
    assert abs(entry.value - RATE * corner) < 2.1 * (entry.high - entry.low) / 2


@pytest.mark.slow
def test_a_filter_of_another_form_is_named_and_said_to_differ():
    """A FIR filter under a Hamming window: no form of the catalogue."""
    g = generator(32)
    recording, simulation = array().simulate(N, generator=g), array().simulate(N, batch=(4,), generator=g)
    taps = signal.firwin(21, 0.4)
    recording[0] = torch.from_numpy(signal.lfilter(taps, 1.0, recording[0].numpy()).copy())
    given = comparison(recording, simulation)
    found = nominated(given)
    assert found is not None
    assert (found.mechanism, found.sensors) == ("low_pass", (0,))
    assert "% of how the spectra differ is explained" in found.sentence
    # What its form leaves is not given another name.
    assert nominated(found.effect.repair(given, g)) is None
