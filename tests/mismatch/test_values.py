"""Rounding, clipping, repeats: what single values tell, against naive twins."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from mismatch_draws import LEVEL, SCENE, N, covers, drawn, even, nominated, normal, settled
from scipy import signal

import gyrofuse as gf
from gyrofuse import AR1, WhiteNoise
from gyrofuse.mismatch.detectors.spectra.band_tests import spectrum_test
from gyrofuse.mismatch.detectors.values import lattices, quantisation_grid
from gyrofuse.mismatch.detectors.values import values as marginals
from gyrofuse.mismatch.detectors.values.median_windows import median_windows
from gyrofuse.mismatch.detectors.values.missing_codes import missing_codes
from gyrofuse.mismatch.detectors.values.straight_lines import straight_lines
from gyrofuse.mismatch.detectors.variance import outliers as impulses
from gyrofuse.mismatch.detectors.variance.noise_level import variance_p_value
from gyrofuse.mismatch.mechanisms.values.clipping import Clipping
from gyrofuse.mismatch.mechanisms.values.interpolated_samples import InterpolatedSamples
from gyrofuse.mismatch.mechanisms.values.median_filter import MedianFilter
from gyrofuse.mismatch.mechanisms.values.rounding.dead_band import DeadBand
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization, _blurred
from gyrofuse.mismatch.mechanisms.values.stuck_samples import StuckSamples
from gyrofuse.mismatch.selection.held_out import score_held_out
from gyrofuse.mismatch.signals import prediction_errors
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.kurtosis import clipped_sd


@pytest.mark.parametrize(("step", "offset"), [(1.0, 0.3), (0.2, 0.0), (4.0, 1.0)])
def test_rounding_is_read_off_the_values(step: float, offset: float) -> None:
    recording, simulation, g = drawn(1)
    recording[:2] = ((recording[:2] - offset) / step).round() * step + offset
    comparison = Comparison.of(SCENE, recording, simulation)
    found = nominated(comparison, Quantization)
    assert found.sensors == (0, 1)
    assert found.alternatives == ()
    assert found.parameters["lsb[0]"].value == pytest.approx(step, rel=1e-9)
    after = settled(comparison, found, g)
    assert marginals.values_test(after).p_value > 0.001
    repaired = found.effect.apply(simulation, SCENE, g)
    assert float(lattices.off_lattice(repaired[:, :2], step, offset).abs().max()) < 1e-9
    assert torch.equal(repaired[:, 2], simulation[:, 2])


@pytest.mark.parametrize("step", [1.0, 1.5])
def test_coarse_rounding_makes_neither_outliers_nor_clipping(step: float) -> None:
    """Medians of few steps are a matter of luck, and predictions from noise go beyond where any value would."""
    for seed in range(4):
        recording, simulation, g = drawn(40 + seed)
        comparison = Comparison.of(SCENE, step * (recording / step).round(), simulation)
        found = nominated(comparison, Quantization)
        assert found.sensors == (0, 1, 2)
        after = found.effect.repair(comparison, g)
        assert impulses.outliers_test(after).p_value > 0.001
        assert Clipping.detect_and_fit(after, LEVEL) is None
        sd, rms = prediction_errors.left_out(after.observed).sd[0], impulses.left_out(after.observed).error[0].std(-1)
        torch.testing.assert_close(sd, rms, rtol=0.03, atol=0.0)


def test_the_clipped_sd_is_that_of_normal_values_and_yields_little_to_outliers() -> None:
    g = torch.Generator().manual_seed(3)
    x = 3.0 * normal(200_000, g=g)
    assert float(clipped_sd(x)) == pytest.approx(3.0, rel=0.01)
    x[:200] = 1e3
    assert float(clipped_sd(x)) == pytest.approx(3.0, rel=0.02)


def test_rounding_that_a_simulation_has_too_is_not_missing() -> None:
    recording, simulation, _ = drawn(2)
    comparison = Comparison.of(SCENE, (2 * recording).round() / 2, (2 * simulation).round() / 2)
    assert Quantization.detect_and_fit(comparison, LEVEL) is None
    assert StuckSamples.detect_and_fit(comparison, LEVEL) is None
    assert marginals.values_test(comparison).p_value > 0.01


def test_a_lattice_hidden_under_later_noise_is_found() -> None:
    inside = 0
    for seed in range(6):
        recording, simulation, g = drawn(10 + seed)
        recording = 1.5 * (recording / 1.5).round() + 0.45 * normal(3, N, g=g)
        comparison = Comparison.of(SCENE, recording, simulation)
        found = nominated(comparison, Quantization)
        assert found.sensors == (0, 1, 2)
        inside += sum(covers(found, f"lsb[{i}]", 1.5) for i in range(3))
    # Fewer than 13 of 18 at 95 % have probability 2e-4.
    assert inside >= 13


def test_the_characteristic_function_is_that_of_the_definition() -> None:
    g = torch.Generator().manual_seed(3)
    values = normal(500, g=g)
    u = torch.tensor([0.5, 3.0, 7.0], dtype=torch.float64)
    naive = [500 * abs(np.mean(np.exp(1j * v * values.numpy()))) ** 2 for v in u.tolist()]
    np.testing.assert_allclose(quantisation_grid._power(values, u).numpy(), naive, rtol=1e-10)


def test_values_cut_at_a_limit_are_clipped() -> None:
    recording, simulation, g = drawn(4)
    recording[0].clamp_(max=3.0)
    recording[2].clamp_(-2.5, 2.0)
    comparison = Comparison.of(SCENE, recording, simulation)
    found = nominated(comparison, Clipping)
    assert found.sensors == (0, 2)
    assert {name: p.value for name, p in found.parameters.items()} == {"high[0]": 3.0, "high[2]": 2.0, "low[2]": -2.5}
    settled(comparison, found, g)


def test_few_samples_at_an_end_prove_it_and_a_repaired_simulation_has_it() -> None:
    """Cut at the fifth largest and smallest values: a simulation as long has a few beyond them, or none by chance."""
    for seed in range(8):
        recording, simulation, g = drawn(200 + seed, records=1)
        ordered = recording.sort(dim=-1).values
        recording = recording.clamp(ordered[:, 4:5], ordered[:, -5:-4])
        comparison = Comparison.of(SCENE, recording, simulation)
        found = nominated(comparison, Clipping)
        assert found.sensors == (0, 1, 2)
        settled(comparison, found, g)


@pytest.mark.parametrize("ratio", [1.0, 0.8])
def test_an_end_is_no_chance_of_a_quieter_simulation(ratio: float) -> None:
    for seed in range(6):
        recording, simulation, _ = drawn(300 + seed, records=1)
        recording = recording.clamp(max=recording.sort(dim=-1).values[:, -5:-4])
        found = nominated(Comparison.of(SCENE, recording, ratio * simulation), Clipping)
        assert found.sensors == (0, 1, 2)


def test_the_largest_of_few_digits_may_be_there_twice() -> None:
    """Half precision is much finer near zero than where the largest values lie: one array in forty has a tie there."""
    ties = 0
    for seed in range(400):
        g = torch.Generator().manual_seed(seed)
        recording = normal(3, N, g=g).half().double()
        ends = torch.cat([recording, -recording])
        if int((ends == ends.amax(-1, keepdim=True)).sum(-1).max()) < 2:
            continue
        ties += 1
        simulation = normal(1, 3, N, g=g).half().double()
        assert Clipping.detect_and_fit(Comparison.of(SCENE, recording, simulation), LEVEL) is None
    assert ties >= 5


def test_clipping_shows_on_a_lattice_as_well() -> None:
    recording, simulation, _ = drawn(5)
    recording, simulation = recording.clamp(max=2.0).round(), simulation.round()
    comparison = Comparison.of(SCENE, recording, simulation)
    assert nominated(comparison, Clipping).parameters["high[0]"].value == 2.0
    plain = Comparison.of(SCENE, drawn(5)[0].round(), simulation)
    assert Clipping.detect_and_fit(plain, LEVEL) is None


@pytest.mark.parametrize("rounded", [False, True])
@pytest.mark.parametrize("together", [False, True])
def test_repeats_beyond_those_of_the_lattice_are_stuck_samples(rounded: bool, together: bool) -> None:
    recording, simulation, g = drawn(6)
    if rounded:
        recording, simulation = (2 * recording).round() / 2, (2 * simulation).round() / 2
    p = torch.tensor([0.05, 0.0, 0.05], dtype=torch.float64)
    stuck = StuckSamples(p, torch.zeros(3, dtype=torch.float64), together)
    comparison = Comparison.of(SCENE, stuck.apply(recording, SCENE, g), simulation)
    found = nominated(comparison, StuckSamples)
    assert found.sensors == (0, 2)
    assert covers(found, "probability[0]", 0.05)
    assert isinstance(found.effect, StuckSamples)
    assert found.effect.together is together
    settled(comparison, found, g)


def test_few_repeats_prove_that_samples_stick_where_values_do_not_recur() -> None:
    recording, simulation, _ = drawn(16)
    at = torch.tensor([500, 1500, 2500, 3500, 5000, 6000, 7000, 8000])
    recording[0, at] = recording[0, at - 1]
    comparison = Comparison.of(SCENE, recording, simulation)
    p = marginals.repeats(comparison).p_values
    shares = comparison.n_samples / (comparison.n_samples + comparison.reference.signal[:, 0].numel())
    assert float(p[0]) == pytest.approx(shares ** len(at))
    assert float(p[1:].min()) == 1.0
    assert nominated(comparison, StuckSamples).sensors == (0,)


def test_few_repeats_of_coarse_numbers_are_chance() -> None:
    recording, simulation, _ = drawn(17)
    fine = 2e-4 * (recording / 2e-4).round()  # a repeat in ten thousand samples or so
    p_values = marginals.repeats(Comparison.of(SCENE, fine, simulation)).p_values
    assert int(marginals.repeated(fine).sum()) > 0
    assert float(p_values.min()) > 0.05


def test_few_repeats_are_compared_with_those_that_a_quieter_simulation_would_have() -> None:
    p_values = []
    for seed in range(12):
        recording, simulation, _ = drawn(70 + seed)
        rounded = 2e-3 * (recording / 2e-3).round()
        noisier = 2e-3 * (8 * simulation / 2e-3).round()
        p_values.append(marginals.repeats(Comparison.of(SCENE, rounded, noisier)).p_values)
    assert float(torch.stack(p_values).min()) > 1e-3
    recording[1, 40::400] = recording[1, 39:-1:400]
    fine = 2e-4 * (recording / 2e-4).round()
    once = simulation.clone()
    once[0, 1, 5] = once[0, 1, 4]  # one repeat there does not say that the recording's own resolution makes none
    p_values = marginals.repeats(Comparison.of(SCENE, fine, once)).p_values
    assert float(p_values[1]) < 1e-4
    assert float(p_values[[0, 2]].min()) > 0.01


def test_repeats_that_chance_would_not_make_may_come_and_go() -> None:
    recording, simulation, g = drawn(14)
    at = (even(N, g=g) < 0.006) & (torch.arange(N) < N // 2)
    for t in at.nonzero()[:, 0].clamp(min=1).tolist():
        recording[:, t] = recording[:, t - 1]
    comparison = Comparison.of(SCENE, recording, simulation)
    assert marginals.values_test(comparison).p_value < 1e-4
    assert nominated(comparison, StuckSamples).sensors == (0, 1, 2)


def test_a_largest_value_that_recurs_on_a_fine_lattice_is_no_end_stop() -> None:
    """Predictions from noise have noise of their own, which would be expected beyond any largest value."""
    g = torch.Generator().manual_seed(42)
    noise = WhiteNoise(1.0) + AR1(0.98, 0.02)
    recording, simulation = (noise.simulate(65536, batch=(*records, 3), generator=g) for records in ((), (2,)))
    step = 0.045 * float(recording.diff().std()) / 2**0.5
    recording, simulation = (step * torch.round(x / step) for x in (recording, simulation))
    for row in recording:
        first, second = row.topk(2).indices.tolist()
        row[second] = row[first]
    assert min(end.p_value for end in marginals.end_stops(Comparison.of(SCENE, recording, simulation))) > LEVEL


def test_what_saturates_does_not_repeat_itself() -> None:
    """A vibration beyond full scale holds the limit for some samples each time."""
    recording, simulation, _ = drawn(21)
    vibration = 8 * (1.5 + (torch.arange(N) * 0.002).sin()) * (2 * torch.pi * 0.0415 * torch.arange(N)).cos()
    recording, simulation = (recording + vibration).clamp(-13, 12), simulation + vibration
    comparison = Comparison.of(SCENE, recording, simulation)
    assert StuckSamples.detect_and_fit(comparison, LEVEL) is None
    found = nominated(comparison, Clipping)
    assert found.sensors == (0, 1, 2)
    assert {p.value for p in found.parameters.values()} == {12.0, -13.0}
    assert marginals.values_test(found.repair(comparison, torch.Generator().manual_seed(1))).p_value > 0.01


@pytest.mark.parametrize("value", [0.0, -40.0])
def test_a_value_in_the_place_of_samples_is_told(value: float) -> None:
    """Zeros or an error code, next to the sensor's own values or far from them: no limit, no shocks."""
    recording, simulation, g = drawn(22)
    recording = recording + torch.tensor([[0.2], [3.4], [-1.0]], dtype=torch.float64)
    for at in (even(25, g=g) * (N - 80)).long().tolist():
        recording[:, at : at + 8 + at % 30] = value
    report = gf.diagnose(gf.Recording(recording, rate=SCENE.rate), gf.Recording(simulation[0], rate=SCENE.rate))
    (found,) = report.findings
    assert (found.mechanism, found.sensors) == ("stuck_samples", (0, 1, 2))
    assert found.sentence.startswith(f"samples are {value:.6g} units, which stands in their place")
    assert not report.unexplained
    assert report.held_out.after < 2
    again = found.effect.apply(simulation[0], SCENE, torch.Generator().manual_seed(1))
    assert bool((again == value).all(0).any())
    assert 0.5 < float((again == value).double().mean() / (recording == value).double().mean()) < 2


@pytest.mark.parametrize("value", [0.0, 5.0])
def test_single_samples_in_whose_place_a_value_stands_are_told(value: float) -> None:
    """A read that failed now and then gives zero, which may lie far out in a sensor's own values."""
    recording, simulation, g = drawn(24)
    failed = even(N, g=g) < 0.01
    recording[1, failed] = value
    comparison = Comparison.of(SCENE, recording, simulation)
    found = nominated(comparison, StuckSamples)
    assert found.sensors == (1,)
    assert found.sentence.startswith(f"single samples are {value:.6g} deg/s, which stands in their place in sensor y")
    assert found.parameters["probability[1]"].value == pytest.approx(float(failed.double().mean()), rel=0.02)
    assert Clipping.detect_and_fit(comparison, LEVEL) is None
    again = found.effect.apply(simulation[0], SCENE, g)
    assert float((again[1] == value).double().mean()) == pytest.approx(0.01, rel=0.3)
    assert bool((again[[0, 2]] == simulation[0, [0, 2]]).all())
    repaired = found.repair(comparison, g)
    assert marginals.values_test(repaired).p_value > 0.01
    assert float(repaired.recording[1, failed].std() / recording[1, ~failed].std()) == pytest.approx(1.0, abs=0.2)


def test_a_stretch_that_was_logged_twice_has_no_limits() -> None:
    recording, simulation, _ = drawn(23)
    recording[:, 3000:4000] = recording[:, 1000:2000]
    for row in recording:  # the largest and the smallest value come twice
        row[[1300, 3300]], row[[1700, 3700]] = 6.0, -6.0
    assert Clipping.detect_and_fit(Comparison.of(SCENE, recording, simulation), LEVEL) is None


@pytest.mark.parametrize(("step", "length"), [(0.0, 150), (0.0, 12), (0.3, 300)])
def test_a_sensor_that_hangs_repeats_samples_and_is_no_quiet_noise(step: float, length: int) -> None:
    """Three times, rounded or not: named with its rows, and filled in for all that is searched after it."""
    recording, simulation, g = drawn(800 + length, records=2)
    if step:
        recording, simulation = (step * torch.round(x / step) for x in (recording, simulation))
    for at in (1000, 2500, N - 800):
        recording[1, at : at + length] = recording[1, at]
    comparison = Comparison.of(SCENE, recording, simulation)
    found = nominated(comparison, StuckSamples)
    assert found.sensors == (1,)
    assert isinstance(found.effect, StuckSamples)
    assert found.effect.row[1] == pytest.approx(length - 1, rel=0.2)
    assert score_held_out(comparison, found.effect).total > 0
    left = found.effect.repair(comparison, g)
    assert length < 100 or variance_p_value(comparison) < LEVEL / 100
    assert variance_p_value(left) > 0.01
    assert torch.equal(left.recording[0], recording[0])
    built = found.effect.apply(torch.randn(2, 100_000, generator=g, dtype=torch.float64).repeat(2, 1)[:3], SCENE, g)
    same = built[1, 1:] == built[1, :-1]
    assert int((same[1:] & ~same[:-1]).sum()) == pytest.approx(int(same.sum()) / length, rel=0.35)


@pytest.mark.parametrize(("period", "length"), [(120, 10), (193, 16), (60, 5)])
def test_a_sensor_that_hangs_for_short_is_not_taken_for_coarse_values(period: int, length: int) -> None:
    """Within a row a sample equals later ones as often as the next one, as on a coarse lattice."""
    recording, simulation, _ = drawn(810, records=2)
    place = torch.arange(N)
    source = place - (place % period - (period - length)).clamp(min=0)
    recording[1] = recording[1, source]
    found = nominated(Comparison.of(SCENE, recording, simulation), StuckSamples)
    assert found.sensors == (1,)
    assert isinstance(found.effect, StuckSamples)
    assert found.effect.row[1] == pytest.approx(length - 1, rel=0.05)
    assert float(found.effect.probability[1]) == pytest.approx((length - 1) / period, rel=0.05)


def test_what_is_read_twice_repeats_every_second_sample() -> None:
    recording, simulation, g = drawn(90, records=2)
    recording[:, 1::2] = recording[:, 0::2]
    found = nominated(Comparison.of(SCENE, recording, simulation), StuckSamples)
    assert isinstance(found.effect, StuckSamples)
    built = found.effect.apply(simulation, SCENE, g)
    same = built[..., 1:] == built[..., :-1]
    assert float((same[..., 1:] != same[..., :-1]).double().mean()) > 0.99
    assert bool((same == same[..., :1, :]).all())


@pytest.mark.parametrize("width", [0.002, 0.02, 0.2, 0.6, 1.0])
def test_a_dead_band_is_no_repeats_and_no_hidden_lattice_however_wide_it_is(width: float) -> None:
    """Half of all samples are zero in the widest one, many of them one after the other."""
    recording, simulation, g = drawn(60, records=2)
    recording -= recording.mean(-1, keepdim=True) - torch.tensor([[0.0], [0.3], [-0.2]])
    recording[:2] = torch.where(recording[:2].abs() < width, 0.0, recording[:2])
    comparison = Comparison.of(SCENE, recording, simulation)
    assert StuckSamples.detect_and_fit(comparison, LEVEL) is None
    found = nominated(comparison, Quantization)
    assert found.sensors == (0, 1)
    assert covers(found, "dead_band[0]", width)
    assert covers(found, "dead_band[1]", width)
    after = found.effect.repair(comparison, g)
    assert Quantization.detect_and_fit(after, LEVEL) is None
    assert StuckSamples.detect_and_fit(after, LEVEL) is None
    assert marginals.values_test(after).p_value > 0.001


def test_a_dead_band_that_pulls_in_what_is_beyond_it_is_no_repeats_and_no_quieter_noise() -> None:
    """Half-widths that leave 16 % to 53 % at zero, a mean that is none of zero; limits hold in 18 of 20 at least."""
    inside = 0
    for seed in range(10):
        recording, simulation, g = drawn(700 + seed)
        width = 0.2 + 0.06 * seed
        beyond = recording[:2] + 0.3
        recording[:2] = beyond.sign() * (beyond.abs() - width).clamp(min=0.0)
        found = DeadBand.detect_and_fit(Comparison.of(SCENE, recording, simulation), LEVEL)
        assert found is not None, seed
        assert found.sensors == (0, 1), seed
        assert isinstance(found.effect, DeadBand)
        assert found.effect.subtracts
        inside += covers(found, "dead_band[0]", width) + covers(found, "dead_band[1]", width)
        comparison = Comparison.of(SCENE, recording, simulation)
        built = found.effect.apply(simulation, SCENE, g)
        for i in (0, 1):
            share = float((recording[i] == 0).double().mean())
            row = built[..., i, :].reshape(-1, N)[0]  # at the place of its own mean
            most = int(torch.unique(row, return_counts=True)[1].max())
            assert most / N == pytest.approx(share, abs=0.03), (seed, i)
            assert float(built[..., i, :].std(-1).mean()) == pytest.approx(float(recording[i].std()), rel=0.03), (
                seed,
                i,
            )
        assert StuckSamples.detect_and_fit(comparison, LEVEL) is None
    assert inside >= 18


def test_a_value_filled_in_is_no_dead_band() -> None:
    recording, simulation, g = drawn(61, records=2)
    recording[0, even(N, g=g) < 0.02] = 0.1
    found = Quantization.detect_and_fit(Comparison.of(SCENE, recording, simulation), LEVEL)
    assert found is None or "dead_band[0]" not in found.parameters


def test_one_long_row_is_a_sensor_that_hangs() -> None:
    recording, simulation, g = drawn(21)
    recording[1, N // 2 :] = recording[1, N // 2]
    comparison = Comparison.of(SCENE, recording, simulation)
    found = nominated(comparison, StuckSamples)
    assert found.sensors == (1,)
    assert found.parameters["probability[1]"].value == pytest.approx(0.5, abs=0.01)
    after = settled(comparison, found, g)
    assert variance_p_value(after) > 0.001


@pytest.mark.parametrize("blur", [0.0, 1e-12, 7e-7, 1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("spread", [0.7, 3.0])
def test_rounding_gives_numbers_whatever_its_blur(blur: float, spread: float):
    values = spread * torch.randn(4000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rounded = _blurred(values, blur)
    assert bool(rounded.isfinite().all())
    assert float((rounded - values).abs().max()) < 1.5


def test_a_sensor_that_hung_twice_is_told_wherever_the_blocks_are() -> None:
    """Both times lie in blocks that are held out together: none is left to estimate how often."""
    recording, simulation, _ = drawn(33)
    block = N // 32
    for at in (9 * block + 100, 21 * block + 100):
        recording[1, at : at + 60] = -3.0
    found = nominated(Comparison.of(SCENE, recording, simulation), StuckSamples)
    score = score_held_out(Comparison.of(SCENE, recording, simulation), found.effect)
    assert found.sensors == (1,)
    assert score.confirms(found.p_value)


def test_a_dead_band_beside_a_bias_that_the_simulation_has_not() -> None:
    """What is left of the mean is not that of the values; the sensor with more bias than band has one as well."""
    recording, simulation, g = drawn(34)
    bias, width = torch.tensor([[0.9], [1.5], [0.0]], dtype=torch.float64), 1.2
    biased = recording - recording.mean(-1, keepdim=True) + bias
    recording = torch.where((biased.abs() < width) & (bias > 0), 0.0, biased)
    comparison = Comparison.of(SCENE, recording, simulation - simulation.mean(-1, keepdim=True))
    found = nominated(comparison, DeadBand)
    assert found.sensors == (0, 1)
    assert isinstance(found.effect, DeadBand)
    torch.testing.assert_close(found.effect.centre[:2], bias[:2, 0], atol=0.05, rtol=0.0)
    built = found.effect.repair(comparison, g)
    ratio = built.reference.signal[:, :2].std(-1).mean(0) / recording[:2].std(-1)
    torch.testing.assert_close(ratio, torch.ones_like(ratio), atol=0.03, rtol=0.0)


def test_a_value_in_the_place_of_samples_leaves_other_sensors_as_they_are() -> None:
    recording, simulation, g = drawn(35)
    recording[1, even(N, g=g) < 0.01] = 0.0
    recording[2, 5000] = 0.0  # its own
    comparison = Comparison.of(SCENE, recording, simulation)
    found = nominated(comparison, StuckSamples)
    assert found.sensors == (1,)
    after = found.effect.repair(comparison, g)
    assert torch.equal(after.recording[[0, 2]], recording[[0, 2]])


def test_what_a_classifier_sees_and_no_test_does_is_said() -> None:
    """A converter that never gives every fourth code."""
    rng = np.random.default_rng(5)
    codes = np.round(rng.standard_normal((2, 2, 16384)) / 0.35)
    recording = np.where(codes[0] % 4 == 3, codes[0] - 1, codes[0])
    report = gf.diagnose(*(torch.from_numpy(0.35 * x) for x in (recording, codes[1])))
    assert report.mismatch or any("A classifier tells the two apart all the same" in note for note in report.notes)
    same = gf.diagnose(
        *(torch.from_numpy(0.35 * x) for x in (np.round(rng.standard_normal((2, 16384)) / 0.35), codes[1]))
    )
    assert not any("classifier" in note for note in same.notes)


@pytest.mark.parametrize(("single", "length"), [(False, 12), (True, 2)])
def test_lost_samples_that_interpolation_filled_in_are_told(single: bool, length: int) -> None:
    recording, simulation, g = drawn(31)
    first = torch.randperm(N // 40 - 1, generator=g)[:60] * 40 + 5
    for a in first.tolist():
        ends = recording[:, a], recording[:, a + length]
        recording[:, a : a + length] = torch.lerp(
            ends[0][:, None], ends[1][:, None], torch.arange(length, dtype=torch.float64) / length
        )
    if single:
        recording = recording.float().double()
    comparison = Comparison.of(SCENE, recording, simulation)
    found = nominated(comparison, InterpolatedSamples)
    assert isinstance(found.effect, InterpolatedSamples)
    assert found.effect.together
    assert found.effect.row.tolist() == pytest.approx([length - 1.0] * 3)
    assert all(covers(found, f"probability[{i}]", 60 * (length - 1) / N) for i in range(3))
    after = settled(comparison, found, g)
    assert marginals.values_test(after).p_value > 0.001
    assert variance_p_value(after) > 0.001
    repaired = Comparison.of(SCENE, found.effect.apply(simulation[0], SCENE, g), simulation)
    assert nominated(repaired, InterpolatedSamples).effect.row.tolist() == pytest.approx([length - 1.0] * 3, rel=0.5)


@pytest.mark.parametrize("step", [0.0, 1e-3, 0.01, 0.5])
def test_noise_lies_on_no_lines_and_values_of_few_digits_do_so_by_chance(step: float) -> None:
    recording, simulation, _ = drawn(32)
    if step:
        recording = (recording / step).round() * step
    comparison = Comparison.of(SCENE, recording, simulation)
    assert float(straight_lines(comparison).p_values.min()) > 0.01
    bursts = torch.zeros_like(recording)
    bursts[:, 3000:4000] = torch.linspace(0, 1, 1000, dtype=torch.float64).square()
    assert float(straight_lines(comparison.subtract(bursts)).p_values.min()) > 0.01


@pytest.mark.parametrize("window", [3, 5, 9])
def test_a_running_median_is_told_and_is_no_sensor_that_repeats(window: int) -> None:
    recording, simulation, g = drawn(33)
    recording[:2] = torch.from_numpy(signal.medfilt(recording[:2].numpy(), (1, window)))
    comparison = Comparison.of(SCENE, recording, simulation)
    assert StuckSamples.detect_and_fit(comparison, LEVEL) is None
    found = nominated(comparison, MedianFilter)
    assert found.sensors == (0, 1)
    assert f"a running median of {window} samples" in found.sentence
    after = settled(comparison, found, g)
    assert marginals.values_test(after).p_value > 0.001
    assert spectrum_test(after).p_value > 0.001


def test_values_that_recur_or_have_few_digits_have_passed_no_median() -> None:
    recording, simulation, g = drawn(34)
    recording[0] = recording[0].clamp(-1, 1)
    recording[1] = torch.where(torch.rand(N, generator=g) < 0.1, 0.0, recording[1])
    recording[2] = (1000 * recording[2]).round() / 1000
    assert median_windows(Comparison.of(SCENE, recording, simulation)).samples.tolist() == [1, 1, 1]


@pytest.mark.parametrize(("stuck", "rounds"), [(True, True), (True, False), (False, True)])
def test_codes_that_are_never_put_out_are_told(stuck: bool, rounds: bool) -> None:
    recording, simulation, g = drawn(35)
    step, offset = 0.1, 0.03
    codes = ((recording - offset) / step).round().long()
    codes[:2] = codes[:2] & ~4 if stuck else torch.where(codes[:2] % 5 == 3, codes[:2] + 1, codes[:2])
    if rounds:
        simulation = step * (simulation / step).round()
    report = gf.diagnose(codes * step + offset, simulation[0], generator=g)
    assert [f.mechanism for f in report.findings] == ["quantization"] * (not rounds) + ["missing_codes"]
    found = report.findings[-1]
    assert found.sensors == (0, 1)
    assert ("bit 2 of the converter" if stuck else "1 of every 5") in found.sentence
    assert not report.unexplained


def test_coarse_values_of_few_codes_miss_none() -> None:
    recording, simulation, _ = drawn(36)
    for step in (0.02, 0.3, 1.0, 3.0):
        comparison = Comparison.of(SCENE, step * (recording / step).round(), step * (simulation / step).round())
        assert not missing_codes(comparison)
