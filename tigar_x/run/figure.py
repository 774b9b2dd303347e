"""Figures with matplotlib: one way to make one, and curves over a quantity or over time.

A figure has panels; a panel is a function of matplotlib's axes. Rank 0 draws, so what a panel shows is gathered before,
on all ranks. Whatever a figure shows has a name and a unit, or the figure is refused: :func:`axis_label` asks for both,
and :func:`draw` looks at every axis before it saves. What is a pure number has the unit ``"-"``; in consistent units
the unit is a word such as ``"length"``.

matplotlib is loaded when something is drawn, without pyplot: no window system is asked for, and no figure stays.
"""

import io
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from math import lcm
from pathlib import Path
from typing import Any, Protocol

from mpi4py import MPI
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.ranks import on_root
from tigar_x.run.writing import replace_bytes

Panel = Callable[[Any], Any]
"""Draws in axes of matplotlib; one with an attribute ``projection`` gets such axes, "3d" for example."""
LABEL = re.compile(r"\S.* \[.+\]", re.DOTALL)
"""What the label of an axis looks like."""
SCALE = "scale"
"""Mark (gid of matplotlib) of a text that gives the scale of axes without ticks."""
MARKS = ".+x^"
DASHES = ("--", ":", "-.", (0, (1, 3)))


class Table(Protocol):
    """Columns of numbers by name: a history, or a dictionary of arrays."""

    def __getitem__(self, name: str, /) -> Any:
        """One number a step."""


def axis_label(what: str, unit: str) -> str:
    """Label of an axis.

    Args:
        what: what it shows.
        unit: in which unit; "-" for a pure number.

    Raises:
        ValueError: one of them is empty or no text.
    """
    for name, text in (("what", what), ("unit", unit)):
        if not isinstance(text, str) or not text.strip():
            raise ValueError(f'{name} = {text!r}: a text is required, the unit of a pure number is "-"')
    return f"{what} [{unit}]"


def draw(
    path: Path | str,
    *panels: Panel | Sequence[Panel],
    columns: int = 2,
    size: tuple[float, float] = (5.5, 4.6),
    heights: Sequence[float] | None = None,
    title: str = "",
    dpi: int = 130,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> None:
    """Draw panels beside and below each other (collective; rank 0 draws).

    Args:
        path: of the picture, ending in the name of its format; its folder is made.
        panels: from left to right and from top to bottom; or rows of them, each as wide as the picture.
        columns: number of panels in a row where no rows are given.
        size: width and height of a panel [inch]; of rows, the width is that of the longest one's.
        heights: of the rows, relative to each other; None: all the same.
        title: above all.
        dpi: dots per inch.
        comm: communicator.

    Raises:
        ValueError: on all ranks: there is no panel, heights are not those of the rows, an axis has no label of the form
            of :func:`axis_label`, or axes without ticks have no scale.
        Exception: on all ranks: that of a panel, or of writing.
    """
    on_root(comm, lambda: _draw(Path(path), _rows(panels, columns), size, heights, title, dpi))


def _rows(panels: Sequence[Any], columns: int) -> list[tuple[Sequence[Panel], int]]:
    """Rows of panels, each with the number of panels that fills it."""
    checks.whole("columns", columns, 1)
    if all(callable(panel) for panel in panels):
        across = min(columns, len(panels))
        rows = [(panels[i : i + across], across) for i in range(0, len(panels), across or 1)]
    else:
        rows = [([row], 1) if callable(row) else (list(row), len(row)) for row in panels]
    if not rows or not all(row for row, _ in rows):
        raise ValueError("panels is empty: one or more in every row is required")
    return rows


def _draw(path: Path, rows: Any, size: Any, heights: Any, title: str, dpi: int) -> None:
    from matplotlib.figure import Figure

    across, ratios = max(width for _, width in rows), [1.0] * len(rows) if heights is None else list(heights)
    if len(ratios) != len(rows):
        raise ValueError(f"heights = {heights}: {len(rows)}, one a row, are required")
    whole = (size[0] * across, size[1] * sum(ratios) / max(ratios))
    figure = Figure(figsize=whole, dpi=dpi, layout="constrained")
    grid = figure.add_gridspec(len(rows), lcm(*(width for _, width in rows)), height_ratios=ratios)
    for i, (row, width) in enumerate(rows):
        span = grid.ncols // width
        for j, panel in enumerate(row):
            place = grid[i, j * span : (j + 1) * span]
            panel(figure.add_subplot(place, projection=getattr(panel, "projection", None)))
    if title:
        figure.suptitle(title)
    _refuse_unlabelled(figure, path)
    content = io.BytesIO()
    figure.draw_without_rendering()  # the ticks that fit are known after a first layout
    figure.savefig(content, format=path.suffix.lstrip(".") or "png")
    replace_bytes(path, content.getvalue())


def _refuse_unlabelled(drawn: Any, path: Path) -> None:
    """Refuse a figure with an axis that does not say what it shows and in which unit."""
    for axes in drawn.axes:
        scaled = any(text.get_gid() == SCALE for text in axes.texts)
        named = {name: axis for name in "xyz" if (axis := getattr(axes, f"{name}axis", None)) is not None}
        ticked = {name: axis for name, axis in named.items() if axes.axison and _has_ticks(axis)}
        title = f" {axes.get_title()!r}" if axes.get_title() else ""
        for name, axis in ticked.items():
            text = axis.get_label().get_text()
            if not LABEL.fullmatch(text):
                raise ValueError(
                    f"{path.name}: the {name} axis of the axes{title} has the label {text!r}: what it shows and "
                    f'[unit] are required, such as axis_label("time", "s")'
                )
        if not ticked and not scaled and axes.has_data():
            raise ValueError(f"{path.name}: the axes{title} have neither ticks nor a scale bar: one is required")


def _has_ticks(axis: Any) -> bool:
    """Whether an axis shows numbers; those between axes that share it do not."""
    return axis.get_visible() and any(t.label1.get_visible() or t.label2.get_visible() for t in axis.get_major_ticks())


def lines(
    courses: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    x: tuple[str, str],
    y: tuple[str, str],
    styles: Mapping[str, Mapping[str, Any]] | None = None,
    levels: Mapping[str, float] | None = None,
    **settings: Any,
) -> Panel:
    """Panel of curves.

    Args:
        courses: abscissae and ordinates by what the legend calls them; it leaves out what begins with "_".
        x: what the abscissa shows, and in which unit.
        y: what the ordinate shows, and in which unit.
        styles: matplotlib's options by name of the curve, such as ``{"published": {"fmt": "ko"}}``.
        levels: horizontal lines by name, such as a limit.
        settings: passed on to ``axes.set``, such as ``yscale="log"`` or ``title="..."``.

    Raises:
        ValueError: an axis has no name or no unit.
    """
    labels, given, marks = {"xlabel": axis_label(*x), "ylabel": axis_label(*y)}, styles or {}, levels or {}

    def panel(axes: Any) -> None:
        for name, (abscissae, ordinates) in courses.items():
            style = {"linewidth": 1.1} | dict(given.get(name, {}))
            form = (style.pop("fmt"),) if "fmt" in style else ()
            axes.plot(abscissae, ordinates, *form, label=name or "_", **style)
        for i, (name, value) in enumerate(marks.items()):
            axes.axhline(value, color="0.4", linestyle=DASHES[i % len(DASHES)], linewidth=0.9, label=name)
        axes.set(**labels, **settings)
        if axes.get_xscale() == "linear":
            axes.locator_params(axis="x", nbins=6)  # long numbers would touch each other
        axes.grid(True, linewidth=0.4)
        if any(name and not name.startswith("_") for name in (*courses, *marks)):
            axes.legend(fontsize="small")

    return panel


def over_time(
    history: Table,
    columns: str | Mapping[str, str],
    *,
    y: tuple[str, str],
    time: str,
    over: str = "t",
    points: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    **more: Any,
) -> Panel:
    """Panel of columns of a history.

    Args:
        history: columns by name.
        columns: name of one, or names by what the legend calls them.
        y: what they show, and in which unit.
        time: unit of the times.
        over: column of the times.
        points: times and values by name, such as published ones; each has a mark of its own.
        more: see :func:`lines`.
    """
    named = {"": columns} if isinstance(columns, str) else columns
    courses = {name: (history[over], history[column]) for name, column in named.items()}
    marks = {name: {"fmt": f"k{mark}", "markersize": 7} for name, mark in zip(points or {}, cycle(MARKS), strict=False)}
    styles = marks | dict(more.pop("styles", {}))
    return lines(courses | dict(points or {}), x=("$t$", time), y=y, styles=styles, **more)
