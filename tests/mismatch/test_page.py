"""A diagnosis told: numbers of figures against naive twins, sentences, the page, corrections and their use."""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from pages import Page
from reference import haar as naive

import gyrofuse as gf
from gyrofuse.mismatch import Finding, MismatchReport
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_tone import DriftingTone
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.reporting import text as telling
from gyrofuse.mismatch.reporting.figures_data import compared_powers, compared_variances, grouped_spectrum
from gyrofuse.mismatch.reporting.page import mismatch_page
from gyrofuse.mismatch.reporting.plots import ends_of_colours, plot_map, plot_shares
from gyrofuse.mismatch.selection.shares import Share
from gyrofuse.mismatch.signals.comparison import Comparison

pytestmark = pytest.mark.usefixtures("blank_images")

N, RATE, TONE = 2**13, 50.0, 7.3
NAMES = ("left", "<b>right</b>", "{{ 7 * 7 }}")
NOISE = gf.WhiteNoise(1.0) + gf.AR1(0.99, 1e-3)


def drawn(n: int, seed: int) -> torch.Tensor:
    return NOISE.simulate(n, batch=(3,), generator=torch.Generator().manual_seed(seed))


def tone(n: int = N) -> torch.Tensor:
    turn = 2 * math.pi * TONE / RATE * torch.arange(n, dtype=torch.float64)
    return torch.tensor([0.3, 0.0, 0.15], dtype=torch.float64)[:, None] * turn.cos()


def observed(with_tone: bool = True) -> gf.Recording:
    return gf.Recording(drawn(N, 1) + with_tone * tone(), rate=RATE, unit="deg/s", sensors=NAMES)


@functools.cache
def report(with_tone: bool = True) -> MismatchReport:
    return gf.diagnose(observed(with_tone), NOISE)


def sides(recording: torch.Tensor, simulation: torch.Tensor) -> Comparison:
    return prepared(recording, simulation, None, torch.Generator().manual_seed(0))


def page(told: MismatchReport, **options: object) -> Page:
    return Page(mismatch_page(told, title="A title", **options))


def test_exported_and_named_alike():
    assert isinstance(report(), MismatchReport)
    assert isinstance(report().findings[0], Finding)
    assert report().mismatch
    assert not report(False).mismatch


def test_the_page_begins_with_the_verdict():
    told = page(report(), remarks=["Said <i>besides</i>."])
    verdict = told.text.index("Verdict")
    found = told.text.index(telling.capital(report().findings[0].sentence))
    assert told.text.index("A title") < verdict < told.text.index("Recording and simulation differ: p = ") < found
    assert "Said <i>besides</i>." in told.text
    h = report().held_out
    assert f"Found: vibration tone. Held-out data become likelier by {telling.nats(h.gain)} nats (spectra)" in told.text
    assert f"discrepancy {h.before:.3g} → {h.after:.3g} (1 = noise alone)." in told.text
    assert told.tags.count("img") == 5  # one of its finding
    assert "script" not in told.tags
    assert "b" not in told.tags
    assert all(link.startswith("data:") for link in told.links)
    held_out = next(row for row in told.rows if row[0] == "discrepancy")
    assert [float(cell) for cell in held_out[1:]] == pytest.approx(
        [report().held_out.before, report().held_out.after], rel=6e-3
    )


def test_the_page_has_every_parameter_with_limits_and_unit():
    rows = {row[0]: row[1:] for row in page(report()).rows if row}
    finding = report().findings[0]
    assert finding.mechanism == "vibration_tone"
    for name, entry in finding.parameters.items():
        told = "frequency (Hz)" if name == "frequency" else f"amplitude, sensor {NAMES[int(name[-2])]} (deg/s)"
        assert [float(cell) for cell in rows[told]] == pytest.approx(list(entry[:3]), rel=6e-3)
        low, high = map(float, rows[told][1:])
        assert low < high  # enough digits


def test_the_amplitude_of_the_sentence_is_that_of_the_table():
    """Noise adds to the squares of amplitudes, and only the table's was without that."""
    finding = gf.diagnose(gf.Recording(drawn(N, 1) + 0.4 * tone(), rate=RATE, unit="deg/s"), NOISE).findings[0]
    sizes = {name: entry.value for name, entry in finding.parameters.items() if name.startswith("amplitude")}
    name = max(sizes, key=sizes.__getitem__)
    assert f"of amplitude up to {sizes[name]:.3g} deg/s (sensor {int(name[-2]) + 1})" in finding.sentence
    assert f"{float(finding.effect.amplitude[int(name[-2])]):.3g}" not in finding.sentence


def test_the_page_names_every_witness_and_what_was_ruled_out():
    told = page(report())
    for before, after in zip(report().evidence, report().evidence_after, strict=True):
        row = next(row for row in told.rows if row[0] == before.test.replace("_", " "))
        assert float(row[1]) == pytest.approx(before.p_value, rel=0.06)
        assert row[2] == telling.chance_words(before.p_value)
        assert float(row[3]) == pytest.approx(after.p_value, rel=0.06)
        if before.p_value < 1e-6:
            assert row[4] == f"{telling.capital(before.words)}."
        elif before.p_value > 0.01 and before.sensors:
            assert row[4] == f"Nothing beyond chance; most extreme: {before.words}."
        else:
            assert before.words[1:] in row[4]
    assert "Looked for and not found" in told.text
    assert "After the repair no test sees a difference." in told.text
    assert "Unexplained" not in told.text


@pytest.mark.parametrize(
    ("p_value", "told"),
    [
        (1.0, "10 of 10"),
        (0.34, "3 of 10"),
        (0.004, "1 of 250"),
        (3.3e-6, "1 of 300 000"),
        (0.0, "less than 1 of a million"),
    ],
)
def test_a_p_value_is_said_as_a_count(p_value: float, told: str):
    assert telling.chance_words(p_value) == told


def test_what_is_left_and_what_cannot_be_told_apart_is_said():
    left = (TestResult("spectrum", 1e-9, "power near 3 Hz is twice the simulation's"),)
    finding = dataclasses.replace(
        report().findings[0], alternatives=("drifting_tone", "something_new"), time_s=12.0, channel="temperature"
    )
    told = page(dataclasses.replace(report(), unexplained=left, findings=(finding,)))
    assert "Unexplained, as seen by: spectrum." in told.text
    assert "Spectrum: power near 3 Hz is twice the simulation's (p = 1e-09)." in told.text
    assert f"Drifting tone. What would tell: {DriftingTone.separated_by}." in told.text
    assert "Something new. What would tell: a longer recording." in told.text
    assert ["sets in at", "12 s"] in told.rows
    assert ["follows", "temperature"] in told.rows
    assert told.tags.count("img") == 6  # and the averages over time


def test_what_stays_is_said_once() -> None:
    before = dataclasses.replace(report().evidence[0], p_value=0.0)
    after = dataclasses.replace(before, words="what it sees after the repair")
    for stays, told in ((before, "Still unexplained."), (after, "Still unexplained: What it sees after the repair.")):
        outcome = dataclasses.replace(
            report(),
            evidence=(before, *report().evidence[1:]),
            evidence_after=(stays, *report().evidence_after[1:]),
            unexplained=(stays,),
        )
        shown = page(outcome)
        row = next(row for row in shown.rows if row[0] == before.test.replace("_", " "))
        assert row[-1] == f"{telling.capital(before.words)}. {told}"
        assert f"{stays.words} (p < 1e-300)." in shown.text


def test_agreement_is_told_as_such():
    told = page(report(False))
    assert "Recording and simulation agree" in told.text
    assert "Nothing found: recording and simulation agree (p = " in told.text
    assert "differ: p" not in told.text
    assert "Vibration tone" not in told.text
    assert "After the repair" not in told.text
    assert told.tags.count("img") == 4
    (note,) = report(False).notes
    assert note.startswith("The model's numbers are taken as known exactly")
    assert note in told.text
    assert str(report(False)) == f"Recording and simulation agree (p = {report(False).p_value:.2g}).\n{note}"


def test_the_same_data_on_both_sides_are_told():
    recording = observed(False)
    with pytest.warns(UserWarning, match="Recording and simulation are the same data, sample by sample"):
        same = gf.diagnose(recording, recording)
    assert same.notes[0].endswith("Give another simulation.")
    assert same.notes[0] in str(same)
    assert same.notes[0] in page(same).text
    with pytest.warns(UserWarning, match="Recording and judge are the same data"):
        gf.diagnose(recording, NOISE, judge=recording)


def test_a_difference_without_a_name_is_told_as_such():
    told = dataclasses.replace(report(), findings=(), unexplained=report().evidence[:1])
    assert "What the simulation leaves out could not be named." in page(told).text
    assert "Unexplained, as seen by" in page(told).text
    assert "before and after the repair" in page(told).text, "it is repaired all the same"
    assert "before and after the repair" not in page(dataclasses.replace(told, repaired=told.comparison)).text


def test_no_line_breaks_within_an_arrow():
    finding = dataclasses.replace(report().findings[0], sentence="white noise 1 -> 2 deg/s")
    told = page(dataclasses.replace(report(), findings=(finding,))).text
    assert told.count("White noise 1 → 2 deg/s.") == 2
    assert "->" not in told


def test_words_are_explained_at_the_foot_of_the_page():
    told = page(report())
    assert "details" in told.tags
    foot = told.text[told.text.index("What the words on this page mean") :]
    for word in ("p value", "held out", "nats", "discrepancy", "area under the curve", "look-alike", "repair"):
        assert word in foot
    assert report().summary().endswith("explained at the foot of the page (to_html, --report).")


def test_to_html_writes_the_page(tmp_path: Path):
    report().to_html(tmp_path / "page.html", title="Mine")
    assert "<h1>Mine</h1>" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_plot_draws_the_map_into_the_given_axes():
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    assert report().plot(ax) is ax
    mesh = ax.collections[0]
    np.testing.assert_array_equal(mesh.get_array().reshape(3, -1).T, report().variances[0].z)
    assert [label.get_text() for label in ax.get_yticklabels()] == list(NAMES)


def test_map_marks_what_chance_does_not_give_and_greys_what_is_unknown():
    from matplotlib.figure import Figure

    z = torch.zeros(4, 3, dtype=torch.float64)
    z[2, 1], z[3] = -7.0, torch.nan
    ax = plot_map(z, names=("a", "b", "c"), rate=2.0, lines_hz=[0.3], ax=Figure().subplots())
    dots, marks = ax.lines
    assert (dots.get_xdata().tolist(), dots.get_ydata().tolist()) == ([2.0], [1])
    assert marks.get_xdata() == [0.3]
    assert ax.collections[0].get_array().mask.sum() == 3
    assert ax.collections[0].norm.vmax == 7.0
    assert ends_of_colours(torch.tensor([0.5]), torch.tensor([100.0])) == 12.0
    assert ends_of_colours(torch.tensor([torch.nan])) == ends_of_colours(torch.tensor([0.5])) == 4.0


def test_shares_are_bars_from_zero_that_add_up():
    """And what is below 0, or left below 0, is said to be so, and why."""
    from matplotlib.figure import Figure

    shares = (Share("quantization", True, 9.0, -1 / 7), Share("vibration_tone", True, 0.5, 8.5 / 7))
    ax = plot_shares(8.0, shares, ax=Figure().subplots())
    bars = [bar.get_width() for bar in ax.patches]
    assert bars == pytest.approx([-100 / 7, 850 / 7, -50 / 7])
    assert all(bar.get_x() == 0 for bar in ax.patches)
    assert [text.get_text() for text in ax.texts] == ["-14.3 %   (8 → 9)", "121 %   (9 → 0.5)", "-7.14 %   (0.5)"]
    held_out = report().held_out._replace(before=8.0, after=0.5, shares=shares)
    told = dataclasses.replace(report(), held_out=held_out)
    assert telling.share_words(told) == [
        "Of the discrepancy above noise alone, 7 on data held out, mechanisms with names carry 107 %; nothing is left: "
        "it is closer than noise alone is on average"
    ]
    assert "A share is below 0 where" in page(told).text
    assert "A share is below 0 where" not in page(report()).text
    curve = shares[0]._replace(identified=False)
    (words,) = telling.share_words(dataclasses.replace(told, held_out=held_out._replace(shares=(curve, shares[1]))))
    assert "curves without a name -14.3 %; nothing is left" in words
    assert "below 0 %: these repairs by themselves take the simulation further away" in words


def test_wavelet_variances_are_those_of_both_sides():
    comparison = report().comparison
    compared = compared_variances(comparison)[0]
    for j in (1, 4, 9):
        expected = [float((naive.coefficients(x, j) ** 2).mean()) for x in comparison.recording.numpy()]
        np.testing.assert_allclose(compared.observed[j - 1], expected, rtol=1e-9)
        each = [
            [float((naive.coefficients(x, j) ** 2).mean()) for x in record]
            for record in comparison.reference.signal.numpy()
        ]
        np.testing.assert_allclose(compared.reference[j - 1], np.mean(each, 0), rtol=1e-9)


def test_standard_deviations_are_those_of_records_that_agree():
    """Over 30 pairs of a recording and a simulation: mean square of z near 1 where levels hold many windows."""
    z, powers = [], []
    for seed in range(30):
        comparison = sides(drawn(4096, 100 + seed), drawn(3 * 4096, 200 + seed))
        z.append(compared_variances(comparison)[0].z[:7])
        powers.append(compared_powers(comparison))
    # 90 independent values at each level, and levels correlate: 5 standard deviations of the mean of 90 squares.
    for values in (torch.stack(z), torch.stack(powers)):
        size = values.square().mean((0, 2))
        assert float(size.mean()) == pytest.approx(1, abs=0.2)
        assert float((size - 1).abs().max()) < 5 * math.sqrt(2 / 90)


def test_a_short_simulation_leaves_levels_unknown():
    comparison = sides(drawn(2**15, 1), drawn(4096, 2))
    compared = compared_variances(comparison)[0]
    assert compared.observed.isfinite().all()
    assert compared.z[:12].isfinite().all()
    assert compared.z[12:].isnan().all()
    assert compared_powers(comparison).isnan().any()


def test_spectrum_is_the_periodogram_over_the_simulations():
    comparison = report().comparison
    spectrum = grouped_spectrum(comparison, comparison.observed, 0)
    x = comparison.recording[0].numpy() - comparison.recording[0].numpy().mean()
    taper = 2 * np.sin(np.pi * np.arange(N) / N) ** 2 * math.sqrt(2 / 3)
    power = np.abs(np.fft.rfft(x * taper)) ** 2 / N
    f = np.arange(len(power)) / N
    ratio = power[2:-2] / comparison.base.spectrum(torch.from_numpy(f[2:-2]))[0].numpy()
    assert float(spectrum.largest.max()) == pytest.approx(ratio.max(), rel=1e-9)
    at = float(spectrum.frequency[spectrum.largest.argmax()])
    assert at * RATE == pytest.approx(TONE, rel=0.05)
    calm = grouped_spectrum(comparison, comparison.reference, 0)
    assert len(calm.mean) == len(spectrum.mean)
    assert bool((calm.mean <= calm.largest).all())
    assert float(calm.largest.max()) < 15 < float(spectrum.largest.max())


def test_correct_takes_the_tone_off_recordings_and_tensors():
    clean = drawn(N, 1)
    corrected = report().correct(observed())
    assert isinstance(corrected, gf.Recording)
    assert (corrected.rate, corrected.unit, corrected.sensors) == (RATE, "deg/s", NAMES)
    left = (corrected.signal - clean).square().mean(-1)
    assert bool((left < 0.05 * tone().square().mean(-1).clamp(min=1e-2)).all())
    torch.testing.assert_close(report().correct(observed().signal), corrected.signal, rtol=0, atol=0)
    turned = report().correct(observed().to("rad/s"))
    assert turned.unit == "rad/s"
    torch.testing.assert_close(turned.to("deg/s").signal, corrected.signal, rtol=0, atol=1e-12)
    single = report().correct(observed().signal.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), corrected.signal, rtol=0, atol=1e-5)


def test_correct_refuses_other_sensors():
    with pytest.raises(
        ValueError, match=r"`recording`: expected .* the 3 sensors of the diagnosis, got shape \(2, 99\)"
    ):
        report().correct(torch.zeros(2, 99, dtype=torch.float64))


def test_benefit_is_what_fusing_both_gives():
    gained = report().benefit("short")
    before, after = observed().signal, report().correct(observed().signal)
    for signal, weights, variance in (
        (before, gained.before, gained.variance_before),
        (after, gained.after, gained.variance_after),
    ):
        fitted = gf.fit_svo(signal, "short")
        torch.testing.assert_close(weights, fitted.weights, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(variance, fitted.in_sample_wavelet_variance, rtol=1e-9, atol=0)
    assert gained.factor > 1
    assert gained.level_factor.argmax() == 2  # 7.3 Hz of 50 lies in the octave of level 2 or 3
    assert set(gained.to_dict()) == {"scale_weights", "before", "after", "level_factor", "factor"}


def test_the_gain_is_said_where_anything_is_taken_off():
    assert telling.fused_words(report(False)) == []
    assert telling.benefit_of(report(False)) is None
    (sentence,) = telling.fused_words(report())
    assert sentence.startswith("Fused for long averaging times, the corrected recording gives a virtual gyro ")
    assert sentence in report().summary()
    assert sentence in page(report()).text
    copied = observed().signal[[0, 0]]
    comparison = dataclasses.replace(
        report().comparison, info=dataclasses.replace(report().comparison.info, sensors=("a", "b"))
    )
    twice = dataclasses.replace(report(), comparison=comparison.with_recording(copied))
    assert telling.benefit_of(dataclasses.replace(twice, model=dataclasses.replace(twice.model, effects=()))) is None


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("frequency", "frequency"),
        ("time_constant[1]", "time constant, sensor b"),
        ("gain[0, 1]", "gain, sensors a, b"),
        ("gain[7]", "gain[7]"),
    ],
)
def test_parameters_have_names_for_readers(name: str, told: str):
    assert telling.parameter_words(name, ("a", "b")) == told


def test_digits_are_those_that_the_interval_leaves():
    from gyrofuse.mismatch.reporting.page import _resolved

    assert _resolved(Parameter(137.200123, 137.200100, 137.200146, "Hz"))["low"] == "137.2001"
    assert _resolved(Parameter(2.76896e-05, 2.0579e-05, 3.48e-05, "deg/s"))["value"] == "2.77e-05"
    assert _resolved(Parameter.exact(57.295779, ""))["value"] == "57.3"
    assert _resolved(Parameter(1.0, -math.inf, math.inf, ""))["low"] == "-"
