"""Pictures of several panels: one file, drawn on rank 0.

A panel is a function of axes of matplotlib. What it shows is gathered before, on all ranks. One with an attribute
``projection = "3d"`` gets axes in space. matplotlib is loaded when something is drawn.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from tigar_x.ranks import root_only

Panel = Callable[[Any], Any]


@root_only
def draw(
    path: Path | str, *panels: Panel, columns: int = 2, size: tuple[float, float] = (5.5, 4.6), dpi: int = 130
) -> None:
    """Draw panels beside and below each other (collective; rank 0 draws).

    Args:
        path: of the picture; its folder is made.
        panels: from left to right and from top to bottom.
        columns: number of panels beside each other.
        size: width and height of a panel [inch].
        dpi: dots per inch.

    Raises:
        OSError: on all ranks: the file cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    across, rows = min(columns, len(panels)), -(-len(panels) // columns)
    figure = plt.figure(figsize=(size[0] * across, size[1] * rows), layout="constrained")
    try:
        for number, panel in enumerate(panels, 1):
            panel(figure.add_subplot(rows, across, number, projection=getattr(panel, "projection", None)))
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=dpi)
    finally:
        plt.close(figure)


def lines(x: ArrayLike, courses: Mapping[str, ArrayLike], style: str = "-", **labels: Any) -> Panel:
    """Panel of values over one quantity.

    Args:
        x: shape (points,).
        courses: values by what the legend calls them, shape (points,) each.
        style: format of the lines.
        labels: passed on to ``axes.set``, such as ``xlabel="$t$ [s]"``.
    """

    def panel(axes: Any) -> None:
        for label, values in courses.items():
            axes.plot(x, values, style, label=label)
        axes.grid(True, linewidth=0.4)
        axes.set(**labels)
        axes.legend()

    return panel
