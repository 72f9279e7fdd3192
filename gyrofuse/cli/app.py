"""The command line: look into a log, fuse it, simulate an array, watch a demonstration.

Bad input ends with one line on stderr and exit status 2, a defect of the program with one line and status 1; with
`--debug` either shows its traceback. Files appear when everything has worked, or not at all.
"""

from __future__ import annotations

import atexit
import gc
import signal
import sys
import threading
from collections.abc import Sequence
from typing import Annotated

import typer

from gyrofuse.cli.console import Commands
from gyrofuse.cli.demo.demo import demo
from gyrofuse.cli.diagnose import diagnose
from gyrofuse.cli.emulate import emulate
from gyrofuse.cli.fit import fit
from gyrofuse.cli.fleet import fleet
from gyrofuse.cli.fuse import fuse
from gyrofuse.cli.info import info
from gyrofuse.cli.rank import rank
from gyrofuse.cli.simulate import simulate

app = typer.Typer(
    name="gyrofuse",
    cls=Commands,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _command in (info, fuse, fit, rank, diagnose, fleet, emulate, simulate, demo):
    app.command()(_command)


def _version(wanted: bool) -> None:
    if wanted:
        from gyrofuse import __version__

        try:
            print(f"gyrofuse {__version__}", flush=True)
        except OSError as error:
            print(f"error: standard output: {error.strerror}", file=sys.stderr)
            raise typer.Exit(2) from None
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and leave.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """One virtual gyro from an array of gyros: better than the mean, and it says where and by how much."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit status."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # names in logs may hold what the terminal cannot show
            stream.reconfigure(errors="replace")
    if threading.current_thread() is threading.main_thread():  # ended from outside: leave no draft behind
        for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):  # SIGHUP: the terminal is gone
            if signal.getsignal(number) != signal.SIG_IGN:  # as nohup asks
                signal.signal(number, lambda got, _: sys.exit(128 + got))
    atexit.register(gc.freeze)  # taking apart what was imported, before the process ends anyway, takes a second
    app(arguments)
