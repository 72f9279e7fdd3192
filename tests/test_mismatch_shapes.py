"""Spectral shapes that a simulation lacks, against direct sums, theory and simulation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.bumps import _coherent_scores, bump_witness, oscillation_of, strongest_bump
from gyrofuse.mismatch.case import Case, Scene
from gyrofuse.mismatch.colour import filtered, noise, of_phase, quadrature
from gyrofuse.mismatch.confirm import held_out_gain
from gyrofuse.mismatch.filter_forms import FILTERS, filter_corner, filter_power, filter_response, filter_strength
from gyrofuse.mismatch.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.common_mode import CommonMode
from gyrofuse.mismatch.mechanisms.drifting_tone import DriftingTone
from gyrofuse.mismatch.mechanisms.flicker import FlickerNoise
from gyrofuse.mismatch.mechanisms.low_pass import LowPassFilter
from gyrofuse.mismatch.mechanisms.parameter_shift import ParameterShift, _numbers
from gyrofuse.mismatch.mechanisms.resonance import Resonance
from gyrofuse.mismatch.oscillating import Mode
from gyrofuse.mismatch.pooled import common_witness
from gyrofuse.mismatch.shape_fit import Ratios, data_model, fair_gain, fit, linearised, log_score
from gyrofuse.mismatch.shape_law import equivalent, smooth_coherence
from gyrofuse.mismatch.shape_scan import bump_start, shape_witness
from gyrofuse.mismatch.shape_terms import (
    Bump,
    Common,
    Flicker,
    LowPass,
    Parts,
    Shift,
    Term,
    oscillation,
)
from gyrofuse.mismatch.shapes import compared, leading_shape
from gyrofuse.mismatch.witnesses import coherence_witness, spectrum_witness
from gyrofuse.simulate import ArrayModel

N, P, RATE = 16384, 6, 100.0
WHITE = 1e-4
BUMP = Mode(0.12, 0.01, torch.ones(6, dtype=torch.complex128), False)
SIGNS = torch.tensor([1.0, 1.0, -1.0, 0.5, 1.0, 1.0], dtype=torch.float64)
CATALOGUE = (ParameterShift, LowPassFilter, Resonance, DriftingTone, FlickerNoise, CommonMode)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def case(recording: Tensor, simulation: Tensor) -> Case:
    return Case.of(Scene(RATE, "deg/s", tuple(map(str, range(recording.shape[-2])))), recording, simulation)


def array(white: float = WHITE, phi: float = 0.99) -> ArrayModel:
    sensor = [gf.WhiteNoise(white * (1 + i / 20)) + gf.AR1(phi, 2e-7) + gf.RandomWalk(1e-9) for i in range(P)]
    return ArrayModel.from_sensors(sensor)


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def drawn(seed: int, change: Callable[[Tensor, torch.Generator], Tensor] | None = None, n: int = N) -> Case:
    g = generator(seed)
    recording, simulation = array().simulate(n, generator=g), array().simulate(n, batch=(4,), generator=g)
    return case(recording if change is None else change(recording, g), simulation)


def nominated(given: Case, level: float = 1e-3) -> Finding | None:
    found = [f for f in (m.nominate(given, level) for m in CATALOGUE) if f is not None]
    return max(found, key=lambda f: f.gain, default=None)


# Kernels ----------------------------------------------------------------------------------------------------------


def test_a_power_gains_under_whittle_what_the_law_of_f_gives_it():
    d, s = tensor(5.0, 5.0, 40.0, 300.0), tensor(5.0, 20.0, 40.0, 1e9)
    ratio = tensor(4.0, 0.3, 1.4, 0.9)
    q = equivalent(ratio, d, s)
    w = d * s / (d + s)
    gain = stats.f.logpdf  # density of log ratio: x f(x)
    for i in range(4):
        r, a, b = float(ratio[i]), 2 * float(d[i]), 2 * float(s[i])
        # With a free level the law is that of ratio / level: from level one to the best one, its own ratio.
        expected = (gain(1.0, a, b)) - (gain(r, a, b) + math.log(r))
        assert float(w[i] * (q[i] - 1 - q[i].log())) == pytest.approx(expected, rel=1e-5)
    assert float(q[3]) == pytest.approx(0.9, rel=1e-6)
    assert ((q > 1) == (ratio > 1)).all()


def test_whittles_score_is_that_of_determinants_and_traces():
    data = compared(drawn(1, n=4096))
    model = data_model(data, [Shift.start(data.ground)])
    for b in (0, 5, 20):
        m, q, w = model[b].numpy(), data.observed[b].numpy(), float(data.worth[b])
        expected = -w * (np.linalg.slogdet(m)[1] + np.trace(np.linalg.solve(m, q)).real)
        # What coherences are worth beyond powers, where the simulation's sensors are independent.
        g, k = (x / np.sqrt(np.outer(x.diagonal().real, x.diagonal().real)) for x in (m, q))
        expected -= float(data.extra[b]) * (np.linalg.slogdet(g)[1] + np.trace(np.linalg.solve(g, k)).real)
        assert float(log_score(data, model)[b]) == pytest.approx(expected, rel=1e-9)


def test_a_model_gains_what_the_law_of_f_gives_it():
    # Independent sensors: the likelihood of every ratio by itself, at whatever powers the data were centred before.
    data = compared(drawn(1, lambda x, g: 3 * x, n=4096))
    model = data.expected * torch.linspace(0.5, 12, len(data.worth), dtype=torch.float64)[:, None, None]
    spectra, power, d, s = data.sides
    ratio = spectra.diagonal(dim1=-2, dim2=-1).real / power
    total = 0.0
    for b in range(len(d)):
        a, c, m = 2 * float(d[b]), 2 * float(s[b]), float(model[b, 0, 0].real)
        for r in ratio[b].tolist() if data.worth[b] > 0 else ():
            # `mean` is what the equivalent of a ratio of one is on average: it moves both alike.
            total += stats.f.logpdf(r / m, a, c) - math.log(m) - stats.f.logpdf(r, a, c)
    bare = replace(
        data, mean=torch.ones_like(data.mean), worth=d * s / (d + s) * (data.worth > 0), extra=0 * data.extra
    )
    eye = torch.eye(P, dtype=torch.complex128).expand_as(data.expected)
    bare, model = replace(bare, expected=eye), eye * model.diagonal(dim1=-2, dim2=-1)[..., None]
    alone = replace(bare, sides=(spectra * torch.eye(P), power, d, s))
    assert fair_gain(alone, model) == pytest.approx(total, rel=1e-4)
    elsewhere = alone.centred(7 * torch.ones(len(d), P, dtype=torch.float64))
    assert fair_gain(elsewhere, model) == pytest.approx(fair_gain(alone, model), rel=1e-9)


def test_standard_deviations_of_sensors_at_a_known_width():
    data = compared(drawn(3, lambda x, g: x + 0.004 * noise(N, BUMP.profile, P, g)))
    free = torch.ones(1, P, dtype=torch.bool)
    free[0, 2] = False
    found = fit(data, [Bump(torch.full((1, P), 1e-5, dtype=torch.float64) * free, free, tensor(0.12, 0.01).log())])
    information = torch.linalg.inv(found.covariance)[: P - 1, : P - 1]  # the shared numbers come last
    expected = torch.linalg.inv(information).diagonal().sqrt()
    sd = found.sd_given_shared(0)[0]
    assert sd.isnan().tolist() == (~free[0]).tolist()
    torch.testing.assert_close(sd[free[0]], expected, rtol=1e-4, atol=0)
    assert (sd[free[0]] <= found.sd(0)[0][0, free[0]]).all()


def test_a_bump_is_looked_for_where_it_is_in_the_sensors_that_may_have_it():
    data = compared(drawn(3, lambda x, g: x + 0.004 * noise(N, BUMP.profile, P, g)), 24)
    some = torch.arange(P) < 2
    starts = [(f, w * f) for f in (0.06, 0.09, 0.12, 0.16, 0.3) for w in (0.02, 0.08)]
    start = bump_start(data, data.expected, starts, some)
    assert start is not None
    assert float(start.shared[0].exp()) == pytest.approx(0.12)
    assert ((start.local[0] > 0) == some).all()
    assert bump_start(data, data.observed, starts, some) is None


def shape_examples(data: Ratios) -> list[Term]:
    ground = data.ground
    common = Common.start(ground, data.observed - data.expected, data.worth, "ar1", tensor(0.01).log())
    return [
        Shift.start(ground),
        LowPass.starts(ground, "pole")[2],
        Flicker.start(ground),
        common,
    ]


def test_derivatives_are_those_of_the_model():
    data = compared(drawn(2, n=4096))
    terms = shape_examples(data)
    model, slopes = linearised(data, terms)
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


def extra(term: Term) -> tuple[str, ...]:
    return (term.kind,) if isinstance(term, LowPass | Common) else ()


def test_coherence_of_independent_sensors_is_drawn_to_none_and_a_common_source_stays():
    given = drawn(3)
    none = smooth_coherence(given.simulated.coherence, given.simulated.dof)
    off = none - torch.eye(P, dtype=none.dtype)
    raw = given.simulated.coherence - torch.eye(P, dtype=none.dtype)
    assert float(off.abs().square().sum()) < 0.1 * float(raw.abs().square().sum())
    g = generator(4)
    shared = 0.02 * torch.randn(4, 1, N, generator=g, dtype=torch.float64)
    together = case(given.recording, array().simulate(N, batch=(4,), generator=g) + shared)
    high = smooth_coherence(together.simulated.coherence, together.simulated.dof)[-3].abs()
    expected = shared.var() / (shared.var() + WHITE * tensor(*(1 + i / 20 for i in range(P))))
    torch.testing.assert_close(high[0, 1:], (expected[0] * expected[1:]).sqrt(), rtol=0.03, atol=0)


@pytest.mark.parametrize("kind", FILTERS)
def test_filters_halve_the_power_at_their_corner(kind: str):
    corner = tensor(0.02, 0.11, 0.3)
    strength = filter_strength(kind, corner)
    torch.testing.assert_close(filter_corner(kind, strength), corner, rtol=1e-6, atol=0)
    for c, q in zip(corner, strength, strict=True):
        torch.testing.assert_close(filter_power(kind, q, c[None])[0], tensor(0.5)[0], rtol=1e-6, atol=0)
    f = torch.linspace(0.001, 0.49, 50, dtype=torch.float64)
    torch.testing.assert_close(
        filter_response(kind, strength, f).abs().square(), filter_power(kind, strength, f), rtol=1e-9, atol=1e-14
    )


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


def test_a_walk_that_was_not_seen_may_grow():
    g = generator(8)
    plain = ArrayModel.from_sensors([gf.WhiteNoise(WHITE)] * P)
    given = case(plain.simulate(N, generator=g), plain.simulate(N, batch=(4,), generator=g))
    f = torch.logspace(-4.2, -0.31, 60, dtype=torch.float64)
    parts, none = Parts(given.base, f), torch.zeros(4, P, dtype=torch.float64)
    torch.testing.assert_close(parts.shifted(none), given.base.spectrum(f))
    unseen = parts.unseen[:, 0] > 0
    assert int(unseen.sum()) >= P // 2  # of the others chance shows a walk
    assert (parts.unseen[:, f > 2 / N] < 0.02 * given.base.spectrum(f)[:, f > 2 / N]).all()
    grown = none.clone()
    grown[3] = math.log(101)
    more = parts.shifted(grown) - given.base.spectrum(f)
    torch.testing.assert_close(more[unseen], 100 * (parts.densities[2] + parts.unseen)[unseen])
    # Without it a walk could not be other numbers of noise that has none.
    walk = 3e-5 * torch.randn(P, N, generator=g, dtype=torch.float64).cumsum(-1)
    data = compared(case(given.recording + walk, given.simulated.signal))
    start = Shift.start(data.ground)
    assert start.free[3].all()
    assert (
        fit(data, [start]).gain
        > 20 + fit(data, [replace(start, free=start.free & (torch.arange(4) < 3)[:, None])]).gain
    )
    # How much of it there was is not said.
    before, least = _numbers(given.base, RATE, "deg/s")
    assert [number == 0 for number, _ in before[3]] == unseen.tolist()
    assert all(x > 0 for x in least)


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


# Witnesses --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("witness", [shape_witness, bump_witness, common_witness])
def test_witnesses_of_shapes_are_honest(witness):
    n_runs = 40
    p = [witness(drawn(100 + s, n=4096)).p_value for s in range(n_runs)]
    assert sum(x < 0.05 for x in p) <= stats.binom.isf(1e-3, n_runs, 0.05)


def test_witnesses_of_shapes_are_honest_with_common_noise_in_both():
    n_runs, p = 24, []
    for s in range(n_runs):
        g = generator(200 + s)
        one, other = (x.simulate(4096, generator=g) for x in (array(), array()))
        source = 0.02 * torch.randn(2, 1, 4096, generator=g, dtype=torch.float64) * SIGNS[:, None]
        given = case(one + source[0], (other + source[1])[None])
        p += [min(w(given).p_value for w in (shape_witness, bump_witness, common_witness, coherence_witness))]
    assert sum(x < 0.05 for x in p) <= stats.binom.isf(1e-3, n_runs, 0.2)


@pytest.mark.parametrize("d", [20, 60])
def test_correlations_of_independent_sensors_have_the_law_of_a_product_of_beta_variables(d: int):
    n_runs = 4000
    parts = torch.randn(2, n_runs, P, d, generator=generator(31), dtype=torch.float64)
    z = torch.complex(parts[0], parts[1])
    scores = _coherent_scores(z @ z.mH, float(d))
    for level in (0.05, 0.005):
        count = (scores > float(stats.norm.isf(level))).sum(-1).tolist()
        low, high = stats.binom.ppf(1e-3, n_runs, 0.85 * level), stats.binom.isf(1e-3, n_runs, 1.15 * level)
        assert all(low <= c <= high for c in count)


def test_white_noise_of_which_sensors_share_a_part_is_named_though_no_power_changes():
    g, share = generator(32), 0.06
    own, simulation = array((1 - share) * WHITE).simulate(N, generator=g), array().simulate(N, batch=(1,), generator=g)
    gain = (share * WHITE * torch.tensor([1 + i / 20 for i in range(P)], dtype=torch.float64)).sqrt()
    given = case(own + gain[:, None] * torch.randn(1, N, generator=g, dtype=torch.float64), simulation)
    found = CommonMode.nominate(given, 1e-4)
    assert found is not None
    assert isinstance(found.effect, CommonMode)
    assert found.effect.inside
    for i in found.sensors:
        entry = found.parameters[f"gain[{i}]"]
        assert abs(entry.value - float(gain[i])) < 2.1 * (entry.high - entry.low) / 2
    explained = found.effect.explained(given, g)
    assert shape_witness(explained).p_value > 1e-4
    assert common_witness(explained).p_value > 1e-4


def test_small_changes_of_all_bands_are_seen_where_single_bands_say_nothing():
    n_runs, pooled, single = 15, 0, 0
    for s in range(n_runs):
        given = drawn(300 + s, lambda x, g: 1.02 * x)
        pooled += shape_witness(given).p_value < 2.5e-3
        single += spectrum_witness(given).p_value < 2.5e-3
    assert pooled >= stats.binom.ppf(1e-3, n_runs, 0.9)
    assert single < pooled / 2


def test_weak_noise_in_common_is_seen_where_single_bands_say_nothing():
    n_runs, pooled, single = 15, 0, 0
    for s in range(n_runs):
        given = drawn(330 + s, lambda x, g: x + 0.0019 * torch.randn(1, N, generator=g, dtype=x.dtype))
        pooled += common_witness(given).p_value < 2.5e-3
        single += coherence_witness(given).p_value < 2.5e-3
    assert pooled >= stats.binom.ppf(1e-3, n_runs, 0.9)
    assert single < pooled / 2


def test_a_short_simulation_has_little_to_say():
    g = generator(8)
    given = case(array().simulate(N, generator=g), array().simulate(4096, generator=g)[None])
    assert shape_witness(given).p_value > 1e-3
    assert bump_witness(given).p_value > 1e-3
    assert nominated(given) is None


def oscillating(g: torch.Generator, centre: float, width: float, rows: int, n: int = N) -> Tensor:
    return noise(n, lambda f: oscillation(f, tensor(centre)[0], tensor(width)[0]), rows, g)


def test_a_line_is_no_bump_and_a_bump_of_both_sides_neither():
    t = torch.arange(N, dtype=torch.float64)
    line = drawn(9, lambda x, g: x + 0.002 * torch.cos(2 * math.pi * 0.1234 * t))
    assert strongest_bump(line).p_value > 1e-3
    g = generator(10)
    both = [array().simulate(N, generator=g) + 0.005 * oscillating(g, 0.1, 0.002, P) for _ in range(3)]
    assert strongest_bump(case(both[0], torch.stack(both[1:]))).p_value > 1e-3


# Mechanisms -------------------------------------------------------------------------------------------------------


def wandering(g: torch.Generator, n: int = N) -> Tensor:
    speed = noise(n, lambda f: 1 / (1e-8 + f.square()), 1, g)[0]
    return torch.cos(2 * math.pi * (0.1 + 0.002 * speed / speed.std()).cumsum(0))


CHANGES: dict[str, tuple[str, Callable[[Tensor, torch.Generator], Tensor], dict[str, float]]] = {
    "levels": ("parameter_shift", lambda x, g: 1.1 * x, {"white_factor[2]": 1.1**2}),
    "filter": (
        "low_pass",
        lambda x, g: filtered(
            x, lambda f: filter_response("bilinear2", filter_strength("bilinear2", tensor(*(P * [0.3]))), f)
        ),
        {"corner[1]": 30.0},
    ),
    "own modes": (
        "resonance",
        lambda x, g: x + 0.004 * oscillating(g, 0.1, 0.01, P),
        {"frequency": 10.0, "width": 2.0, "rms[3]": 0.004},
    ),
    "one mode": (
        "resonance",
        lambda x, g: x + 0.004 * oscillating(g, 0.1, 0.002, 1) * SIGNS[:, None],
        {"frequency": 10.0, "width": 0.4, "rms[3]": 0.002},
    ),
    "tone": ("drifting_tone", lambda x, g: x + 0.004 * wandering(g) * SIGNS[:, None], {"amplitude[0]": 0.004}),
    "flicker": ("flicker", lambda x, g: x + 1e-3 * noise(N, torch.reciprocal, P, g), {"level[4]": 2**0.5 * 1e-3}),
    "white in common": (
        "common_mode",
        lambda x, g: x + 0.004 * torch.randn(1, N, generator=g, dtype=torch.float64) * SIGNS[:, None],
        {"gain[0]": 0.004, "gain[3]": 0.002},
    ),
    "a walk in common": (
        "common_mode",
        lambda x, g: x + 3e-4 * torch.randn(1, N, generator=g, dtype=torch.float64).cumsum(-1) * SIGNS[:, None],
        {"gain[0]": 3e-4, "gain[3]": 1.5e-4},
    ),
}


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
    assert held_out_gain(given, found.effect).confirms(found.p_value)
    explained = found.effect.explained(given, generator(1))
    assert shape_witness(explained).p_value > 1e-4
    assert nominated(explained) is None


def test_modes_of_single_sensors_that_bands_are_too_wide_for():
    # Half as wide as a quarter of an octave, and too weak for a stretch of bins among all of them.
    mode = Mode(0.2, 0.2 / 2 / 15, tensor(*(P * [1.0])).to(torch.complex128), False)
    has = tensor(1, 0, 0, 1, 0, 1)
    named, inside = 0, []
    for seed in range(6):
        given = drawn(700 + seed, lambda x, g: x + 3.6e-3 * has[:, None] * noise(N, mode.profile, P, g))
        found = Resonance.nominate(given, 1e-3)
        if found is None:
            continue
        named += 1
        f, q = found.parameters["frequency"], found.parameters["quality_factor"]
        inside += [f.low <= 0.2 * RATE <= f.high, q.low <= 15 <= q.high]
        again = found.effect.refitted(given, 0)
        assert isinstance(again, Resonance)
        assert isinstance(found.effect, Resonance)
        assert ((again.mode.gain != 0) <= (found.effect.mode.gain != 0)).all()
    assert named >= 4
    assert sum(inside) >= stats.binom.ppf(1e-3, len(inside), 0.95)


def test_a_filter_and_what_it_acts_on_are_found_one_after_the_other():
    def change(x: Tensor, g: torch.Generator) -> Tensor:
        q = filter_strength("bilinear2", tensor(*(P * [0.3])))
        return filtered(x + 0.004 * wandering(g) * SIGNS[:, None], lambda f: filter_response("bilinear2", q, f))

    given, names = drawn(12, change), []
    while (found := nominated(given)) is not None:
        names.append(found.mechanism)
        given = found.effect.explained(given, generator(2))
        assert len(names) < 4
    assert names == ["drifting_tone", "low_pass"]


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
    built = effect.simulated(plain, given.scene, generator(16))
    assert built.shape == plain.shape
    before, after = case(given.recording, plain), case(given.recording, built)
    places = given.bands.places
    matrices = torch.diag_embed(before.base.spectrum(places).mT).to(torch.complex128)
    promised = effect.spectra(matrices, places).movedim(0, -1)
    expected = given.bands.mean_of(promised).movedim(-1, 0)
    high = given.bands.dof > 40
    level = expected.diagonal(dim1=-2, dim2=-1).real.sqrt()
    error = (after.simulated.spectra - expected).abs() / (level[:, :, None] * level[:, None, :])
    spread = (n_records * given.bands.dof).rsqrt()
    # A source of one path is common: its errors in several sensors are one error.
    assert float((error.amax((-1, -2)) / spread)[high].median()) < 4.0
    assert float((error.amax((-1, -2)) / spread)[high].max()) < 12.0


@pytest.mark.parametrize("name", ["levels", "filter", "own modes", "one mode", "flicker", "white in common"])
def test_numbers_without_a_fold_are_near_those_of_all(name: str):
    _, change, _ = CHANGES[name]
    given = drawn(17, change)
    found = nominated(given)
    assert found is not None
    part = found.effect.refitted(given, 0)
    f = torch.linspace(0.02, 0.45, 40, dtype=torch.float64)
    matrices = torch.diag_embed(given.base.spectrum(f).mT).to(torch.complex128)
    one, other = (e.spectra(matrices, f).diagonal(dim1=-2, dim2=-1).real for e in (found.effect, part))
    assert float((one / other).log().abs().mean()) < 0.1


def test_fits_of_nothing_gain_what_chance_gives():
    gains = []
    for s in range(12):
        data = compared(drawn(400 + s))
        gains.append(2 * fit(data, [LowPass.starts(data.ground, "pole")[0]]).gain)
    # Half the sensors' estimates would be negative: at most chi-square with as many numbers.
    assert float(np.mean(gains)) < P + 4 * math.sqrt(2 * P / 12)


def test_nothing_is_named_where_nothing_is_missing():
    named = [f.mechanism for s in range(3) if (f := nominated(drawn(500 + s))) is not None]
    assert named == []


def test_coherent_or_not_is_told_of_a_bump():
    alone = oscillation_of(drawn(18, CHANGES["own modes"][1]))
    together = oscillation_of(drawn(19, CHANGES["one mode"][1]))
    assert alone is not None
    assert together is not None
    assert alone.gain is None
    assert together.gain is not None
    turned = together.gain * together.gain[0].conj()
    assert (turned.real.sign() == SIGNS.sign()).all()


def test_shapes_are_searched_once_for_a_case():
    given = drawn(20, CHANGES["levels"][1])
    assert leading_shape(given) is leading_shape(given)
