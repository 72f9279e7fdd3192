"""Reports: verdicts against numbers worked out by hand, and pages that hold together and let nothing in."""

from __future__ import annotations

import dataclasses
import math
import re
import time

import matplotlib
import pytest
import torch
from certain import certain_fit
from matplotlib import pyplot as plt
from pages import Page
from scipy import stats

from gyrofuse import ConfidenceInterval, Recording, fit_multiscale, fit_svo
from gyrofuse.fusion import MultiScaleResult, SVOResult
from gyrofuse.fusion.report.page import (
    fusion_figure,
    fusion_report,
    new_figure,
    number,
    recording_report,
    save_figure,
    sensor_rows,
    verdict,
)
from gyrofuse.fusion.weights.methods import METHODS
from gyrofuse.fusion.weights.rdvg import rdvg
from gyrofuse.io.streams import Note

pytestmark = pytest.mark.usefixtures("blank_images")

SCRIPT, BOLD = '"><script>alert(1)</script>', "<b>x</b>.csv"


def made_up(ratios: list[float], best: float = 0.9) -> SVOResult:
    """A result with the Allan deviation `ratios` times that of the plain mean; sensor b has `best` times the virtual.

    With weights (1, 0, 0), `nu_1 = 1` and independent sensors, the mean has `(1 + best^2 + nu_3) / 9 = 1 / ratio^2`.
    """
    third = [9 / r**2 - 1 - best**2 for r in ratios]
    wccv = torch.stack([torch.tensor([1.0, best**2, v], dtype=torch.float64).diag() for v in third])
    return dataclasses.replace(
        fit_svo(noise(3, 1000), n_levels=len(ratios)),
        weights=torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64),
        weights_cov=1e-4 * torch.eye(3, dtype=torch.float64),
        confidence_interval=around(0.02),
        wavelet_cross_covariance=wccv,
        dof=torch.full((len(ratios),), 100.0, dtype=torch.float64),
        cross_fit=certain_fit(torch.full((len(ratios),), 100.0, dtype=torch.float64), 0.95),
        sensors=("a", "b", "c"),
        rate=100.0,
        unit="deg/s",
    )


def around(half_width: float) -> ConfidenceInterval:
    """Limits around the weights (1, 0, 0)."""
    weights = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    return ConfidenceInterval(weights - half_width, weights + half_width)


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def made_up_bands(virtual: list[float], equal: list[float], degrees: list[float]) -> MultiScaleResult:
    """Two bands of three sensors, with these Allan deviations of the virtual gyro and of the plain mean."""
    n = len(virtual)
    variance, mean = (torch.tensor(values, dtype=torch.float64).square() / 2 for values in (virtual, equal))
    single = dataclasses.replace(
        made_up([0.9] * n),
        wavelet_cross_covariance=3 * mean[:, None, None] * torch.eye(3, dtype=torch.float64),
        dof=torch.tensor(degrees, dtype=torch.float64),
    )
    weights = torch.tensor([[0.2, 0.5, 0.3], [1.1, 0.2, -0.3]], dtype=torch.float64)
    return MultiScaleResult(weights, variance, certain_fit(single.dof, 0.95), variance / 2, single)


def plain(sentences: list[str]) -> list[str]:
    return [sentence.replace("\N{NO-BREAK SPACE}", " ") for sentence in sentences]


@pytest.fixture(autouse=True)
def _leaves_matplotlib_alone():
    settings, open_figures = dict(matplotlib.rcParams), plt.get_fignums()
    yield
    assert dict(matplotlib.rcParams) == settings
    assert plt.get_fignums() == open_figures


def test_verdict_says_where_the_virtual_gyro_wins_and_where_it_loses():
    carried, uncertain, against_mean, against_best = plain(verdict(made_up([0.5, 0.8, 1.2, 1.001, 0.7], best=2.0)))
    assert (
        carried == "Sensors that carry the virtual gyro, with weights whose 95 % intervals exclude 0: a (weight 1.000)."
    )
    assert uncertain == "Sensors whose weights cannot be told from 0: b (weight 0.000) and c (weight 0.000)."
    assert against_mean == (
        "The Allan deviation of the virtual gyro is lower than that of the plain mean at averaging times of "
        "0.01 to 0.02 s and 0.16 s, by up to 50 % (at 0.01 s). It is higher at 0.04 s, by 20 %."
    )
    assert against_best.endswith(" is that of the best single sensor within 0.5 % at every averaging time.")


def test_verdict_where_there_is_one_side_only():
    *_, against_mean, against_best = plain(verdict(made_up([0.9, 0.96], best=0.8)))
    assert against_mean.endswith(
        "at averaging times of 0.01 to 0.02 s, by up to 10 % (at 0.01 s). It is nowhere higher."
    )
    assert against_best == (
        "The Allan deviation of the virtual gyro is nowhere lower than that of the best single sensor; it is higher "
        "at averaging times of 0.01 to 0.02 s, by up to 25 % (at 0.01 s)."
    )


def test_verdict_orders_carriers_by_size_and_explains_negative_weights():
    result = dataclasses.replace(
        made_up([0.9]),
        weights=torch.tensor([0.3, -0.1, 0.8], dtype=torch.float64),
        confidence_interval=ConfidenceInterval(
            torch.tensor([0.2, -0.2, 0.7], dtype=torch.float64), torch.tensor([0.4, -0.05, 0.9], dtype=torch.float64)
        ),
    )
    carried, negative, *_ = verdict(result)
    assert carried.endswith(": c (weight 0.800), a (weight 0.300) and b (weight -0.100).")
    assert negative.startswith("A negative weight subtracts")


def test_verdict_without_any_certain_weight():
    unsure = dataclasses.replace(made_up([0.9]), confidence_interval=around(1.6), confidence_level=0.9)
    assert verdict(unsure)[0] == "No sensor stands out: the 90 % interval of every weight holds 0."
    unknown = dataclasses.replace(made_up([0.9]), confidence_interval=around(math.nan))
    assert verdict(unknown)[0].startswith("The largest weights are those of a (weight 1.000)")


def test_verdict_of_the_plain_mean():
    result = fit_svo(noise(3, 1000), method="equal")
    sentences = verdict(result)
    assert sentences[0] == "Every sensor has the weight 1/3: this is the plain mean."
    assert not any("than that of the plain mean" in sentence for sentence in sentences)


def test_verdict_begins_with_motion():
    still = noise(3, 3000)
    assert "moved" not in verdict(fit_svo(still))[0]
    turned = still + 20 * torch.sin(torch.arange(3000, dtype=torch.float64) / 10)
    assert verdict(fit_svo(turned))[0].startswith("Beware: the sensors agree closely")


def test_verdict_warns_where_observations_are_fewer_than_sensors():
    result = made_up([0.9, 0.9, 0.9])
    assert not any("fewer independent" in sentence for sentence in verdict(result))
    few = dataclasses.replace(result, dof=torch.tensor([30.0, 2.5, 1.2], dtype=torch.float64))
    (warning,) = (sentence for sentence in verdict(few) if "fewer independent" in sentence)
    start = "From 0.02 s on, the recording holds fewer independent observations (2.5 or less) than there are sensors, "
    assert warning.startswith(f"{start}so that the comparisons end before: what it gains there follows from a model")
    unweighted = dataclasses.replace(few, scale_weights=torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    assert verdict(unweighted)[-1] == f"{start}so that the comparisons end before."


def test_verdict_takes_range_and_maximum_from_the_levels_that_are_well_observed():
    result = dataclasses.replace(
        made_up([0.9, 1.2, 0.8, 0.5, 1.9, 0.4]),
        dof=torch.tensor([90.0, 50.0, 30.0, 2.5, 3.5, 1.0], dtype=torch.float64),
        method="nonnegative",
    )
    *_, against_mean, against_best, few = plain(verdict(result))
    assert against_mean == (
        "Up to 0.04 s, the Allan deviation of the virtual gyro is lower than that of the plain mean at averaging times "
        "of 0.01 s and 0.04 s, by up to 20 % (at 0.04 s). It is higher at 0.02 s, by 20 %."
    )
    assert against_best.startswith("Up to 0.04 s, ")
    assert few == (
        "From 0.08 s on, the recording holds fewer independent observations (3.5 or less) than there are sensors, "
        "so that the comparisons end before."
    )
    nowhere = dataclasses.replace(result, dof=torch.full((6,), 2.0, dtype=torch.float64))
    *_, against_mean, _, few = plain(verdict(nowhere))
    assert against_mean.endswith(
        "0.01 s, 0.04 to 0.08 s and 0.32 s, by up to 60 % (at 0.32 s). It is higher at 0.02 s and 0.16 s, by up to "
        "90 % (at 0.16 s)."
    )
    assert few.startswith("From 0.01 s on")
    assert few.endswith("than there are sensors: the comparisons are an indication and no more.")


def test_verdict_names_a_few_of_many_sensors():
    sentences = verdict(fit_svo(noise(20, 4000), "flat"))
    assert sentences[0].count("(") == 8
    assert sentences[0].endswith("and 12 more.")


def test_verdict_of_bands_begins_with_both_ends():
    result = made_up_bands([0.8, 1.2, 1.0, 0.1], [1.0, 1.0, 1.25, 1.0], [1e6, 300.0, 20.0, 1.0])
    low, high = ((2 * limit[2]).sqrt().item() for limit in result.interval_of(result.virtual_wavelet_variance))
    short, long, bands, mean, best, one, few = plain(verdict(result))
    assert short == (
        "At 0.01 s, the shortest averaging time, the Allan deviation is 20 % lower than with equal weights: "
        "0.8 deg/s, 95 % interval 0.7989 to 0.8011, against 1."
    )
    assert long == (
        "At 0.04 s, the longest averaging time with no fewer observations than sensors, the Allan deviation is 20 % "
        f"lower than with equal weights: 1 deg/s, 95 % interval {low:.4g} to {high:.4g}, against 1.25."
    )
    assert low == pytest.approx(math.sqrt(20 / stats.chi2.ppf(0.975, 20)))
    assert high == pytest.approx(math.sqrt(20 / stats.chi2.ppf(0.025, 20)))
    assert bands == (
        "Each of 2 bands of time scales has its own weights: in the fastest band sensor b (weight 0.500) weighs most, "
        "in the slowest sensor a (weight 1.100)."
    )
    assert mean.startswith("Up to 0.04 s, the Allan deviation")
    assert mean.endswith("0.01 s and 0.04 s, by up to 20 % (at 0.01 s). It is higher at 0.02 s, by 20 %.")
    assert "than that of the best single sensor" in best
    assert "than that of one vector of weights for all scales" in one
    assert "0.08 s" not in one
    assert few.startswith("From 0.08 s on")


def test_verdict_of_bands_that_gain_nothing_and_of_one_level_that_is_resolved():
    alike, bands, *_ = plain(verdict(made_up_bands([1.0, 2.0], [1.0, 1.0], [100.0, 2.0])))
    assert "the Allan deviation is that of equal weights within 0.5 %: 1 deg/s, 95 % interval" in alike
    assert bands.startswith("Each of 2 bands")
    worse, longer, *_ = plain(verdict(made_up_bands([1.1, 2.0], [1.0, 1.0], [100.0, 50.0])))
    assert "is 10 % higher than with equal weights" in worse
    assert "is 100 % higher than with equal weights" in longer


def test_verdict_of_one_band_and_of_motion():
    still = noise(3, 3000)
    assert any(s.startswith("There is one band for all time scales") for s in verdict(fit_multiscale(still, n_bands=1)))
    turned = still + 20 * torch.sin(torch.arange(3000, dtype=torch.float64) / 10)
    assert verdict(fit_multiscale(turned))[0].startswith("Beware: the sensors agree closely")


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (None, 4, "-"),
        (math.nan, 4, "-"),
        (math.inf, 4, "-"),
        (0.0, 4, "0"),
        (26214.4, 4, "26210"),
        (26214.4, 6, "26214.4"),
        (0.1, 4, "0.1"),
        (-0.0123456, 3, "-0.0123"),
        (1.23456e-5, 4, "1.235e-05"),
        (123456789.0, 4, "1.235e+08"),
    ],
)
def test_numbers(value: float | None, digits: int, text: str):
    assert number(value, digits) == text


def test_page_holds_everything_and_needs_nothing():
    notes = (Note("gaps", "imu2", "3 gaps were found"),)
    recording = Recording(noise(3, 5000), rate=100.0, unit="deg/s", source=("log.csv",), notes=notes)
    result = fit_svo(recording, "long")
    html = fusion_report(result, recording, result.virtual(recording), title="The array", remarks=["A remark."])
    page = Page(html)
    assert html.startswith("<!DOCTYPE html>")
    assert page.tags.count("img") == 2
    assert all(link.startswith("data:image/svg+xml;base64,") for link in page.links)
    assert "//" not in re.sub(r'src="data:[^"]*"', "", html)
    assert not {"script", "link", "iframe", "object"} & {*page.tags}
    for sentence in verdict(result):
        assert html.index("Verdict") < html.index(sentence) < html.index("<figure>")
    for text in ("The array", "A remark.", "log.csv", "3 gaps were found", "imu2", "5000 samples at 100 Hz"):
        assert text in page.text
    low, high = result.confidence_interval
    for i, name in enumerate(result.sensors):
        limits = [f"{value:+.4f}" for value in (result.weights[i], low[i], high[i])]
        assert any(row[:4] == [name, *limits] for row in page.rows)
    levels = [row for row in page.rows if len(row) == 10]
    assert len(levels) == result.n_levels
    for j, row in enumerate(levels):
        assert float(row[0]) == pytest.approx(0.01 * 2**j)
        assert float(row[5]) == pytest.approx((2 * result.virtual_wavelet_variance[j]).sqrt().item(), rel=1e-3)
        assert row[3] == result.sensors[result.wavelet_variance[j].argmin()]


def test_page_of_bands_holds_the_numbers_of_the_dictionary():
    recording = Recording(noise(3, 5000), rate=100.0, unit="deg/s", source=("log.csv",))
    result = fit_multiscale(recording, "long")
    html = fusion_report(result, recording, result.virtual(recording), title="Bands", remarks=["A remark."])
    page, known = Page(html), result.to_dict()
    assert page.tags.count("img") == 2
    for sentence in verdict(result):
        assert html.index("Verdict") < html.index(sentence) < html.index("<figure>")
    times = [number(tau, 6) for tau in known["tau"]]
    names = [*times[: known["n_bands"] - 1], "longer"]
    for name, weights in zip(names, known["weights"], strict=True):
        assert [name, *(f"{weight:+.4f}" for weight in weights)] in page.rows
    named = ("equal", "single", "optimal", "virtual")
    for j, time_ in enumerate(times):
        best = min(known["wavelet_variance"][j])
        equal, one, least, virtual = (known[f"{name}_wavelet_variance"][j] for name in named)
        variances = [f"{value:.3e}" for value in (best, equal, one, least, virtual)]
        assert [time_, *variances, f"{virtual / equal:.4f}", f"{virtual / best:.4f}"] in page.rows
        limits = result.interval_of(result.virtual_wavelet_variance)
        deviations = [(2 * value) ** 0.5 for value in (equal, virtual, *(limit[j].item() for limit in limits))]
        (row,) = (row for row in page.rows if len(row) == 10 and row[0] == time_)
        assert row[1] == f"{known['scale_weights'][j]:.4f}"
        assert row[4:] == [
            *(f"{value:.3e}" for value in deviations),
            f"{(virtual / equal) ** 0.5:.4f}",
            number(known["degrees_of_freedom"][j], 3),
        ]
    assert "least possible" not in page.text.lower()
    for text in ("Multi-scale virtual gyro", "one vector for this level", "log.csv", "(deg/s)2", "95 % interval"):
        assert text in page.text


def test_page_of_bands_for_every_axis_with_markup_and_levels_that_are_not_known():
    signal = noise(2, 3, 1024)
    signal[1, 0, 500:520] = math.nan  # no complete window of the last levels
    scale_weights = [1.0] * 8 + [0.0, 0.0]
    recording = Recording(signal, rate=50.0, axes=("x", "z"), sensors=(SCRIPT, BOLD, "{{ 7 * 7 }}"))
    result = fit_multiscale(recording, scale_weights)
    assert result.virtual_wavelet_variance.isnan().any()
    page = Page(fusion_report(result, recording, title=SCRIPT))
    assert page.tags.count("img") == 2
    assert not {"script", "b"} & {*page.tags}
    assert "nan" not in page.text.lower()
    assert page.text.count("Axis ") == 2
    for name in recording.sensors:
        assert name in page.text
    assert sum(row[0] == "longer" for row in page.rows) == 2
    without_rate = Page(fusion_report(fit_multiscale(noise(2, 100)), title="Samples"))
    assert any(row[0] == "averaging time (samples)" for row in without_rate.rows)
    assert "(None)" not in without_rate.text


@pytest.mark.parametrize("method", METHODS)
def test_every_method_has_its_page(method: str):
    wandering = noise(3, 1000) + 0.1 * noise(3, 1000, seed=1).cumsum(-1)
    page = Page(fusion_report(fit_svo(wandering, method=method, covariance="none"), title=method))
    assert "How it was computed" in page.text
    assert "nan" not in page.text.lower()


@pytest.mark.filterwarnings("ignore:RDVG:UserWarning")
def test_page_says_where_rdvg_weights_minimise_nothing():
    white, walk = noise(3, 4000), noise(3, 4000, seed=1).cumsum(-1)
    signal = torch.stack([white, white + walk])
    assert rdvg(signal).positive_definite.tolist() == [False, True]
    recording = Recording(signal, rate=10.0, axes=("x", "y"))
    html = fusion_report(fit_svo(recording, method="rdvg"), recording, title="RDVG")
    told = "Beware: the estimated covariance of the random walks, Q, is not positive definite"
    assert html.count(told) == 1
    assert html.index("<h3>x</h3>") < html.index(told) < html.index("<h3>y</h3>")
    part = fit_svo(recording.between(0, 200), method="rdvg")  # of which the whole recording does not tell
    assert told not in fusion_report(part, recording, title="RDVG")


def test_page_says_why_weights_were_chosen():
    result = fit_svo(noise(2, 3, 1000), method="auto", covariance="none")
    assert result.selection is not None
    different = dataclasses.replace(result, method="auto")  # as when the choice differs over the axes
    assert result.selection.sentence in Page(fusion_report(different, title="Chosen")).text


def test_every_axis_has_its_section():
    recording = Recording(noise(3, 4, 3000), rate=50.0, axes=("x", "y", "z"))
    result = fit_svo(recording)
    html = fusion_report(result, recording, result.virtual(recording), title="Three axes")
    assert Page(html).tags.count("img") == 6
    assert [html.count(f"<h2>Axis {axis}</h2>") for axis in "xyz"] == [1, 1, 1]
    assert [html.count(f"<h3>{axis}</h3>") for axis in "xyz"] == [1, 1, 1]
    for i in range(3):
        assert all(sentence in html for sentence in verdict(result[i]))
    assert "unknown" not in html  # a unit that the log does not state is left out


def test_markup_stays_text():
    notes = (Note(SCRIPT, BOLD, BOLD),)
    sensors = (SCRIPT, "{{ 7 * 7 }}")
    recording = Recording(noise(2, 1000), rate=50.0, unit="<i>u</i>", sensors=sensors, source=(BOLD,), notes=notes)
    result = fit_svo(recording)
    fused = fusion_report(result, recording, result.virtual(recording), title=SCRIPT, remarks=[SCRIPT])
    for html in (fused, recording_report(recording, title=SCRIPT)):
        page = Page(html)
        assert not {"script", "b", "i"} & {*page.tags}
        for text in (SCRIPT, BOLD, "{{ 7 * 7 }}", "<i>u</i>"):
            assert text in page.text


def test_missing_numbers_are_dashes():
    result = fit_svo(noise(3, 1000), covariance="none")
    page = Page(fusion_report(result, title="No intervals"))
    assert "nan" not in page.text.lower()
    for i, name in enumerate(result.sensors):
        assert [name, f"{result.weights[i]:+.4f}"] in page.rows
    assert "with their 95 % intervals" not in page.text
    assert "with their 95 % intervals" in Page(fusion_report(fit_svo(noise(3, 1000)), title="Intervals")).text
    assert "at 100 Hz" not in page.text
    assert any(row[0] == "averaging time (samples)" for row in page.rows)


def test_long_recordings_make_small_pages_quickly():
    recording = Recording(noise(2, 1_000_000), rate=200.0)
    result = fit_svo(recording)
    start = time.perf_counter()
    html = fusion_report(result, recording, result.virtual(recording), title="Long")
    assert time.perf_counter() - start < 20
    assert len(html) < 600_000


def test_report_of_a_recording():
    signal = noise(2, 3, 2000) + 5.0
    signal[1, 2, :500] = math.nan
    recording = Recording(signal, rate=100.0, unit="rad/s", axes=("x", "z"), source=("a.csv", "b.csv"))
    html = recording_report(recording, title="What is in it")
    page = Page(html)
    assert page.tags.count("img") == 4
    assert "a.csv, b.csv" in page.text
    known = signal[1, 2, 500:]
    assert ["3", "z", "25 %", *(number(v.item()) for v in (known.mean(), known.std(correction=0)))] in page.rows
    rows = sensor_rows(recording)
    assert [(row["axis"], row["name"]) for row in rows] == [(a, s) for a in "xz" for s in "123"]
    assert rows[-1]["missing"] == 0.25


def test_figure_of_bands_of_several_axes():
    figure = fusion_figure(fit_multiscale(Recording(noise(2, 3, 1000), rate=10.0, axes=("x", "y"))))
    assert [part.get_suptitle() for part in figure.subfigs] == ["x", "y"]
    assert all(part.axes[2].get_ylabel() == "sensor" for part in figure.subfigs)


def test_figure_of_several_axes_and_formats(tmp_path):
    result = fit_svo(Recording(noise(2, 3, 1000), rate=10.0, axes=("x", "y")))
    figure = fusion_figure(result)
    assert [part.get_suptitle() for part in figure.subfigs] == ["x", "y"]
    for suffix, start in (("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")):
        path = tmp_path / f"figure.{suffix}"
        save_figure(figure, path, suffix)
        assert path.read_bytes().startswith(start)


def test_names_that_the_font_lacks_are_drawn_without_a_warning(tmp_path, recwarn):
    figure = new_figure(3, 2)
    figure.text(0.1, 0.5, "\u9640\u87ba")
    save_figure(figure, tmp_path / "figure.png", "png")
    assert not recwarn.list


def test_more_than_one_batch_dimension_is_refused():
    result = fit_svo(noise(2, 2, 3, 500))
    with pytest.raises(ValueError, match=r"`result`: expected one array, or one per axis, got batch shape \(2, 2\)"):
        fusion_report(result, title="Too many")
    with pytest.raises(ValueError, match="`result`"):
        fusion_figure(result)
    with pytest.raises(ValueError, match=r"`result`: expected one array, or one per axis, got batch shape \(2, 2\)"):
        fusion_report(fit_multiscale(noise(2, 2, 3, 500)), title="Too many")
