"""Imports point down only, and importing the package stays light."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "gyrofuse"

# From top to bottom; packages of one floor do not know each other.
FLOORS = [
    {"__main__"},
    {"cli"},
    {"__init__"},
    {"fleet"},
    {"export"},
    {"mismatch", "navigation"},
    {"fitting"},
    {"fusion"},
    {"wavelets", "noise"},
    {"io"},
    {"_base"},
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


def floor(package: str) -> int:
    """Floor of a package, counted from the top."""
    return next((i for i, packages in enumerate(FLOORS) if package in packages), -1)


@cache
def modules() -> dict[str, Path]:
    """Dotted name inside the package of every module, `io.ulog` say, with its file."""
    paths = sorted(PACKAGE.rglob("*.py"))
    return {".".join(path.relative_to(PACKAGE).with_suffix("").parts): path for path in paths}


@cache
def imports(name: str, path: Path) -> frozenset[str]:
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
    return frozenset(found - {name})


def package_of(module: str) -> str:
    return module.partition(".")[0]


@pytest.mark.parametrize("name", modules())
def test_imports_point_down(name):
    here = package_of(name)
    others = {other for other in imports(name, modules()[name]) if package_of(other) != here}
    up = sorted(other for other in others if 0 <= floor(package_of(other)) <= floor(here))
    assert not up, f"gyrofuse.{name} imports from above or beside: {up}"


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
