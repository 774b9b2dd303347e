"""Colours with their bar, and animations; how figures are made is in :mod:`tigar_x.run.figure`."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.ranks import root_only
from tigar_x.run.figure import axis_label
from tigar_x.run.writing import replace_bytes


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
        axis_label(self.what, self.unit)
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
        return several[0].figure.colorbar(explained, label=axis_label(self.what, self.unit), extend=extend, **place)


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
