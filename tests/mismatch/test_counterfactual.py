"""Findings left out, set against analysis-alikes, and dropped where others make them needless."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from scipy import stats

import gyrofuse as gf
from gyrofuse.mismatch import diagnose
from gyrofuse.mismatch.detectors.slow.scans import slow_analysis
from gyrofuse.mismatch.detectors.spectra.peak_fit import Oscillation
from gyrofuse.mismatch.detectors.spectra.peaks import Stretch
from gyrofuse.mismatch.detectors.spectra.steadiness import Steadiness, steadiness
from gyrofuse.mismatch.mechanisms.finding_parts import Alternative, Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, repaired
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone, line_near
from gyrofuse.mismatch.mechanisms.slow.late_warm_up import LateWarmUp
from gyrofuse.mismatch.mechanisms.slow.step import Step
from gyrofuse.mismatch.mechanisms.slow.warm_up import WarmUpTransient
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode, wandering_sd
from gyrofuse.mismatch.mechanisms.spectra.bumps.resonance import Resonance
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_tone import DriftingTone
from gyrofuse.mismatch.mechanisms.spectra.common_source import CommonMode
from gyrofuse.mismatch.mechanisms.spectra.parameter_change import ParameterShift
from gyrofuse.mismatch.mechanisms.spectra.slopes.flicker import FlickerNoise
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.reporting.text import otherwise_words
from gyrofuse.mismatch.selection import alternatives
from gyrofuse.mismatch.selection.alternatives import compare, rivals_of
from gyrofuse.mismatch.selection.backward import eliminate, nearer, same_line
from gyrofuse.mismatch.selection.discrepancy import mean_discrepancy
from gyrofuse.mismatch.selection.forward import Selected
from gyrofuse.mismatch.selection.held_out import HeldOutScore, score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import sd_of_sum
from gyrofuse.mismatch.stats.limits import amplitude_limits

MODEL = gf.WhiteNoise(1.0) + gf.AR1(0.999, 1e-4) + gf.RandomWalk(1e-8)
N, RATE, SENSORS = 2**14, 100.0, 4
LEVEL = 5e-4


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def case_of(seed: int, signal: torch.Tensor | None = None) -> Comparison:
    """A recording with a signal added, beside a simulation of twice its length."""
    recording = MODEL.simulate(N, batch=(SENSORS,), generator=generator(seed))
    simulation = MODEL.simulate(N, batch=(2, SENSORS), generator=generator(seed + 1))
    info = RecordingInfo(RATE, "deg/s", tuple("abcd"))
    return Comparison.of(info, recording if signal is None else recording + signal, simulation)


def tone(frequency: float, amplitude: float) -> torch.Tensor:
    angle = 2 * math.pi * frequency * torch.arange(N, dtype=torch.float64) / RATE
    return amplitude * torch.tensor([1.0, 0.7, 0.0, 0.5], dtype=torch.float64)[:, None] * angle.cos()


def step(size: float) -> torch.Tensor:
    return size * torch.ones(SENSORS, 1, dtype=torch.float64) * (torch.arange(N) >= N // 2)


def chain(comparison: Comparison, *mechanisms: type[Mechanism]) -> tuple[list[Selected], Comparison]:
    """Findings one after the other."""
    links = []
    for mechanism in mechanisms:
        finding = mechanism.detect_and_fit(comparison, LEVEL)
        assert finding is not None
        gain = score_held_out(comparison, finding.effect)
        links.append(Selected(replace(finding, held_out_gain=gain.total), comparison, gain))
        comparison = finding.effect.repair(comparison, generator(0))
    return links, comparison


def instead_of(finding: Finding, comparison: Comparison, beside: Sequence[Finding] = ()) -> tuple[str, ...]:
    """Names of events that explain as much as a finding."""
    return finding.effect.explained_by_others(comparison, finding, beside)


def test_red_noise_may_be_a_step_that_gains_as_much():
    stepped, plain = case_of(3, step(0.3)), case_of(3)
    scan = slow_analysis(stepped).scan("step")
    assert scan is not None
    assert scan.p_value < 0.01
    gain = torch.complex(*torch.full((2, SENSORS), 0.1, dtype=torch.float64))
    noise = CommonMode("walk", 0.0, gain, stepped.base, False)

    def alike(comparison: Comparison, effect: Mechanism, nats: float) -> tuple[str, ...]:
        return instead_of(Finding(effect.name, effect, "", 1e-4, (0, 1), {}, gain=nats), comparison)

    assert "step" in alike(stepped, noise, scan.gain + 4)
    assert "step" not in alike(stepped, noise, scan.gain + 6)
    assert alike(plain, noise, 10.0) == ()
    assert alike(stepped, VibrationTone.at(stepped, 12.0), scan.gain) == ()


def walking(seed: int, *, common: bool, steps: bool) -> torch.Tensor:
    """Increments of two sensors that have some each, or share them but for their size."""
    g, gains = generator(seed), torch.tensor([1.0, -0.7], dtype=torch.float64)[:, None]
    rows = torch.randn(1 if common else 2, N, generator=g, dtype=torch.float64)
    jumps = torch.where(rows.abs() >= rows.abs().topk(6).values[:, -1:], rows.sign(), 0.0)
    walk = (gains * (jumps if steps else 0.02 * rows)).cumsum(-1)
    return torch.cat([walk, torch.zeros(SENSORS - 2, N, dtype=torch.float64)])


@pytest.mark.statistical
@pytest.mark.parametrize("common", [True, False])
def test_several_steps_may_look_like_slow_noise_and_slow_noise_does_not_look_like_steps(common: bool, draws):
    gain = torch.tensor([1.0, -0.7, 0.0, 0.0], dtype=torch.complex128)
    told = {}
    for steps in (True, False):
        said = 0
        for seed in range(draws(3, 6)):
            comparison = case_of(40 + 2 * seed, walking(seed, common=common, steps=steps))
            effect: Mechanism = FlickerNoise(gain.real)
            if common:
                effect = CommonMode("walk", 0.0, gain, comparison.base, False)
            finding = Finding(effect.name, effect, "", 1e-4, (0, 1), {}, gain=100.0)
            said += "step" in instead_of(finding, comparison)
        told[steps] = said
    assert told == {True: draws(3, 6), False: 0}


def test_red_noise_beside_several_steps_may_be_more_of_them():
    plain = case_of(3)
    noise = FlickerNoise(torch.full((SENSORS,), 1e-3, dtype=torch.float64))
    red = Finding(noise.name, noise, "", 1e-4, (0, 1), {}, gain=10.0)
    one = Step(torch.ones(SENSORS, dtype=torch.float64), torch.zeros(3, SENSORS, dtype=torch.float64), 10.0)
    step_found = Finding(one.name, one, "", 1e-9, (0, 1), {}, gain=50.0)
    assert instead_of(red, plain, [step_found]) == ()
    assert instead_of(red, plain, [step_found, step_found]) == ("step",)
    assert instead_of(red, plain, [step_found, replace(step_found, sensors=(2, 3))]) == ()
    factors = torch.zeros(4, SENSORS, dtype=torch.float64)
    for row, alike in ((0, ()), (3, ("step",))):
        other = ParameterShift(plain.base, factors.index_fill(0, torch.tensor(row), 0.4))
        assert instead_of(replace(red, effect=other), plain, [step_found, step_found]) == alike


def test_what_stands_alone_stays_and_its_loss_is_its_gain():
    links, comparison = chain(case_of(1, tone(12.34, 0.15)), VibrationTone)
    after, left = eliminate(links, comparison, LEVEL, generator(0))
    (link,) = after
    assert left is comparison
    assert link.finding.gain_without == link.finding.held_out_gain
    assert link.finding.instead is not None
    assert link.finding.instead.mechanism == "resonance"
    assert link.finding.instead.gain < link.finding.gain_without - 10
    assert link.finding.alternatives == ()


def test_two_effects_are_each_judged_with_the_other_in():
    start = case_of(3, tone(12.34, 0.12) + step(0.5))
    links, comparison = chain(start, VibrationTone, Step)
    first, second = eliminate(links, comparison, LEVEL, generator(0))[0]
    # Without the tone: the recording less the step alone.
    left = links[1].finding.effect.repair(start, generator(0))
    assert first.finding.gain_without == pytest.approx(score_held_out(left, first.finding.effect).total, rel=1e-9)
    assert second.finding.gain_without == second.finding.held_out_gain


def test_what_others_make_needless_is_dropped_and_the_rest_rebuilt():
    start = case_of(5, tone(12.34, 0.15))
    (true,), _ = chain(start, VibrationTone)
    # The same tone a third too weak, found first: what it leaves was found again, and is all there is without it.
    effect = true.finding.effect
    assert isinstance(effect, VibrationTone)
    weak = replace(effect, frequency_hz=effect.frequency_hz + 0.3 * RATE / N, cosine=0.3 * effect.cosine)
    poor = replace(true.finding, effect=weak, p_value=0.1)
    middle = weak.repair(start, generator(0))
    links = [
        Selected(poor, start, score_held_out(start, weak)),
        Selected(true.finding, middle, score_held_out(middle, effect)),
    ]
    after, left = eliminate(links, effect.repair(middle, generator(0)), LEVEL, generator(0))
    (link,) = after
    assert link.before is start
    assert link.finding.held_out_gain == pytest.approx(true.finding.held_out_gain, rel=1e-9)
    torch.testing.assert_close(left.recording, effect.repair(start, generator(0)).recording)


def test_what_leads_away_with_all_the_others_goes_and_the_others_stay():
    """A tone that is there, and one that is not: with the second the simulation is farther off than it came."""
    start = case_of(5, tone(12.34, 0.3))
    (there,), _ = chain(start, VibrationTone)
    effect = there.finding.effect
    assert isinstance(effect, VibrationTone)
    wrong = replace(effect, frequency_hz=0.7 * effect.frequency_hz, cosine=effect.cosine + 1.0)
    links = [Selected(replace(there.finding, effect=wrong), start, score_held_out(start, wrong)), there]
    made = repaired(start, [wrong, effect], generator(0))
    kept, comparison = nearer(links, start, made, generator(0))
    assert kept == [there]
    assert mean_discrepancy(comparison) < mean_discrepancy(start) < mean_discrepancy(made)
    assert nearer(kept, start, comparison, generator(0)) == (kept, comparison)


def test_a_tone_stays_though_the_simulation_was_fitted_to_make_up_for_it():
    """Power of a tone as noise of the same wavelet variances: without the tone all levels are too loud."""
    white = gf.WhiteNoise(0.03).simulate(N, batch=(1,), generator=generator(5))
    fitted = gf.AR1(phi=-0.45, variance=0.1)
    simulation = fitted.simulate(N, batch=(2, 1), generator=generator(6))
    start = Comparison.of(RecordingInfo(RATE, "deg/s", ("a",)), white + tone(35.3, 0.42)[:1], simulation)
    (link,), made = chain(start, VibrationTone)
    assert mean_discrepancy(made) > 1.5 * mean_discrepancy(start)
    assert nearer([link], start, made, generator(0)) == ([link], made)


def test_a_better_look_alike_takes_the_place():
    decay = 1.2 * torch.ones(SENSORS, 1, dtype=torch.float64) * (-torch.arange(N) / (0.15 * N)).exp()
    start = case_of(7, decay)
    (true,), _ = chain(start, WarmUpTransient)
    effect = true.finding.effect
    assert isinstance(effect, WarmUpTransient)
    wrong = Step(-0.2 * effect.size, effect.log_factors, 0.1 * N / RATE)
    finding = replace(true.finding, mechanism="step", effect=wrong, p_value=1e-9)
    link = Selected(finding, start, score_held_out(start, wrong))
    assert link.score.confirms(1e-9)
    (after,) = eliminate([link], wrong.repair(start, generator(0)), LEVEL, generator(0))[0]
    assert after.finding.mechanism == "warm_up_transient"
    assert after.finding.instead is not None
    assert after.finding.instead.mechanism == "step"


@pytest.mark.statistical
@pytest.mark.parametrize("walk", [0.0, 1e-4])
def test_limits_of_a_tone_hold_though_its_phase_walks(walk: float):
    """Twenty tones each: fifteen within 95 % limits or fewer would come once in thousands."""
    hits, n = 0, 12_007
    for seed in range(20):
        g = generator(seed)
        noise = torch.randn(5, 2, n, generator=g, dtype=torch.float64)
        steps = math.sqrt(walk) * torch.randn(n, generator=g, dtype=torch.float64)
        phase = 2 * math.pi * 0.1234 * torch.arange(n, dtype=torch.float64) + steps.cumsum(0)
        given = Comparison.of(RecordingInfo(100.0, "deg/s", ("a", "b")), noise[0] + 0.25 * phase.cos(), noise[1:])
        found = VibrationTone.detect_and_fit(given, LEVEL)
        assert found is not None
        limits = found.parameters["frequency"]
        hits += limits.low <= 12.34 <= limits.high
    assert hits > 15


@pytest.mark.statistical
def test_a_line_that_wanders_is_told_once_and_not_as_tones():
    """Each of the tones that were found in it lost to a bump by hundreds of nats, and kept its name."""
    n, g = 12_007, generator(1)
    recording = torch.randn(3, n, generator=g, dtype=torch.float64)
    steps = math.sqrt(3e-3) * torch.randn(n, generator=g, dtype=torch.float64)
    line = (2 * math.pi * 0.1234 * torch.arange(n, dtype=torch.float64) + steps.cumsum(0)).cos()
    report = gf.diagnose(recording + 0.3 * line, gf.WhiteNoise(1.0), rate=100.0)
    (finding,) = report.findings
    assert finding.mechanism in ("drifting_tone", "resonance")
    low, high = finding.parameters["frequency"].low, finding.parameters["frequency"].high
    assert low - 0.05 < 12.34 < high + 0.05
    assert finding.instead is not None
    assert not finding.instead.beats(finding.gain_without or 0.0)


def test_lines_closer_than_their_width_are_one():
    given = case_of(1)
    rate, n, none = RATE, N, torch.zeros(SENSORS, dtype=torch.float64)

    def tone(frequency: float, reach: float, sensors: tuple[int, ...] = (0,)) -> Finding:
        limits = {"frequency": Parameter(frequency, frequency - reach, frequency + reach, "Hz")}
        effect = VibrationTone(frequency, none, none)
        return Finding("vibration_tone", effect, "", 0.0, sensors, limits, frequency_hz=frequency)

    def mode(kind: type[Mechanism], frequency: float, width: float) -> Finding:
        own = Mode(frequency / rate, width / rate, none.to(torch.complex128), True)
        effect = DriftingTone(own, True) if kind is DriftingTone else Resonance(own)
        return Finding(effect.name, effect, "", 0.0, (0,), {}, frequency_hz=frequency)

    f, resolution = 0.1 * rate, rate / n
    assert same_line(tone(f, 0.0), tone(f + 0.9 * resolution, 0.0), given)
    assert not same_line(tone(f, 0.0), tone(f + 1.1 * resolution, 0.0), given)
    assert same_line(tone(f, 0.0), tone(f + 4 * resolution, 5 * resolution), given)
    assert not same_line(tone(f, 0.0), tone(f, 0.0, (1,)), given)
    assert same_line(mode(DriftingTone, f, 0.5), tone(f + 0.4, 0.0), given)
    assert not same_line(mode(Resonance, f, 0.5), tone(f + 0.4, 0.0), given)  # a tone may stand on a resonance


def test_a_name_that_is_not_earned_goes_where_nothing_is_found_in_its_place():
    decay = 1.2 * torch.ones(SENSORS, 1, dtype=torch.float64) * (-torch.arange(N) / (0.15 * N)).exp()
    start = case_of(7, decay)
    (true,), _ = chain(start, WarmUpTransient)
    effect = true.finding.effect
    assert isinstance(effect, WarmUpTransient)
    wrong = Step(-0.2 * effect.size, effect.log_factors, 0.1 * N / RATE)
    finding = replace(true.finding, mechanism="step", effect=wrong, p_value=1e-9)
    link = Selected(finding, start, score_held_out(start, wrong))
    never = 0.0  # level at which no analysis-alike is found
    after, left = eliminate([link], wrong.repair(start, generator(0)), never, generator(0))
    assert after == []
    torch.testing.assert_close(left.recording, start.recording)


def test_the_converter_is_judged_on_numbers_as_they_came():
    start = case_of(9, tone(12.34, 0.15))
    rounded = start.with_recording((start.recording / 0.5).round() * 0.5)
    links, comparison = chain(rounded, Quantization, VibrationTone)
    after, _ = eliminate(links, comparison, LEVEL, generator(0))
    assert [link.finding.mechanism for link in after] == ["quantization", "vibration_tone"]
    assert after[0].finding.gain_without == after[0].finding.held_out_gain


def test_look_alikes_have_other_names_and_the_same_sensors():
    comparison = case_of(11, step(0.6))
    (link,), _ = chain(comparison, Step)
    rivals = rivals_of(link.finding, comparison)
    assert [rival.name for rival in rivals] == ["warm_up_transient"]
    assert isinstance(rivals[0], WarmUpTransient | LateWarmUp)
    assert rivals[0].size.nonzero()[:, 0].tolist() == list(link.finding.sensors)


def test_reports_tell_what_was_ruled_out(tmp_path):
    comparison = case_of(1, tone(12.34, 0.15))
    recording = gf.Recording(comparison.recording, rate=RATE, unit="deg/s")
    report = diagnose(recording, gf.Recording(comparison.reference.signal[0], rate=RATE, unit="deg/s"))
    (finding,) = report.findings
    words = otherwise_words(finding)
    assert words.startswith("closest look-alike of vibration tone: resonance, which in its place predicts held-out ")
    assert words.endswith("it is ruled out")
    assert words in report.summary()
    report.to_html(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "Closest look-alike of vibration tone: resonance" in page
    assert "lost if left out alone" in page
    entry = report.to_dict()["findings"][0]["instead"]
    assert {"mechanism", "gain", "sd"} == entry.keys()


def test_equals_are_told_as_such():
    finding = Finding(
        "step",
        Step(torch.ones(1), torch.zeros(1, 2), 1.0),
        "a step",
        1e-9,
        (0,),
        {},
        alternatives=("warm_up_transient",),
        gain_without=12.0,
        instead=Alternative("warm_up_transient", 11.0, 2.0),
    )
    assert otherwise_words(finding) == (
        "closest look-alike of step: warm up transient, which in its place predicts held-out data worse by 1.0 nats "
        "(standard deviation 2.0): these data do not tell which of the two it is"
    )
    likelier = replace(finding, instead=Alternative("warm_up_transient", 17.0, 2.0))
    assert "better by 5.0 nats (standard deviation 2.0): the name given here is in doubt" in otherwise_words(likelier)
    nothing = replace(finding, alternatives=(), instead=Alternative("warm_up_transient", -3.0, 2.0))
    assert otherwise_words(nothing).endswith("which in its place explains nothing of the held-out data")
    assert otherwise_words(replace(finding, instead=None)) == ""


@pytest.mark.parametrize(("apart", "told"), [(1.5, ("resonance",)), (2.5, ())])
def test_a_rival_within_two_standard_deviations_is_told(monkeypatch, apart: float, told: tuple[str, ...]):
    comparison = case_of(1, tone(12.34, 0.15))
    finding = VibrationTone.detect_and_fit(comparison, LEVEL)
    assert finding is not None
    scatter = 4.0 * (-1.0) ** torch.arange(16)
    difference = scatter + apart * sd_of_sum(scatter) / len(scatter)
    (peak,) = rivals_of(finding, comparison)
    gains = {
        finding.effect: HeldOutScore("spectra", 100 + difference, (), 1.0),
        peak: HeldOutScore("spectra", 100 + 0 * difference, (), 1.0),
    }
    monkeypatch.setattr(alternatives, "rivals_of", lambda *_: [peak])
    monkeypatch.setattr(alternatives, "score_held_out", lambda _, effect: gains[effect])
    compared = compare(finding, gains[finding.effect], comparison, [])
    assert compared.alternatives == told


def test_limits_of_amplitudes_hold_among_those_that_were_seen():
    seen = 3.0
    g = generator(13)
    for truth in (2.0, 3.0, 5.0, 15.0):
        z = torch.randn(2, 3000, generator=g, dtype=torch.float64)
        snr = torch.hypot(z[0] + truth, z[1])
        low, value, high = amplitude_limits(snr[snr > seen], seen)
        hits = int(((low <= truth) & (truth <= high)).sum())
        assert stats.binomtest(hits, len(low), 0.95).pvalue > 1e-3
        assert bool(((low <= value) & (value <= high)).all())


def test_limits_of_amplitudes_are_those_of_the_law():
    snr = torch.tensor([4.5], dtype=torch.float64)
    low, _, high = amplitude_limits(snr, 3.0)[:, 0].tolist()
    for limit, share in ((low, 0.025), (high, 0.975)):
        law = stats.ncx2(2, limit**2)
        assert law.sf(4.5**2) / law.sf(9.0) == pytest.approx(share, rel=1e-6)
    assert amplitude_limits(torch.tensor([3.01], dtype=torch.float64), 3.0)[0] == 0


def test_a_frequency_that_wanders_is_known_as_well_as_its_mean_over_the_record():
    width, n_draws = 20 / N, 40
    gain = torch.ones(SENSORS, dtype=torch.complex128)
    peak = Oscillation(Stretch(0.1, width, 0.0, ()), 0.1, width, (0.0, 0.0), gain.real, gain.real / 10, gain, 100.0)
    found = []
    for seed in range(n_draws):
        path = DriftingTone(Mode(0.1, width, gain, True), True).path(N, generator(seed))
        found.append(wandering_sd(case_of(100 + seed, path), peak) ** 2)
    tau = 8 / (2 * math.pi * width)  # samples, the memory of what wanders slowly
    truth = width**2 * 2 * tau / N * (1 - tau / N * (1 - math.exp(-N / tau)))
    assert 0.7 * truth < sum(found) / n_draws < 1.5 * truth


def test_the_highest_place_near_a_frequency_is_the_line():
    comparison = case_of(15, tone(12.34, 0.3))
    assert abs(line_near(comparison, 0.1236, 0.001) - 0.1234) < 1 / N


@pytest.mark.statistical
def test_noise_that_a_simulator_of_white_noise_lacks_leaves_a_better_one():
    white = gf.WhiteNoise(1.0)
    recording = (white + gf.AR1(0.9, 2e-2)).simulate(N, batch=(3,), generator=generator(4))
    report = diagnose(gf.Recording(recording, rate=RATE, unit="deg/s"), white)
    assert report.held_out.low > 0
    assert report.held_out.after < report.held_out.before
    names = {"parameter_shift", "flicker"}  # an AR1 has no name of its own
    assert all(names & {f.mechanism, *f.alternatives} for f in report.findings)
    for finding in report.findings:
        _, _, apart = finding.sentence.partition("; these data do not tell it apart from ")
        assert apart == ", ".join(name.replace("_", " ") for name in finding.alternatives)


def test_a_bump_at_either_end_of_the_spectrum_is_no_tone():
    comparison = case_of(5)
    one = torch.ones(SENSORS, dtype=torch.float64)
    for centre in (2.0 / N, 0.5 - 2.0 / N):
        stretch = Stretch(centre, 4.0 / N, 1e-6, (0,))
        peak = Oscillation(stretch, centre, 2.0 / N, (0.1, 0.1), one, 0.1 * one, one.to(torch.complex128), 10.0)
        assert steadiness(comparison, peak) == Steadiness(tone=False, open=True, slow=False)
