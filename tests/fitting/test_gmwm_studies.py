"""The studies of noise models with tones run, print their verdicts and draw their figures."""

from pathlib import Path

import pytest
from test_papers import is_png, row, run


def verdicts(text: str) -> dict[str, int]:
    """How many conclusions hold, and how many do not."""
    conclusions = " ".join(text.split("conclusions")[1].split())
    return {name: conclusions.count(f": {name}") for name in ("holds", "does not hold")}


@pytest.mark.statistical
@pytest.mark.parametrize(("number", "n_conclusions"), [(1, 6), (3, 4)])
def test_simulations(tmp_path: Path, number: int, n_conclusions: int):
    done = run("gmwm_simulations.py", "--simulation", number, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    figures = ("variances", "estimates", *(["rmse"] if number == 1 else []))
    assert all(is_png(tmp_path / f"gmwm_simulation{number}_{name}.png") for name in figures)
    assert sum(verdicts(done.stdout).values()) == n_conclusions
    last = done.stdout.split("The paper's conclusions")[0].split(" runs of ")[-1]
    # Truth, bound, then bias, theory, held, weak and RMSE of moments and refined
    cells = [float(cell) for cell in row(last, "sinusoid_1.amplitude")]
    assert cells[0] == (0.85 if number == 1 else 0.025)
    assert 0.5 < cells[3] < 2
    assert 0.5 < cells[8] < 2
    # [V] theorem 1 leaves out most of what makes amplitudes vary.
    assert "theorem 1" in done.stdout
    assert float(last.split("would be said to be ")[1].split()[0]) < 0.5


@pytest.mark.statistical
def test_simulation_2_of_a_length(tmp_path: Path):
    done = run("gmwm_simulations.py", "--simulation", 2, "--samples", 2**18, "--runs", 2, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_png(tmp_path / "gmwm_simulation2_estimates.png")
    assert "2 runs of 262144 samples, 17 levels" in done.stdout


def test_figures_go_to_a_new_folder(tmp_path: Path):
    done = run("gmwm_running_time.py", "--turns", 1, "--samples", 4096, "--out", "new/folder", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_png(tmp_path / "new" / "folder" / "gmwm_running_time.png")


def test_calibration_names_the_recordings_that_it_needs(tmp_path: Path):
    done = run("gmwm_calibration.py", cwd=tmp_path)
    assert done.returncode == 2
    assert "expected a folder with adis16405_rec1.npz" in done.stderr
    assert "broad_trials.npz; name it with --data FOLDER" in done.stderr


@pytest.mark.statistical
def test_running_time(tmp_path: Path):
    done = run("gmwm_running_time.py", "--turns", 1, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_png(tmp_path / "gmwm_running_time.png")
    assert len(row(done.stdout, "10000")) >= 11


@pytest.mark.statistical
def test_misspecification(tmp_path: Path):
    done = run("gmwm_misspecification.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_png(tmp_path / "gmwm_misspecification.png")
    truth, wrong, wrong_bias, _, wrong_held, right, *_ = row(done.stdout, "ar1_1.variance")
    assert float(truth) == pytest.approx(0.03559, rel=1e-3)
    assert float(wrong) > 2 * float(truth)
    assert float(wrong_bias.rstrip("%")) > 100
    assert float(wrong_held) == 0
    assert float(right) == pytest.approx(float(truth), rel=0.02)
    assert "J test without tones: rejects 100.0 %" in done.stdout


@pytest.mark.statistical
def test_likelihood(tmp_path: Path):
    done = run("gmwm_likelihood.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_png(tmp_path / "gmwm_likelihood.png")
    assert sum(verdicts(done.stdout).values()) == 6
    assert done.stdout.count("searches of the likelihood that failed: 0 of 3") == 2
    without, with_tone = done.stdout.split("CPU time")[:2]
    for part in (without, with_tone):
        ratios = [float(cell) for cell in row(part, "white_noise.variance")[-2:]]
        assert ratios == pytest.approx([1, 1], abs=0.5)


@pytest.mark.statistical
def test_calibration(shared: Path, tmp_path: Path):
    done = run("gmwm_calibration.py", "--data", shared / "data", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert all(is_png(tmp_path / f"gmwm_calibration_{name}.png") for name in ("adis16405", "broad"))
    assert sum(verdicts(done.stdout).values()) == 5
    assert "at 0.56" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((), "name it with --data FOLDER"), (("--data", "nowhere"), "nowhere: expected adis16405_rec1.npz")],
)
def test_calibration_says_which_recordings_it_lacks(tmp_path: Path, arguments: tuple[str, ...], message: str):
    done = run("gmwm_calibration.py", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr


@pytest.mark.statistical
def test_navigation_emulation(tmp_path: Path):
    done = run("navigation_emulation.py", "--quick", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_png(tmp_path / "navigation_flight.png")
    assert is_png(tmp_path / "navigation_ratio.png")
    truth, without, with_tones = (float(cell) for cell in row(done.stdout, "ar1_1.variance"))
    assert without > 1.5 * truth
    assert with_tones == pytest.approx(truth, rel=0.1)
    peak = float(done.stdout.split("positions of 1 to 1.5 m ")[1].split()[0])
    assert 0.9 < peak < 2
    assert sum(verdicts(done.stdout).values()) == 2
