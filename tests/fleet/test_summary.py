"""The summary of a fleet, and its page."""

from __future__ import annotations

import numpy as np
import pytest

from gyrofuse.fleet import summary as fleet_summary
from gyrofuse.fleet.report import fleet_report
from gyrofuse.fleet.summary import mean_gain, summarise

pytestmark = pytest.mark.usefixtures("blank_images")


def fused(n: int, *, seed: int = 0, drift: float = 0.0, sensors: tuple[str, ...] = ("s1", "s2", "s3")) -> list[dict]:
    rng = np.random.default_rng(seed)
    rows = []
    for i in range(n):
        weights = np.array([0.5, 0.3, 0.2]) + 0.02 * rng.standard_normal(3)
        weights[0] += drift * i / n
        rows.append(
            {
                "log": f"log{i:03d}.npz",
                "axis": None,
                "status": "ok",
                "error": None,
                "sensors": list(sensors),
                "weights": list(weights / weights.sum()),
                "relative_noise": list(np.array([0.8, 1.0, 1.4]) * np.exp(0.05 * rng.standard_normal(3))),
                "gain": list(1.3 * np.exp(0.05 * rng.standard_normal(4))),
                "virtual_deviation": list(1e-3 * np.exp(0.05 * rng.standard_normal(4))),
            }
        )
    return rows


def test_an_even_fleet_has_nothing_that_stands_out():
    alarms = 0
    for seed in range(100):
        summary = summarise("fuse", fused(40, seed=seed))
        alarms += bool(summary.trends) + bool(summary.outliers)
    assert alarms <= 9  # of 200, at 1 % each: more than 9 have a chance of 1e-4
    assert "unlike the others" not in str(summarise("fuse", fused(40)))


def test_a_drifting_weight_is_told():
    (drift, *_) = summarise("fuse", fused(40, drift=0.2)).trends
    assert drift.sensor == "s1"
    assert drift.last > drift.first
    assert drift.p_value < 1e-6
    assert drift.tau > 0.5


def test_a_noisy_sensor_and_a_strange_log_are_told():
    rows = fused(30)
    for row in rows:
        row["relative_noise"][2] *= 3
    rows[7]["virtual_deviation"] = [5e-3] * 4
    rows[11]["gain"] = [4.0] * 4
    summary = summarise("fuse", rows)
    assert summary.noisy[0].sensor == "s3"
    assert summary.noisy[0].relative_noise == pytest.approx(4.2, rel=0.05)
    assert {o.log for o in summary.outliers} == {"log007.npz", "log011.npz"}
    assert summary.ranked[0][1]["log"] == "log011.npz"
    text = str(summary)
    assert "noisy: sensor s3" in text
    assert "unlike the others: log007.npz" in text


def test_gain_is_the_mean_over_known_averaging_times():
    assert mean_gain({"gain": [1.0, 4.0, None]}) == pytest.approx(2.0)
    assert np.isnan(mean_gain({"gain": [None]}))


def test_gain_counts_averaging_times_as_they_counted_for_the_weights():
    row = {"gain": [0.5, 4.0, None], "scale_weights": [0.0, 0.25, 0.75]}
    assert mean_gain(row) == pytest.approx(4.0)
    assert mean_gain(row | {"scale_weights": [0.6, 0.3, 0.1]}) == pytest.approx(1.0)
    assert np.isnan(mean_gain(row | {"scale_weights": [0.0, 0.0, 1.0]}))


def test_the_page_says_what_a_gain_is_and_what_was_asked():
    rows = fused(6)
    rows[2]["gain"] = [0.9] * 4
    settings = {"task": "fuse", "method": "shrinkage", "scale_weights": [0.5, 0.5]}
    page = fleet_report(summarise("fuse", rows), rows, title="Fleet", settings=settings)
    assert "6 logs, fused (method shrinkage, scale weights 0.5, 0.5)" in page
    assert "For 1 of 6 it is below one: worse than the plain mean." in page
    assert "which count as in the choice of the weights" in page
    assert "below 1 is worse than the plain mean" in str(summarise("fuse", rows))


def test_logs_that_moved_or_are_too_short_are_to_be_doubted():
    rows = fused(6)
    rows[1] |= {"axis": "x", "motion": "the sensors agree closely"}
    rows[4] |= {"motion": None, "enough": False, "warnings": ["Recording: too short"]}
    rows[5] |= {"motion": None, "enough": True, "warnings": ["of something else"]}
    summary = summarise("fuse", rows)
    assert [(d.log, d.axis, d.why) for d in summary.weight_warnings] == [
        ("log001.npz", "x", "the sensors agree closely"),
        ("log004.npz", None, "Recording: too short"),
    ]
    assert "weights to doubt: 2 logs\n  log001.npz axis x: the sensors agree closely\n  log004.npz: Rec" in str(summary)
    assert [doubt["log"] for doubt in summary.to_dict()["doubts"]] == ["log001.npz", "log004.npz"]
    page = fleet_report(summary, rows, title="Fleet")
    assert "<h2>Logs to doubt</h2>" in page
    assert "The weights of 2 logs are to be doubted" in page
    assert "No sensor, log or drift" not in page
    assert "No sensor, log or drift" in fleet_report(summarise("fuse", fused(6)), fused(6), title="Fleet")


def test_the_ranking_shows_axes_where_any_log_has_them():
    rows = fused(3)
    rows[2] |= {"axis": "z", "gain": [1.01] * 4}  # the last
    assert '<td class="text">axis z</td>' in fleet_report(summarise("fuse", rows), rows, title="Fleet")


def test_no_sensor_is_drawn_like_the_plain_mean():
    from gyrofuse.fleet.plots import plot_weights_over_logs

    *sensors, mean = plot_weights_over_logs(np.full((9, 8), 0.125), names="abcdefgh").get_lines()[1:]
    assert len({line.get_color() for line in sensors} | {mean.get_color()}) == 9


def test_logs_of_one_name_in_several_folders_are_several():
    rows = [
        {"log": "a.npz", "path": f"/{i}/a.npz", "status": "failed", "error": "empty", "axis": None} for i in range(3)
    ]
    summary = summarise("fuse", rows)
    assert (summary.n_logs, len(summary.failures)) == (3, 3)


def test_failures_are_counted_and_explained():
    rows = [*fused(3), {"log": "bad.npz", "status": "failed", "error": "empty file", "axis": None}]
    summary = summarise("fuse", rows)
    assert (summary.n_logs, summary.failures) == (4, (("bad.npz", "empty file"),))
    assert "failed: bad.npz: empty file" in str(summary)
    nothing = summarise("fuse", rows[3:])
    assert "1 logs, 1 failed" in str(nothing)
    assert "empty file" in fleet_report(nothing, rows[3:], title="Fleet")


def test_the_page_tells_what_stands_out_and_stays_text():
    rows = [*fused(12, drift=0.3), {"log": "<b>bad</b>.npz", "status": "failed", "error": "empty", "axis": None}]
    page = fleet_report(summarise("fuse", rows), rows, title="Fleet of <i>mine</i>")
    assert "&lt;b&gt;bad&lt;/b&gt;.npz" in page
    assert "<i>mine" not in page
    assert "The weight of sensor s1" in page
    assert page.count("<img") == 2  # weights over time, spread of gains
    assert "log000.npz" in page


def test_pages_of_fits_and_diagnoses():
    fits = [
        {"log": f"{i}", "axis": None, "sensor": "1", "status": "ok", "error": None, "sensors": ["1"], "p_value": p}
        | {"parameters": ["white_noise.variance"], "values": [2.5]}
        for i, p in enumerate([0.5, 0.001, None])
    ]
    summary = summarise("fit", fits)
    assert [row["log"] for _, row in summary.ranked] == ["1", "0", "2"]
    assert "1 of 3 fits refused" in str(summary)
    assert "white_noise.variance 2.5" in fleet_report(summary, fits, title="Fits")
    fits[2] |= {"identified": False, "remarks": ["two processes are one"]}
    fits[0] |= {"identified": True, "quantities": ["angle random walk N"], "figures": [0.3]}
    fits[0] |= {"figure_units": ["deg/sqrt(h)"]}
    summary = summarise("fit", fits)
    assert "1 of 3 fits have parameters that cannot be told apart" in str(summary)
    page = fleet_report(summary, fits, title="Fits", settings={"model": "WN"})
    assert "1 of 3 fits have parameters that cannot be told apart." in page
    assert "white_noise.variance 2.5; not identified; two processes are one" in page
    assert "white_noise.variance 2.5; angle random walk N 0.3 deg/sqrt(h)" in page
    assert "fitted (model WN)" in page
    found = [
        {"log": "a", "axis": None, "status": "ok", "error": None, "sensors": ["1"], "p_value": 1e-9, "mismatch": True}
        | {"mechanisms": ["vibration_tone"], "sentences": ["a tone at 12.5 Hz"], "unexplained": ["jumps"]},
        {"log": "b", "axis": None, "status": "ok", "error": None, "sensors": ["1"], "p_value": 0.4, "mismatch": False}
        | {"mechanisms": [], "sentences": [], "unexplained": []},
    ]
    summary = summarise("diagnose", found)
    assert dict(summary.mechanisms) == {"vibration_tone": 1, "unexplained": 1}
    assert "1 of 2 differ" in str(summary)
    page = fleet_report(summary, found, title="Diagnoses")
    assert "a tone at 12.5 Hz; unexplained: jumps" in page
    assert "agrees" in page


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Standing", "FleetSummary"),
        ("Drift", "WeightTrend"),
        ("Doubt", "WeightWarning"),
        ("standing_of", "summarise"),
    ],
)
def test_old_names_work_with_a_warning(old: str, new: str):
    with pytest.warns(DeprecationWarning, match=rf"gyrofuse.fleet.summary.{old} is deprecated .* use .*{new}"):
        assert getattr(fleet_summary, old) is getattr(fleet_summary, new)


def test_old_attributes_work_with_a_warning():
    found = summarise("fuse", fused(3))
    for old, new in (("drifts", "trends"), ("doubts", "weight_warnings"), ("n_doubted", "n_warned")):
        with pytest.warns(DeprecationWarning, match=f"FleetSummary.{old} is deprecated"):
            assert getattr(found, old) == getattr(found, new)
