"""Numbered pictures of a run as a series, which become an animation at its end."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

from tigar_x import checks
from tigar_x.ranks import on_root
from tigar_x.run.output import Series, check_writable, is_later
from tigar_x.run.pictures import animate

FOLDER = "frames"


class Frames(Series):
    """A picture at each output; at the end an animation and a sheet with six of them (collective).

    The pictures are in the folder ``frames`` beside the animation, and have their times in their names.

    Args:
        path: of the animation, a GIF; the sheet is a PNG of the same name.
        draw: draws the present state into a file, at a time (collective).
        after: time from which a run goes on: pictures of an earlier series are kept up to then; None: a new series.
        seconds: how long each picture is shown.

    Raises:
        ValueError: the path does not end in ".gif", or a number is out of range.
        OSError: on all ranks: the animation cannot be written.
    """

    def __init__(
        self, path: Path | str, draw: Callable[[Path, float], Any], *, after: float | None = None, seconds: float = 0.1
    ) -> None:
        self._path, self._draw = Path(path), draw
        if self._path.suffix != ".gif":
            raise ValueError(f"path = {str(path)!r}: a name that ends in '.gif' is required")
        self._seconds = checks.positive("seconds", seconds)
        on_root(MPI.COMM_WORLD, lambda: self._begin(after))

    def _begin(self, after: float | None) -> None:
        check_writable(self._path)
        for frame in self.frames:
            if after is None or is_later(_time(frame), after):
                frame.unlink(missing_ok=True)

    @property
    def frames(self) -> list[Path]:
        """The pictures there are, by their times."""
        every = (self._path.parent / FOLDER).glob("*.png")
        # a longer name that begins like this one is that of another series
        name = re.compile(re.escape(self._path.stem) + r"_-?[0-9]+\.[0-9]{9}")
        return sorted((frame for frame in every if name.fullmatch(frame.stem)), key=_time)

    def write(self, t: float) -> None:
        """Draw the present state at time ``t``."""
        self._draw(self._path.parent / FOLDER / f"{self._path.stem}_{t:.9f}.png", t)

    def close(self) -> None:
        """Make the animation and the sheet."""
        animate(self._path, self.frames, seconds=self._seconds, sheet=self._path.with_suffix(".png"))


def _time(frame: Path) -> float:
    return float(frame.stem.rpartition("_")[2])
