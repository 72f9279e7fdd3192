"""Reports in a browser: figures are drawn, the console stays silent, names with markup stay text."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch

from gyrofuse import Recording, WhiteNoise, diagnose, fit_gmwm, fit_multiscale, fit_svo, rank_models
from gyrofuse.fitting.report.page import model_report
from gyrofuse.fitting.report.ranking import rank_report
from gyrofuse.fleet import Fuse
from gyrofuse.fleet.report import fleet_report
from gyrofuse.fleet.run import Log, rows_of
from gyrofuse.fleet.summary import summarise
from gyrofuse.fusion.report.page import fusion_report, recording_report
from gyrofuse.mismatch.reporting.page import mismatch_page

NAMES = ("chromium", "chromium-browser", "google-chrome")
HOSTILE = ('"><script>alert(1)</script>', "<b>imu</b>", "<img src=x onerror=alert(2)>", "{{ 7 * 7 }}")
DARK = ("--window-size=500,900", "--blink-settings=preferredColorScheme=0")  # a phone that asks for it
PROBE = """<script>
addEventListener("load", () => {
  const root = document.scrollingElement;
  document.title = JSON.stringify({
    images: [...document.images].map(i => [i.complete, i.naturalWidth, i.naturalHeight, i.width]),
    tags: [...document.querySelectorAll("*")].map(e => e.tagName),
    text: document.body.innerText,
    overflow: root.scrollWidth - root.clientWidth,
    hidden: [...document.querySelectorAll(".scroll:has(.stacked)")].map(e => e.scrollWidth - e.clientWidth),
    colours: [getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color],
  });
});
</script>"""


class Seen(NamedTuple):
    """What the browser made of a page."""

    dom: str
    console: list[str]


class Browser:
    """A browser without a window, with a fresh profile for every page."""

    def __init__(self, program: str, folder: Path) -> None:
        self.program, self.folder = program, folder
        self.measured: dict[tuple[Path, tuple[str, ...]], dict[str, Any]] = {}

    def open(self, page: Path, *options: str) -> Seen:
        """Load a page and return the document it became and what its console said."""
        profile = self.folder / "profile"
        quiet = "no-sandbox disable-gpu disable-quic no-first-run disable-background-networking"
        quiet += " disable-component-update disable-sync disable-dev-shm-usage"
        command = [self.program, "--headless", *(f"--{option}" for option in quiet.split())]
        command += [f"--user-data-dir={profile}", "--enable-logging=stderr", "--v=0", "--virtual-time-budget=10000"]
        command += [*options, "--dump-dom", page.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        shutil.rmtree(profile, ignore_errors=True)
        return Seen(done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line])

    def measure(self, page: Path, *options: str) -> dict[str, Any]:
        """Let a script look at a copy of a page that allows one; at most once with the same options."""
        if (page, options) in self.measured:
            return self.measured[page, options]
        html = re.sub("<meta http-equiv=.*?>", "", page.read_text(encoding="utf-8"))
        probed = self.folder / "probed.html"
        probed.write_text(html.replace("</body>", PROBE + "</body>"), encoding="utf-8")
        title = re.search("<title>(.*?)</title>", self.open(probed, *options).dom, re.DOTALL)
        assert title is not None
        self.measured[page, options] = json.loads(unescape(title.group(1)))
        return self.measured[page, options]


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Browser:
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        (pytest.fail if "CI" in os.environ else pytest.skip)(f"needs a browser: one of {', '.join(NAMES)}")
    return Browser(program, tmp_path_factory.mktemp("browser"))


@pytest.fixture(scope="module")
def recording() -> Recording:
    noise = torch.randn(3, 4, 5000, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return Recording(noise, rate=100.0, unit="deg/s", sensors=HOSTILE, axes=("x", "y", "z"))


@pytest.fixture(
    scope="module", params=["fusion", "axes", "multiscale", "recording", "fit", "rank", "mismatch", "fleet"]
)
def page(request: pytest.FixtureRequest, recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    if request.param == "axes":
        result = fit_svo(recording, "long")
        html = fusion_report(result, recording, result.virtual(recording), title=HOSTILE[0], remarks=[HOSTILE[1]])
    elif request.param == "multiscale":
        bands = fit_multiscale(recording, "long")
        html = fusion_report(bands, recording, bands.virtual(recording), title=HOSTILE[0])
    elif request.param == "fit":
        axis = recording.select(axis="x")
        html = model_report(fit_gmwm(axis, "WN + QN + AR1 + RW"), axis, title=HOSTILE[0])
    elif request.param == "rank":
        axis = recording.select(axis="x")
        ranked = rank_models(axis, ["WN", "WN + RW", "WN + QN + AR1 + RW"])
        html = rank_report(ranked, axis, title=HOSTILE[0], remarks=[HOSTILE[1]])
    elif request.param == "mismatch":
        axis = recording.select(axis="x")
        turns = 0.9 * torch.arange(axis.n_samples, dtype=torch.float64)
        report = diagnose(replace(axis, signal=axis.signal + 0.5 * turns.cos()), WhiteNoise(1.0))
        assert report.findings
        html = mismatch_page(report, title=HOSTILE[0], remarks=[HOSTILE[1]])
    elif request.param == "fleet":
        logs = [Log(f"{HOSTILE[i % 4]}{i}", recording.select(axis="xyz"[i % 3])) for i in range(10)]
        rows = rows_of(Fuse("long"), [*logs, Log("gone.npz", None, "no such file")])
        html = fleet_report(summarise("fuse", rows), rows, title=HOSTILE[0])
    elif request.param == "fusion":
        html = fusion_report(fit_svo(recording.select(axis="x"), "long"), title=HOSTILE[2])
    else:
        html = recording_report(recording, title=HOSTILE[0])
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(html, encoding="utf-8")
    return path


def test_the_console_is_heard(browser: Browser, tmp_path: Path):
    page = tmp_path / "page.html"
    page.write_text("<script>console.error('heard')</script><img src=missing.png>")
    assert "heard" in " ".join(browser.open(page).console)
    page.write_text('<meta http-equiv="Content-Security-Policy" content="default-src *"><script>alert(1)</script>')
    assert "Content Security Policy" in " ".join(browser.open(page).console)


def test_figures_are_drawn_and_the_console_is_silent(browser: Browser, page: Path):
    seen = browser.open(page)
    assert seen.console == []
    assert "</html>" in seen.dom
    measured = browser.measure(page)
    n_figures = page.read_text(encoding="utf-8").count("<figure>")
    assert len(measured["images"]) == n_figures > 0
    for complete, width, height, shown in measured["images"]:
        assert complete
        assert min(width, height) > 100
        assert shown > 300


def test_markup_in_names_stays_text(browser: Browser, page: Path):
    measured = browser.measure(page)
    assert measured["tags"].count("SCRIPT") == 1  # the probe
    assert "B" not in measured["tags"]
    assert len(measured["images"]) == measured["tags"].count("FIGURE")
    for name in HOSTILE:
        assert name in measured["text"]


def test_fits_a_phone(browser: Browser, page: Path):
    for options in (("--window-size=420,900",), DARK):
        measured = browser.measure(page, *options)
        assert measured["overflow"] <= 0
        assert all(hidden <= 0 for hidden in measured["hidden"])  # stacked tables show all they say


def test_light_and_dark(browser: Browser, page: Path):
    """Dark ink on a light page, and the other way round where the reader prefers it."""
    light, dark = (
        [sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in measured["colours"]]
        for measured in (browser.measure(page), browser.measure(page, *DARK))
    )
    assert light[0] > 700 > 150 > light[1]
    assert dark[0] < 150 < 600 < dark[1]
