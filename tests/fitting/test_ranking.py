"""Ranking of structures: that the true one is chosen, that smaller ones are seen in larger, and the criteria."""

from __future__ import annotations

import json
import math

import matplotlib as mpl
import numpy as np
import pytest
import torch
from scipy import fft, stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting import rank_models_moments
from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.fitting.ranking.candidates import all_noises, key_of, simplified, structure_of
from gyrofuse.fitting.ranking.spectra import NoiseFit, Spectra, _grid


def signals(model: gf.Model, n: int, n_samples: int = 4096, seed: int = 0) -> Tensor:
    return model.simulate(n_samples, batch=(n, 1), generator=torch.Generator().manual_seed(seed))


WHITE = gf.WhiteNoise(1.0)
WALK = gf.RandomWalk(4e-3)
MARKOV = gf.AR1(0.975, 0.05)
TONE = gf.Sinusoid(0.85, 0.35)
PARTS = {
    "WN": gf.Model([WHITE]),
    "WN + RW": WHITE + WALK,
    "WN + AR1": WHITE + MARKOV,
    "AR1": gf.Model([MARKOV]),
    "WN + RW + SIN": WHITE + WALK + TONE,
    "WN + AR1 + SIN": WHITE + MARKOV + TONE,
}


@pytest.mark.statistical
def test_the_true_composition_is_chosen(draws):
    """In some records of each; a rate of 95 % gives fewer than 3 of 6 (8 of 12) once in thousands of times."""
    n_records = draws(6, 12)
    found = gf.rank_models(torch.cat([signals(model, n_records, 2048) for model in PARTS.values()]), fit=False)
    for n, name in enumerate(PARTS):
        chosen = found.names[n_records * n : n_records * (n + 1)]
        assert chosen.count(name) >= stats.binom.ppf(0.0005, n_records, 0.95), (name, chosen)
    assert bool((found.difference[~found.redundant].nan_to_num(nan=0.0) >= 0).all())


@pytest.mark.statistical
def test_two_tones_and_none():
    both = PARTS["WN"] + TONE + gf.Sinusoid(0.5, 1.1)
    assert (gf.rank_models(signals(both, 6), fit=False).n_sinusoids == 2).all()
    # 0.1 % a record: more than 2 of 60 once in 30 000 times.
    assert (
        int((gf.rank_models(signals(PARTS["WN"], 60, 512), ["WN", "WN + SIN"], fit=False).n_sinusoids > 0).sum()) <= 2
    )


def test_bic_of_white_noise_and_of_a_walk():
    """Variances that scale one known shape have their likelihood in closed form."""
    signal = signals(PARTS["WN + RW"], 2, 1000)
    found = gf.rank_models(signal, ["WN", "RW"], fit=False)
    y = fft.dct(signal[:, 0].numpy(), norm="ortho")[:, 1:]
    sine = np.sin(math.pi * np.arange(1, 1000) / 2000) ** 2
    for c, shape in enumerate((np.ones(999), 0.25 / sine)):
        variance = shape * (y**2 / shape).mean(-1, keepdims=True)
        by_hand = (np.log(2 * math.pi * variance) + y**2 / variance).sum(-1) + 3 * math.log(math.log(1000))
        # Bands hold ordinates over which the walk's variance changes by a twelfth.
        assert found.criterion[:, 0, c].tolist() == pytest.approx(by_hand.tolist(), abs=1e-6 if c == 0 else 8)


def test_score_of_an_ar1_as_by_hand():
    """Loops over ordinates, and the information that other processes leave by the Schur complement."""
    n = 48
    signal = signals(PARTS["WN + AR1"], 3, n)[:, 0]
    spectra = Spectra(signal)
    parent = structure_of([gf.WhiteNoise, gf.AR1, gf.RandomWalk], held=True)
    phi, p = torch.tensor([0.5, 0.7, 0.2]), torch.tensor([[1.0, 0.3, 0.01], [0.8, 0.2, 0.0], [0.0, 1.0, 0.02]])
    linear, shape = p.double(), phi.double().atanh()[:, None]
    nothing = torch.zeros(3, dtype=torch.float64)
    x, start = spectra._best_shape(parent, NoiseFit(linear, shape, nothing, nothing, nothing), gf.AR1())
    grid = _grid(gf.AR1, n).tanh()
    energy, step = fft.dct(signal.numpy(), norm="ortho")[:, 1:] ** 2, 1e-6

    def variances(phi: float) -> np.ndarray:
        return (
            gf.AR1.unit_band_variance(spectra.bins, torch.tensor([phi], dtype=torch.float64).atanh()).value[0].numpy()
        )

    sine = np.sin(math.pi * np.arange(1, n) / (2 * n)) ** 2
    for i in range(3):
        own, walk = variances(phi[i].item()), 0.25 / sine
        moved = (variances(math.tanh(shape[i, 0] + step)) - variances(math.tanh(shape[i, 0] - step))) / (2 * step)
        columns = [np.ones(n - 1), own, walk, p[i, 1].item() * moved]
        variance = p[i, 0].item() + p[i, 1].item() * own + p[i, 2].item() * walk
        there = [c for c, size in zip(columns, [*p[i].tolist(), p[i, 1].item()], strict=True) if size > 0]
        score, best = [], []
        for one in grid.tolist():
            everything = [*there, variances(one)]
            information = np.zeros((len(everything), len(everything)))
            slope = np.zeros(len(everything))
            for k in range(n - 1):
                for a, left in enumerate(everything):
                    slope[a] += left[k] * (energy[i, k] - variance[k]) / (2 * variance[k] ** 2)
                    for b, right in enumerate(everything):
                        information[a, b] += left[k] * right[k] / (2 * variance[k] ** 2)
            across = np.linalg.lstsq(information[:-1, :-1], information[:-1, -1], rcond=None)[0]
            left_over = information[-1, -1] - information[-1, :-1] @ across
            gradient = slope[-1] - slope[:-1] @ across
            score.append(gradient / math.sqrt(left_over))
            best.append(max(gradient / left_over, 0.0))
        place = int(np.argmax(score))
        assert x[i].item() == pytest.approx(math.atanh(grid[place].item()))
        assert start[i].item() == pytest.approx(best[place], rel=1e-4)


def test_larger_candidates_never_have_less_likelihood():
    """Each starts where the best with one process less ended."""
    names = ["WN", "WN + AR1", "WN + AR1 + RW", "WN + QN + AR1 + RW", "WN + QN + 2*AR1 + RW"]
    found = gf.rank_models(signals(PARTS["WN + AR1"], 8), names, fit=False)
    penalty = torch.tensor([1, 3, 4, 5, 7]) * 3 * math.log(math.log(4096))
    likelihood = -(found.criterion[:, 0] - penalty) / 2
    assert (likelihood.diff(dim=-1) > -1e-3).all()
    assert set(found.names) == {"WN + AR1"}


@pytest.mark.statistical
def test_an_ar1_that_is_white_noise_does_not_hide_it():
    """The three best pairs hold no WN + QN: of three processes QN + AR1 + RW came first in half of these records.

    An AR1 that white noise cannot replace pays its way in less than 1 % of records: in two of ten once in 200 times.
    """
    signal = signals(gf.QuantizationNoise(0.5) + WHITE + gf.RandomWalk(4e-5), 10, seed=3)
    assert gf.rank_models(signal, fit=False).names.count("WN + QN + RW") >= 9


def test_the_search_ends_where_nothing_next_to_it_is_better():
    """As good as all candidates that are alike: white and quantisation noise look like an AR1 that alternates."""
    model = gf.QuantizationNoise(0.5) + WHITE + gf.AR1(0.9, 0.05) + gf.RandomWalk(1e-4)
    signal = signals(model, 3, seed=3)
    least = gf.rank_models(signal, fit=False).criterion.nan_to_num(nan=math.inf).amin(-1)
    alike = gf.rank_models(signal, ["WN + QN + AR1", "2*AR1 + RW", "WN + QN + AR1 + RW"], fit=False)
    assert (least <= alike.criterion.amin(-1) + 1e-2).all()


@pytest.mark.statistical
def test_wavelet_variances_alone():
    """Criteria as by hand, and the true composition; fewer than 15 of 20 once in 3000 times at 95 %, 2 of 4 in 2000."""
    signal = signals(PARTS["WN + RW"], 20)[:, 0]
    variance = gf.wavelet_variance(signal, 11)  # 20 sensors
    names = ["WN", "RW", "WN + RW", "WN + AR1 + RW", "WN + QN + RW"]
    found = rank_models_moments(variance, 4096, names)
    assert found.names.count("WN + RW") >= 15
    assert found.n_sinusoids is None
    fit = gf.fit_gmwm_moments(variance[:, :1], 4096, "WN + RW")
    residual = (variance[:, 0] - fit.fitted_wavelet_variance[:, 0]).numpy()
    spread = moment_covariance(fit.model.with_params(fit.params[0]), 4096, 11).numpy()
    distance = residual @ np.linalg.solve(spread, residual)
    size = variance[:, 0].max().item()
    by_hand = distance + np.linalg.slogdet(spread / size**2)[1] + 2 * 3 * math.log(math.log(4096))
    assert found.criterion[0, 2].item() == pytest.approx(by_hand, abs=0.02)
    assert found.wvic[0, 2].item() == pytest.approx(distance + 4, abs=0.02)
    assert found.p_value[0, 2].item() == pytest.approx(stats.chi2.sf(distance, 9), abs=0.01)
    assert rank_models_moments(variance[:, :4], 4096, fit=False).names.count("WN + RW") >= 2


@pytest.mark.statistical
def test_wvic_keeps_more():
    """2 ln L of a process too many exceeds WVIC's 2 far more often than 3 ln ln T."""
    found = gf.rank_models(signals(PARTS["WN"], 20), fit=False)
    place = found.candidates.index("WN")
    assert int((found.choice == place).sum()) > int((found.wvic_choice == place).sum()) > 0


def test_what_a_fit_amounts_to():
    structure = structure_of([gf.WhiteNoise, gf.AR1, gf.AR1, gf.RandomWalk], held=True)
    phi, short, long = 0.9, 0.001, math.exp(-1 / 800)
    rows = {
        (1.0, phi, 1.0, 0.5, 1.0, 1.0): None,
        (1.0, phi, 0.0, 0.5, 1.0, 1.0): ("WN + AR1 + RW", "AR1 1 has no variance"),
        (0.0, phi, 1.0, 0.5, 1.0, 1.0): ("2*AR1 + RW", "WN has no variance"),
        (1.0, phi, 1.0, phi + 1e-4, 1.0, 1.0): ("WN + AR1 + RW", "AR1 2 is AR1 1"),
        (1.0, long, 1.0, 0.5, 1.0, 1.0): ("WN + AR1 + RW", "AR1 1 is a random walk"),
        (1.0, phi, 1.0, short, 1.0, 1.0): ("WN + AR1 + RW", "AR1 2 is white noise"),
        (1.0, phi, 1.0, 0.5, 1.0, 1e-9): ("WN + 2*AR1", "RW is not identified"),
        (0.0, long, 1.0, short, 1.0, 0.0): (
            "WN + RW",
            "WN has no variance, AR1 1 is a random walk, AR1 2 is white noise, RW has no variance",
        ),
    }
    params = torch.tensor(list(rows), dtype=torch.float64)
    covariance = torch.diag_embed(torch.full_like(params, 1e-6))
    found = simplified(structure, params, covariance, 1000)
    for got, expected in zip(found, rows.values(), strict=True):
        if expected is None:
            assert got is None
        else:
            assert got is not None
            assert (structure_of(got[0], held=True).name, got[1]) == expected


def test_redundant_and_equivalent_are_named():
    walk = gf.rank_models(signals(PARTS["WN + RW"], 1, seed=4)[0], ["WN + RW", "WN + AR1", "WN + AR1 + RW"], fit=False)
    assert walk.names == ("WN + RW",)
    assert walk.redundant[0].tolist()[2]
    assert walk.reasons[0][2] is not None
    # A time constant of three quarters of the record: nobody can tell.
    slow = gf.rank_models(signals(WHITE + gf.AR1(1 - 1 / 3000, 4e-3), 12), ["WN + RW", "WN + AR1"], fit=False)
    assert int(slow.equivalent.sum()) >= 6
    alone = gf.rank_models(signals(PARTS["WN + RW"], 1)[0], ["WN + AR1"], fit=False)
    assert not alone.redundant.any()  # there is no smaller one among the candidates
    assert alone.names == ("WN + AR1",)


def test_the_number_of_sinusoids_is_kept_to_the_candidates():
    signal = signals(PARTS["WN + RW + SIN"] + gf.Sinusoid(0.5, 1.1), 1)[0]
    found = gf.rank_models(signal, ["WN + RW", "WN + RW + SIN", "RW + SIN"], fit=False)
    assert found.names == ("WN + RW + SIN",)
    assert found.criterion[0, 0].isnan()  # without the sinusoid that is there it is not tried
    forced = gf.rank_models(signals(PARTS["WN"], 1)[0], ["WN + 2*SIN", "WN + RW + 2*SIN"], fit=False)
    assert forced.names == ("WN + 2*SIN",)


def test_ramp():
    signal = signals(PARTS["WN"] + gf.Drift(1e-3), 1)[0]
    found = gf.rank_models(signal)
    assert found.names == ("WN + DR",)
    assert found.best[0].params[0, 1].item() == pytest.approx(1e-3, rel=0.1)


@pytest.mark.statistical
def test_weak_ramps_are_told_from_walks():
    """In 20 records; a rate of 95 % gives fewer than 15 once in 3000 times."""
    weak = signals(PARTS["WN"] + gf.Drift(1.4e-4), 20)  # 10 standard deviations
    assert gf.rank_models(weak, fit=False).names.count("WN + DR") >= 15
    variance = gf.wavelet_variance(signals(PARTS["WN"] + gf.Drift(3e-4), 20)[:, 0], 11)
    found = rank_models_moments(variance, 4096, ["WN", "WN + RW", "WN + DR", "WN + RW + DR"], fit=False)
    assert found.names.count("WN + DR") >= 15


def test_result_of_a_recording():
    signal = torch.cat([signals(PARTS["WN"], 1)[0], signals(PARTS["WN + RW + SIN"], 1)[0]])
    recording = gf.Recording(signal, rate=100.0, unit="deg/s", sensors=("a", "b"))
    found = gf.rank_models(recording)
    assert found.names == ("WN", "WN + RW + SIN")
    assert found.sensors == ("a", "b")
    fit = found.best[1]
    assert (fit.sensors, fit.rate, fit.unit, fit.refined) == (("b",), 100.0, "deg/s", True)
    assert fit.params.shape == (1, 4)
    expected = gf.fit_gmwm(signal[1:], "WN + RW + SIN", refine=True)
    torch.testing.assert_close(fit.params, expected.params, rtol=1e-6, atol=0)
    text = str(found)
    assert text == found.summary()
    assert "sensor b: WN + RW + SIN" in text
    assert max(map(len, text.splitlines())) < 140
    plain = found.to_dict()
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain["best"][1]["params"] == fit.to_dict()["params"]
    with mpl.rc_context({"backend": "agg"}):
        ax = found.plot()
    assert next(label.get_text() for label in ax.get_yticklabels()) == "WN"
    assert ax.get_title(loc="left") == "sensor a"


def test_the_figure_shows_the_chosen_one_and_those_not_compared():
    signal = signals(PARTS["WN + RW + SIN"], 1)[0]
    found = gf.rank_models(signal, ["WN", "RW + SIN", "WN + RW + SIN"], fit=False)
    with mpl.rc_context({"backend": "agg"}):
        ax = found.plot()
    names = [label.get_text() for label in ax.get_yticklabels()]
    assert names == ["WN + RW + SIN", "RW + SIN", "WN"]
    difference = found.difference[0, 1].item()
    assert [t.get_text() for t in ax.texts] == ["chosen", f"{difference:+.1f}", "not compared"]
    assert ax.get_xscale() == "linear"
    assert ax.get_xlim()[0] < 0 < ax.get_xlim()[1]
    shown = [line.get_xdata()[0] for line in ax.lines if line.get_marker() in ("o", ">") and len(line.get_xdata())]
    assert max(shown) == pytest.approx(min(difference, 40))
    assert ("arrow: beyond the axis" in ax.get_xlabel()) == (difference > 40)


def test_the_figure_says_what_it_does_not_show():
    signal = signals(gf.Model([gf.AR1(0.9, 1.0)]), 2)[:, 0]
    signal[0] = 3.0
    with pytest.warns(UserWarning, match="they are not ranked"):
        found = gf.rank_models(signal, ["WN", "RW"], fit=False)
    with mpl.rc_context({"backend": "agg"}):
        ax = found.plot()
    assert ax.get_title(loc="left") == "sensor 2"
    assert ax.get_title(loc="right") == "1 sensor before it not ranked"
    assert ax.texts[0].get_text() == "chosen, though the J test refuses it"
    many = gf.rank_models(signal[1:], fit=False)
    n = int(many.criterion.isfinite().sum())
    assert n > 12
    with mpl.rc_context({"backend": "agg"}):
        ax = many.plot(title="Sensor 1, axis y")
    assert ax.get_title(loc="right") == f"12 best of {n}"
    assert ax.get_title(loc="left") == "Sensor 1, axis y"
    assert "chosen" in [text.get_text() for text in ax.texts]


def test_one_order_of_processes():
    signal = signals(PARTS["WN + AR1"] + gf.Drift(1e-3), 1)[0]
    found = gf.rank_models(signal, ["WN + DR + AR1"])
    assert found.names == ("WN + AR1 + DR",)
    assert found.best[0].name == "WN + AR1 + DR"


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_the_search_leaves_out_what_has_too_many_parameters_with_the_sinusoid(levels):
    signal = signals(PARTS["WN + AR1 + SIN"], 1)[0]
    found = gf.rank_models(signal, n_levels=levels)
    assert found.n_sinusoids.tolist() == [min(levels - 1, 1)]
    assert found.names[0] is not None
    assert found.best[0].params.shape[-1] - found.n_sinusoids[0] <= levels
    aside = [found.candidates[c] for c in found.set_aside((0,))]
    assert ("WN + AR1 + SIN" in aside) == (levels == 3)
    assert ("WN + RW + SIN" in aside) == (levels == 2)
    size = levels + 1
    assert f"not compared: {size} parameters, but {levels} levels" in found.summary() or levels == 1


def test_batch_is_its_items():
    signal = torch.stack(
        [signals(PARTS[name], 2, 2048)[:, 0] for name in ("WN + AR1", "WN + RW + SIN")]
    )  # (2, 2, time)
    names = ["WN", "WN + AR1", "WN + RW", "WN + RW + SIN"]
    whole = gf.rank_models(signal, names, fit=False)
    assert whole.criterion.shape == (2, 2, 4)
    assert whole.choice.shape == whole.wvic_choice.shape == (2, 2)
    for i in range(2):
        item = gf.rank_models(signal[i], names, fit=False)
        torch.testing.assert_close(item.criterion, whole.criterion[i], rtol=1e-6, atol=1e-3, equal_nan=True)
        assert item.choice.tolist() == whole.choice[i].tolist()
    single = gf.rank_models(signal.float(), names, fit=False)
    assert single.names == whole.names
    assert single.criterion.dtype == torch.float64
    many = gf.rank_models(signals(PARTS["WN"], 13, 256), ["WN", "RW"], fit=False)
    assert "13  WN" in many.summary()


def test_items_that_cannot_be_ranked():
    signal = signals(PARTS["WN"], 3, 512)[:, 0]
    signal[1, 7] = torch.nan
    with pytest.warns(UserWarning, match="got 1 of 3 others; they are not ranked"):
        found = gf.rank_models(signal, ["WN", "RW"])
    assert found.names == ("WN", None, "WN")
    assert found.choice.tolist() == [0, -1, 0]
    assert found.best[1] is None
    assert "sensor 2: not ranked" in found.summary()
    constant = torch.cat([signal[:1], torch.full((1, 512), 3.0)])
    with pytest.warns(UserWarning, match="`signal`: expected records that vary .* got 1 of 2 others"):
        assert gf.rank_models(constant, ["WN", "RW"], fit=False).names == ("WN", None)
    signal[2, 0] = torch.inf
    with pytest.warns(UserWarning, match="got 2 of 3 others"):
        assert gf.rank_models(signal, ["WN", "RW"], fit=False).names == ("WN", None, None)
    with pytest.raises(ValueError, match="`signal`: expected records that vary and have no missing samples"):
        gf.rank_models(signal[1:2])
    with pytest.raises(ValueError, match="`wavelet_variance`: expected wavelet variances that are finite and > 0"):
        rank_models_moments(torch.zeros(4, 1), 512)


def test_default_candidates():
    noises = all_noises(20)
    assert len(noises) == len({key_of(kinds) for kinds in noises}) == 62  # 4 * 2^4, less nothing and a ramp alone
    assert max(len(kinds) + kinds.count(gf.AR1) for kinds in all_noises(5)) == 5


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"candidates": "WN"}, TypeError, "`candidates`: expected a sequence of models or formulas"),
        ({"candidates": [3]}, TypeError, "`candidates`: expected models or formulas such as 'WN \\+ AR1', got int"),
        ({"candidates": []}, ValueError, "`candidates`: expected at least one, got none"),
        ({"candidates": ["WN", gf.WhiteNoise()]}, ValueError, "got WN twice"),
        ({"candidates": ["WN + RW", "RW + WN"]}, ValueError, "`candidates`: expected each composition once"),
        ({"candidates": ["WN", "WN + XX"]}, ValueError, "at character 6 of 'WN \\+ XX': unknown process 'XX'"),
        ({"candidates": [""]}, ValueError, "`formula`: cannot read ''"),
        ({"candidates": [gf.AR1(0.5, 1.0) + gf.WhiteNoise()]}, ValueError, "got values of ar1_1.phi, ar1_1.variance"),
        ({"candidates": ["SIN + DR"]}, ValueError, "`candidates`: expected a noise in each, got DR \\+ SIN"),
        ({"candidates": ["WN(variance=1)"]}, ValueError, "got values of white_noise.variance"),
        ({"candidates": ["WN + 5*AR1"]}, ValueError, "at most as many parameters as the 8 levels, got 11"),
        ({"line_alpha": 0.0}, ValueError, "`line_alpha`: expected a probability"),
        ({"max_sinusoids": -1}, ValueError, "`max_sinusoids`: expected a whole number >= 0"),
        ({"n_levels": 0}, ValueError, "`n_levels`: expected a whole number >= 1"),
        ({"confidence_level": 1.0}, ValueError, "`confidence_level`: expected a number between 0 and 1"),
    ],
)
def test_refusals(options, error, says):
    with pytest.raises(error, match=says):
        gf.rank_models(signals(PARTS["WN"], 1, 512)[0], **options)


def test_refusals_of_signals():
    with pytest.raises(TypeError, match="`signal`: expected a torch tensor"):
        gf.rank_models([1.0, 2.0])
    with pytest.raises(ValueError, match="`signal`: expected at least 32 samples, got 20"):
        gf.rank_models(torch.randn(1, 20))
    with pytest.raises(ValueError, match=r"expected a wavelet variance .* of at most 9 levels"):
        rank_models_moments(torch.ones(10, 1), 512)
    with pytest.raises(ValueError, match="`n_levels`: expected 1 to 5"):
        rank_models_moments(torch.ones(5, 1), 512, n_levels=6)


def test_the_summary_says_when_no_candidate_fits():
    signal = (gf.AR1(0.9, 1.0)).simulate(4000, batch=(1,), generator=torch.Generator().manual_seed(4))
    assert "No candidate fits: the J test refuses all" in gf.rank_models(signal, ["WN", "RW"], fit=False).summary()
    assert "No candidate fits" not in gf.rank_models(signal, ["WN", "AR1"], fit=False).summary()


def test_candidates_that_were_not_tested_do_not_hide_that_none_fits():
    """Each sensor has candidates that are for the other alone: one of the two has a line."""
    signal = signals(gf.Model([gf.AR1(0.9, 1.0)]), 2)[:, 0]
    signal[1] += 20 * torch.cos(0.35 * torch.arange(4096, dtype=torch.float64))
    found = gf.rank_models(signal, ["WN", "RW", "WN + SIN", "RW + SIN"], fit=False)
    assert found.p_value[0].isnan().tolist() == [False, False, True, True]
    for sensor in range(2):
        assert "No candidate fits" in " ".join(found.doubts((sensor,)))


def test_weak_processes_in_wavelet_variances_are_climbed_to_from_every_side():
    """A criterion as good as with all that lead to it, and no candidate behind the fit of that model alone."""
    model = gf.WhiteNoise(1e-4) + gf.AR1(0.99, 1e-6)
    signal = signals(model, 3, 8192)[:, 0]
    hard = [44, 71]  # where white noise takes all, and the climb from there stays with it
    more = torch.stack(
        [model.simulate(8192, batch=(3,), generator=torch.Generator().manual_seed(s // 3))[s % 3] for s in hard]
    )
    variance = gf.wavelet_variance(torch.cat([signal, more]))
    names = ["WN", "WN + AR1", "WN + 2*AR1"]
    found = rank_models_moments(variance, 8192, names, fit=False)
    assert set(found.names) == {"WN + AR1"}
    whole = rank_models_moments(variance, 8192, [*names, "AR1", "2*AR1"], fit=False)
    assert (found.criterion - whole.criterion[:, :3]).max() < 0.1
    alone = gf.fit_gmwm_moments(variance, 8192, "WN + AR1")
    size = variance.amax(0)
    for s, params in enumerate(alone.params):
        fitted = alone.model.with_params(params)
        spread = moment_covariance(fitted, 8192, len(variance))
        residual = variance[:, s] - fitted.wavelet_variance(len(variance))
        loss = residual @ torch.linalg.solve(spread, residual) + torch.linalg.slogdet(spread / size[s] ** 2)[1]
        assert found.criterion[s, 1].item() < loss.item() + 3 * 3 * math.log(math.log(8192)) + 0.1
