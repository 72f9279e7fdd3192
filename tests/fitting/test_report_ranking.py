"""Report of ranked noise models: sentences and tables against what the ranking says, and a page that holds together."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import matplotlib as mpl
import pytest
import torch
from pages import Page

import gyrofuse as gf
from gyrofuse._base.page import number
from gyrofuse.fitting import RankResult, rank_models_moments
from gyrofuse.fitting.report import ranking as report_ranking
from gyrofuse.fitting.report.ranking import rank_report, rank_verdict

pytestmark = pytest.mark.usefixtures("blank_images")

MODELS = (
    gf.WhiteNoise(1e-2) + gf.RandomWalk(1e-6) + gf.Sinusoid(0.05, 0.4),
    gf.WhiteNoise(1e-2) + gf.AR1(0.99, 1e-5),
)
CANDIDATES = ["WN", "WN + AR1", "WN + RW", "2*AR1", "WN + RW + SIN", "WN + AR1 + RW", "WN + AR1 + SIN"]


@functools.cache
def recording() -> gf.Recording:
    generator = torch.Generator().manual_seed(5)
    signal = torch.stack([model.simulate(2**13, generator=generator) for model in MODELS])
    return gf.Recording(signal, rate=50.0, unit="deg/s", sensors=("left", "<b>right</b>"))


@functools.cache
def ranked() -> RankResult:
    return gf.rank_models(recording(), CANDIDATES)


def plain(sentences: list[str]) -> str:
    return " ".join(sentences)


def test_verdict_names_the_model_the_line_and_what_is_as_good():
    result = ranked()
    assert result.names == ("WN + RW + SIN", "WN + AR1")
    left, right = plain(rank_verdict(result, (0,))), plain(rank_verdict(result, (1,)))
    tried = int(result.difference[0].isfinite().sum())
    assert f"WN + RW + SIN is the best of {tried} candidates tried." in left
    assert "One line stands out of the noise in the spectrum." in left
    assert "stands out" not in right
    for index, words in enumerate((left, right)):
        same = [name for name, there in zip(CANDIDATES, result.equivalent[index].tolist(), strict=True) if there]
        assert ("Equivalent to it:" in words) == bool(same)
        assert all(name in words for name in same)


def test_the_runner_up_lost_by_odds_and_for_a_reason():
    result = ranked()
    difference = result.difference[1].clone()
    difference[(result.difference[1] == 0) | result.equivalent[1]] = torch.inf
    runner = int(difference.nan_to_num(nan=torch.inf).argmin())
    words = plain(rank_verdict(result, (1,)))
    odds = number(math.exp(difference[runner].item() / 2), 2)
    told = f"The runner-up, {CANDIDATES[runner]}, has a criterion {difference[runner].item():.1f} above"
    assert f"{told} ({odds} times less likely, with its numbers charged for)" in words
    reason = result.reasons[1][runner]
    assert reason
    assert f"and is more than it takes: {reason}." in words


def compared(*rows: tuple[str, float, float]) -> RankResult:
    """A ranking of these candidates with the first one chosen: name, criterion and p value."""
    n = len(rows)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(1, 512, generator=generator, dtype=torch.float64)
    base = gf.rank_models(noise, ["WN"], fit=False)
    values = torch.tensor([row[1:] for row in rows], dtype=torch.float64)[None]
    nothing = torch.zeros(1, n, dtype=torch.bool)
    return replace(
        base,
        candidates=tuple(row[0] for row in rows),
        criterion=values[..., 0],
        wvic=values[..., 0],
        p_value=values[..., 1],
        redundant=nothing,
        equivalent=nothing,
        reasons=((None,) * n,),
    )


def test_a_charge_alone_is_no_odds():
    charge = 3 * math.log(math.log(512))
    same = plain(rank_verdict(compared(("WN", 0.0, 0.5), ("WN + QN", charge + 0.1, 0.5)), (0,)))
    assert f"has a criterion {charge + 0.1:.1f} above (no likelihood gained for 1 more number)." in same
    two = plain(rank_verdict(compared(("WN", 0.0, 0.5), ("WN + AR1", 2 * charge, 0.5)), (0,)))
    assert "(no likelihood gained for 2 more numbers)" in two
    other = plain(rank_verdict(compared(("WN", 0.0, 0.5), ("WN + QN", charge + 0.5, 0.5)), (0,)))
    assert "times less likely, with its numbers charged for)" in other


def test_what_does_not_fit_is_held_against_it_where_the_chosen_one_fits():
    told = "its wavelet variances do not fit"
    fits = plain(rank_verdict(compared(("WN", 0.0, 0.5), ("RW", 9.0, 0.0)), (0,)))
    assert f"{told} (J test: p < 1e-300)" in fits
    assert told not in plain(rank_verdict(compared(("WN", 0.0, 5e-3), ("RW", 9.0, 1e-5)), (0,)))


def test_one_candidate_has_one_standing():
    base = compared(("WN + AR1", 0.0, 0.5), ("2*AR1", 1.0, 0.0), ("WN", 9.0, math.nan))
    marks = torch.tensor([[False, True, False]])
    result = replace(base, redundant=marks, equivalent=marks, reasons=((None, "AR1 2 is white noise", None),))
    assert [result.standing((0,), c) for c in range(3)] == ["chosen", "equivalent", ""]
    told = "equivalent: AR1 2 is white noise"
    assert told in result.summary()
    assert "redundant:" not in result.summary()
    assert any(row[-1] == told for row in Page(rank_report(result, title="one")).rows)
    with mpl.rc_context({"backend": "agg"}):
        ax = result.plot()
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["candidate", "equivalent"]
    words = plain(rank_verdict(result, (0,)))
    assert "The next one, WN, has" in words  # third in the table
    assert "runner-up" not in words
    assert "< 1e-300" in result.summary()
    assert result.summary().endswith(" -")  # without a test


def test_the_table_is_in_line_and_nothing_is_no_less_than_nothing():
    result = compared(("WN", 0.0, 0.5), ("RW", -1e-3, 0.5))
    rows = result.summary().splitlines()[-3:]
    assert "-0.00" not in result.summary()
    assert "-0.00" not in Page(rank_report(result, title="zero")).text
    assert [row.index(word) + len(word) for row, word in zip(rows, ("criterion", "+0.00", "+0.00"), strict=True)] == (
        [rows[0].index("criterion") + len("criterion")] * 3
    )


def test_candidates_are_counted_for_every_sensor():
    result = ranked()
    counts = result.criterion.isfinite().sum(-1).tolist()
    assert counts[0] != counts[1]
    assert result.compared == f"{counts[0]} and {counts[1]} of 7 candidates"
    criterion = result.criterion[:1].expand(9, -1).clone()
    criterion[3, int(result.choice[0])] = torch.nan
    many = replace(result, criterion=criterion, choice=result.choice[:1].expand(9))
    assert many.compared == f"{counts[0] - 1} to {counts[0]} of 7 candidates"


def test_odds_too_large_for_a_number():
    far = torch.tensor(1e6, dtype=torch.float64)
    result = ranked()
    criterion = result.criterion.clone()
    criterion[1, [c for c in range(len(CANDIDATES)) if c not in (0, int(result.choice[1]))]] = torch.nan
    criterion[1, 0] = criterion[1, int(result.choice[1])] + far
    words = plain(rank_verdict(replace(result, criterion=criterion), (1,)))
    assert (
        "The runner-up, WN, has a criterion 1000000.0 above (beyond any doubt); its wavelet variances do not" in words
    )


def test_a_redundant_candidate_with_a_better_criterion_is_named():
    result = ranked()
    c, reason = next((c, reason) for c, reason in enumerate(result.reasons[1]) if reason)
    best = result.criterion[1, int(result.choice[1])]
    criterion, equivalent = result.criterion.clone(), result.equivalent.clone()
    criterion[1, c], equivalent[1, c] = best - 2.5, False
    words = plain(rank_verdict(replace(result, criterion=criterion, equivalent=equivalent), (1,)))
    assert f"{CANDIDATES[c]} has a criterion 2.5 below, but is more than it takes: {reason}." in words


def test_wvic_advises_nothing():
    result = ranked()
    other = replace(result, wvic_choice=torch.full_like(result.choice, CANDIDATES.index("WN + AR1 + RW")))
    assert "prefers" not in plain(rank_verdict(other, (1,)))
    assert "own choice" not in other.summary()


def test_page_and_summary_name_those_that_were_not_compared():
    result = gf.rank_models(recording(), ["WN", "WN + RW", "WN + AR1", "WN + RW + SIN"])
    reason = "the spectrum has 1 line, the model none"
    left, right = (plain(rank_verdict(result, (i,))) for i in range(2))
    assert "WN + RW + SIN is the only candidate that was tried." in left
    assert f"Not compared: WN, WN + RW, WN + AR1 ({reason})." in left
    assert "Not compared: WN + RW + SIN (the spectrum has no lines, the model 1)." in right
    assert f"WN + RW        not compared: {reason}" in result.summary()
    assert result.reasons[0] == (reason, reason, reason, None)
    assert result.to_dict()["n_lines"] == [1, 0]
    page = Page(rank_report(result, recording(), title="aside"))
    assert "4 candidates compared" in page.text
    alone = gf.rank_models(recording().signal[:1], ["WN", "WN + RW + SIN"], fit=False)
    assert "1 of 2 candidates" in alone.summary()


def test_a_line_without_a_candidate_for_it_is_told():
    told = "The spectrum has more lines than those compared have sinusoids"
    result = gf.rank_models(recording(), ["WN + RW", "WN + AR1"], fit=False)
    assert told in plain(rank_verdict(result, (0,)))
    assert told in result.summary()
    assert told not in plain(rank_verdict(result, (1,)))
    assert result.n_sinusoids.tolist() == [0, 0]
    assert result.n_lines.tolist() == [1, 0]


def test_lines_are_not_counted_beyond_what_candidates_allow():
    time = torch.arange(4096, dtype=torch.float64)
    noise = torch.randn(1, 4096, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    signal = noise + sum(torch.cos(f * time) for f in (0.3, 0.7, 1.1, 1.9))
    capped = gf.rank_models(signal, ["WN", "WN + 2*SIN"], fit=False)
    assert "At least 3 lines stand out of the noise" in plain(rank_verdict(capped, (0,)))
    one = gf.rank_models(signal, ["WN"], fit=False)
    assert "At least one line stands out of the noise" in plain(rank_verdict(one, (0,)))
    whole = gf.rank_models(signal, ["WN", "WN + 5*SIN", "WN + 4*SIN"], fit=False)
    assert "4 lines stand out of the noise" in plain(rank_verdict(whole, (0,)))
    assert "At least" not in plain(rank_verdict(whole, (0,)))


def test_page_and_summary_say_when_no_candidate_fits():
    result = gf.rank_models(recording().signal[1:], ["WN", "RW"])
    told = "No candidate fits: the J test refuses all (largest p = "
    assert told in plain(rank_verdict(result, (0,)))
    assert told in result.summary()
    assert told not in plain(rank_verdict(ranked(), (1,)))


def test_page_holds_what_the_result_says():
    result = ranked()
    page = Page(rank_report(result, recording(), title="<script>alert(1)</script>"))
    assert "script" not in page.tags
    assert page.tags.count("img") == 2
    assert [link for link in page.links if link.startswith("#")] == ["#fit-1", "#fit-2"]
    assert all(link.startswith(("#", "data:image/svg+xml;base64,")) for link in page.links)
    assert "Sensor <b>right</b>" in page.text
    assert "7 candidates compared on 8192 samples at 50 Hz" in page.text
    wvic = result.wvic - result.wvic.gather(-1, result.wvic_choice[:, None])
    for sensor in range(2):
        for c, name in enumerate(CANDIDATES):
            if bool(result.difference[sensor, c].isfinite()):
                numbers = [f"{value[sensor, c].item():+.2f}" for value in (result.difference, wvic)]
                found = [row for row in page.rows if row[:3] == [name, *numbers]]
                assert found
                reason = result.reasons[sensor][c]
                assert any((reason or "") in row[4] for row in found)
        chosen = [row for row in page.rows if len(row) == 5 and row[4] == "chosen"]
        assert [row[0] for row in chosen] == list(result.names)
        for value in result.best[sensor].params[0].tolist():
            assert any(len(row) > 3 and row[1] == number(value, 6) for row in page.rows)


def test_best_fits_keep_their_own_remarks():
    """Of a batch of fits each page part says what cannot be told apart there, and only there."""
    generator = torch.Generator().manual_seed(7)
    slow = (gf.WhiteNoise(1.0) + gf.AR1(0.99999, 1e-2)).simulate(2**12, generator=generator)
    quick = (gf.WhiteNoise(1.0) + gf.AR1(0.95, 1.0)).simulate(2**12, generator=generator)
    signal = torch.stack([quick, slow])
    result = gf.rank_models(signal, ["WN + AR1"])
    alone = gf.fit_gmwm(signal, "WN + AR1", refine=True, n_levels=result.best[0].wavelet_variance.shape[-2])
    assert [fit.notes for fit in result.best] == [(texts,) for texts in alone.notes]
    assert alone.notes[0] == ()
    assert alone.notes[1] == ("ar1_1: indistinguishable from a random walk at this length",)
    assert rank_verdict(result, (0,))[0] == "WN + AR1 is the only candidate that was tried."
    page = Page(rank_report(result, title="remarks"))
    assert page.text.count("Not identified: ar1_1 (indistinguishable from a random walk at this length).") == 1


@pytest.mark.filterwarnings("ignore:`signal`")
def test_a_sensor_that_could_not_be_ranked_and_a_ranking_without_fits():
    signal = recording().signal.clone()
    signal[0] = 3.0
    page = Page(rank_report(gf.rank_models(signal, ["WN", "WN + AR1"], fit=False), title="dead"))
    assert "Not ranked: its record does not vary or has missing samples." in page.text
    assert page.tags.count("img") == 0
    assert page.links == []
    assert "Best fit" not in page.text
    assert [row[0] for row in page.rows if row[-1] == "chosen"] == ["WN + AR1"]


def test_a_ranking_of_wavelet_variances():
    variance = gf.wavelet_variance(recording().signal[1:], 10)
    result = rank_models_moments(variance, 2**13, ["WN", "WN + AR1"])
    page = Page(rank_report(result, title="moments"))
    assert "likelihood of the wavelet variances" in page.text
    assert "stands out of the noise" not in page.text


def test_a_page_of_many_says_what_it_leaves_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(report_ranking, "MOST_SENSORS", 1)
    monkeypatch.setattr(report_ranking, "_MOST_ROWS", 1)
    result = ranked()
    page = Page(rank_report(result, recording(), title="many"))
    assert page.tags.count("img") == 1
    assert "1 more sensors are not shown" in page.text
    assert f"And {int(result.difference[0].isfinite().sum()) - 1} more that were tried." in page.text
    assert len([row for row in page.rows if len(row) == 5 and row[1].startswith("+")]) == 1


def test_a_page_of_axes():
    axes = gf.Recording(recording().signal[:, None, :2048], rate=50.0, unit="deg/s", axes=("x", "y"))
    page = Page(rank_report(gf.rank_models(axes, ["WN", "WN + AR1"]), axes, title="axes"))
    assert "Sensor 1, axis y" in page.text
    assert page.tags.count("img") == 2
