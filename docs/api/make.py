"""Write the pages of the API: the public names of every package, with the first sentence of their docstrings.

    python docs/api/make.py

Names are those of `__all__`. A package without one lists the names of `gyrofuse` that come from its modules.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import gyrofuse

FOLDER = Path(__file__).parent


def packages() -> list[str]:
    """Public packages, in alphabetical order."""
    return [name for _, name, is_package in pkgutil.iter_modules(gyrofuse.__path__) if is_package and name[0] != "_"]


def first_sentence(value: object) -> str:
    """First paragraph of a docstring, cut after its first sentence, as one cell of a table."""
    paragraph = " ".join((inspect.getdoc(value) or "").split("\n\n")[0].split())
    return re.split(r"(?<=\.)\s", paragraph)[0].replace("|", "\\|")


def public_names(package: str) -> dict[str, object]:
    """What a package offers, by the name to import it by."""
    module = importlib.import_module(f"gyrofuse.{package}")
    own = {f"gyrofuse.{package}.{name}": getattr(module, name) for name in getattr(module, "__all__", ())}
    top = {f"gyrofuse.{name}": getattr(gyrofuse, name) for name in gyrofuse.__all__}
    from_here = {name: value for name, value in top.items() if value.__module__.startswith(f"gyrofuse.{package}")}
    values = list(from_here.values())
    return from_here | {name: value for name, value in own.items() if not any(value is other for other in values)}


def page_of(package: str) -> str:
    """Table of the public names of a package."""
    lines = [f"# gyrofuse.{package}", "", first_sentence(importlib.import_module(f"gyrofuse.{package}")), ""]
    lines += ["| name | what it is |", "|---|---|"]
    for name, value in sorted(public_names(package).items(), key=lambda item: item[0].lower()):
        kind = "class" if inspect.isclass(value) else "function"
        lines.append(f"| `{name}` | {kind}: {first_sentence(value)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write a page for each package with public names, and the list of pages."""
    index = ["# Public names", "", "| package | what it is for |", "|---|---|"]
    for package in packages():
        if not public_names(package):
            continue
        (FOLDER / f"{package}.md").write_text(page_of(package), encoding="utf-8")
        module = importlib.import_module(f"gyrofuse.{package}")
        index.append(f"| [gyrofuse.{package}]({package}.md) | {first_sentence(module)} |")
    index += ["", "Made by `python docs/api/make.py` from the docstrings."]
    (FOLDER / "index.md").write_text("\n".join(index) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
