"""What all report pages are made with: numbers, figures that need no file, and templates."""

from __future__ import annotations

import base64
import io
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from gyrofuse._base import __version__, axes
from gyrofuse._base.results import p_words

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def number(value: float | None, digits: int = 4) -> str:
    """Write a number with so many significant digits, `-` when it is missing."""
    if value is None or not math.isfinite(value):
        return "-"
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:.{digits}g}" if not 1e-3 <= abs(rounded) < 1e7 else f"{rounded:.10g}"


def new_figure(width: float, height: float) -> Figure:
    """A figure of so many inches that pyplot does not know."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def save_figure(figure: Figure, file: Path | IO[bytes], file_format: str, **options: Any) -> None:
    """Save a figure.

    Args:
        figure: The figure.
        file: Where to write.
        file_format: `"png"`, `"svg"` or `"pdf"`.
        **options: As for `Figure.savefig`.
    """
    with warnings.catch_warnings():
        # A name in a script that the font lacks is drawn as boxes, which shows by itself.
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        figure.savefig(file, format=file_format, **{"dpi": 200, **options})


def image(width: float, height: float, draw: Callable[..., None], *arguments: Any, **options: Any) -> str:
    """Draw a figure as the source of an `img`: a picture that cannot run anything, whatever its labels say.

    Args:
        width: Inches.
        height: Inches.
        draw: Draws into the figure, its first argument.
        *arguments: Further arguments of `draw`.
        **options: And by name.
    """
    figure = new_figure(width, height)
    draw(figure, *arguments, **options)
    file = io.BytesIO()
    save_figure(figure, file, "svg", transparent=True)
    return "data:image/svg+xml;base64," + base64.b64encode(file.getvalue()).decode()


def render(template: Path, **context: Any) -> str:
    """Fill in a template; what it is given stays text, whatever markup it holds.

    Args:
        template: The file; it may use others beside it, and the `base` and `parts` beside this module.
        **context: What the template asks for, all of it.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([template.parent, Path(__file__).parent]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    environment.filters["p_words"] = p_words
    environment.filters["with_unit"] = axes.with_unit
    environment.filters["scientific"] = lambda value: f"{value:.3e}" if math.isfinite(value) else "-"
    environment.filters["fixed"] = lambda value: f"{value:.4f}" if math.isfinite(value) else "-"
    environment.filters["signed"] = lambda value: f"{value:+.4f}" if math.isfinite(value) else "-"
    page = environment.get_template(template.name).render(version=__version__, **context)
    # Names of files and sensors may hold bytes that are no text: they are written out.
    return page.encode("utf-8", "backslashreplace").decode()
