"""Every mechanism draws its evidence, before the repair and after it, from numbers that are checked by hand."""

from __future__ import annotations

from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.catalogue import CATALOGUE
from gyrofuse.mismatch.mechanisms.mechanism import Context, Finding, Mechanism
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone
from gyrofuse.mismatch.mechanisms.slow.step import Step
from gyrofuse.mismatch.signals.comparison import Comparison, block_means
from tests import mechanism_draws  # noqa: F401  # which draws every mechanism
from tests.mechanism_settings import RATE, compared, concealed

mpl.use("Agg")
PHYSICS = [kind for kind in CATALOGUE if kind.identified]


def found(kind: type[Mechanism], *others: Mechanism) -> tuple[Finding, Comparison]:
    recording, simulation, drawn = concealed(kind, "picture")
    start = compared(recording, simulation)
    effect = drawn.effect
    finding = Finding(kind.name, effect, "", 1e-9, (0,), {}, frequency_hz=None, context=Context(start, others))
    return finding, start


def drawn_lines(ax) -> list[np.ndarray]:
    return [np.asarray(line.get_xydata(), dtype=float) for line in ax.get_lines()]


@pytest.mark.parametrize("kind", PHYSICS, ids=lambda kind: kind.__name__)
def test_every_mechanism_draws_what_it_is_found_by(kind: type[Mechanism]) -> None:
    finding, _ = found(kind)
    before, after = finding.plot(list(Figure().subplots(2, 1)))
    for ax, when in ((before, "before the repair"), (after, "after the repair")):
        assert ax.get_title(loc="left").endswith(f"sensor 1, {when}")
        assert ax.get_xlabel()
        assert ax.get_ylabel()
        assert ax.lines or ax.patches or ax.collections
        assert all(np.isfinite(line).all() for line in drawn_lines(ax))
    assert before.get_ylim() == after.get_ylim()


def test_the_picture_of_a_step_has_the_means_of_the_blocks_and_the_step() -> None:
    finding, start = found(Step)
    before, after = (drawn_lines(ax) for ax in finding.plot(list(Figure().subplots(2, 1))))
    means = block_means(start.recording[0])
    np.testing.assert_allclose(before[0][:, 1], means - means.mean(), atol=1e-12)
    np.testing.assert_allclose(before[0][:, 0], (np.arange(256) + 0.5) * start.block / RATE)
    step = before[1][:, 1]
    size = float(finding.effect.amplitudes[0, 0])
    assert step.max() - step.min() == pytest.approx(abs(size), rel=1e-9)
    assert len(after) == 1  # nothing is fitted any more
    left = block_means(start.recording[0] - torch.from_numpy(np.repeat(step, start.block)))
    np.testing.assert_allclose(after[0][:, 1], left - left.mean(), atol=2e-2)


def test_the_picture_of_a_tone_has_its_line_before_the_repair_alone() -> None:
    finding, start = found(VibrationTone)  # whose phase is another one in every recording
    finding = replace(finding, effect=VibrationTone.at(start, finding.effect.frequency_hz))
    before, after = (drawn_lines(ax) for ax in finding.plot(list(Figure().subplots(2, 1))))
    observed, reference = before[1], before[0]
    assert observed[:, 1].max() > 5 * reference[:, 1].max()
    assert observed[observed[:, 1].argmax(), 0] == pytest.approx(finding.effect.frequency_hz, abs=2 * RATE / 8192)
    assert after[1][:, 1].max() < observed[:, 1].max() / 5


def test_the_picture_of_coherence_names_the_pair_and_has_the_reach_of_chance() -> None:
    _, start = found(Step)
    p = start.n_sensors
    ax = Figure().subplots()
    pictures.coherence(ax, start, 0, torch.tensor([9.0] + [0.1] * (p - 2) + [-0.5]))
    name = start.info.sensors[-1]
    assert ax.get_ylabel() == f"coherence of {start.info.sensors[0]} and {name}"
    assert name in ax.get_legend().get_texts()[0].get_text()
    own, _, limit = drawn_lines(ax)
    np.testing.assert_allclose(own[:, 1], start.observed.coherence[:, 0, -1].abs())
    rng, n_pictures = np.random.default_rng(0), 500
    above = np.zeros(n_pictures, dtype=bool)
    dof = start.observed.coherence_dof
    for d, most in zip(dof[dof > 1].tolist(), limit[:, 1], strict=True):
        # The power of one sensor that goes with another one's is one ordinate of d.
        shared = rng.beta(1, d - 1, n_pictures)
        above |= shared > most**2
    assert above.sum() == pytest.approx(0.05 * n_pictures, abs=4 * (0.05 * n_pictures) ** 0.5)


def test_other_findings_are_repaired_in_both_pictures() -> None:
    recording, simulation, drawn = concealed(Step, "picture")
    start = compared(recording, simulation)
    decay = drawn.effect.with_amplitudes(0.5 * drawn.effect.amplitudes)
    finding = Finding("step", drawn.effect, "", 1e-9, (0,), {}, context=Context(start, (decay,)))
    before, _ = finding.plot(list(Figure().subplots(2, 1)))
    means = block_means(decay.remove(start.recording, start.info)[0])
    np.testing.assert_allclose(drawn_lines(before)[0][:, 1], means - means.mean(), atol=1e-12)


def test_the_likeliest_path_is_that_of_all_paths() -> None:
    rng = np.random.default_rng(0)
    y, variance, stay = rng.standard_normal(9), 0.7, 0.8
    paths = np.array(np.meshgrid(*[[-1.0, 1.0]] * 9)).reshape(9, -1).T
    moves = (paths[:, 1:] != paths[:, :-1]).sum(-1)
    score = -((y - paths) ** 2).sum(-1) / variance + moves * np.log(1 - stay) + (8 - moves) * np.log(stay)
    path = pictures.likeliest_path(torch.from_numpy(y), variance, stay)
    np.testing.assert_array_equal(path, paths[score.argmax()])


def test_a_finding_without_a_report_has_no_picture() -> None:
    finding, start = found(Step)
    with pytest.raises(ValueError, match="`finding`: expected one of a report's findings"):
        Finding("step", finding.effect, "", 1e-9, (0,), {}).plot()
    with pytest.raises(ValueError, match="`axes`: expected two, before and after the repair, got 1"):
        finding.plot([Figure().subplots()])
    assert start is finding.context.start
