"""Reports: one HTML file with embedded images, for light and dark themes.

The only script is that of the comparison sliders. Without it, a page shows their first two
pictures.
"""

from __future__ import annotations

import base64
import io
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from lightsim.core.version import __version__
from lightsim.errors import InputError
from lightsim.profiling import ProfileRow

_TEMPLATE = "report.html.jinja"
COMPARED_PX = 960
"""Width of compared pictures: twice their width on a page, for screens of high resolution."""
# Greatest number of rows of a profile on a page.
_PROFILED = 30
Cell = str | int | float | None


@dataclass(frozen=True)
class Card:
    """One key figure: its name, its value with unit, and its meaning."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of cells under column names; numbers are aligned right, None is a dash."""

    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""

    def __post_init__(self) -> None:
        wrong = [len(row) for row in self.rows if len(row) != len(self.columns)]
        if wrong:
            raise InputError(
                "a table row and the header differ in length",
                where=f"table '{self.caption}'",
                got=wrong[0],
                expected=len(self.columns),
            )


@dataclass(frozen=True, eq=False)
class Figure:
    """Image, 8-bit sRGB; `is_wide` extends it over the whole width of the page."""

    caption: str
    image: UInt8[np.ndarray, "h w 3"]
    is_wide: bool = False


@dataclass(frozen=True, eq=False)
class Comparison:
    """Pictures of one view under a movable divider: one picture left of it, another one right.

    Args:
        images: 8-bit sRGB pictures of one size, by the name that the page shows; at least two. The
            page opens with the first one on the left and the second one on the right.
    """

    caption: str
    images: Mapping[str, UInt8[np.ndarray, "h w 3"]]

    def __post_init__(self) -> None:
        sizes = {image.shape for image in self.images.values()}
        if len(self.images) < 2 or len(sizes) > 1:
            raise InputError(
                "these pictures cannot be compared",
                where=f"comparison '{self.caption}'",
                got=f"{len(self.images)} pictures of {len(sizes)} sizes",
                expected="two or more pictures of one size",
            )


@dataclass(frozen=True)
class Video:
    """Video file beside the report; `source` is a path relative to the report."""

    caption: str
    source: str


@dataclass(frozen=True)
class Section:
    """Part of the report; paragraphs of `text` are separated by an empty line."""

    title: str
    text: str = ""
    cards: Sequence[Card] = ()
    tables: Sequence[Table] = ()
    comparisons: Sequence[Comparison] = ()
    figures: Sequence[Figure] = ()
    videos: Sequence[Video] = ()


def profile_section(rows: Sequence[ProfileRow]) -> list[Section]:
    """Return the part of a page with the times of a profiled command; none without rows."""
    if not rows:
        return []
    text = (
        "Samples of all threads. The time of a library counts for the module that calls it; "
        "peak memory is that of the whole process while the module ran."
    )
    columns = ["stage", "module", "wall s", "processor s", "peak MB"]
    cells = [[r.stage, r.module, r.wall_s, r.processor_s, r.peak_mb] for r in rows[:_PROFILED]]
    return [Section("Where the time went", text, tables=[Table(columns, cells)])]


def viewer_command(work: Path, scenario: str = "") -> str:
    """Return the command line that opens a work folder in the viewer, quoted for a shell.

    Args:
        work: the work folder; the line has its absolute path, as a page is read from anywhere.
        scenario: folder of a scenario under WORK/scenarios, to open with its edits and sky.
    """
    words = ["lightsim", "view", str(work.resolve())]
    return shlex.join([*words, "--scenario", scenario] if scenario else words)


def render_report(
    title: str,
    sections: Sequence[Section],
    *,
    subtitle: str = "",
    cards: Sequence[Card] = (),
    viewer: str = "",
) -> str:
    """Return the report as one HTML page; all text is escaped.

    Args:
        viewer: command line that opens the viewer on the page's subject; shown in the header.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        # A misspelt name in the template is an error, not an empty cell.
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["data_uri"] = _data_uri
    environment.filters["cell"] = _format_cell
    environment.tests["numeric"] = _is_number
    return environment.get_template(_TEMPLATE).render(
        title=title,
        subtitle=subtitle,
        cards=cards,
        viewer=viewer,
        sections=sections,
        version=__version__,
    )


def write_report(
    path: Path,
    title: str,
    sections: Sequence[Section],
    *,
    subtitle: str = "",
    cards: Sequence[Card] = (),
    viewer: str = "",
) -> None:
    """Write `render_report`'s page atomically: the file is complete or absent.

    Raises:
        InputError: the folder does not exist.
    """
    if not path.parent.is_dir():
        raise InputError(
            "the folder to write to does not exist",
            where=path.parent,
            remedy="Create the folder first.",
        )
    page = render_report(title, sections, subtitle=subtitle, cards=cards, viewer=viewer)
    # In the same folder, since a rename is atomic only within one file system.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        temporary.write_text(page, encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _data_uri(image: UInt8[np.ndarray, "h w 3"]) -> str:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(stream, "JPEG", quality=88)
    # Embedded, so that a report remains complete when its file is moved or sent.
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def _is_number(value: Cell) -> bool:
    # A bool is an int in Python, but not a number of a table.
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _format_cell(value: Cell) -> str:
    """Format floats with four significant digits, thousands separated; None as a dash."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:,.0f}" if 1000 <= abs(value) < 1e7 else f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
