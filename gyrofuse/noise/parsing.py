"""Models from text and from dictionaries."""

from __future__ import annotations

import ast
import difflib
from collections.abc import Mapping
from typing import Any

import torch

from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.estimation import EstimatedFrom
from gyrofuse.noise.processes import PROCESSES, Model, Process

_SPELLINGS: dict[str, type[Any]] = {
    name: kind for kind in PROCESSES for name in (kind.__name__.lower(), kind.symbol.lower(), kind.key, *kind.spellings)
}
_LONGEST = 1000  # characters of a formula: far more than any model takes, and what a parser can nest
_MOST = 50  # processes of a model: ten times what any recording determines
_KNOWN = ", ".join(f"{kind.symbol} ({kind.__name__})" for kind in PROCESSES)


def parse_model(formula: str) -> Model:
    """Read a model such as `"WN + 2*AR1 + RW + SIN"` or `"WN(variance=1e-4) + AR1(phi=0.99, variance=1e-6)"`.

    Names are WN, QN, AR1 (or GM, Gauss-Markov), GM2 (Matern 3/2), RW, FN, DR, SIN or the full names of the
    processes, in either case. What `str` prints of a model with scalar parameters is read back exactly.

    Raises:
        ValueError: Not a formula, one of more than 1000 characters or 50 processes, an unknown name or parameter, a
            value outside its domain, or a repetition of a process that may appear once.
    """
    if len(formula) > _LONGEST:
        raise ValueError(f"`formula`: expected at most {_LONGEST} characters, got {len(formula)}; add fewer processes")
    text = " ".join(formula.split())
    try:
        tree = ast.parse(text, mode="eval").body
        return _read(tree, text)
    except (RecursionError, MemoryError):
        raise ValueError("`formula`: expected processes joined by +, got brackets or signs nested too deeply") from None
    except SyntaxError as error:
        position = error.offset or len(text)
        raise ValueError(
            f"`formula`: cannot read {text!r} near character {position}; "
            'expected processes joined by +, such as "WN + 2*AR1 + RW"'
        ) from None


def _read(node: ast.expr, text: str) -> Model:
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = _read(node.left, text), _read(node.right, text)
        _check_count(len(left.processes) + len(right.processes), node, text)
        return left + right
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
        times = _number(node.left, text)
        if not isinstance(times, int) or times < 1:
            raise _error(node.left, text, f"expected a whole number >= 1, got {times!r}")
        right = _read(node.right, text)
        _check_count(times * len(right.processes), node, text)
        return times * right
    if isinstance(node, ast.Name):
        return _kind(node, text)()
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return _process(node.func, node, text)
    raise _error(node, text, f"expected processes joined by +, got {ast.unparse(node)!r}; known: {_KNOWN}")


def _check_count(count: int, node: ast.expr, text: str) -> None:
    if count > _MOST:
        raise _error(node, text, f"expected at most {_MOST} processes, got {count}")


def _process(name: ast.Name, call: ast.Call, text: str) -> Process:
    kind = _kind(name, text)
    names = tuple(kind().parameters)
    for node in call.args:
        raise _error(node, text, f"expected `name=number` in {kind.__name__}({', '.join(names)})")
    for keyword in call.keywords:
        if keyword.arg not in names:
            raise _error(
                keyword.value,
                text,
                f"{kind.__name__} has no parameter `{keyword.arg}`; known: {', '.join(names)}",
            )
    return kind(**{str(keyword.arg): _number(keyword.value, text) for keyword in call.keywords})


def _kind(node: ast.Name, text: str) -> type[Any]:
    kind = _SPELLINGS.get(node.id.lower())
    if kind is None:
        raise _error(node, text, _unknown(node.id))
    return kind


def _unknown(name: object) -> str:
    """What is wrong with the name of a process, and what it may stand for."""
    text = str(name).lower()
    cutoff = 0.6 if len(text) > 2 else 0.5  # one letter of two
    close = difflib.get_close_matches(text, _SPELLINGS, n=1, cutoff=cutoff)
    hint = f"did you mean {_SPELLINGS[close[0]].symbol}? " if close else ""
    return f"unknown process {name!r}; {hint}known: {_KNOWN}"


def _number(node: ast.expr, text: str) -> Any:
    try:
        value = ast.literal_eval(node)
        float(value)
    except (ValueError, TypeError, OverflowError):  # such as an unhashable key, or digits beyond any float
        value = None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _error(node, text, f"expected a number, got {ast.unparse(node)!r}")
    return value


def _error(node: ast.expr, text: str, message: str) -> ValueError:
    return ValueError(f"`formula`: at character {node.col_offset + 1} of {text!r}: {message}")


def model_from_dict(description: Mapping[str, Any]) -> Model | ArrayModel:
    """Rebuild the `Model` or `ArrayModel` whose `to_dict` gave `description`.

    Raises:
        ValueError: Missing or unknown entries, or a value outside its domain.
    """
    record = EstimatedFrom.from_dict(description.get("estimated_from"))
    if "components" in description:
        return ArrayModel([_component(entry) for entry in _entries(description, "components")], estimated_from=record)
    if "processes" not in description:
        raise ValueError(
            "`description`: expected the entry 'processes' of a model or 'components' of an array, "
            f"got {sorted(description)}"
        )
    return Model([_process_from_dict(entry) for entry in _entries(description, "processes")], estimated_from=record)


def _entries(description: Mapping[str, Any], name: str) -> list[Any]:
    """A list of dictionaries."""
    entries = description[name]
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise ValueError(f"`description`: expected '{name}' to be a list of dictionaries, got {str(entries)[:80]!r}")
    return entries


def _component(entry: Mapping[str, Any]) -> tuple[Process, Any]:
    matrix = entry.get("covariance", entry.get("gains"))
    if matrix is None or len(entry.get("processes", ())) != 1:
        raise ValueError(
            f"`description`: expected one process with a 'covariance' or 'gains' in every component, got {entry!r}"
        )
    return _process_from_dict(entry["processes"][0]), matrix


def _process_from_dict(entry: Mapping[str, Any]) -> Process:
    values = dict(entry)
    name = values.pop("process", None)
    kind = _SPELLINGS.get(str(name).lower())
    if kind is None:
        raise ValueError(f"`description`: in {entry!r}: {_unknown(name)}")
    unknown = sorted(set(values) - set(kind().parameters))
    if unknown:
        raise ValueError(
            f"`description`: {kind.__name__} has no parameter {', '.join(unknown)}; "
            f"known: {', '.join(kind().parameters)}"
        )
    return kind(**{parameter: _value(parameter, value) for parameter, value in values.items()})


def _value(parameter: str, value: Any) -> Any:
    """A number, a batch of numbers, or nothing where it is to be estimated."""
    if value is None:
        return None
    try:
        return torch.tensor(value, dtype=torch.float64) if isinstance(value, list) else value + 0.0
    except (TypeError, ValueError, OverflowError, RuntimeError):
        given = str(value)
        raise ValueError(
            f"`description`: expected a number for {parameter}, or a list of them, got "
            f"{given if len(given) < 80 else given[:80] + '...'}"
        ) from None
