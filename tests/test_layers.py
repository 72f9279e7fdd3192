"""Imports point down only, and importing the package stays light."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "gyrofuse"

# From top to bottom; modules of one layer may use each other, as long as nothing goes round in circles. A leading
# underscore puts a module at the bottom, unless it is named here. A name without a file is one to come.
LAYERS = [
    {
        "__main__",
        "cli",
        "cli_fleet",
        "cli_mismatch",
        "cli_models",
        "cli_navigation",
        "cli_reading",
        "cli_shared",
        "_console",
        "_preload",
        "fleet_run",
        "lightning_module",
    },
    {
        "demo",
        "demo_mismatch",
        "demo_models",
        "report",
        "report_words",
        "report_models",
        "report_ranking",
        "report_fleet",
        "model_words",
    },
    {"__init__"},
    {"fleet"},
    {"mismatch", "report_mismatch", "navigation"},
    {
        "svo",
        "svo_result",
        "svo_stream",
        "_virtual_gyro",
        "virtual_file",
        "multiscale",
        "multiscale_result",
        "virtual_noise",
        "live",
        "parity",
        "parity_result",
        "gmwm",
        "gmwm_result",
        "export",
        "joint",
        "array_gmwm",
        "array_gmwm_result",
        "moment_bootstrap",
        "ranking",
        "ranking_result",
        "_drift_sign",
        "_rank_table",
        "_rank_search",
        "_rank_spectra",
        "_rank_moments",
        "_rank_candidates",
        "_model_tones",
        "_white_kurtosis",
        "whittle",
    },
    {"parity_energy", "parity_reference", "fault_kinds"},
    {"fusion", "weights_spread", "cross_fitting", "hypotheses", "gain", "selection"},
    {"competitors", "rdvg", "assisted", "saturation"},
    {"svo_weights"},
    {
        "intervals",
        "influence",
        "parametric",
        "pilot",
        "moment_inference",
        "moment_fit",
        "continuous",
        "_moment_search",
        "_array_fit",
        "_array_inference",
        "_array_search",
        "_spectral_search",
        "moment_profile",
        "profile_surfaces",
        "moment_identity",
    },
    {
        "bootstrap",
        "series",
        "block_length",
        "scale_weights",
        "moment_covariance",
        "robust",
        "robust_covariance",
        "_records",
        "tones",
        "_composition",
        "_array_moments",
        "_cosine_bins",
    },
    {
        "covariance",
        "metric",
        "uncertainty",
        "simulate",
        "parsing",
        "datasheet",
        "state_space",
        "plotting_models",
        "plotting_mismatch",
        "plotting_fleet",
        "plotting_navigation",
        "report_page",
    },
    {"haar", "processes", "recording", "long_recording", "io"},
    {"units", "plotting"},
]
HEAVY = {
    "matplotlib",
    "lightning",
    "pytorch_lightning",
    "torchmetrics",
    "h5py",
    "pyarrow",
    "pyulog",
    "rosbags",
    "scipy",
    "typer",
    "rich",
    "jinja2",
}


def depth(part: str) -> int:
    """Layer of a module or folder of the package, counted from the top."""
    for i, layer in enumerate(LAYERS):
        if part in layer:
            return i
    assert part.startswith("_"), f"gyrofuse.{part} is in no layer: say in LAYERS of {Path(__file__).name} where"
    return len(LAYERS) - 1


def modules() -> dict[str, Path]:
    """Dotted name inside the package of every module, `io.ulog` say, with its file."""
    paths = sorted(PACKAGE.rglob("*.py"))
    return {".".join(path.relative_to(PACKAGE).with_suffix("").parts): path for path in paths}


def imports(name: str, path: Path) -> set[str]:
    """Modules of the package that a module imports, anywhere in it."""
    known, found = modules(), set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: import absolutely, as everywhere else"
            targets = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for target in targets:
            first, _, inside = target.partition(".")
            if first != "gyrofuse":
                continue
            # `from gyrofuse.a import b` means the module a.b, or else something in a.
            for candidate in (inside, f"{inside}.__init__".lstrip("."), inside.rpartition(".")[0] or "__init__"):
                if candidate in known:
                    found.add(candidate)
                    break
    return found - {name}


def test_every_module_has_a_layer():
    assert modules()
    for name in modules():
        depth(name.split(".")[0])


@pytest.mark.parametrize("name", modules())
def test_imports_point_down(name):
    here = depth(name.split(".")[0])
    up = [other for other in imports(name, modules()[name]) if depth(other.split(".")[0]) < here]
    assert not up, f"gyrofuse.{name} imports from above: {up}"


def test_imports_do_not_go_in_circles():
    graph = {name: imports(name, path) for name, path in modules().items()}
    try:
        tuple(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail("imports go in a circle: " + " -> ".join(error.args[1]))


def test_importing_the_package_loads_torch_and_numpy_only():
    script = f"import gyrofuse, sys; print(sorted({HEAVY!r} & set(sys.modules)))"
    path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(PACKAGE.parent)]))
    run = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "[]"
    assert run.stderr == ""


def test_public_names_exist_and_are_listed():
    import gyrofuse

    assert sorted(gyrofuse.__all__) == sorted(set(gyrofuse.__all__))
    for name in gyrofuse.__all__:
        assert getattr(gyrofuse, name).__doc__, f"{name} says nothing about itself"
    assert set(gyrofuse.__all__) <= set(dir(gyrofuse))
    with pytest.raises(AttributeError, match="module 'gyrofuse' has no attribute 'nothing'"):
        gyrofuse.nothing  # noqa: B018
