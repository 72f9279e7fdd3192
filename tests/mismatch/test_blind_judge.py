"""The blind proof's seal and judge: what was changed is refused, counts by hand, a trial from plan to verdict."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import beta, norm

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from blind import (
    cases,
    field,
    judge,
    ordinary_view,
    scoring,
    seal,
    trial,
)
from blind.cases import make_case
from blind.curves import draw_curves

N = 8192


# the seal


def test_seal_refuses_what_was_changed(tmp_path):
    truth, answers = tmp_path / "truth.json", tmp_path / "answers.json"
    digest = seal.seal([{"kind": "null"}], truth)
    frozen = seal.freeze([{"mismatch": False}], digest, answers)
    assert seal.unseal(truth, digest, answers, frozen) == ([{"kind": "null"}], [{"mismatch": False}])
    assert seal.seal([{"kind": "null"}], tmp_path / "again.json") != digest  # salted

    kept = answers.read_text()
    answers.write_text(kept.replace("false", "true"))
    with pytest.raises(seal.SealBrokenError, match="`answers_path`: expected the frozen answers"):
        seal.unseal(truth, digest, answers, frozen)
    answers.write_text(kept)
    other = seal.seal([{"kind": "step"}], tmp_path / "other.json")
    with pytest.raises(seal.SealBrokenError, match="expected answers to these truths"):
        seal.unseal(tmp_path / "other.json", other, answers, frozen)
    truth.write_text(truth.read_text().replace("null", "step"))
    with pytest.raises(seal.SealBrokenError, match="`truth_path`: expected the sealed truths"):
        seal.unseal(truth, digest, answers, frozen)
    two = seal.freeze([None, None], other, answers)
    with pytest.raises(seal.SealBrokenError, match="expected 1 answers, got 2"):
        seal.unseal(tmp_path / "other.json", other, answers, two)


# the judge


def effect(**changes):
    return {
        "mechanism": "step", "class": ["step", "warm_up_transient"], "sensors": [0, 2], "sensor_nats": [20.0, 2.0],
        "nats": 30.0, "oracle_llr": 28.0, "oracle_nats": 30.0, "oracle_law": "cumulants",
        "oracle_null": [-30.0, 60.0, 0.0], "frequency_hz": None, "frequency_sd_hz": None,
        "time_s": 10.0, "onset_sd_s": 0.5, "channel": None,
        "parameters": {"step": {"value": 0.1, "unit": "deg/s", "per_sensor": [0.08, 0.12]}}, **changes,
    }  # fmt: skip


def truth(group="mechanism", effects=None, kind="step", nats=30.0):
    effects = [effect()] if effects is None else effects
    whose = {"group": group, "kind": kind, "nats": nats, "effects": effects}
    return whose | {"true_gain": 28.0, "n_samples": 4096, "simulated": 8192, "reach": None}


def answer(*named, mismatch=True, **fields):
    findings = [{"mechanism": name, "alternatives": [], "sensors": [0, 2], **fields} for name in named]
    held_out = {"before": 1.5, "after": 1.0, "gain": {"value": 14.0, "low": 5.0, "high": 20.0}}
    held_out["auc"] = {"before": 0.8, "after": 0.56}
    return {"mismatch": mismatch, "findings": findings, "unexplained": [], "held_out": held_out}


SILENT = {"mismatch": False, "findings": [], "unexplained": [], "held_out": {}}


def test_judge_counts_by_hand():
    truths = [truth()] * 5 + [truth("null", [], "null", None)] * 4
    answers = [
        answer("step", time_s=10.4, parameters={"step": {"value": 0.1, "low": 0.09, "high": 0.11, "unit": "deg/s"}}),
        answer("warm_up_transient"),
        answer("flicker"),
        answer("flicker", alternatives=["step"], sensors=[0]),
        SILENT,
        SILENT,
        SILENT,
        answer("step"),
        None,
    ]
    verdict = judge.judge(truths, answers)

    def count(line, of="all", nats=None):
        row = verdict.row(line, of, nats)
        return row.hits, row.trials

    assert count("false alarm") == (1, 4)
    assert count("diagnosis failed") == (1, 9)
    assert count("detected", "step", 30.0) == (4, 5)
    assert count("right name") == (1, 5)
    assert count("right class") == (3, 5)
    assert count("right class, of detected") == (3, 4)
    assert count("wrong name with confidence") == (1, 5)
    assert count("oracle detects") == (5, 5)
    assert count("exact sensors") == (1, 1)
    assert count("onset within 3 sd of the oracle") == (1, 1)
    assert count("interval covers", "step.step") == (1, 1)
    assert count("held-out score improves") == (4, 4)
    assert count("area under the curve after, at most 0.55") == (0, 4)
    told = {figure["line"]: figure for figure in verdict.to_dict()["figures"]}
    assert told["onset error / sd of the oracle"]["median"] == pytest.approx(0.8)  # 0.4 s of 0.5 s
    assert told["oracle has the exact sensors"]["mean"] == pytest.approx(norm.cdf(10**0.5) * norm.cdf(1.0))
    gain = next(f for f in verdict.figures if f.line.startswith("gain"))
    assert np.median(gain.values) == pytest.approx(0.5)
    low, high = verdict.row("false alarm").interval
    assert low == pytest.approx(beta.ppf(0.025, 1, 4))
    assert high == pytest.approx(beta.ppf(0.975, 2, 3))
    assert "false alarm" in str(verdict)
    json.dumps(verdict.to_dict(), allow_nan=False)


def test_judge_of_forms_fits_and_noise_alike_by_hand():
    form = truth("form", kind="form:several_steps") | {"reach": "one"}
    left = answer("step") | {"held_out": {"before": 9.0, "after": 2.5}}
    told = left | {"unexplained": ["shape"]}
    verdict = judge.judge(
        [form, form, form, truth("fitted", [], "fitted:gmwm", None), truth("common_noise", [], "common_noise:t5", None),
         truth("misfit", [], "misfit:no_walk", None)],
        [answer("step"), left, told, SILENT, answer("spikes"), answer("parameter_shift")],
    )  # fmt: skip

    def count(line, of="all", nats=None):
        row = verdict.row(line, of, nats)
        return row.hits, row.trials

    assert count("form: right class", "in one", 30.0) == (3, 3)
    assert count("form: discrepancy after, at most 1.5") == (1, 3)
    assert count("much is left and nothing said to be") == (1, 5)
    assert count("fitted: false alarm") == (0, 1)
    assert count("common_noise: false alarm") == (1, 1)
    assert count("common_noise: something named") == (1, 1)
    assert count("misfit: detected") == (1, 1)
    assert count("misfit: other noise named, of detected") == (1, 1)


def test_judge_of_the_other_groups():
    outside = truth("outside", [effect(mechanism="chirp", **{"class": ["chirp"]})], "outside:chirp")
    vague = answer("not_identifiable") | {"unexplained": ["0.1 to 0.4 fs"]}
    blind = truth("unidentifiable", [effect(mechanism="not_identifiable", **{"class": ["not_identifiable"]})], "alias")
    two = truth("two", [effect(), effect(mechanism="flicker", **{"class": ["flicker"]})], "two:step+flicker")
    verdict = judge.judge(
        [outside, outside, blind, blind, two, two],
        [vague, answer("drifting_tone"), SILENT, answer("scale_factor"), answer("step", "flicker"), answer("step")],
    )
    assert verdict.row("outside: misnamed")[3:] == (1, 2)
    assert verdict.row("outside: unexplained, of detected")[3:] == (1, 2)
    assert verdict.row("unidentifiable: abstained")[3:] == (1, 2)
    assert verdict.row("two: both in class")[3:] == (1, 2)
    assert verdict.row("two: at least one in class")[3:] == (2, 2)
    real = truth("real", [effect()], "real:step")
    untouched = truth("real", [], "real:untouched", None)
    found = judge.judge([real, real, untouched], [answer("step"), answer("flicker"), answer("flicker")])
    assert found.row("real: right name")[3:] == (1, 2)
    assert found.row("real: something else named")[3:] == (1, 2)
    assert found.row("real, untouched: something named")[3:] == (1, 1)


def test_scores_of_sensors_and_intervals():
    true = effect()
    assert scoring.right_sensors(true, {"sensors": [0]}) == (False, True)  # the other has 2 nats
    assert scoring.right_sensors(true, {"sensors": [0, 1]}) == (False, False)
    interval = {"low": 0.07, "high": 0.09, "unit": "deg/s"}
    each = {"parameters": {"step[0]": interval, "step[1]": interval, "step[2]": interval, "step": interval}}
    assert scoring.coverage(true, each) == [("step", True), ("step", False), ("step", False)]
    assert scoring.unmatched(true, each) == ["step[1]"]
    alike = effect(parameters={"rate": {"value": 300.0, "unit": "1/h"}})
    shared = {"low": 200.0, "high": 250.0, "unit": "1/h"}
    assert scoring.coverage(alike, {"parameters": {"rate[0]": shared, "rate[2]": shared}}) == [("rate", False)]
    foreign = {"parameters": {"step": {"unit": "rad/s"}, "size": {"unit": "deg/s"}}}
    assert scoring.unmatched(true, foreign) == ["step", "size"]
    weak = effect(oracle_null=[-3.0, 6.0, 0.0])
    assert not scoring.oracle_detects(weak | {"oracle_llr": 2.69}, 0.01)  # -3 + 2.326 sqrt 6 = 2.698
    assert scoring.oracle_detects(weak | {"oracle_llr": 2.71}, 0.01)
    assert scoring.oracle_detects(effect(nats=30.0, oracle_llr=5.0, oracle_law="bound"), 0.01)


def check_effect_in_recording(kind: str, data: Path) -> None:
    """The background is there in counts, the simulation is its continuation, the effect has its size in its noise."""
    n = 4096
    case = make_case(kind, 30.0, 5, n_samples=n, data=data)
    again = make_case(kind, 30.0, 5, n_samples=n, data=data)
    np.testing.assert_array_equal(case.recording["gyro"], again.recording["gyro"])
    assert case.recording["gyro"].shape == case.simulation["gyro"].shape == (3, n)
    assert case.recording["fs"] == 100.0
    counts = case.recording["gyro"] / 0.05
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    if kind == "real:untouched":
        folder = [np.load(data / name)["counts"][:3] for name in field.FILES]
        given = np.concatenate([counts, case.simulation["gyro"] / 0.05], axis=1)
        here = [f for f in folder for k in np.flatnonzero(f[0, : -2 * n] == round(given[0, 0])) if
                np.array_equal(f[:, k : k + 8], np.round(given[:, :8]))
                and np.array_equal(f[:, k : k + 2 * n], np.round(given))]  # fmt: skip
        assert len(here) == 1
    json.dumps(seal.plain(case.truth), allow_nan=False)
    if case.truth["effects"]:
        (effect,) = case.truth["effects"]
        assert sum(effect["sensor_nats"] or [30.0]) == pytest.approx(30, rel=1e-6)


def test_effects_in_real_recordings(data: Path, subtests: pytest.Subtests):
    for kind in cases.kinds("real"):
        with subtests.test(kind=kind):
            check_effect_in_recording(kind, data)


def test_real_recordings_are_asked_for():
    with pytest.raises(ValueError, match=r"`data`: expected a folder with adis16405_rec1.npz"):
        make_case("real:step", 30.0, 1)


def test_spectrum_of_a_stretch():
    """White noise of two levels; the bands of the upper half have 700 ordinates and more, 5 %."""
    rng = np.random.default_rng(4)
    base = field.measured_base(rng.standard_normal((2, N)) * np.array([[1.0], [3.0]]), 100.0)
    np.testing.assert_allclose(base.white, [1.0, 9.0], rtol=0.2)
    np.testing.assert_allclose(base.spectrum(N)[:, N // 2 :], np.outer([1.0, 9.0], np.ones(N // 2 - 1)), rtol=0.25)
    with pytest.raises(ValueError, match="as measured"):
        base.components(N // 2)


def test_curves_are_drawn(tmp_path):
    found = judge.judge([truth("mechanism", [effect()])] * 2, [answer("step"), SILENT])
    assert draw_curves(found, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert not draw_curves(judge.judge([truth("null", [], "null", None)], [SILENT]), tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_concealed_is_what_wavelet_variances_do_not_show():
    loud = make_case("vibration_tone", 3000.0, 1, n_samples=N).truth
    faint = make_case("vibration_tone", 10.0, 1, n_samples=N).truth
    assert ordinary_view.concealed(faint)
    assert not ordinary_view.concealed(loud)


def test_trial_from_plan_to_verdict(tmp_path):
    plan = trial.plan_trial(1, 2, (30.0,), seed=1, groups=("null", "unidentifiable"))
    assert len(plan) == 2 * len(cases.kinds("null")) + len(cases.kinds("unidentifiable"))
    seen = []

    def analyse(recording, simulation):
        seen.append(set(recording) | set(simulation))
        if len(seen) == 1:
            raise RuntimeError("no opinion")
        return SILENT

    verdict = trial.run_trial(plan, analyse, tmp_path, n_samples=2048)
    assert verdict.row("false alarm").hits == 0
    assert verdict.row("diagnosis failed")[3:] == (1, len(plan))
    assert all(
        names <= {"gyro", "fs", "unit", "terms", "temperature", "acceleration", "reference_rate"} for names in seen
    )
    digests = json.loads((tmp_path / "digests.json").read_text())
    assert seal.digest_of(json.loads((tmp_path / "truth.json").read_text())) == digests["truth"]
    assert "no opinion" in (tmp_path / "failures.txt").read_text()
