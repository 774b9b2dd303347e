"""Figures with matplotlib: one way to make one, curves, histories, colours with their bar, and animations.

Whatever a figure shows has a name and a unit, or the figure is refused: :func:`label` asks for both, and
:func:`figure` looks at every axis before it saves. What is a pure number has the unit ``"-"``; in consistent units the
unit is a word such as ``"length"``.

matplotlib is loaded by the functions that draw, without pyplot: no window system is asked for, and no figure stays.
"""

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.ranks import on_root, root_only, together
from tigar_x.run.writing import replace_bytes

LABEL = re.compile(r"\S.* \[.+\]", re.DOTALL)
"""What the label of an axis looks like."""
SCALE = "scale"
"""Mark (gid of matplotlib) of a text that gives the scale of axes without ticks."""


class Table(Protocol):
    """Columns of numbers by name: a history, or a dictionary of arrays."""

    def __getitem__(self, name: str, /) -> Any:
        """One number a step."""


def label(what: str, unit: str) -> str:
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


@dataclass(frozen=True)
class Colours:
    """A scale of colours.

    Attributes:
        what: what the colours show.
        unit: in which unit.
        low: value at the lower end; None: the smallest value that is painted.
        high: value at the upper end; None: the largest.
        palette: name of matplotlib's.
    """

    what: str
    unit: str
    low: float | None = None
    high: float | None = None
    palette: str = "viridis"

    def __post_init__(self) -> None:
        label(self.what, self.unit)
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"low = {self.low}: a number below high = {self.high} is required")

    def ends(self, values: ArrayLike) -> tuple[float, float]:
        """Both ends of the scale: those that are given, the others from values."""
        x = np.ravel(np.asarray(values, dtype=float))
        x = x[np.isfinite(x)] if np.isfinite(x).any() else np.zeros(1)
        low = float(x.min()) if self.low is None else self.low
        high = float(x.max()) if self.high is None else self.high
        if not low < high:  # values that are all the same, or beyond the end that is given
            low, high = (low, low + (abs(low) or 1.0)) if self.high is None else (high - (abs(high) or 1.0), high)
        return low, high

    def mappable(self, values: ArrayLike) -> Any:
        """Matplotlib's ``ScalarMappable`` for values."""
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        return ScalarMappable(Normalize(*self.ends(values)), self.palette)

    def bar(self, axes: Any, values: ArrayLike, *, mappable: Any = None, **place: Any) -> Any:
        """Add a bar with its label; its ends are pointed where values lie beyond them.

        Args:
            axes: of matplotlib, beside which it stands; or several.
            values: what has been painted.
            mappable: what to explain; None: this scale.
            place: passed on to matplotlib's ``colorbar``.

        Returns:
            The bar.
        """
        x, (low, high) = np.asarray(values, dtype=float), self.ends(values)
        slack = 1e-9 * (high - low)
        beyond = (bool((x < low - slack).any()), bool((x > high + slack).any()))
        extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[beyond]
        several = np.ravel(axes)
        explained = self.mappable(values) if mappable is None else mappable
        if len(several) == 1 and not place:  # as high as the axes, whatever their aspect makes of them
            place = {"cax": several[0].inset_axes((1.02, 0.0, 0.025, 1.0))}
        else:
            place = {"ax": list(several)} | place
        return several[0].figure.colorbar(explained, label=label(self.what, self.unit), extend=extend, **place)


@contextmanager
def figure(
    path: Path, size: tuple[float, float] = (8.0, 5.0), *, dpi: int = 130, comm: MPI.Comm = MPI.COMM_WORLD
) -> Iterator[Any]:
    """A figure to draw in, saved at the end (collective, so not within ``root_only``: all ranks draw, rank 0 saves).

    Args:
        path: of the picture; its folder is made.
        size: width and height in inches.
        dpi: pixels per inch.
        comm: communicator.

    Yields:
        matplotlib's ``Figure`` without axes; ``figure.subplots(...)`` makes some.

    Raises:
        ValueError: an axis has no label of the form of :func:`label`, or axes without ticks have no scale.
        Exception: that of the body or of saving, on all ranks.
    """
    from matplotlib.figure import Figure

    drawn, failure = Figure(figsize=size, dpi=dpi, layout="constrained"), None
    try:
        yield drawn
    except Exception as error:
        failure = error

    def check() -> None:
        if failure is not None:
            raise failure
        _refuse_unlabelled(drawn, path)

    def save() -> None:
        content = io.BytesIO()
        drawn.draw_without_rendering()  # the ticks that fit are known after a first layout
        drawn.savefig(content, format=path.suffix.lstrip(".") or "png")
        replace_bytes(path, content.getvalue())

    together(comm, check)
    on_root(comm, save)


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
                    f'[unit] are required, such as label("time", "s")'
                )
        if not ticked and not scaled and axes.has_data():
            raise ValueError(f"{path.name}: the axes{title} have neither ticks nor a scale bar: one is required")


def _has_ticks(axis: Any) -> bool:
    """Whether an axis shows numbers; those between axes that share it do not."""
    return axis.get_visible() and any(t.label1.get_visible() or t.label2.get_visible() for t in axis.get_major_ticks())


# -- curves -----------------------------------------------------------------------------------------------------------


def curves(
    axes: Any,
    lines: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    x: tuple[str, str],
    y: tuple[str, str],
    styles: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Draw curves with a grid, labels and a legend.

    Args:
        axes: of matplotlib.
        lines: abscissae and ordinates by name; a name that begins with "_", or is empty, is not in the legend.
        x: what the abscissa shows, and in which unit.
        y: what the ordinate shows, and in which unit.
        styles: matplotlib's options by name of the curve, such as ``{"published": {"fmt": "ko"}}``.
    """
    for name, (abscissae, ordinates) in lines.items():
        style = {"linewidth": 1.1} | dict((styles or {}).get(name, {}))
        form = (style.pop("fmt"),) if "fmt" in style else ()
        axes.plot(abscissae, ordinates, *form, label=name or "_", **style)
    axes.set(xlabel=label(*x), ylabel=label(*y))
    axes.grid(True, linewidth=0.4)
    if any(name and not name.startswith("_") for name in lines):
        axes.legend(fontsize="small")


@dataclass(frozen=True)
class Panel:
    """One diagram of a history.

    Attributes:
        what: what it shows.
        unit: in which unit.
        curves: a column's name, or columns by the name that they have in the legend.
        over: column of the times.
        levels: horizontal lines by name, such as a published value; unit: as the curves.
        points: times and values by name, such as published ones.
        limits: lowest and highest value that is shown; None: as the curves have it.
        logarithmic: whether the scale is.
    """

    what: str
    unit: str
    curves: str | Mapping[str, str]
    over: str = "t"
    levels: Mapping[str, float] = field(default_factory=dict)
    points: Mapping[str, tuple[ArrayLike, ArrayLike]] = field(default_factory=dict)
    limits: tuple[float, float] | None = None
    logarithmic: bool = False

    def __post_init__(self) -> None:
        label(self.what, self.unit)

    def draw(self, axes: Any, history: Table, time: str) -> None:
        """Draw the panel.

        Args:
            axes: of matplotlib.
            history: columns by name.
            time: unit of the times.
        """
        named = {"": self.curves} if isinstance(self.curves, str) else self.curves
        lines = {name: (history[self.over], history[column]) for name, column in named.items()}
        styles = {name: {"fmt": "k.", "markersize": 7} for name in self.points}
        curves(axes, lines | dict(self.points), x=("t", time), y=(self.what, self.unit), styles=styles)
        for (name, value), dashes in zip(self.levels.items(), ("--", ":", "-.", (0, (1, 3))) * 9, strict=False):
            axes.axhline(value, color="0.4", linestyle=dashes, linewidth=0.9, label=name)
        if self.levels:
            axes.legend(fontsize="small")
        if self.limits is not None:
            axes.set_ylim(self.limits)
        if self.logarithmic:
            axes.set_yscale("log")


def histories(
    path: Path,
    history: Table,
    panels: Sequence[Panel],
    *,
    time: str,
    columns: int = 2,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> None:
    """Draw a history in several panels over one time (collective).

    Args:
        path: of the picture.
        history: columns by name.
        panels: what to draw.
        time: unit of the times.
        columns: number of panels side by side.
        comm: communicator.
    """
    if not panels:
        raise ValueError("panels is empty: one or more is required")
    across = min(checks.whole("columns", columns, 1), len(panels))
    rows = -(-len(panels) // across)
    with figure(path, (5.4 * across, 0.6 + 2.6 * rows), comm=comm) as drawn:
        axes = drawn.subplots(rows, across, squeeze=False).ravel()
        for panel, one in zip(panels, axes, strict=False):
            panel.draw(one, history, time)
        for unused in axes[len(panels) :]:
            unused.remove()


# -- animations -------------------------------------------------------------------------------------------------------


@root_only
def animate(path: Path, frames: Sequence[Path], *, seconds: float = 0.1, sheet: Path | None = None) -> None:
    """An animation of pictures of one size, and six of them on one sheet (collective; rank 0 works).

    Args:
        path: of the animation, a GIF.
        frames: the pictures in their order; none: nothing is written.
        seconds: how long each is shown.
        sheet: picture with six of the frames, two a row; None: none.
    """
    from PIL import Image

    if not frames:
        return
    pictures = []
    for frame in frames:
        with Image.open(frame) as opened:
            pictures.append(opened.convert("RGB"))
    first, *others = [picture.quantize() for picture in pictures]
    moving = io.BytesIO()
    shown = {"duration": round(1000 * checks.positive("seconds", seconds)), "loop": 0}
    first.save(moving, format="GIF", save_all=True, append_images=others, **shown)
    replace_bytes(path, moving.getvalue())
    if sheet is None:
        return
    chosen = [pictures[round(i)] for i in np.linspace(0, len(pictures) - 1, min(6, len(pictures)))]
    width, height = chosen[0].size
    across = min(2, len(chosen))
    whole = Image.new("RGB", (across * width, height * -(-len(chosen) // across)), "white")
    for i, picture in enumerate(chosen):
        whole.paste(picture, (width * (i % across), height * (i // across)))
    still = io.BytesIO()
    whole.save(still, format="PNG")
    replace_bytes(sheet, still.getvalue())
