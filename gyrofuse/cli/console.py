"""Output of commands: results on stdout; progress, warnings and errors on stderr."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

_BAD_INPUT = (ValueError, TypeError, OSError, ImportError)


class Commands(TyperGroup):
    """Commands whose errors are one line, however they are started."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command; turn what goes wrong into a message and an exit status."""
        if ctx.params["debug"]:
            return super().invoke(ctx)
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _show_warning
                return super().invoke(ctx)
        except (typer.Exit, typer.Abort, BrokenPipeError):
            raise
        except Exception as error:
            if hasattr(error, "format_message"):  # typer's own, for wrong arguments
                _complain("error", f"{error.format_message()} (see {ctx.command_path} --help)")
            elif isinstance(error, OSError) and error.filename is not None:
                _complain("error", f"{error.filename}: {error.strerror}")
            elif isinstance(error, _BAD_INPUT):
                _complain("error", str(error))
            else:
                _complain("error", f"unexpected {type(error).__name__}: {error} (--debug shows where)")
                raise typer.Exit(1) from None
            raise typer.Exit(2) from None


@contextmanager
def _written() -> Iterator[None]:
    """Turn an error of writing to stdout into one that names it, and adds that the files of the command are there."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OSError(f"standard output: {error.strerror}; files that were asked for are written") from None


def say(text: str) -> None:
    """Print text to stdout, without the control characters that terminals act on."""
    with _written():
        print(_printable(text), flush=True)


def say_table(head: Sequence[str], rows: Sequence[Sequence[str]], right: Collection[int] = ()) -> None:
    """Print a table to stdout, as wide as it needs to be where it does not go to a screen.

    Args:
        head: Heading of each column; empty for a table without headings.
        rows: Cells of each row, as plain text.
        right: Indices of the columns that are aligned to the right.
    """
    table = Table(box=SIMPLE_HEAD if head else None, show_header=bool(head), pad_edge=False)
    for i in range(len(rows[0])):
        table.add_column(Text(_printable(head[i])) if head else "", justify="right" if i in right else "left")
    for row in rows:
        table.add_row(*(Text(_printable(cell)) for cell in row))
    with _written():
        Console(width=None if sys.stdout.isatty() else 10_000).print(table)


def progress(what: str) -> AbstractContextManager[Any]:
    """Show that an activity takes time, on a terminal only."""
    return Console(stderr=True).status(f"{what} ...")


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[str, float], None]]:
    """Show a progress bar, on a terminal only; yields the callback of the current step and the share done, 0 to 1."""
    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=1.0)

        def show(step: str, share: float) -> None:
            bar.update(task, completed=share, description=f"{what}: {step}")

        yield show


def warn(text: str) -> None:
    """Print a warning to stderr."""
    _complain("warning", text)


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    warn(str(message))


def _complain(kind: str, text: str) -> None:
    print(f"{kind}: {_printable(' '.join(text.split()))}", file=sys.stderr)


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)
