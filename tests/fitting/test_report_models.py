"""Report of fitted noise models: sentences against fits whose answer is known, and a page that holds together."""

from __future__ import annotations

import functools
from dataclasses import replace

import matplotlib
import pytest
import torch
from matplotlib import pyplot as plt
from pages import Page

from gyrofuse import AR1, RandomWalk, Recording, Sinusoid, WhiteNoise, fit_gmwm, fit_gmwm_moments
from gyrofuse.fitting import GMWMResult
from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.fitting.plots import plot_residuals
from gyrofuse.fitting.report import page as report_models
from gyrofuse.fitting.report.page import model_report
from gyrofuse.fitting.report.words import model_method, model_verdict, residuals

pytestmark = pytest.mark.usefixtures("blank_images")

RATE = 50.0
MODEL = WhiteNoise(1e-2) + RandomWalk(1e-6) + Sinusoid(0.05, 0.4)


@functools.cache
def recording() -> Recording:
    generator = torch.Generator().manual_seed(5)
    signal = torch.stack([MODEL.simulate(2**14, generator=generator) for _ in range(2)])
    return Recording(signal, rate=RATE, unit="deg/s", sensors=("left", "<b>right</b>"))


@functools.cache
def fit(formula: str) -> GMWMResult:
    return fit_gmwm(recording(), formula)


def plain(sentences: list[str]) -> str:
    return " ".join(sentences).replace("\N{NO-BREAK SPACE}", " ")


def test_verdict_of_a_complete_model():
    words = plain(model_verdict(fit("WN + RW + SIN"), (0,)))
    assert "explains the wavelet variances at all scales" in words
    assert "Largest by averaging time: white noise from 0.02 s to " in words
    assert ", then the random walk from " in words
    assert f"A tone at {0.4 * RATE / (2 * torch.pi):.3f}"[:-1] in words
    assert "not complete" not in words


def test_verdict_of_a_model_without_the_tone():
    result = fit("WN + RW")
    words = plain(model_verdict(result, (0,)))
    off = residuals(result, (0,))
    worst = int(off.abs().argmax())
    side = "above" if off[worst] > 0 else "below"
    assert off[worst].abs() > 5
    assert "The model is not complete (J test: p " in words
    assert f"at {2**worst / RATE:.3g} s the measured wavelet variance is" in words
    assert f"{off[worst].abs():.1f} standard deviations {side} the model's" in words
    assert "A tone" not in words


def test_verdict_names_what_is_not_seen():
    signal = torch.randn(1, 4096, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    result = fit_gmwm(signal, "WN + RW")
    assert result.params[0, 1] == 0
    words = plain(model_verdict(result, (0,)))
    assert "Not seen, with an upper limit only: random_walk.variance." in words
    assert "white noise from 1 samples to 1024 samples" in words


def test_verdict_tells_of_two_alike():
    signal = (AR1(0.999, 1e-3) + AR1(0.8, 1.0)).simulate(2**15, generator=torch.Generator().manual_seed(2))
    words = plain(model_verdict(fit_gmwm(signal[None], "2*AR1"), (0,)))
    assert "the AR1 2 from 1 samples" in words
    assert "the AR1 1 from" in words


def test_verdict_says_what_cannot_be_told_apart():
    generator = torch.Generator().manual_seed(7)
    slow = (WhiteNoise(1.0) + AR1(0.99999, 1e-2)).simulate(2**12, generator=generator)
    quick = (WhiteNoise(1.0) + AR1(0.9, 1.0)).simulate(2**12, generator=generator)
    signal = torch.stack([torch.stack([quick, slow]), torch.stack([slow, quick])])  # (item, sensor, time)
    result = fit_gmwm(signal, "WN + AR1")
    told = "Not identified: ar1_1 (indistinguishable from a random walk at this length)."
    found = [told in model_verdict(result, index) for index in ((0, 0), (0, 1), (1, 0), (1, 1))]
    assert found == [False, True, True, False] == [bool(texts) for texts in result.notes]
    assert model_report(result, title="remarks").count(told) == 2


def test_verdict_refuses_nothing_where_the_search_did_not_end():
    refused, fine = fit("WN + RW"), fit("WN + RW + SIN")
    assert refused.p_value[0] < 1e-6
    words = plain(model_verdict(replace(refused, converged=torch.tensor([False, True])), (0,)))
    assert "Beware: the search for the best fit to the wavelet variances did not end" in words
    assert "not complete" not in words
    words = plain(model_verdict(replace(fine, converged=torch.tensor([False, True])), (0,)))
    assert "Beware" in words
    assert "explains the wavelet variances at all scales" in words


def test_verdict_says_why_there_is_no_test():
    variance = fit("WN + RW").wavelet_variance
    untested = plain(model_verdict(fit_gmwm(recording(), "WN", weighting="identity"), (0,)))
    assert "was not tested: the J test asks for optimal weighting" in untested
    full = plain(model_verdict(fit_gmwm_moments(variance, 2**14, "WN + RW", n_levels=2), (0,)))
    assert "cannot be tested: it has as many parameters as there are levels" in full


def test_method_says_how_the_model_was_fitted():
    classic = model_method(fit("WN + RW"))
    assert "inverse of their covariance" in classic
    assert "robust" not in classic
    assert "Whittle" not in classic
    assert "of efficiency 0.7" in model_method(fit_gmwm(recording(), "WN", efficiency=0.7))
    assert "Whittle" in model_method(fit_gmwm(recording(), "WN", refine=True))
    assert "reciprocals" in model_method(fit_gmwm(recording(), "WN", weighting="diagonal"))
    assert "weighted alike" in model_method(fit_gmwm(recording(), "WN", weighting="identity"))
    weights = torch.ones(13, dtype=torch.float64)
    assert "that were given" in model_method(fit_gmwm(recording(), "WN", weighting=weights))


@pytest.mark.filterwarnings("ignore:`signal`")
def test_a_sensor_that_could_not_be_fitted():
    signal = recording().signal.clone()
    signal[1] = 3.0
    result = fit_gmwm(signal, "WN + RW")
    assert "Nothing could be fitted" in plain(model_verdict(result, (1,)))
    page = Page(model_report(result, title="dead"))
    assert page.tags.count("img") == 1
    assert ["white_noise.variance", "-", "-", "-", ""] in page.rows


def test_residuals_are_in_standard_deviations():
    result = fit("WN + RW + SIN")
    model = result.model.with_params(result.params[1])
    nu, fitted = result.wavelet_variance[:, 1], result.fitted_wavelet_variance[:, 1]
    sd = moment_covariance(model, result.n_samples, len(nu)).diagonal().sqrt()
    torch.testing.assert_close(residuals(result, (1,)), (nu - fitted) / sd)
    torch.testing.assert_close(fitted, model.wavelet_variance(len(nu)))


def test_page_holds_what_the_result_says():
    result = fit("WN + RW + SIN")
    html = model_report(result, recording(), title="<script>alert(1)</script>")
    page = Page(html)
    assert "script" not in page.tags
    assert all(link.startswith("data:image/svg+xml;base64,") for link in page.links)
    assert page.tags.count("img") == 2
    assert "Sensor <b>right</b>" in page.text
    low, high = result.confidence_interval
    for sensor in range(2):
        for k, name in enumerate(result.param_names):
            row = [name, *(f"{float(v[sensor, k]):.6g}" for v in (result.params, low, high))]
            found = [r for r in page.rows if r and r[0] == name]
            assert any(
                all(float(a) == pytest.approx(float(b), rel=1e-5) for a, b in zip(r[1:4], row[1:], strict=True))
                for r in found
            )
    assert any(row[0] == "tone frequency" and row[2] == "Hz" for row in page.rows if len(row) == 3)


def test_page_of_axes_and_without_units():
    both = recording().signal
    axes = Recording(torch.stack([both, 2 * both]), rate=RATE, axes=("x", "y"))
    page = Page(model_report(fit_gmwm(axes, "WN + RW"), axes, title="axes"))
    assert page.tags.count("img") == 4
    assert "Sensor 2, axis y" in page.text
    assert "In datasheet units" not in page.text
    forces = Recording(both, rate=RATE, unit="m/s^2")
    page = Page(model_report(fit_gmwm(forces, "WN + RW"), forces, title="accelerometers"))
    assert "in (m/s^2)" in page.text
    assert "velocity random walk N" in page.text
    assert "angle random walk" not in page.text


def test_a_page_of_many_sensors_says_what_it_leaves_out(monkeypatch):
    monkeypatch.setattr(report_models, "MOST_SENSORS", 2)
    signal = torch.randn(5, 256, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    page = Page(model_report(fit_gmwm(signal, "WN"), title="many"))
    assert page.tags.count("img") == 2
    assert "3 more sensors are not shown" in page.text


def test_residual_figure():
    settings = dict(matplotlib.rcParams)
    figure, ax = plt.subplots()
    assert plot_residuals(torch.tensor([0.5, -3.0]), rate=10.0, ax=ax) is ax
    assert ax.get_ylim()[0] <= -3
    assert ax.get_xlabel() == "averaging time (s)"
    plt.close(figure)
    assert dict(matplotlib.rcParams) == settings
