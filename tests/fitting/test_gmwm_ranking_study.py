"""The study of rankings runs, tells what is identified, prints its table and draws its figure."""

from pathlib import Path

import pytest
from test_papers import is_png, row, run


@pytest.mark.statistical
def test_ranking(tmp_path: Path):
    done = run("gmwm_ranking.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_png(tmp_path / "gmwm_ranking.png")
    assert "Simulation 1: 20000 samples, 4 records of each composition" in done.stdout
    chosen, named, wvic, at_most = map(float, row(done.stdout, "WN", "+", "RW")[:4])
    assert at_most == pytest.approx(1, abs=1e-3)
    assert named >= chosen >= 0.5  # at 95 % fewer than 2 of 4 once in 2000 times
    assert 0 <= wvic <= 1
    assert float(row(done.stdout, "mean:", "chosen")[0]) >= 0.775  # of 36; fewer than 28 once in 18 000 times


@pytest.mark.statistical
def test_what_a_short_record_does_not_show(tmp_path: Path):
    done = run("gmwm_ranking.py", "--simulation", 3, "--samples", 4000, "--runs", 1, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # The slow AR1, a walk here, ends at a fifth of the white noise's standard deviation, the walk at an eightieth.
    lost = [line for line in done.stdout.splitlines() if "not identified" in line]
    assert len(lost) == 2
    assert all(line.startswith("WN + RW ") and line.endswith(("closest: WN", "closest: WN + DR")) for line in lost)
    assert row(done.stdout, "WN", "+", "SIN")[0] == "1.000"
