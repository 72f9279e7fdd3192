"""A level of noise that changes bit by bit: its course, what it is called, and what is left beside it."""

from __future__ import annotations

import itertools
import math
import re

import numpy as np
import pytest
import torch
from mismatch_draws import LEVEL, NOISE, RATE, SCENE, N, drawn, nominated, normal, settled
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.mechanisms.regimes.gradual_change import GradualChange
from gyrofuse.mismatch.mechanisms.regimes.variance_change import VarianceChange
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats import variance_courses as courses
from gyrofuse.mismatch.stats.segments import course_scores

T = torch.arange(N, dtype=torch.float64) / N


def ramp(start: float, stop: float) -> Tensor:
    """From 0 to 1."""
    return ((T - start) / (stop - start)).clamp(0, 1)


FORMS = {
    "ramp": ramp(0.2, 0.8),
    "fading": 1 - ramp(0.0, 1.0),
    "decay": (-T / 0.15).exp(),
    "swell": (-((T - 0.4) / 0.15).square()).exp(),
    "dip": 1 - (-((T - 0.6) / 0.2).square()).exp(),
}


def case_of(log_variance: Tensor, seed: int) -> tuple[Comparison, torch.Generator]:
    """White noise of variance one goes another way than its mean in sensors 0 and 2; what is slow stays as it is."""
    g = torch.Generator().manual_seed(seed)
    slow = gf.AR1(0.98, 0.004) + gf.RandomWalk(1e-5)
    level = log_variance.exp() / log_variance.exp().mean()
    white = normal(3, N, g=g)
    white[[0, 2]] *= level.sqrt()
    recording = white + slow.simulate(N, batch=(3,), generator=g)
    return Comparison.of(SCENE, recording, NOISE.simulate(N, batch=(2, 3), generator=g)), g


def test_a_course_is_the_nearest_one_with_a_single_peak():
    values = [0.0, 0.5, 1.0]
    for y in ([0.2, 0.9, 0.1, 0.8], [1.0, 0.3, 0.4, 0.2], [0.1, 0.2, 0.3, 0.9], [0.5, 0.1, 0.6, 0.5]):
        found = courses._unimodal(np.array(y)).tolist()
        error = sum((a - b) ** 2 for a, b in zip(found, y, strict=True))
        for rival in itertools.product(values, repeat=4):
            peak = max(range(4), key=lambda k: rival[k])
            if list(rival[: peak + 1]) == sorted(rival[: peak + 1]) and list(rival[peak:]) == sorted(
                rival[peak:], reverse=True
            ):
                assert error <= sum((a - b) ** 2 for a, b in zip(rival, y, strict=True)) + 1e-12
        top = found.index(max(found))
        assert found[: top + 1] == sorted(found[: top + 1])
        assert found[top:] == sorted(found[top:], reverse=True)


@pytest.mark.parametrize("form", FORMS)
def test_a_course_and_its_levels_are_found(form: str):
    g = torch.Generator().manual_seed(1)
    true = FORMS[form]
    white = normal(3, N, g=g)
    white[0] *= (0.8 * true / 2).exp()
    white[2] *= (-1.2 * true / 2).exp()
    white[0, 5000] = 30.0  # an outlier is no change
    found = courses.course_of(white, torch.tensor([0.6, 0.0, -0.9], dtype=torch.float64))
    assert found is not None
    assert found.factor[1] == 1
    level = torch.stack([0.8 * true, 0 * true, -1.2 * true])
    apart = (found.variance.log() - level).abs()
    assert float(apart.mean()) < 0.05
    assert float(course_scores(white, found.variance).sum()) > 0.95 * float(course_scores(white, level.exp()).sum())


def test_steady_noise_gains_what_an_order_gains_by_chance():
    """The mean for one order of `m` blocks is `(1/2 + .. + 1/m)/2`; two are allowed for, and the place of the peak."""
    gains, worth = [], []
    for seed in range(40):
        white = normal(1, N, g=torch.Generator().manual_seed(seed))
        found = courses.course_of(white, torch.ones(1, dtype=torch.float64))
        if found is not None:
            gains.append(float(course_scores(white, found.variance).sum()))
            worth.append(courses.course_score(white, found, torch.ones(1, dtype=torch.float64)))
    assert sum(gains) / len(gains) < 1.5 * math.log(128)
    assert max(worth) < 5


@pytest.mark.statistical
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("depth", [0.8, 3.0])
def test_a_level_that_changes_bit_by_bit_is_a_change_of_variance_of_another_form(form: str, depth: float):
    comparison, g = case_of(depth * FORMS[form], 3)
    found = nominated(comparison, GradualChange)
    assert found.sensors == (0, 2)
    assert "form" in found.sentence
    assert isinstance(found.effect, GradualChange)
    after = settled(comparison, found, g)
    assert VarianceChange.detect_and_fit(after, LEVEL) is None


@pytest.mark.statistical
@pytest.mark.parametrize("depth", [0.6, 1.5, 4.0])
def test_a_ramp_is_all_that_differs(depth: float):
    """Its mean level is the simulation's; spectra that take it for steady noise, or its level for another, differ."""
    comparison, _ = case_of(depth * FORMS["ramp"], 5)
    model = gf.WhiteNoise(1.0) + gf.AR1(0.98, 0.004) + gf.RandomWalk(1e-5)
    report = gf.diagnose(gf.Recording(comparison.recording, rate=RATE, unit="deg/s"), model)
    assert [f.mechanism for f in report.findings] == ["variance_change"]
    said = re.search(r"to (\S+) times what it was", report.findings[0].sentence)
    assert said is not None
    assert float(said[1]) == pytest.approx(math.exp(depth), rel=0.4)
    assert report.unexplained == ()
    assert report.held_out.after < 1.5


@pytest.mark.parametrize("louder", [0.5, 1.5])
def test_an_episode_is_none(louder: float):
    for seed in (20, 21, 22):
        recording, simulation, g = drawn(seed, records=2)
        recording[:2, 5000:9000] += louder * normal(2, 4000, g=g)
        comparison = Comparison.of(SCENE, recording, simulation)
        assert GradualChange.detect_and_fit(comparison, LEVEL) is None
        assert nominated(comparison, VarianceChange).sensors == (0, 1)


@pytest.mark.parametrize("depth", [0.3, 1.0, 3.0])
def test_a_level_that_goes_up_and_down_all_the_time_has_no_course(depth: float):
    wave = 0.5 * torch.sin(2 * math.pi * 33.3 * T) + 0.2 * torch.sin(2 * math.pi * 71.1 * T)
    comparison, _ = case_of(depth * wave, 7)
    assert GradualChange.detect_and_fit(comparison, LEVEL) is None


@pytest.mark.parametrize("depth", [1.0, 3.0])
def test_a_level_that_goes_up_and_down_a_few_times_has_one(depth: float):
    wave = 0.5 * torch.sin(2 * math.pi * 3.3 * T) + 0.2 * torch.sin(2 * math.pi * 7.1 * T)
    comparison, _ = case_of(depth * wave, 7)
    found = GradualChange.detect_and_fit(comparison, LEVEL)
    assert found is not None
    assert "up and down" in found.sentence
    course = found.effect.course(comparison.n_samples, comparison.info).variance[found.sensors[0]].log()
    assert float(torch.corrcoef(torch.stack([course, wave]))[0, 1]) > 0.95


def test_nothing_is_found_where_nothing_changes():
    for seed in range(4):
        recording, simulation, _ = drawn(seed, records=2)
        assert GradualChange.detect_and_fit(Comparison.of(SCENE, recording, simulation), LEVEL) is None
