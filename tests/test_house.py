"""The house: which package may know which, how large folders and files are, and how light an import is."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import gyrofuse
from gyrofuse.noise.processes.base import Process

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
# The same inside `mismatch`.
FLOORS_OF_MISMATCH = [
    {"__init__"},
    {"several"},
    {"diagnose"},
    {"reporting"},
    {"repair"},
    {"selection"},
    {"mechanisms"},
    {"detectors"},
    {"likelihoods"},
    {"signals"},
    {"stats"},
    {"decisions"},
]
MOST_ENTRIES = 14  # of a folder, __init__.py and folders inside it included
MOST_LINES = 400  # of a file
MOST_NUMBERS = 200  # at module level, in all files but those of `mismatch`
MOST_NUMBERS_OF_MISMATCH = 354
MOST_SWITCHES = 5  # `isinstance` of a process outside `noise`
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


def floor(package: str, floors: Sequence[set[str]] = FLOORS) -> int:
    """Floor of a package, counted from the top; -1 of none."""
    return next((i for i, packages in enumerate(floors) if package in packages), -1)


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


@pytest.mark.parametrize("name", [name for name in modules() if name.startswith("mismatch.")])
def test_imports_inside_mismatch_point_down(name):
    here = floor(inside(name), FLOORS_OF_MISMATCH)
    assert here >= 0, f"gyrofuse.{name}: no floor of its own"
    others = {other for other in imports(name, modules()[name]) if other.startswith("mismatch.")}
    up = sorted(o for o in others if inside(o) != inside(name) and floor(inside(o), FLOORS_OF_MISMATCH) <= here)
    assert not up, f"gyrofuse.{name} imports from above: {up}"


def inside(module: str) -> str:
    """Package inside `mismatch`, of a dotted name."""
    return module.split(".")[1]


def measured(*, mismatch: bool | None = None) -> list[Path]:
    """Files of the library; all of them, or those of `mismatch`, or the others."""
    files = list(PACKAGE.rglob("*.py"))
    return [path for path in files if mismatch in (None, "mismatch" in path.relative_to(PACKAGE).parts)]


def test_folders_are_small():
    folders = [PACKAGE, *{path.parent for path in measured()}]
    sizes = {str(folder): sum(entry.name != "__pycache__" for entry in folder.iterdir()) for folder in folders}
    assert max(sizes.values()) <= MOST_ENTRIES, {name: size for name, size in sizes.items() if size > MOST_ENTRIES}


def test_files_are_short():
    lines = {str(path): len(path.read_text(encoding="utf-8").splitlines()) for path in measured()}
    assert max(lines.values()) <= MOST_LINES, {name: n for name, n in lines.items() if n > MOST_LINES}


def test_private_names_stay_in_their_files():
    found = [
        f"{path}: {alias.name} of {node.module}"
        for path in measured()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gyrofuse")
        for alias in node.names
        if alias.name.startswith("_") and alias.name not in ("_base", "__version__")
    ]
    assert not found


@pytest.mark.parametrize(("mismatch", "most"), [(False, MOST_NUMBERS), (True, MOST_NUMBERS_OF_MISMATCH)])
def test_numbers_of_modules_are_few(mismatch: bool, most: int):
    """Numbers assigned at module level: thresholds and sizes, each of which somebody has to understand."""
    count = sum(
        isinstance(leaf, ast.Constant) and isinstance(leaf.value, int | float) and not isinstance(leaf.value, bool)
        for path in measured(mismatch=mismatch)
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None
        for leaf in ast.walk(node.value)
    )
    assert count <= most


def test_mechanisms_declare_what_others_have_to_know():
    """The search, the repaired simulation and the report ask no mechanism for its class, and keep no global cache."""
    mechanisms = {
        node.name
        for path in (PACKAGE / "mismatch" / "mechanisms").rglob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    } - {"Mechanism"}
    asked, cached = [], []
    for path in measured(mismatch=True):
        if "mechanisms" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "isinstance" and len(node.args) == 2:
                if any(isinstance(leaf, ast.Name) and leaf.id in mechanisms for leaf in ast.walk(node.args[1])):
                    asked.append(f"{path}:{node.lineno}")
            elif isinstance(node, ast.Name) and node.id in ("WeakKeyDictionary", "WeakValueDictionary"):
                cached.append(f"{path}:{node.lineno}")
    assert not asked
    assert not cached


def test_processes_own_their_formulas():
    """Who asks what kind of process one is has a formula that belongs to the process."""
    kinds = {name for name in vars(gyrofuse) if is_process(getattr(gyrofuse, name))}
    assert "AR1" in kinds
    asked = [
        f"{path}:{node.lineno}"
        for path in measured()
        if "noise" not in path.relative_to(PACKAGE).parts
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "isinstance" and len(node.args) == 2
        if any(isinstance(leaf, ast.Name) and leaf.id in kinds for leaf in ast.walk(node.args[1]))
    ]
    assert len(asked) <= MOST_SWITCHES, asked


def is_process(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, Process) and value is not Process


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
    assert sorted(gyrofuse.__all__) == sorted(set(gyrofuse.__all__))
    for name in gyrofuse.__all__:
        assert getattr(gyrofuse, name).__doc__, f"{name} says nothing about itself"
    assert set(gyrofuse.__all__) <= set(dir(gyrofuse))
    with pytest.raises(AttributeError, match="module 'gyrofuse' has no attribute 'nothing'"):
        gyrofuse.nothing  # noqa: B018
