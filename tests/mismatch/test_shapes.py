"""Spectral shapes that a simulation lacks: fits and witnesses, against direct sums, theory and simulation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import signal, stats
from shape_draws import BUMP, CHANGES, RATE, SIGNS, WHITE, N, P, array, comparison, drawn, generator, nominated, tensor

import gyrofuse as gf
from gyrofuse._base.transforms import cosine_ordinates
from gyrofuse.mismatch.detectors.spectra.band_tests import coherence_test, spectrum_test
from gyrofuse.mismatch.detectors.spectra.peaks import peak_test
from gyrofuse.mismatch.detectors.spectra.pooled_coherence import common_source_test
from gyrofuse.mismatch.detectors.spectra.shape_scan import shape_test
from gyrofuse.mismatch.likelihoods.spectra.choice import keeps_own
from gyrofuse.mismatch.likelihoods.spectra.coherence import smooth_coherence
from gyrofuse.mismatch.likelihoods.spectra.common_sources import Common
from gyrofuse.mismatch.likelihoods.spectra.components import (
    Flicker,
    LowPass,
    PowerLaw,
    Shift,
    SimulatedLowPass,
    Term,
    oscillation,
)
from gyrofuse.mismatch.likelihoods.spectra.data import block_spectra, fast_groups, slow_groups
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import (
    FILTERS,
    filter_corner,
    filter_power,
    filter_response,
    filter_strength,
)
from gyrofuse.mismatch.likelihoods.spectra.fit import (
    _power_slopes,
    data_model,
    fit,
    pieces,
    slopes_of_powers,
    slopes_of_spectra,
)
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Parts
from gyrofuse.mismatch.likelihoods.spectra.ratios import FLOOR, Ratios, fitness, log_gain, power_gains
from gyrofuse.mismatch.likelihoods.spectra.starts import best_bump, best_start
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import compared, leading_shape
from gyrofuse.mismatch.mechanisms.spectra.parameter_change import _numbers
from gyrofuse.mismatch.mechanisms.spectra.slopes.any_slope import with_its_slope
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.filters import filtered, noise, of_phase, quadrature
from gyrofuse.mismatch.signals.folds import in_fold
from gyrofuse.noise.array_model import ArrayModel


def test_powers_gain_what_the_law_of_f_gives_them():
    """The density of a ratio of powers around a model's, against that around one."""
    given = compared(drawn(1, lambda x, g: 3 * x, n=4096))
    d, s = tensor(5.0, 5.0, 40.0, 300.0, 7.0), tensor(5.0, 20.0, 40.0, 1e7, 0.0)
    r, m = tensor(4.0, 0.3, 1.4, 0.9, 2.0), tensor(2.0, 5e-3, 1e5, 1.1, 3.0)
    data = replace(
        given,
        observed=r[:, None, None].to(torch.complex128),
        expected=torch.ones(5, 1, 1, dtype=torch.complex128),
        d=d,
        s=s,
        usable=(s > 0).to(torch.float64)[:, None],
        pair_dof=torch.zeros(5, dtype=torch.float64),
        together=torch.ones(5, 1, dtype=torch.float64),
    )
    gain = power_gains(data, m[:, None])[:, 0]
    for i in range(4):
        a, b = 2 * float(d[i]), 2 * float(s[i])
        x, y = (float((v[i] + FLOOR) / (1 + FLOOR)) for v in (r, m))
        expected = stats.f.logpdf(x / y, a, b) - math.log(y) - stats.f.logpdf(x, a, b)
        assert float(gain[i]) == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert float(gain[4]) == 0  # no reference


@pytest.mark.statistical
def test_deviances_have_the_mean_that_chance_gives_and_no_more():
    n_runs, excess, worse = 30, 0.0, 0
    for s in range(n_runs):
        data = compared(drawn(900 + s, n=4096))
        seen = fitness(data, data.expected)
        excess += float(seen.excess.sum()) / float(data.weight.sum())
        worse += seen.p_value < 0.05
    # A deviance has a variance of about two: 2 / 4 a nat squared, in some 25 cells of 6 sensors.
    assert abs(excess / n_runs) < 4 * math.sqrt(0.5 / (n_runs * 150))
    # 7.3 % of 1350 nulls were below 5 %: neighbouring bands are slightly correlated.
    assert worse <= stats.binom.isf(1e-3, n_runs, 0.08)


def test_score_and_information_are_those_of_the_likelihood():
    """Score by differences of the log likelihood; information as the mean of the curvature under the model."""
    data = compared(drawn(1, lambda x, g: 1.5 * x, n=4096))
    terms = [LowPass.starts(data.ground, "bilinear")]
    terms = [replace(terms[0], local=terms[0].local[22].expand(1, P))]
    parts = pieces(data, terms)
    model = parts.model(data)
    derivatives = slopes_of_spectra(data, terms, parts, model)
    power = parts.power(data)
    slopes = slopes_of_powers(data, terms, parts, power)
    for own, of_pairs in ((power, model), (slopes, derivatives)):  # what needs no pairs is the diagonal of what does
        torch.testing.assert_close(own, of_pairs.diagonal(dim1=-2, dim2=-1).real, rtol=1e-9, atol=1e-9)
    information, score = _power_slopes(data, power, slopes)
    step = 1e-5
    for i in range(P):
        local = terms[0].local.clone()
        local[0, i] += step
        moved = data_model(data, [replace(terms[0], local=local)])
        expected = float((log_gain(data, moved, paired=False) - log_gain(data, model, paired=False)).sum()) / step
        assert float(score[i]) == pytest.approx(expected, rel=2e-3, abs=0.05)
    # Of powers drawn around the model scores vary as the information says.
    g = np.random.default_rng(1)
    d, s = (np.broadcast_to(x.numpy()[:, None], (len(x), P)) for x in (data.d, data.s))
    drawn_scores = []
    for _ in range(400):
        ratio = torch.from_numpy(g.gamma(d) / d / (g.gamma(s) / s)) * model.diagonal(dim1=-2, dim2=-1).real
        other = replace(data, observed=torch.diag_embed(ratio).to(torch.complex128))
        drawn_scores.append(_power_slopes(other, power, slopes)[1])
    spread = torch.stack(drawn_scores).var(0)
    torch.testing.assert_close(spread, information.diagonal(), rtol=0.35, atol=0)  # 0.07 each, five of them


def test_blocks_of_both_sides_add_up_and_are_held_out():
    given = drawn(5, n=8192)
    both = block_spectra(given)
    assert both.observed.products.shape[0] == 32
    assert both.reference.products.shape[0] == 4
    every, d = both.observed.mean(torch.ones(32, dtype=torch.bool))
    length, edges = 8192 // 32, both.bands.edges
    # A naive twin of the blocks' highest band: eigencoefficients of the four sine tapers, block by block.
    t = np.arange(1, length + 1)
    power = np.zeros(P)
    for block in given.recording.numpy().reshape(P, 32, length).swapaxes(0, 1):
        centred = block - block.mean(-1, keepdims=True)
        for k in range(1, 5):
            taper = math.sqrt(2 / length) * np.sin(math.pi * k * t / length)
            seen = np.abs(np.fft.fft(centred * taper)[:, edges[-2] : edges[-1]]) ** 2
            power += seen.mean(-1) / (4 * 32)
    last = len(slow_groups()) + len(edges) - 2
    np.testing.assert_allclose(every[last].diagonal().real.numpy(), power, rtol=2e-2)
    # Above it stand the ordinates of the record, up to half the rate.
    x = (torch.arange(491, dtype=torch.float64) + 1) / 492  # 6 % of the record at either end
    taper = torch.ones(8192, dtype=torch.float64)
    taper[:491] = 1 / (1 + (1 / x - 1 / (1 - x)).exp())
    taper[-491:] = taper[:491].flip(0)
    taper = taper / taper.square().mean().sqrt()
    y = cosine_ordinates((given.recording - given.recording.mean(-1, keepdim=True)) * taper)
    groups = fast_groups(8192)
    assert groups[-1][-1] == 8191
    assert groups[0][0] == round(2 * 32 * (edges[-1] - 0.5))
    for band, group in zip(every[last + 1 :], groups, strict=True):
        torch.testing.assert_close(band.diagonal().real, y[:, list(group)].square().mean(-1))
    # The slowest ordinate is one real number.
    y = cosine_ordinates(given.recording)[:, 1]
    torch.testing.assert_close(every[0].diagonal().real, y.square())
    assert float(d[0]) == 0.5
    parts = [both.observed.mean(in_fold(32, k)) for k in range(4)]
    torch.testing.assert_close(sum(m * n[:, None, None] for m, n in parts), every * d[:, None, None])
    # What a fold holds out changes no number that is fitted without it, of either side.
    changed = given.recording.clone()
    changed[:, : 8192 // 32] *= 3  # the first block is the first fold's
    one, other = (block_spectra(comparison(x, given.reference.signal)) for x in (given.recording, changed))
    kept, blocks = ~in_fold(32, 0), slice(len(slow_groups()), last + 1)
    torch.testing.assert_close(one.observed.mean(kept)[0][blocks], other.observed.mean(kept)[0][blocks])


def test_a_reference_of_another_length_has_its_ordinates_where_their_frequencies_are():
    g = generator(9)
    given = comparison(array().simulate(8192, generator=g), array().simulate(4096, generator=g)[None])
    both = block_spectra(given)
    _, s = both.reference.mean(torch.ones(4, dtype=torch.bool))
    _, d = both.observed.mean(torch.ones(32, dtype=torch.bool))
    assert float(s[0]) == 0  # it has no ordinate so slow
    assert float(s[1]) == 0.5  # its first has the frequency of the recording's second
    assert float(s[-1]) == pytest.approx(float(d[-1]) / 2, rel=1e-3)  # of shorter tapers


def test_correlations_gain_what_determinants_and_traces_say():
    given = drawn(1, lambda x, g: x + 0.01 * torch.randn(1, len(x[0]), generator=g, dtype=x.dtype), n=4096)
    data = compared(given)
    model = data_model(data, shape_examples(data)[-1:])
    alone = power_gains(data, model.diagonal(dim1=-2, dim2=-1).real).sum(-1)
    for b in (3, 20, len(data.d) - 1):
        c, m, q, d = data.expected[b].numpy(), model[b].numpy(), data.observed[b].numpy(), float(data.pair_dof[b])
        assert d > 0
        g, k = (x / np.sqrt(np.outer(x.diagonal().real, x.diagonal().real)) for x in (m, q))
        expected = -d * (np.linalg.slogdet(g)[1] + np.trace(np.linalg.solve(g, k)).real)
        expected += d * (np.linalg.slogdet(c)[1] + np.trace(np.linalg.solve(c, k)).real)
        assert float(log_gain(data, model)[b] - alone[b]) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_a_bump_is_looked_for_where_it_is():
    data = compared(drawn(3, lambda x, g: x + 0.004 * noise(N, BUMP.profile, P, g)))
    centres = (0.06, 0.09, 0.12, 0.16, 0.3)
    places = torch.tensor([(f, w * f) for f in centres for w in (0.02, 0.08)], dtype=torch.float64)
    start = best_bump(data, [], places)
    assert start is not None
    assert start.shared.exp().tolist() == pytest.approx([0.12, 0.08 * 0.12])
    assert (start.local[0] / 0.004**2).log().abs().max() < math.log(3)
    nothing = compared(drawn(3, lambda x, g: 0.5 * x))  # nowhere is there more
    assert best_bump(nothing, [], places) is None


def shape_examples(data: Ratios) -> list[Term]:
    ground = data.ground
    common = Common.start(ground, data.observed - data.expected, data.information, "ar1", tensor(0.01).log())
    return [
        Shift.start(ground),
        replace(LowPass.starts(ground, "pole"), local=LowPass.starts(ground, "pole").local[22].expand(1, P)),
        replace(SimulatedLowPass.starts(ground, "bilinear2"), local=torch.full((1, P), 0.3, dtype=torch.float64)),
        Flicker.start(ground),
        PowerLaw.like(Flicker.start(ground), ground),
        common,
    ]


def test_derivatives_are_those_of_the_model():
    data = compared(drawn(2, n=4096))
    terms = shape_examples(data)
    parts = pieces(data, terms)
    model = parts.model(data)
    slopes = slopes_of_spectra(data, terms, parts, model)
    place = 0
    for k, term in enumerate(terms):
        for number in range(term.local.numel()):
            step = 1e-5 * float(term.local.abs().amax().clamp(min=1e-9)) if term.acts == "add" else 1e-5
            local = term.local.flatten().clone()
            local[number] += step
            moved = [
                *terms[:k],
                type(term)(local.view_as(term.local), term.free, term.shared, *extra(term)),
                *terms[k + 1 :],
            ]
            slope = (data_model(data, moved) - model) / step
            found = slopes[place + number]
            scale = float(slope.abs().amax().clamp(min=1e-12))
            assert float((found - slope).diagonal(dim1=-2, dim2=-1).abs().amax()) < 0.02 * scale
            if isinstance(term, Common):
                assert float((found - slope).abs().amax()) < 0.02 * scale
        place += term.local.numel() + len(term.shared)


def extra(term: Term) -> tuple[str | float, ...]:
    if isinstance(term, PowerLaw):
        return (term.middle,)
    return (term.kind,) if isinstance(term, LowPass | Common) else ()


def test_coherence_of_independent_sensors_is_drawn_to_none_and_a_common_source_stays():
    given = drawn(3)
    none = smooth_coherence(given.reference.coherence, given.reference.dof)
    off = none - torch.eye(P, dtype=none.dtype)
    raw = given.reference.coherence - torch.eye(P, dtype=none.dtype)
    assert float(off.abs().square().sum()) < 0.1 * float(raw.abs().square().sum())
    g = generator(4)
    shared = 0.02 * torch.randn(4, 1, N, generator=g, dtype=torch.float64)
    together = comparison(given.recording, array().simulate(N, batch=(4,), generator=g) + shared)
    high = smooth_coherence(together.reference.coherence, together.reference.dof)[-3].abs()
    expected = shared.var() / (shared.var() + WHITE * tensor(*(1 + i / 20 for i in range(P))))
    torch.testing.assert_close(high[0, 1:], (expected[0] * expected[1:]).sqrt(), rtol=0.03, atol=0)


@pytest.mark.parametrize("kind", FILTERS)
def test_filters_halve_the_power_at_their_corner(kind: str):
    corner = tensor(0.02, 0.11, 0.3)
    strength = filter_strength(kind, corner)
    torch.testing.assert_close(filter_corner(kind, strength), corner, rtol=1e-6, atol=0)
    for c, q in zip(corner, strength, strict=True):
        if not kind.startswith("analogue"):  # aliases add to it
            torch.testing.assert_close(filter_power(kind, q, c[None])[0], tensor(0.5)[0], rtol=1e-6, atol=0)
    f = torch.linspace(0.001, 0.49, 50, dtype=torch.float64)
    torch.testing.assert_close(
        filter_response(kind, strength, f).abs().square(), filter_power(kind, strength, f), rtol=1e-9, atol=1e-14
    )


@pytest.mark.parametrize("order", [2, 4])
def test_what_sampling_leaves_of_an_analogue_filter_has_its_aliases(order: int):
    corner, f = 0.3, torch.linspace(0.0, 0.5, 101, dtype=torch.float64)
    images = np.arange(-200, 201)[:, None]
    _, h = signal.freqs(*signal.butter(order, corner, analog=True), worN=np.abs(f.numpy() + images).ravel())
    folded = (np.abs(h) ** 2).reshape(len(images), -1).sum(0)
    kind = f"analogue{order}"
    seen = filter_power(kind, filter_strength(kind, tensor(corner)), f)[0]
    torch.testing.assert_close(seen, torch.from_numpy(folded / folded[0]), rtol=2e-3, atol=0)


@pytest.mark.parametrize(
    ("kind", "power"),
    [
        # Next to half the rate the image of the step is seen as well.
        ("window0", lambda at: signal.freqz(signal.firwin(29, 0.9), worN=at)[1]),
        ("window1", lambda at: signal.freqz(signal.firwin(15, 0.8), worN=at)[1]),
        (
            "damped4",
            lambda at: signal.freqz(*signal.bilinear([1.0], [1.0, 1 / 1.2**4, 1.0], fs=0.5), worN=at)[1],
        ),
        ("chebyshev4", lambda at: signal.sosfreqz(signal.cheby1(4, 0.5, 0.94, output="sos"), worN=at)[1]),
    ],
)
def test_filters_are_those_that_are_designed(kind: str, power: Callable[[np.ndarray], np.ndarray]):
    f = torch.linspace(0.0005, 0.4995, 9981, dtype=torch.float64)
    designed = torch.from_numpy(np.abs(power(2 * math.pi * f.numpy())) ** 2)
    half = f[(designed > 0.5).sum() - 1 : (designed > 0.5).sum() + 1].mean()
    seen = filter_power(kind, filter_strength(kind, half[None]), f)[0]
    assert float((seen - designed).abs().max()) < (0.05 if kind != "window0" else 0.12)
    none = filter_power(kind, tensor(0.0), f)
    torch.testing.assert_close(none, torch.ones_like(none))


@pytest.mark.statistical
@pytest.mark.parametrize("corner", [0.465, 0.48])
def test_filters_next_to_half_the_rate_are_named(corner: float):
    """Their edge is steeper than blocks can show, and errors of prediction ring next to a record's ends."""
    sections = signal.cheby1(4, 0.5, 2 * corner, output="sos")
    g = generator(7)
    noise = gf.WhiteNoise(1.0)
    recording = torch.from_numpy(signal.sosfilt(sections, noise.simulate(8500, batch=(1,), generator=g).numpy()))
    report = gf.diagnose(recording[:, 300:], noise.simulate(16400, batch=(1,), generator=g))
    assert [f.mechanism for f in report.findings] == ["low_pass"]


def test_an_oscillation_has_variance_one_and_its_half_width():
    f = torch.linspace(-0.5, 0.5, 200001, dtype=torch.float64)
    density = oscillation(f, tensor(0.12)[0], tensor(0.004)[0])
    assert float(torch.trapezoid(density, f)) == pytest.approx(1.0, rel=1e-6)
    at = oscillation(tensor(0.12, 0.124, 0.116), tensor(0.12)[0], tensor(0.004)[0])
    assert (at[1:] / at[0]).tolist() == pytest.approx([0.5, 0.5], rel=0.05)


def test_parts_make_up_the_noise_and_move_as_their_numbers_say():
    given = drawn(5)
    f = torch.logspace(-3.5, -0.31, 60, dtype=torch.float64)
    parts = Parts(given.base, f)
    torch.testing.assert_close(parts.densities.sum(0), given.base.spectrum(f))
    none = torch.zeros(4, P, dtype=torch.float64)
    torch.testing.assert_close(parts.shifted(none), given.base.spectrum(f))
    # Corners twice as high: the AR1s' density at 2 f is what it was at f, far below half the rate.
    moved = none.clone()
    moved[2] = math.log(2)
    low = tensor(1e-3, 2e-3)
    torch.testing.assert_close(
        Parts(given.base, 2 * low).shifted(moved) - Parts(given.base, 2 * low).densities[[0, 2]].sum(0),
        Parts(given.base, low).densities[1],
        rtol=1e-2,
        atol=0,
    )


def test_what_an_ar1_of_a_sample_or_two_has_is_white():
    """Beside white noise chance gives some to it: strong changes of the one must not leave the other behind."""
    given = drawn(5)
    coefficients = given.base.coefficients.clone()
    coefficients[:, -2] = coefficients[:, 0] / 50
    parts = Parts(replace(given.base, coefficients=coefficients), torch.linspace(0.01, 0.5, 50, dtype=torch.float64))
    lower = torch.zeros(4, P, dtype=torch.float64)
    lower[0] = -3.0
    left = parts.shifted(lower) / parts.densities.sum(0)
    assert (left[:, -25:] < 1.1 * math.exp(-3)).all()


def test_a_walk_that_was_not_seen_may_grow():
    g = generator(8)
    plain = ArrayModel.from_sensors([gf.WhiteNoise(WHITE)] * P)
    given = comparison(plain.simulate(N, generator=g), plain.simulate(N, batch=(4,), generator=g))
    f = torch.logspace(-4.2, -0.31, 60, dtype=torch.float64)
    parts, none = Parts(given.base, f), torch.zeros(4, P, dtype=torch.float64)
    torch.testing.assert_close(parts.shifted(none), given.base.spectrum(f))
    has_walk = ~parts.lacks[2]
    assert int(has_walk.sum()) <= P // 2  # by chance
    # Little of it, and it does not level off.
    slow = torch.tensor([1 / N], dtype=torch.float64)
    share = parts.growing_walk / (2 * math.pi * slow).square() / given.base.spectrum(slow)[:, 0]
    assert (share[~has_walk] < 0.3).all()
    grown = none.clone()
    grown[3] = math.log(101)
    more = parts.shifted(grown) - given.base.spectrum(f)
    torch.testing.assert_close(more, 100 * parts.growing_walk[:, None] / (2 * torch.sin(math.pi * f)).square())
    # Without it a walk could not be other numbers of noise that has none.
    walk = 3e-5 * torch.randn(P, N, generator=g, dtype=torch.float64).cumsum(-1)
    data = compared(comparison(given.recording + walk, given.reference.signal))
    start = best_start(data, pieces(data, []), Shift.starts(data.ground)[0])[0]
    assert start.free[3].all()
    # From where the search starts a walk; an AR1 that was not seen either would do nearly as well.
    white = start.free & torch.tensor([True, False, False, False])[:, None]
    walking = best_start(data, pieces(data, []), Shift.starts(data.ground)[-1])[0]
    gains = [fit(data, [term]).gain for term in (replace(walking, free=walking.free | white), start.only(white))]
    assert gains[0] > 70 + gains[1]
    # How much of it there was is not said.
    before, least = _numbers(given.base, RATE, "deg/s")
    assert [number > 0 for number, _ in before[3]] == has_walk.tolist()
    assert all(x > 0 for x in least[3])


def test_noise_with_a_memory_is_other_numbers_of_a_white_simulation():
    g, white = generator(43), gf.WhiteNoise(1e-4)
    truth = white + gf.AR1(0.97, 4e-6)
    recording, simulation = truth.simulate(N, batch=(3,), generator=g), white.simulate(N, batch=(4, 3), generator=g)
    given = comparison(recording, simulation)
    parts = Parts(given.base, torch.linspace(1 / N, 0.5, 200, dtype=torch.float64))
    assert (parts.unseen_ar1[1] > 0).all()
    torch.testing.assert_close(parts.shifted(torch.zeros(4, 3, dtype=torch.float64)), parts.densities.sum(0))
    found = nominated(given)
    assert found is not None
    assert found.mechanism == "parameter_shift"
    assert "AR1 noise of sensor 1 none -> " in found.sentence
    corners = [found.parameters[f"corner[{i}]"] for i in range(3)]
    true = -math.log(0.97) / (2 * math.pi) * RATE
    assert all(abs(c.value - true) < 1.5 * (c.high - c.low) / 2 for c in corners)  # three standard deviations
    assert shape_test(found.effect.repair(given, generator(1))).p_value > 1e-4
    # Where there is an AR1, none is made up beside it.
    assert (Parts(drawn(44).base, parts.f).unseen_ar1[1] == 0).all()


def test_filters_act_on_walks_without_a_jump_at_the_ends():
    g = generator(6)
    walk = torch.randn(2, 4096, generator=g, dtype=torch.float64).cumsum(-1)
    same = filtered(walk, lambda f: torch.ones(2, len(f), dtype=torch.float64))
    torch.testing.assert_close(same, walk)
    half = filtered(walk, lambda f: 0.5 * torch.ones(2, len(f), dtype=torch.float64))
    torch.testing.assert_close(half, walk / 2)


def test_noise_of_a_density_and_its_quadrature():
    g = generator(7)
    x = noise(2**15, lambda f: 1 + 8 * oscillation(f, tensor(0.1)[0], tensor(0.02)[0]), 8, g)
    assert float(x.var()) == pytest.approx(9.0, rel=0.05)
    y = quadrature(x[:, : 2**14])
    correlation = (x[:, : 2**14] * y).mean() / x.var()
    assert abs(float(correlation)) < 0.01
    turned = of_phase(torch.tensor([1.0, 1j], dtype=torch.complex128), x[:1])
    ahead = torch.fft.rfft(turned[1]) / torch.fft.rfft(turned[0])
    assert ahead[100:-100].mean().imag == pytest.approx(1.0, abs=1e-9)


@pytest.mark.statistical
@pytest.mark.parametrize("witness", [shape_test, peak_test, common_source_test])
def test_witnesses_of_shapes_are_honest(witness):
    n_runs = 40
    p = [witness(drawn(100 + s, n=4096)).p_value for s in range(n_runs)]
    assert sum(x < 0.05 for x in p) <= stats.binom.isf(1e-3, n_runs, 0.05)


@pytest.mark.statistical
def test_witnesses_of_shapes_are_honest_with_common_noise_in_both():
    n_runs, p = 24, []
    for s in range(n_runs):
        g = generator(200 + s)
        one, other = (x.simulate(4096, generator=g) for x in (array(), array()))
        source = 0.02 * torch.randn(2, 1, 4096, generator=g, dtype=torch.float64) * SIGNS[:, None]
        given = comparison(one + source[0], (other + source[1])[None])
        p += [min(w(given).p_value for w in (shape_test, peak_test, common_source_test, coherence_test))]
    assert sum(x < 0.05 for x in p) <= stats.binom.isf(1e-3, n_runs, 0.2)


@pytest.mark.statistical
def test_small_changes_of_all_bands_are_seen_where_single_bands_say_nothing():
    n_runs, pooled, single = 15, 0, 0
    for s in range(n_runs):
        given = drawn(300 + s, lambda x, g: 1.02 * x)
        pooled += shape_test(given).p_value < 2.5e-3
        single += spectrum_test(given).p_value < 2.5e-3
    assert pooled >= stats.binom.ppf(1e-3, n_runs, 0.9)
    assert single < pooled / 2


def test_weak_noise_in_common_is_seen_where_single_bands_say_nothing():
    n_runs, pooled, single = 15, 0, 0
    for s in range(n_runs):
        given = drawn(330 + s, lambda x, g: x + 0.0019 * torch.randn(1, N, generator=g, dtype=x.dtype))
        pooled += common_source_test(given).p_value < 2.5e-3
        single += coherence_test(given).p_value < 2.5e-3
    assert pooled >= stats.binom.ppf(1e-3, n_runs, 0.9)
    assert single < pooled / 2


def test_a_short_simulation_has_little_to_say():
    g = generator(8)
    given = comparison(array().simulate(N, generator=g), array().simulate(4096, generator=g)[None])
    assert shape_test(given).p_value > 1e-3
    assert peak_test(given).p_value > 1e-3
    assert nominated(given) is None


@pytest.mark.statistical
def test_fits_of_nothing_gain_what_chance_gives():
    gains = []
    for s in range(12):
        data = compared(drawn(400 + s))
        gains.append(2 * fit(data, [best_start(data, pieces(data, []), LowPass.starts(data.ground, "pole"))[0]]).gain)
    # Half the sensors' estimates would be negative: at most chi-square with as many numbers.
    assert float(np.mean(gains)) < P + 4 * math.sqrt(2 * P / 12)


def test_shapes_are_searched_once_for_a_case():
    given = drawn(20, CHANGES["levels"][1])
    assert leading_shape(given) is leading_shape(given)


@pytest.mark.slow
def test_what_a_shape_is_fitted_beside_comes_first_where_it_was_passed_over():
    given = drawn(22, lambda x, g: CHANGES["filter"][1](CHANGES["white in common"][1](x, g), g))
    first = leading_shape(given)
    assert first is not None
    assert [term.name for term in (first.term, *first.company)] == ["low_pass", "common_mode"]
    second = leading_shape(replace(given, passed_over=("low_pass",)))
    assert second is not None
    assert second.term.name == "common_mode"
    assert leading_shape(replace(given, passed_over=("low_pass", "common_mode"))) is None


@pytest.mark.parametrize(("share", "regular"), [(0.0, True), (0.9, True), (0.999, False)])
def test_sensors_keep_something_of_their_own_beside_what_is_common(share: float, regular: bool):
    """Cross-spectra of fewer ordinates than sensors lie in a plane: noise in it alone would be infinitely likely."""
    data = compared(drawn(21, CHANGES["levels"][1]))
    found = fit(data, [Flicker.start(data.ground)])
    signs = torch.tensor([1.0, -1.0] * P, dtype=torch.float64)[:P]
    plane = share * signs[:, None] * signs + (1 - share) * torch.eye(P, dtype=torch.float64)
    size = torch.arange(1, P + 1, dtype=torch.float64)
    model = found.model.clone()
    model[3] = plane * size[:, None] * size
    assert keeps_own(found._replace(model=model)) == regular


def falling(slope: float) -> Comparison:
    """A recording with noise added that falls so."""
    middle = math.sqrt(0.5 / N)
    return drawn(23, lambda x, g: x + 1.5e-3 * noise(N, lambda f: (middle / f) ** slope / middle, P, g))


@pytest.mark.parametrize("slope", [1.0, 1.2])
def test_noise_that_is_a_little_steeper_is_no_flicker(slope: float):
    data = compared(falling(slope))
    first = fit(data, [Flicker.start(data.ground)])
    assert (with_its_slope(data, first).terms[0].name == "power_law") == (slope != 1.0)


def test_flicker_noise_far_above_the_rest_may_be_bent_by_its_sampling():
    """Means over samples of noise whose fastest trap dwells for a quarter of one fall faster next to the rate."""
    data = compared(drawn(24, lambda x, g: x + 0.05 * noise(N, sampled_flicker, P, g)))
    first = fit(data, [Flicker.start(data.ground)])
    assert with_its_slope(data, first) is first


def sampled_flicker(f: torch.Tensor) -> torch.Tensor:
    return torch.sinc(f).square() * (1 - 2 / math.pi * torch.atan(2 * math.pi * f / 4)) / f


@pytest.mark.statistical
@pytest.mark.parametrize("slope", [1.0, 1.5])
def test_noise_is_flicker_only_if_it_falls_as_flicker_does(slope: float):
    given = falling(slope)
    data = compared(given)
    alone = fit(data, [PowerLaw.like(Flicker.start(data.ground), data.ground)])
    assert float(alone.terms[0].shared) == pytest.approx(slope, abs=3 * float(alone.sd(0)[1]))
    assert float(alone.sd(0)[1]) < 0.1
    assert spectrum_test(given).p_value < 1e-4
    found = nominated(given)
    assert found is not None
    assert found.mechanism == ("flicker" if slope == 1.0 else "power_law")
