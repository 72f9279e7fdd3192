"""What README and guides promise: two commands at the beginning, Python that runs, options and files that exist."""

import math
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import gyrofuse as gf
from gyrofuse.fleet import read_results

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs" / "guide").glob("*.md"))]
DOCUMENTS = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/*.md")]


def blocks(language: str, path: Path = README) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", path.read_text(), re.DOTALL)


def write_recordings() -> None:
    """Files that pages read: an array, a single IMU, a measured and a simulated array that differ by a tone."""
    generator = torch.Generator().manual_seed(0)
    noise = gf.parse_model("WN(variance=1) + RW(variance=1e-4)")
    array = noise.simulate(2000, batch=(4,), generator=generator)
    gf.Recording(array, rate=100.0, unit="deg/s").save("array.npz")
    imu = noise.simulate(2000, batch=(3, 1), generator=generator)
    gf.Recording(imu, rate=100.0, unit="deg/s", sensors=("imu",), axes=("x", "y", "z")).save("imu.npz")
    measured, simulated = noise.simulate(4096, batch=(2, 3), generator=generator)
    tone = 0.3 * torch.sin(2 * math.pi * 12.5 * torch.arange(4096) / 100)
    gf.Recording(measured + tone, rate=100.0, unit="deg/s").save("measured.npz")
    gf.Recording(simulated, rate=100.0, unit="deg/s").save("simulated.npz")


def check_readme(scope: dict) -> None:
    assert scope["virtual"].shape == (2000,)
    assert scope["fit"].params.shape == (3, 1, 4)
    assert "gyroscope_noise_density" in scope["yaml"]
    assert [finding.mechanism for finding in scope["report"].findings] == ["vibration_tone"]
    assert Path("mismatch.html").stat().st_size > 0


def check_fusing(scope: dict) -> None:
    assert scope["weights"].sum().item() == pytest.approx(1)
    assert scope["virtual"].shape == (2000,)


def check_noise_models(scope: dict) -> None:
    assert scope["fit"].params.shape == (3, 5)
    assert "noise_density" in scope["yaml"]


def check_ranking(scope: dict) -> None:
    told = str(scope["ranked"])
    assert scope["ranked"].names == ("WN + AR1 + SIN",) * 3
    for words in ("criterion", "redundant: AR1 2 is white noise", "equivalent: 2*AR1 + SIN"):
        assert words in told


def check_diagnosis(scope: dict) -> None:
    assert [finding.mechanism for finding in scope["report"].findings] == ["vibration_tone"]
    assert scope["report"].findings[0].frequency_hz == pytest.approx(12.5, abs=1e-3)
    assert scope["repaired"].shape == (10, 3, 20_000)
    assert scope["clean"].sensors == scope["recording"].sensors
    assert Path("mismatch.html").stat().st_size > 0


def check_fleets(scope: dict) -> None:
    assert read_results("fleet.parquet")[1][0]["status"] == "ok"


CHECKS: dict[str, Callable[[dict], None]] = {
    "README": check_readme,
    "fusing": check_fusing,
    "noise-models": check_noise_models,
    "ranking": check_ranking,
    "diagnosis": check_diagnosis,
    "fleets": check_fleets,
}


def test_begins_with_one_sentence_and_two_commands():
    first, second = (block.strip() for block in blocks("bash")[:2])
    assert first.startswith("pip install ")
    assert first.endswith("gyrofuse demo")
    assert second.startswith("pip install ")
    assert second.endswith("pytest -n auto")
    text = README.read_text()
    before = text[: text.index("```bash")].strip().splitlines()
    assert before[0] == "# gyrofuse"
    assert before[2].count(". ") == 0
    assert before[2].endswith(".")


def test_readme_is_short():
    assert len(README.read_text().splitlines()) <= 120


def test_the_continuous_integration_runs_the_test_command_of_the_readme():
    script = (ROOT / ".ci" / "run").read_text()
    pattern = re.search(r"sed -n 's/\^\\\((.*?)\\\)\$", script)
    assert pattern
    lines = [line for line in README.read_text().splitlines() if re.fullmatch(pattern.group(1), line)]
    assert lines == [blocks("bash")[1].strip()]


def test_commands_of_the_command_line_exist_with_their_options():
    from typer.main import get_command

    from gyrofuse.cli.app import app

    known = get_command(app).commands
    lines = [line for path in PAGES for block in blocks("bash", path) for line in block.splitlines()]
    named = [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("gyrofuse ")]
    assert {name for name, *_ in named} == set(known)
    for name, *options in named:
        known[name].make_context(name, list(options))  # refuses what the command does not know


@pytest.mark.filterwarnings("error:.* is deprecated and goes with release:DeprecationWarning")
@pytest.mark.usefixtures("blank_images")
@pytest.mark.parametrize("path", [path for path in PAGES if blocks("python", path)], ids=lambda path: path.stem)
def test_python_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    write_recordings()
    scope: dict = {}
    for block in blocks("python", path):
        exec(block, scope)
    if path.stem in CHECKS:
        CHECKS[path.stem](scope)


def test_links_between_documents_lead_somewhere():
    for path in DOCUMENTS:
        for target in re.findall(r"(?:\]\(|src=\")([^)\"#\s]+)", path.read_text()):
            if "://" not in target:
                assert (path.parent / target).exists(), f"{path.relative_to(ROOT)} links to {target}"
