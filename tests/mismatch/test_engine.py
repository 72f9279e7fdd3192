"""Diagnosis from end to end: verdicts, names, repairs, and what is said of input that does not fit."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import sys

import pytest
import torch
from scipy import stats

import gyrofuse as gf
from gyrofuse.mismatch import MismatchReport, diagnose, discrepancy
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode
from gyrofuse.mismatch.mechanisms.spectra.bumps.resonance import Resonance
from gyrofuse.mismatch.mechanisms.spectra.low_pass import LowPassFilter
from gyrofuse.mismatch.mechanisms.values.clipping import Clipping
from gyrofuse.mismatch.mechanisms.values.unit_scale import UnitScale
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.selection.forward import is_known, select
from gyrofuse.mismatch.selection.null_replicates import twin, twin_p_values
from gyrofuse.mismatch.signals.comparison import RecordingInfo
from gyrofuse.mismatch.stats.multiplicity import monte_carlo_p_value

MODEL = gf.WhiteNoise(1.0) + gf.AR1(0.999, 1e-4) + gf.RandomWalk(1e-8)
N, RATE = 2**14, 100.0


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def array(seed: int, n_samples: int = N) -> gf.Recording:
    return gf.Recording(MODEL.simulate(n_samples, batch=(6,), generator=generator(seed)), rate=RATE, unit="deg/s")


def with_tone(recording: gf.Recording, amplitude: float) -> gf.Recording:
    gains = torch.tensor([1.0, 0.5, 0.0, 0.0, 0.8, 0.0], dtype=torch.float64)[:, None]
    wave = torch.sin(2 * math.pi * 12.34 * recording.time + 1)
    return gf.Recording(recording.signal + amplitude * gains * wave, rate=RATE, unit="deg/s")


@functools.cache
def concealed_tone() -> tuple[MismatchReport, list[tuple[str, float]]]:
    """A tone, diagnosed with a simulation four times as long, and what progress was told."""
    told: list[tuple[str, float]] = []
    simulation = array(2, 4 * N)
    return diagnose(with_tone(array(1), 0.12), simulation, progress=lambda *step: told.append(step)), told


def test_a_concealed_tone_is_found_named_and_repaired():
    report, _ = concealed_tone()
    assert report.mismatch
    (finding,) = report.findings
    assert finding.mechanism == "vibration_tone"
    assert finding.sensors == (0, 1, 4)
    frequency = finding.parameters["frequency"]
    assert frequency.low < 12.34 < frequency.high
    assert frequency.unit == "Hz"
    for i, truth in ((0, 0.12), (1, 0.06), (4, 0.096)):
        entry = finding.parameters[f"amplitude[{i}]"]
        assert abs(entry.value - truth) < 2 * (entry.high - entry.low)
    assert not report.unexplained
    assert report.held_out.gain > 10
    assert finding.held_out_gain == pytest.approx(report.held_out.gain)


def test_a_fact_on_the_numbers_is_found_once():
    """What its repair could not take away in some of its sensors is no other one; a second step there would be."""
    signal = array(3).signal
    clipped = gf.Recording(signal.clamp(max=signal[:, ::2000].amax()), rate=RATE, unit="deg/s")
    found = Clipping.detect_and_fit(prepared(clipped, array(4), None, generator(0)), 0.01)
    assert found is not None
    assert len(found.sensors) > 1
    fewer = dataclasses.replace(found, sensors=found.sensors[:1])
    assert is_known(fewer, [found])
    assert not is_known(found, [fewer])
    steps = [dataclasses.replace(f, mechanism="step", effect=UnitScale(2.0)) for f in (fewer, found)]
    assert not is_known(steps[0], steps[1:])


def test_what_was_found_is_taken_off_and_simulated_again():
    recording = with_tone(array(1), 0.12)
    report, _ = concealed_tone()
    left = diagnose(gf.Recording(report.correct(recording.signal), rate=RATE, unit="deg/s"), array(3, 4 * N))
    assert not left.mismatch
    with pytest.raises(ValueError, match=r"expected the .* Hz of the diagnosis, got 1e\+06 Hz"):
        report.correct(gf.Recording(recording.signal, rate=1e6, unit="deg/s"))
    again = report.model.simulate(4 * N, generator=generator(4))
    assert not diagnose(recording, gf.Recording(again, rate=RATE, unit="deg/s"), false_alarm=1e-3).mismatch


@functools.cache
def agreement() -> MismatchReport:
    return diagnose(array(5), array(6, 4 * N))


def test_agreement_is_said():
    report = agreement()
    assert not report.mismatch
    assert report.findings == ()
    assert "agree" in report.summary()
    assert report.held_out.gain == 0
    assert report.held_out.before == report.held_out.after


def test_verdicts_are_repeatable_and_leave_the_global_generator_alone():
    state = torch.get_rng_state()
    recording = with_tone(array(1, N // 4), 0.23).select(sensors=[0, 1, 4])
    first, second = (diagnose(recording, MODEL) for _ in range(2))
    assert first.to_dict() == second.to_dict()
    assert torch.equal(state, torch.get_rng_state())


def test_results_are_plain_for_json():
    report, _ = concealed_tone()
    content = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert {"mismatch", "p_value", "findings", "unexplained", "held_out", "model", "evidence"} <= content.keys()
    assert {
        "mechanism", "alternatives", "sensors", "levels", "frequency_hz", "time_s", "channel", "parameters", "p_value",
        "held_out_gain", "gain_without", "instead", "sentence",
    } == content["findings"][0].keys()  # fmt: skip
    assert {"before", "after", "paired", "shares", "gain", "families", "auc"} == content["held_out"].keys()
    assert "vibration_tone" in str(report)


@pytest.mark.statistical
def test_models_and_samples_of_any_length_serve_as_simulations():
    some = [0, 1, 4]
    recording = with_tone(array(1, N // 2), 0.16).select(sensors=some)
    batched = MODEL.with_params(MODEL.params.expand(3, -1))
    samples = [array(2, n).select(sensors=some) for n in (N // 4, 3 * N // 4)]
    for simulation in (MODEL, batched, gf.ArrayModel.from_sensors([MODEL] * 3), *samples):
        report = diagnose(recording, simulation)
        assert [f.mechanism for f in report.findings] == ["vibration_tone"]


@pytest.mark.statistical
def test_other_units_are_a_finding():
    recording = array(1)
    report = diagnose(gf.Recording(recording.signal * math.pi / 180, rate=RATE), array(2, 4 * N).signal)
    assert report.mismatch
    assert report.findings[0].mechanism == "parameter_shift"
    assert "rad/s against deg/s" in report.findings[0].sentence
    assert len(report.findings) == 1
    assert not report.unexplained


@pytest.mark.slow
def test_the_discrepancy_is_that_of_a_diagnosis():
    two = [0, 1]
    recording, simulation = array(5, N // 2).select(sensors=two), array(6, N).select(sensors=two)
    louder = gf.Recording(1.2 * simulation.signal, rate=simulation.rate, unit=simulation.unit)
    alike, other = discrepancy(recording, simulation), discrepancy(recording, louder)
    assert alike == pytest.approx(diagnose(recording, simulation).held_out.before, rel=1e-12)
    assert other == pytest.approx(diagnose(recording, louder).held_out.before, rel=1e-12)
    assert alike < 1.5 < 5 < other
    model = gf.WhiteNoise(recording.signal.var(-1).mean().item())
    assert discrepancy(recording, model) == pytest.approx(diagnose(recording, model).held_out.before, rel=1e-12)
    with pytest.raises(ValueError, match="sensors"):
        discrepancy(recording, simulation.select(sensors=[0]))


def test_known_units_are_converted():
    assert not diagnose(array(5).to("rad/s"), array(6, 4 * N)).mismatch


@pytest.mark.statistical
def test_twins_agree_and_their_rank_is_a_p_value(draws):
    some = [0, 2, 4]
    comparison = diagnose(array(5, N // 4).select(sensors=some), array(6, N // 4).select(sensors=some)).comparison
    mate = twin(comparison, generator(1))
    assert mate.recording.shape == comparison.recording.shape
    assert mate.reference.signal.shape == comparison.reference.signal.shape
    n_twins = draws(30, 60)
    values = twin_p_values(comparison, n_twins, generator(2))
    hits = int((values < 0.05).sum())
    assert stats.binom.sf(hits - 1, n_twins, 0.05) > 1e-3
    assert monte_carlo_p_value(1.0, values) == 1.0
    assert monte_carlo_p_value(1e-9, values) < 1e-3  # more the 15 most extreme of them cannot tell


def test_the_fitted_tail_is_that_of_honest_witnesses():
    uniform = torch.rand(400, generator=generator(3), dtype=torch.float64)
    for p in (0.5, 0.1, 0.01, 1e-4):
        assert 0.5 < monte_carlo_p_value(p, uniform) / p < 2


@pytest.mark.statistical
@pytest.mark.parametrize("n_samples", [4096, 6144])
def test_simulations_far_shorter_than_the_recording_are_judged_by(n_samples):
    noise = gf.WhiteNoise(1.0)
    recording = noise.simulate(2**16, batch=(2,), generator=generator(5))
    simulations = noise.simulate(n_samples, batch=(8, 2), generator=generator(6))
    apart = torch.tensor([discrepancy(recording, simulation) for simulation in simulations])
    assert 0.3 < float(apart.mean()) < 3
    held_out = diagnose(recording, simulations[0]).held_out
    assert held_out.before == pytest.approx(float(apart[0]))
    assert 0.25 < held_out.auc_before < 0.65
    assert discrepancy(recording, 1.5 * simulations[0]) > 5
    louder = diagnose(1.3 * recording, simulations[0])
    assert [finding.mechanism for finding in louder.findings] == ["parameter_shift"]


@pytest.mark.parametrize("n_twins", [60, 256])
def test_a_p_value_among_few_twins_keeps_its_level(n_twins):
    own, among = torch.rand(5000, n_twins + 1, generator=generator(4), dtype=torch.float64).split([1, n_twins], -1)
    p = torch.tensor([monte_carlo_p_value(float(o), twins) for o, twins in zip(own, among, strict=True)])
    for level in (0.3, 0.1, 0.03, 0.01):
        # A fitted rate taken for the true one would alarm 1.5 times as often at the last.
        assert stats.binomtest(int((p < level).sum()), len(p), level).pvalue > 1e-3


def test_twins_that_all_say_the_same_tell_no_tail():
    assert monte_carlo_p_value(1e-9, torch.ones(20, dtype=torch.float64)) == pytest.approx(1 / 21)
    # Where most of them do, the ten others tell it, whose mean excess is one.
    some = torch.cat([torch.ones(246), torch.full((10,), math.exp(-1))]).to(torch.float64)
    assert monte_carlo_p_value(math.exp(-5), some) == pytest.approx(11 / 257 * (1 + 5 / 10) ** -10, rel=1e-6)


HALF_RATE = gf.Recording(array(2).signal, rate=RATE / 2)


@pytest.mark.parametrize(
    ("recording", "simulation", "options", "message"),
    [
        (torch.zeros(2, 5000).double(), MODEL, {}, "got constant ones: 1, 2; leave them out"),
        (array(1).signal[0], MODEL, {}, r"`recording`: expected \(..., sensor, time\)"),
        (array(1, 4000), MODEL, {}, "expected at least 4096 samples for a diagnosis, got 4000"),
        (array(1), array(2).select(sensors=[0, 1]), {}, "expected 6 sensors as in the recording, got 2"),
        (array(1), gf.Recording(array(2).signal, rate=50.0), {}, "expected samples at 100 Hz.*got 50 Hz"),
        (array(1), "model.json", {}, "expected a recording, a tensor.*got str"),
        (array(1), MODEL, {"rate": 100.0}, "the recording has one"),
        (array(1), MODEL, {"false_alarm": 1.5}, "`false_alarm`: expected a number between 0 and 1"),
        (array(1), MODEL, {"twins": 3}, "`twins`: expected 0, or 50 or more, got 3"),
        (array(1).signal[None].expand(3, -1, -1), MODEL, {}, "one axis at a time"),
        (array(1), MODEL.with_params(MODEL.params.expand(5, -1)), {}, r"parameters \(6,\) for each, got.*\(5,\)"),
        (array(1), MODEL, {"generator": 0}, r"expected a torch.Generator, got int; make one by `torch.Generator\(\)"),
        (array(1), array(2).select(sensors=[5, 0, 1, 2, 3, 4]), {}, "expected the sensors in the order 1, 2.*got 6, 1"),
        (
            array(1),
            gf.fit_gmwm(HALF_RATE, "WN"),
            {},
            "a fit of records at 100 Hz as of the recording, got one at 50 Hz",
        ),
        (array(1), gf.WhiteNoise() + gf.AR1(), {}, "expected a number, got a parameter to be estimated"),
    ],
)
def test_what_does_not_fit_is_told(recording, simulation, options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        diagnose(recording, simulation, **options)


def test_missing_samples_are_told():
    signal = array(1).signal.clone()
    signal[2, 100] = math.nan
    with pytest.raises(
        ValueError, match="expected whole sensors, got missing samples in 3; give a stretch without gaps"
    ):
        diagnose(gf.Recording(signal, rate=RATE), MODEL)


def test_progress_is_told_and_never_goes_back():
    _, told = concealed_tone()
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert 0 <= shares[0] < 0.1
    assert 0.8 < shares[-1] <= 1
    assert any("vibration_tone" in what for what, _ in told)


def test_sensors_that_add_up_to_nothing_are_refused():
    signal = array(1).signal
    with pytest.raises(ValueError, match="`recording`: expected sensors with noise of their own"):
        diagnose(signal - signal.mean(0), array(2).signal)


@pytest.mark.statistical
@pytest.mark.parametrize(("step", "hides"), [(3.0, False), (4.0, True)])
def test_of_values_that_hardly_leave_a_step_only_the_step_is_told(step: float, hides: bool):
    g = torch.Generator().manual_seed(1)
    noise = gf.ArrayModel.from_sensors([gf.WhiteNoise(1.0 + i / 10) + gf.AR1(0.99, 1e-3) for i in range(3)])
    recording = step * torch.round(noise.simulate(2**15, generator=g) / step)
    found = diagnose(recording, noise.simulate(2**15, generator=g), rate=100.0)
    (finding,) = found.findings
    assert finding.mechanism == "quantization"
    hidden = "the noise of sensors 1, 2, 3 is so much smaller that nothing else can be told there"
    assert finding.sentence.endswith(hidden) == hides
    assert not found.unexplained
    assert found.held_out.after < 2 < found.held_out.before


@pytest.mark.statistical
@pytest.mark.parametrize(("mechanism", "step"), [("resonance", 6.0), ("low_pass", 4.0)])
def test_beside_a_sensor_that_hardly_leaves_a_step_the_others_are_searched_on(mechanism: str, step: float):
    """And what is left is told as unexplained: the rounded sensor has the same in it, of which no more can be told."""
    g = torch.Generator().manual_seed(1)
    info = RecordingInfo(100.0, "unknown", tuple("abcdef"))
    noise = gf.ArrayModel.from_sensors([gf.WhiteNoise(1.0 + i / 10) + gf.AR1(0.99, 1e-3) for i in range(6)])
    recording, simulation = (noise.simulate(8191, generator=g) for _ in range(2))
    effects = {
        "resonance": Resonance(Mode(0.17, 0.01, torch.full((6,), 0.6, dtype=torch.complex128), True)),
        "low_pass": LowPassFilter("pole", torch.full((6,), 0.4, dtype=torch.float64)),
    }
    recording = effects[mechanism].apply(recording, info, g)
    recording[2] = step * torch.round(recording[2] / step)
    found = diagnose(recording, simulation, rate=100.0)
    rounding, *others = found.findings
    assert (rounding.mechanism, rounding.sensors, rounding.hides) == ("quantization", (2,), (2,))
    assert [(f.mechanism, f.sensors) for f in others] == [(mechanism, (0, 1, 3, 4, 5))]
    assert any("sensor 3" in e.words for e in found.unexplained)
    assert not any(e.sensors and 2 not in e.sensors for e in found.unexplained)
    steps = found.model.effects[0].apply(simulation, info, g)[2].diff() / step
    assert float((steps - steps.round()).abs().max()) < 1e-9


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_what_lies_on_a_device_is_diagnosed_as_it_is_beside_the_processor():
    recording, simulation = with_tone(array(1, 2**13), 0.3), array(2, 2**13)
    model = gf.fit_gmwm(simulation, "WN + RW").model
    for given in (simulation.signal, model, gf.ArrayModel([(gf.WhiteNoise(1.0), torch.eye(6))])):
        there = model_on_device(given) if isinstance(given, gf.Model) else given
        there = there.cuda() if isinstance(there, torch.Tensor) else there
        expected = diagnose(recording.signal, given, judge=array(3, 2**13).signal)
        got = diagnose(recording.signal.cuda(), there, judge=array(3, 2**13).signal.cuda())
        assert got.to_dict() == expected.to_dict()


def model_on_device(model: gf.Model) -> gf.Model:
    return model.with_params(model.params.cuda(), estimated_from=model.estimated_from)


@pytest.mark.slow
def test_what_leads_away_is_searched_without(monkeypatch: pytest.MonkeyPatch):
    """Once: what was found in its place may have been hidden behind it."""
    module = sys.modules[diagnose.__module__]
    searches, first = [], module.nearer

    def search(start, level, generator, progress, but_for):
        searches.append(but_for)
        return select(start, level, generator, progress, but_for)

    def none_of_tones(selected, start, comparison, generator):
        kept = [one for one in selected if one.finding.mechanism != "vibration_tone"]
        return first(kept, start, comparison, generator)

    monkeypatch.setattr(module, "select", search)
    monkeypatch.setattr(module, "nearer", none_of_tones)
    found = diagnose(with_tone(array(1, 2**13), 1.0), array(2, 2**13))
    assert searches == [frozenset(), frozenset({VibrationTone})]
    assert "vibration_tone" not in [f.mechanism for f in found.findings]
    assert found.unexplained  # nothing else explains it
