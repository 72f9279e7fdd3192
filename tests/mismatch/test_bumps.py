"""Bumps of the spectrum: what is one, how it is fitted, and whether it is a tone."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from scipy import stats
from shape_draws import CHANGES, RATE, SIGNS, N, P, array, comparison, drawn, generator, nominated, oscillating, tensor

from gyrofuse.mismatch.detectors.spectra.band_tests import excess_p_value
from gyrofuse.mismatch.detectors.spectra.modulated_ordinates import inflation, level_correlations
from gyrofuse.mismatch.detectors.spectra.own_peak_scan import _scores, _shape, scanned_own_peaks
from gyrofuse.mismatch.detectors.spectra.peak_fit import Background, Oscillation, oscillation_of
from gyrofuse.mismatch.detectors.spectra.peaks import Stretch, strongest_peak
from gyrofuse.mismatch.detectors.spectra.shared_peak_scan import log_ratios
from gyrofuse.mismatch.detectors.spectra.steadiness import steadiness
from gyrofuse.mismatch.likelihoods.spectra.common_sources import CommonBump
from gyrofuse.mismatch.likelihoods.spectra.components import oscillation
from gyrofuse.mismatch.likelihoods.spectra.fit import fit, pieces, slopes_of_spectra
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode, _momentary, _seen, excess_along, wandering_sd
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import nominated as nominated_bump
from gyrofuse.mismatch.mechanisms.spectra.bumps.resonance import Resonance
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import compared
from gyrofuse.mismatch.signals.filters import noise
from gyrofuse.mismatch.signals.lines import whitened


@pytest.mark.parametrize("p", [1, 3, 6])
def test_a_source_that_sensors_share_has_a_mean_ratio_of_one_where_there_is_none(p: int):
    # Whatever the noise is that sensors share: heavy tails of ratios make their mean uncertain.
    n_runs, m, f = 20_000, 6, 24
    g = generator(31)
    mix = torch.eye(p, dtype=torch.complex128) + 0.8
    z = mix @ torch.complex(*torch.randn(2, n_runs, p, m + f, generator=g, dtype=torch.float64))
    inside, beside = (x @ x.mH for x in (z[..., :m], z[..., m:]))
    ratio = log_ratios(inside, beside, m, f).exp()
    assert float(ratio.mean()) < 1 + 4 * float(ratio.std()) / math.sqrt(n_runs)
    for x in (5.0, 50.0):
        assert float((ratio > x).double().mean()) < 1 / x
    # A source six times as loud as the noise would be seen.
    loud = torch.complex(*torch.randn(2, n_runs, 1, m, generator=g, dtype=torch.float64))
    z[..., :m] += math.sqrt(6.0) * mix[:, :1] * loud
    inside = z[..., :m] @ z[..., :m].mH
    assert float(log_ratios(inside, beside, m, f).median()) > 2


@pytest.mark.parametrize("half", [4.0, 16.0, 64.0])
def test_scores_of_humps_are_normal_where_there_is_none(half: float):
    cell = max(int(half / 4), 1)
    drawn_ones = []
    for seed in range(32, 38):  # of broad humps a record has a few thousand
        power = torch.empty(4, 2**18, dtype=torch.float64).exponential_(generator=generator(seed))
        cells, worth = power.unflatten(-1, (-1, cell)).mean(-1), torch.full((4, 1), float(cell), dtype=torch.float64)
        scores, whole = _scores(cells, _shape(cells.shape[-1], half / cell), worth, 3)
        drawn_ones.append(scores[:, whole])
    scores = torch.cat(drawn_ones, -1)
    assert abs(float(scores.mean())) < 0.01
    assert abs(float(scores.std()) - 1) < 0.02
    for x in (2.0, 3.0):
        share = float((scores > x).double().mean()) / float(stats.norm.sf(x))
        assert 0.8 < share < 1.25


def test_a_hump_is_where_it_was_put():
    power = torch.empty(P, 2**14, dtype=torch.float64).exponential_(generator=generator(33))
    k = torch.arange(2**14)
    power[:3] *= 1 + 1.2 / (1 + ((k - 5000) / 60).square())
    steady = torch.zeros(P, 1, dtype=torch.float64)
    best = max(scanned_own_peaks(power, 1.0, steady, 1.0), key=lambda scan: float(scan.log_ratio.amax()))
    at = int(best.log_ratio.argmax())
    assert abs(int(best.first[at]) + best.width / 2 - 5000) < 60
    assert 60 <= best.width <= 300
    assert float(best.log_ratio.amax()) > 20


@pytest.mark.parametrize("bursts", [True, False])
def test_bands_of_noise_with_bursts_scatter_by_what_their_squares_tell(bursts: bool):
    # 400 records with a burst of 20 samples in a thousand, five times as loud; a hump as broad as they are short.
    n, n_runs, g = 4096, 400, generator(34)
    loud = (torch.rand(n_runs, n + 20, generator=g) < 1e-3).double().unfold(-1, 20, 1).amax(-1)[:, :n]
    x = torch.randn(n_runs, n, generator=g, dtype=torch.float64) * (1 + 4 * loud * bursts)
    power = torch.fft.rfft(x)[:, 1:].abs().square() / n
    shape = _shape(n // 2, 60.0)
    weights = shape - shape.mean()
    sums = (power[:, 200 : 200 + len(weights)] @ weights) / power.mean(-1)
    expected = inflation(level_correlations(x), weights, 1.0)
    scatter = float(sums.var() / weights.square().sum())
    assert float(expected.mean()) == pytest.approx(scatter, rel=0.25)  # 400 draws: 7 % and the correlations' own
    assert (scatter > 1.8) == bursts
    # Twice as wide stretches of half as many weights say the same.
    half = weights[: len(weights) // 2 * 2].unflatten(-1, (-1, 2)).mean(-1)
    torch.testing.assert_close(inflation(level_correlations(x), half, 2.0), expected, rtol=0.02, atol=0.02)


def test_backgrounds_that_nothing_holds_stay_numbers_that_can_be_worked_out():
    data = compared(drawn(2, n=4096))
    lost = replace(Background.start(P), local=tensor(-800, 100)[:, None].expand(2, P))
    found = fit(data, [lost], rounds=1)
    assert bool(found.model.isfinite().all())
    assert bool(found.covariance.isfinite().all())
    parts = pieces(data, found.terms)
    assert bool(slopes_of_spectra(data, found.terms, parts, parts.model(data)).isfinite().all())


def test_a_line_is_no_bump_and_a_bump_of_both_sides_neither():
    t = torch.arange(N, dtype=torch.float64)
    line = drawn(9, lambda x, g: x + 0.002 * torch.cos(2 * math.pi * 0.1234 * t))
    assert strongest_peak(line).p_value > 1e-3
    g = generator(10)
    both = [array().simulate(N, generator=g) + 0.005 * oscillating(g, 0.1, 0.002, P) for _ in range(3)]
    assert strongest_peak(comparison(both[0], torch.stack(both[1:]))).p_value > 1e-3


def test_more_power_in_a_band_tells_of_a_broad_bump_that_stands_out_among_all_places():
    has = tensor(1, 0, 0, 0, 0, 0)
    given = drawn(902, lambda x, g: x + 2.2e-3 * has[:, None] * oscillating(g, 0.12, 0.01, P))
    scanned, bands = strongest_peak(given).p_value, excess_p_value(given, 0.11, 0.13)
    assert bands < 1e-7 < scanned < 1e-5
    found = Resonance.detect_and_fit(given, 1e-7)
    assert found is not None
    assert found.p_value == bands
    assert found.sensors == (0,)
    assert excess_p_value(given, 0.2, 0.22) > 0.01
    without = replace(given, observed=given.reference, reference=given.observed)  # less power there, not more
    assert excess_p_value(without, 0.11, 0.13) > 0.01


def test_more_power_without_a_bump_is_none():
    """Bands alone, where nothing stands out beside its flanks: a level, or a slope."""
    louder = drawn(903, lambda x, g: 1.25 * x)
    assert excess_p_value(louder, 0.11, 0.13) < 1e-6
    assert nominated_bump(louder, 1e-3, tone=False) is None


@pytest.mark.statistical
def test_modes_of_single_sensors_that_bands_are_too_wide_for():
    # Half as wide as a quarter of an octave, and too weak for a stretch of bins among all of them.
    mode = Mode(0.2, 0.2 / 2 / 15, tensor(*(P * [1.0])).to(torch.complex128), False)
    has = tensor(1, 0, 0, 1, 0, 1)
    named, inside = 0, []
    for seed in range(6):
        given = drawn(700 + seed, lambda x, g: x + 3.6e-3 * has[:, None] * noise(N, mode.profile, P, g))
        found = Resonance.detect_and_fit(given, 1e-3)
        if found is None:
            continue
        named += 1
        f, q = found.parameters["frequency"], found.parameters["quality_factor"]
        inside += [f.low <= 0.2 * RATE <= f.high, q.low <= 15 <= q.high]
        again = found.effect.fit_without(given, 0)
        assert isinstance(again, Resonance)
        assert isinstance(found.effect, Resonance)
        assert ((again.mode.gain != 0) <= (found.effect.mode.gain != 0)).all()
    assert named >= 4
    assert sum(inside) >= stats.binom.ppf(1e-3, len(inside), 0.95)


def test_coherent_or_not_is_told_of_a_bump():
    alone = oscillation_of(drawn(18, CHANGES["own modes"][1]))
    together = oscillation_of(drawn(19, CHANGES["one mode"][1]))
    assert alone is not None
    assert together is not None
    assert alone.gain is None
    assert together.gain is not None
    turned = together.gain * together.gain[0].conj()
    assert (turned.real.sign() == SIGNS.sign()).all()


@pytest.mark.statistical
def test_a_mode_of_some_sensors_is_seen_that_a_taper_would_hide():
    # Under a Hann taper, which costs half of the ordinates, none of these is seen at that level.
    mode, n_runs, seen = Mode(0.3, 0.01, torch.ones(P, dtype=torch.complex128), False), 10, 0
    has = tensor(1, 0, 0, 1, 0, 1)
    for seed in range(n_runs):
        given = drawn(720 + seed, lambda x, g: x + 1.9e-3 * has[:, None] * noise(N, mode.profile, P, g))
        seen += strongest_peak(given).p_value < 1e-3
    assert seen >= stats.binom.ppf(1e-3, n_runs, 0.9)


def test_squares_of_gains_have_two_degrees_of_freedom():
    """Of gains 0 with a standard deviation of 0.1 in each part, 20 000 of them: mean 2, and the tail of chi-square."""
    g = generator(3)
    local = 0.1 * torch.randn(2, 20_000, generator=g, dtype=torch.float64)
    free, shared = torch.ones(2, 20_000, dtype=torch.bool), torch.tensor([0.1, 0.01], dtype=torch.float64).log()
    term = CommonBump(local, free, shared, kind="oscillation")
    sd = torch.full((2, 20_000), 0.1, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    squares, dof = _seen(Oscillation.of(Stretch(0.1, 0.01, 0.0, ()), term, sd, 0.0))
    assert dof == 2
    assert float(squares.mean()) == pytest.approx(2, rel=0.04)
    assert float((squares > stats.chi2.isf(0.01, 2)).double().mean()) == pytest.approx(0.01, abs=0.003)


def test_gains_of_a_mode_are_told_whatever_the_level_of_the_noise():
    g = generator(41)
    profile = oscillation(torch.linspace(0.1, 0.2, 50, dtype=torch.float64), *tensor(0.15, 0.01))
    root = torch.complex(*torch.randn(2, 3, 3, generator=g, dtype=torch.float64))
    both = (1 + torch.rand(50, 1, 1, generator=g, dtype=torch.float64)).expand(-1, 3, 3)
    wanted, level = root @ root.mH, torch.eye(3, dtype=torch.complex128) * 1.3
    found = excess_along(profile, level + wanted * profile[:, None, None] / both, both)
    torch.testing.assert_close(found, wanted)


@pytest.mark.statistical
@pytest.mark.parametrize(("name", "tone"), [("tone", True), ("one mode", False)])
def test_a_source_that_all_share_is_a_tone_or_is_not(name: str, tone: bool):
    n_runs, told = 8, 0
    for seed in range(n_runs):
        peak = oscillation_of(given := drawn(740 + seed, CHANGES[name][1]))
        told += peak is not None and steadiness(given, peak).tone == tone
    assert told >= stats.binom.ppf(1e-3, n_runs, 0.95)


def test_whitened_walks_do_not_jump_where_they_end():
    g = generator(42)
    walk = torch.randn(P, N, generator=g, dtype=torch.float64).cumsum(-1)
    white = whitened(walk, comparison(walk, torch.randn(4, P, N, generator=g, dtype=torch.float64).cumsum(-1)).base)
    assert float(white[:, [0, -1]].abs().max()) < 5 * float(white.std())


@pytest.mark.statistical
def test_what_rings_after_a_blow_is_no_mode_and_no_tone():
    after = torch.arange(N, dtype=torch.float64) - 5000
    ring = (-after.clamp(min=0) / 40).exp() * torch.cos(2 * math.pi * 0.21 * after) * (after > 0)
    given = drawn(3, lambda x, _: x + 0.3 * SIGNS[:, None] * ring)
    assert strongest_peak(given).p_value < 1e-6
    assert nominated(given) is None


def test_a_bump_at_the_end_of_the_spectrum_has_no_band_around_it():
    given, one = drawn(3), tensor(*(P * [1.0]))
    stretch = Stretch(1 / N, 1 / N, 1e-9, (0,))
    peak = Oscillation(stretch, 1 / N, 1 / N, (0.1, 0.1), one, 0.1 * one, None, 10.0)
    assert not _momentary(given, peak)
    assert wandering_sd(given, peak) == 0.0
