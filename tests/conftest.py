"""The data beside the repository, the command line as a function, and threads and memory of the tests' processes."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import pytest

# Before torch is loaded: tests' matrices are small, and beside other tests a second thread only waits for the first.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from made_recordings import make_recordings
from matplotlib.figure import Figure

from gyrofuse._base import page
from gyrofuse.cli import app as cli

SHARED = Path(__file__).resolve().parents[2] / "shared"

# glibc gives large arrays back and asks for new ones, page by page: up to a third of all the time here. In this process
# (M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX of malloc.h), and in those that tests start.
_TRIM, _PAD, _MAPPED = 2**31 - 1, 2**26, 0
if hasattr(ctypes.pythonapi, "mallopt"):
    for option, value in ((-1, _TRIM), (-2, _PAD), (-4, _MAPPED)):
        ctypes.pythonapi.mallopt(option, value)
os.environ |= {"MALLOC_TRIM_THRESHOLD_": str(_TRIM), "MALLOC_TOP_PAD_": str(_PAD), "MALLOC_MMAP_MAX_": str(_MAPPED)}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--full", action="store_true", help="studies over drawn records at their full size: hours")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Studies come first: at the end of a run short tests keep all processes busy."""
    items.sort(key=lambda item: item.get_closest_marker("statistical") is None)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Neighbours, which share what they compute, run in one process until another one has nothing left to do."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)


Draws = Callable[[int, int], int]


@pytest.fixture(scope="session")
def draws(pytestconfig: pytest.Config) -> Draws:
    """The number of records of a study, by default and with `--full`."""
    return lambda few, many: many if pytestconfig.getoption("full") else few


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder `shared` beside the repository, with the public recordings in `data`."""
    if not SHARED.is_dir():
        pytest.skip("needs the public recordings of the folder `shared` beside the repository")
    return SHARED


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of small recordings in the layout of the public ones."""
    folder = tmp_path_factory.mktemp("made")
    make_recordings(folder)
    return folder


@pytest.fixture(params=["made", "recorded"])
def data(request: pytest.FixtureRequest) -> Path:
    """A folder of recordings: small ones that are made here, then the public ones."""
    return request.getfixturevalue("made") if request.param == "made" else request.getfixturevalue("shared") / "data"


class Outcome(NamedTuple):
    """How a command ended."""

    status: int
    out: str
    err: str


Run = Callable[..., Outcome]


@pytest.fixture
def blank_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images of pages are drawn but not rendered, half the time of a page; cli/test_browser.py renders every kind."""
    rendered = page.save_figure

    def save(figure: Figure, file: Path | BytesIO, *arguments: str, **options: Any) -> None:
        if isinstance(file, BytesIO):
            file.write(b"<svg/>")
        else:
            rendered(figure, file, *arguments, **options)

    monkeypatch.setattr(page, "save_figure", save)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, blank_images: None) -> Run:
    """Run a command in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: object) -> Outcome:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main([str(argument) for argument in arguments])
        status = ended.value.code
        return Outcome(status if isinstance(status, int) else 0 if status is None else 1, *capsys.readouterr())

    return run
