"""The studies of the papers run, print their verdicts and draw their figures."""

import subprocess
from pathlib import Path

import pytest
from scripts import run_script

PAPERS = Path(__file__).resolve().parents[1] / "examples" / "papers"


def run(name: str, *arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    return run_script(PAPERS / name, "--quick", *arguments, cwd=cwd)


def is_png(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000


def row(text: str, *start: str) -> list[str]:
    """Cells after the first words of the one line that begins with them."""
    (found,) = [line.split()[len(start) :] for line in text.splitlines() if tuple(line.split()[: len(start)]) == start]
    return found


@pytest.mark.statistical
def test_case1(tmp_path: Path):
    done = run("svo_case1.py", "--out", "figures", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert all(is_png(tmp_path / "figures" / f"svo_case1_{n}.png") for n in ("variances", "estimates", "weights"))
    table = done.stdout.split("Excess risk")[1].split("Weights, mean")[0]
    mean, median, new = (float(cell) for cell in row(table, "equal")[:3])
    assert mean == median == pytest.approx(307.54, abs=0.01)  # known: the true noise and equal weights
    assert new > 50
    short = [float(cell) for cell in row(table, "SVO", "short")]
    assert short[3] < 0.1  # short weights are all but the best for short times, and bad for long ones
    assert short[0] > 100
    assisted, long = (float(row(table, *name)[0]) for name in (("model-assisted",), ("SVO", "long")))
    assert 0 < assisted < long
    conclusions = " ".join(done.stdout.split("conclusions")[1].split())
    assert conclusions.count(": holds") == 5
    assert "does not hold" not in conclusions
    # Estimates of the white noise of virtual signals agree with c'Rc.
    estimate, *_, truth = row(done.stdout.split("sigma^2  in truth")[1].split("conclusions")[0], "equal")[:4]
    assert float(estimate) == pytest.approx(float(truth), rel=0.02)


@pytest.mark.statistical
def test_case2(tmp_path: Path):
    done = run("svo_case2.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_png(tmp_path / "svo_case2_variances.png")
    assert is_png(tmp_path / "svo_case2_weights.png")
    table = done.stdout.split("Excess risk")[1].split("Weights, mean")[0]
    assert float(row(table, "equal")[0]) == pytest.approx(81.16, abs=0.01)
    assert float(row(table, "SVO", "long")[0]) < 30
    assert float(row(table, "RDVG")[0]) > 100  # its model is wrong here
    conclusions = " ".join(done.stdout.split("What the paper reads")[1].split())
    assert conclusions.count(": holds") == 4
    assert "does not hold" not in conclusions


@pytest.mark.statistical
def test_coverage(tmp_path: Path):
    done = run("svo_coverage.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_png(tmp_path / "svo_coverage_4096.png")
    studies = done.stdout.split(", 30 arrays of 4096 samples")
    assert [text.splitlines()[-1] for text in studies[:-1]] == [
        "Case 1",
        "Case 2",
        "Case 1, Laplace",
        "Case 1 and tone",
    ]
    for study in studies[1:]:
        for scale in ("short", "long"):
            model = [float(cell) for cell in row(study, scale, "model")[:7]]
            bootstrap = [float(cell) for cell in row(study, scale, "block", "bootstrap")[:7]]
            # 21 or fewer of 30 intervals of 95 % hold the truth once in 94 000 times; there are 88 such counts here.
            assert min(model) > 100 * 21 / 30
            assert bootstrap[-1] < model[-1]  # trimmed to the coefficients of the last level, it is too short
        for level in range(1, 11):
            assert float(row(study.split("by level")[1], str(level))[1]) > 100 * 21 / 30


@pytest.mark.statistical
def test_case_study(shared: Path, tmp_path: Path):
    done = run("svo_case_study.py", "--data", shared / "data", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    figures = [f"svo_case_study_{name}.png" for name in ("adis16405", "mimu4444", "xsens", "weights")]
    assert all(is_png(tmp_path / name) for name in figures)
    for name in ("ADIS16405: 18 sensors", "MIMU4444: 8 sensors", "Xsens DOT: 10 sensors"):
        assert name in done.stdout


def test_case_study_says_which_recordings_it_lacks(tmp_path: Path):
    done = run("svo_case_study.py", "--data", "nowhere", cwd=tmp_path)
    assert done.returncode == 2
    assert "nowhere: expected adis16405_rec1.npz" in done.stderr
    assert "--data FOLDER" in done.stderr
