"""What the README promises: two commands at its beginning, and Python that runs."""

import re
from pathlib import Path

import pytest
import torch

import gyrofuse as gf
from gyrofuse.fleet import read_results

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_begins_with_one_sentence_and_two_commands():
    first, second = (block.strip() for block in blocks("bash")[:2])
    assert first.startswith("pip install ")
    assert first.endswith("gyrofuse demo")
    assert second.startswith("pip install ")
    assert second.endswith("pytest -n auto")
    before = README[: README.index("```bash")].strip().splitlines()
    assert before[0] == "# gyrofuse"
    assert before[2].count(". ") == 0
    assert before[2].endswith(".")


def test_the_continuous_integration_runs_the_test_command_of_the_readme():
    script = (ROOT / ".ci" / "run").read_text()
    pattern = re.search(r"sed -n 's/\^\\\((.*?)\\\)\$", script)
    assert pattern
    lines = [line for line in README.splitlines() if re.fullmatch(pattern.group(1), line)]
    assert lines == [blocks("bash")[1].strip()]


def test_commands_of_the_command_line_exist():
    from typer.main import get_command

    from gyrofuse.cli.app import app

    known = get_command(app).commands
    named = set(re.findall(r"^gyrofuse (\w+)", "\n".join(blocks("bash")), re.MULTILINE))
    assert named
    assert named <= set(known)


def test_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    noise = gf.parse_model("WN(variance=1) + RW(variance=1e-4)")
    signal = noise.simulate(2000, batch=(4,), generator=torch.Generator().manual_seed(0))
    gf.Recording(signal, rate=100.0).save("array.npz")
    scope: dict = {}
    for block in blocks("python"):
        exec(block, scope)
    assert scope["weights"].sum().item() == pytest.approx(1)
    assert scope["virtual"].shape == (2000,)
    assert [finding.mechanism for finding in scope["report"].findings] == ["vibration_tone"]
    assert scope["report"].findings[0].frequency_hz == pytest.approx(12.5, abs=1e-3)
    assert scope["repaired"].shape == (10, 3, 20_000)
    assert scope["clean"].sensors == scope["recording"].sensors
    assert Path("mismatch.html").stat().st_size > 0
    assert read_results("fleet.parquet")[1][0]["status"] == "ok"
    told = str(scope["ranked"])
    assert scope["ranked"].names == ("WN + AR1 + SIN",) * 3
    for words in ("criterion", "redundant: AR1 2 is white noise", "not told from it: 2*AR1 + SIN"):
        assert words in told
