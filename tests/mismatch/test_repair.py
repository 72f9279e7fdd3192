"""What becomes of a simulation that is repaired: what acts last, what remains, and who can still tell."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import stats

import gyrofuse as gf
from gyrofuse.mismatch import diagnose
from gyrofuse.mismatch.mechanisms.remainders.coherence import CoherenceRemainder
from gyrofuse.mismatch.mechanisms.remainders.slow import SlowRemainder
from gyrofuse.mismatch.mechanisms.remainders.spectrum import Remainder
from gyrofuse.mismatch.mechanisms.slow.step import Step
from gyrofuse.mismatch.mechanisms.spectra.slopes.flicker import FlickerNoise
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.reporting.text import verdict
from gyrofuse.mismatch.selection import forward
from gyrofuse.mismatch.selection.classifier import area_under_curve, distinguishability, features
from gyrofuse.mismatch.selection.discrepancy import (
    differences_of_fold,
    discrepancy_left,
    discrepancy_p_value,
    mean_discrepancy,
    paired_discrepancy,
)
from gyrofuse.mismatch.selection.held_out import agreement, score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, estimation_samples, held_out_blocks, in_fold
from gyrofuse.mismatch.signals.psd import narrow_bands

N, P = 8192, 3
SCENE = RecordingInfo(100.0, "deg/s", ("1", "2", "3"))
NONE = torch.zeros(P, dtype=torch.float64)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def white(seed: int, n_records: int = 4) -> torch.Tensor:
    return torch.randn(n_records, P, N, generator=generator(seed), dtype=torch.float64)


def comparison(recording: torch.Tensor, seed: int = 2) -> Comparison:
    return Comparison.of(SCENE, recording, white(seed))


def rounding(step: float) -> Quantization:
    return Quantization(torch.full((P,), step, dtype=torch.float64), NONE, NONE, NONE)


def test_every_sample_is_held_out_once_and_estimates_never_see_it():
    signal = torch.arange(N + 5, dtype=torch.float64)
    seen = torch.cat([held_out_blocks(signal, fold).flatten() for fold in range(N_FOLDS)])
    assert torch.equal(seen.sort().values, signal[:N])
    for fold in range(N_FOLDS):
        kept = set(signal[estimation_samples(N + 5, fold)].tolist())
        assert kept.isdisjoint(held_out_blocks(signal, fold).flatten().tolist())
        assert len(kept) == N * (N_FOLDS - 1) // N_FOLDS
    assert torch.stack([in_fold(10, fold) for fold in range(N_FOLDS)]).sum(0).tolist() == [1] * 10


def test_rounding_stays_last_whatever_is_found_after_it():
    g = generator(3)
    noise = FlickerNoise(torch.full((P,), 0.3, dtype=torch.float64))
    after = noise.repair(rounding(0.5).repair(comparison(white(1)[0]), g), g)
    steps = after.reference.signal / 0.5
    assert torch.allclose(steps, steps.round())
    assert float(after.analog.diff().abs().amin()) > 0
    model = gf.ArrayModel.from_sensors([gf.Model([gf.WhiteNoise(1.0)])] * P)
    drawn = RepairedModel(model, SCENE, (rounding(0.5), noise)).simulate(1000, generator=g) / 0.5
    assert torch.allclose(drawn, drawn.round())


def test_what_happened_once_is_not_expected_elsewhere():
    step = Step(torch.ones(P, dtype=torch.float64), torch.zeros(P, 4, dtype=torch.float64), 10.0)
    model = gf.ArrayModel.from_sensors([gf.Model([gf.WhiteNoise(1.0)])] * P)
    repaired = RepairedModel(model, SCENE, (step, rounding(0.1)))
    assert [effect.name for effect in repaired.elsewhere().effects] == ["quantization"]


def test_a_remainder_has_the_ratio_of_the_spectra():
    f = torch.linspace(0.01, 0.49, 50, dtype=torch.float64)
    coloured = white(1)[0] + 0.8 * white(1)[0].roll(1, -1)
    found = Remainder.left_over(comparison(coloured))
    truth = (1 + 0.64 + 1.6 * torch.cos(2 * math.pi * f)).log() / 2
    assert float((found.response(f).log() - truth).abs().mean()) < 0.08
    before, after = comparison(coloured), found.repair(comparison(coloured), generator(1))
    one, other = (c.observed.power.log() - c.reference.power.log() for c in (before, after))
    assert float(other.abs().mean()) < 0.3 * float(one.abs().mean())


def test_a_remainder_has_narrow_peaks_too():
    """Narrower than a quarter of an octave, in which most of it would be lost."""
    f = torch.arange(N // 2 + 1, dtype=torch.float64) / N
    peak = 1 + 2 * torch.exp(-(((f - 0.3) / 0.008) ** 2))
    recording = torch.fft.irfft(torch.fft.rfft(white(1)[0]) * peak, n=N)
    found = Remainder.left_over(comparison(recording))
    at = torch.tensor([0.26, 0.3, 0.34], dtype=torch.float64)
    assert float((found.response(at)[:, 1] - 3).abs().max()) < 0.5
    assert float((found.response(at)[:, ::2] - 1).abs().max()) < 0.35


def test_sensors_share_what_those_of_the_recording_share():
    """A source a quarter of a cycle apart in two of three sensors, in one band."""
    f = torch.arange(N // 2 + 1, dtype=torch.float64) / N
    inside = ((f > 0.1) & (f < 0.2)).to(torch.complex128)
    own, source = white(1)[0], torch.fft.rfft(white(7)[0, 0])
    shared = torch.stack([source * inside, 1j * source * inside, 0 * source])
    recording = own + torch.fft.irfft(shared, n=N)
    start = comparison(recording)
    levelled = Remainder.left_over(start).repair(start, generator(1))
    after = CoherenceRemainder.left_over(levelled).repair(levelled, generator(1))
    band = (after.bands.frequency > 0.11) & (after.bands.frequency < 0.18)
    coherence = after.reference.coherence[band]
    assert float((coherence[:, 0, 1] - after.observed.coherence[band][:, 0, 1]).abs().max()) < 0.1
    assert float((coherence[:, 0, 1] - -0.5j).abs().mean()) < 0.1
    assert float(coherence[:, :2, 2].abs().mean()) < 0.1
    power = (after.reference.power / levelled.reference.power)[:, band]
    assert float((power - 1).abs().max()) < 0.1


def test_nothing_remains_where_nothing_differs():
    start = comparison(white(1)[0])
    found, narrow = CoherenceRemainder.left_over(start), narrow_bands(N)
    one, other = (side.in_bands(narrow).coherence for side in (start.observed, start.reference))
    assert float((found.after - found.before).abs().mean()) < 0.2 * float((one - other).abs().mean())
    assert float(Remainder.left_over(comparison(white(1)[0])).log_gain.abs().mean()) < 0.03


@pytest.mark.slow
def test_a_difference_without_a_name_stays_unexplained_and_is_filled_in():
    g, n = generator(5), 2**14
    base = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-8)
    recording = base.simulate(n, batch=(P,), generator=g)
    f = torch.arange(n // 2 + 1, dtype=torch.float64) / n
    ripple = 1 + 0.3 * torch.cos(8 * math.pi * f)
    recording = torch.fft.irfft(torch.fft.rfft(recording) * ripple, n=n)
    report = diagnose(recording, base.simulate(4 * n, batch=(P,), generator=g), rate=100.0)
    assert report.unexplained
    assert isinstance(report.model.effects[-1], Remainder)
    assert report.held_out.after < 0.5 * report.held_out.before
    assert report.held_out.auc_before > 0.8
    assert report.held_out.auc_after < 0.6
    assert "stands for no physics" in "".join(verdict(report))


def test_a_paired_discrepancy_allows_for_noise_that_is_unsteady():
    """Of 40 recordings whose noise comes and goes, with the simulation's power in the mean; not for a level off."""
    loud = torch.randint(0, 2, (40, 1, N_JUDGED), generator=generator(8))
    gain = (0.2 + 1.6 * loud).sqrt().repeat_interleave(N // N_JUDGED, -1)
    recordings, simulation = white(5, 40), white(2, 8)

    def both(recording: torch.Tensor) -> tuple[float, float]:
        start = Comparison.of(SCENE, recording, simulation)
        return paired_discrepancy([differences_of_fold(start, k) for k in range(N_FOLDS)]), mean_discrepancy(start)

    unsteady = torch.tensor([both(recording) for recording in gain * recordings]).mean(0)
    assert 0.7 < float(unsteady[0]) < 1.3
    assert float(unsteady[1]) > 2
    assert both(1.1 * recordings[0])[0] > 3


def test_area_under_the_curve_counts_pairs():
    positive, negative = torch.tensor([0.0, 1.0, 2.0]), torch.tensor([1.0, 3.0])
    pairs = [(p > n) + 0.5 * (p == n) for p in positive.tolist() for n in negative.tolist()]
    assert area_under_curve(positive, negative) == pytest.approx(sum(pairs) / 6)


def test_nobody_tells_what_is_alike_and_anybody_what_is_louder():
    areas = torch.tensor([[distinguishability(comparison(white(s)[0], s + 50), 0) for s in range(12)]])
    assert abs(float(areas.mean()) - 0.5) < 3 * float(areas.std()) / math.sqrt(12)
    assert distinguishability(comparison(1.3 * white(1)[0]), 0) > 0.9


def test_features_are_finite_for_what_stands_still():
    signal = torch.zeros(P, N, dtype=torch.float64)
    signal[:, ::7] = 1.0
    assert bool(features(signal, 32).isfinite().all())


@pytest.mark.parametrize("n", [4096, 4812, 5003])
def test_a_remainder_is_estimated_anew_from_the_blocks_of_the_shortest_recordings(n: int):
    """Their last bands are narrower than a bin of a block."""
    recording, simulation = white(3)[0, :, :n], white(4)[:, :, :n]
    given = Comparison.of(SCENE, 1.5 * recording, simulation)
    found = Remainder.left_over(given)
    for fold in range(N_FOLDS):
        again = found.fit_without(given, fold)
        assert bool(again.log_gain.isfinite().all())
        assert float(again.log_gain.mean()) == pytest.approx(math.log(1.5), abs=0.2)
        assert bool(again.held_out_scores(given, fold).isfinite().all())


def test_much_that_is_left_on_blocks_held_out_is_told():
    """Of three sensors with a third more power at all levels; of noise alone nothing, in each of 20 arrays."""
    rng = torch.Generator().manual_seed(4)
    info = RecordingInfo(1.0, "unknown", ("a", "b", "c"))
    noise = torch.randn(21, 2, 3, 16384, dtype=torch.float64, generator=rng)
    louder = Comparison.of(info, 1.15 * noise[20, 0], noise[20, 1:])
    told = discrepancy_left(louder, mean_discrepancy(louder))
    assert told is not None
    assert told.p_value < 1e-6
    assert 1 in told.levels
    for recording, simulation in noise[:20]:
        alike = Comparison.of(info, recording, simulation[None])
        assert discrepancy_left(alike, mean_discrepancy(alike)) is None


def test_the_discrepancy_left_has_a_p_value_that_errs_on_the_side_of_chance():
    """Of 200 arrays of two sensors p is below 5 % in no more than the law of 5 % has in 999 of 1000 studies."""
    rng = torch.Generator().manual_seed(5)
    noise = torch.randn(200, 2, 2, 8192, dtype=torch.float64, generator=rng).cumsum(-1) * 0.01
    noise = noise + torch.randn(noise.shape, dtype=torch.float64, generator=rng)
    below = 0
    for recording, simulation in noise:
        comparison = Comparison.of(RecordingInfo(1.0, "unknown", ("a", "b")), recording, simulation[None])
        p = discrepancy_p_value(comparison, mean_discrepancy(comparison))
        below += p < 0.05
    assert below <= stats.binom.ppf(0.999, 200, 0.05)


def test_what_is_left_of_a_slow_course_is_taken_off_as_it_goes_on_in_what_is_held_out():
    model, n = gf.WhiteNoise(1.0) + gf.AR1(0.99, 1e-3) + gf.RandomWalk(1e-7), 8192
    t, g = torch.arange(n, dtype=torch.float64), generator(1)
    signal = model.simulate(n, batch=(5, P), generator=g).double()
    bends = (2 * math.pi * t / 5000).sin() * (-t / 9000).exp()
    size = torch.zeros(P, 1, dtype=torch.float64)
    size[0], size[1] = 30.0, -20.0
    given = Comparison.of(SCENE, signal[0] + size * bends, signal[1:])
    course = SlowRemainder.left_over(given)
    gain = score_held_out(given, course)
    assert gain.confirms(1e-9)
    judged = agreement(given, [gain], g)
    assert judged.before > 3
    assert judged.after < 1.5
    left = course.remove(given.recording, SCENE) - signal[0]
    assert float(left[:2].mean(-1, keepdim=True).sub(left[:2]).abs().max()) < 3
    assert float((course.sizes[2:] != 0).sum()) <= 2  # of the others' noise next to nothing


def test_a_slow_course_without_a_name_is_no_finding(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(forward, "STAGES", ())
    model, n = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-8), 4096
    t, g = torch.arange(n, dtype=torch.float64), generator(2)
    recording = model.simulate(n, batch=(1,), generator=g).double() + 30 * (-t / 500).exp()
    report = diagnose(recording, model.simulate(4 * n, batch=(1,), generator=g), rate=100.0)
    assert "slow" in [e.test for e in report.unexplained]
    assert report.findings == ()
    assert "slow_remainder" in [e.name for e in report.model.effects]
    assert report.held_out.low > 0
    assert report.held_out.auc_after < 0.6 < report.held_out.auc_before
    assert "slow course that is left" in "".join(verdict(report))
