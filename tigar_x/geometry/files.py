"""Patches in ASCII files, one a file.

Line 1 has the dimension of space, line 2 the degrees and line 3 the numbers of control points (one for each parametric
direction). The next lines are knot vectors, one each, and then come the control points, "x y z w" on every line, the
first direction fastest. Coordinates are physical, not multiplied by the weight. Blank lines do not count, and what
follows the control points is ignored.
"""

from collections.abc import Iterator
from itertools import count as count_from
from pathlib import Path

import numpy as np
from mpi4py import MPI

from tigar_x import checks
from tigar_x.geometry.bspline import BSplineBasis
from tigar_x.geometry.patch import Patch
from tigar_x.ranks import on_root
from tigar_x.run.writing import replace_text


def read_patch(path: Path | str) -> Patch:
    """Curve, surface or volume from a file.

    Args:
        path: file name.

    Returns:
        The patch, on the knots as they are in the file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated or not of this format; the message names the file and the line.
    """
    lines = _Lines(Path(path))
    (nsd,) = lines.integers("the dimension of space", 1, 1)
    if nsd > 3:
        raise lines.error("the dimension of space, 1 to 3", nsd)
    degrees = lines.integers("a degree >= 1 for each of 1 to 3 directions", 1)
    dim = len(degrees)
    if dim > nsd:
        raise lines.error(f"degrees of 1 to {nsd} directions", degrees)
    sizes = lines.integers(f"{dim} numbers of control points", 2, dim)
    bases = []
    for direction, (p, n) in enumerate(zip(degrees, sizes, strict=True)):
        knots = lines.numbers(f"{n + p + 1} open knots of direction {direction} (degree {p})", n + p + 1)
        try:
            bases.append(BSplineBasis(p, np.array(knots)))
        except ValueError as error:
            raise ValueError(f"{lines.place}: {error}") from error
    total = int(np.prod(sizes))
    rows = []
    for i in range(total):
        row = lines.numbers(f"control point {i + 1} of {total}: {nsd} coordinates and a weight > 0", nsd + 1)
        if row[-1] <= 0.0:
            raise lines.error("a weight > 0", row[-1])
        rows.append(row)
    control = np.array(rows)
    return Patch.from_points(bases, control[:, :-1], control[:, -1])


def read_patches(prefix: Path | str, suffix: str, count: int | None = None) -> tuple[Patch, ...]:
    """Patches from files with numbered names: prefix + number + suffix, from 1.

    Args:
        prefix: beginning of the file names, with the folder.
        suffix: their end, such as ".txt".
        count: number of files; None: all up to the first number that is missing.

    Returns:
        The patches.

    Raises:
        FileNotFoundError: one of the files is missing (with no count: the first).
        ValueError: see :func:`read_patch`.
    """
    if count is not None:
        checks.whole("count", count, 1)
    patches: list[Patch] = []
    for number in count_from(1) if count is None else range(1, count + 1):
        path = Path(f"{prefix}{number}{suffix}")
        if count is None and patches and not path.exists():
            break
        patches.append(read_patch(path))
    return tuple(patches)


def write_patch(path: Path | str, patch: Patch) -> None:
    """Write a patch with 17 digits, at once or not at all; names of sides are not kept (collective; rank 0 writes).

    Args:
        path: file name; its folder is made.
        patch: open in every direction.

    Raises:
        ValueError: the patch is periodic.
        OSError: on all ranks: the file cannot be written.
    """
    checks.kind("patch", patch, Patch, "a Patch")
    if any(basis.periodic for basis in patch.bases):
        raise ValueError("patch is periodic: one that is open in every direction is required")
    header = [[patch.nsd], patch.basis.degrees, [basis.n for basis in patch.bases]]
    numbers = [*(basis.knots for basis in patch.bases), *np.column_stack([patch.points, patch.weights])]
    lines = [" ".join(str(k) for k in row) for row in header]
    lines += [" ".join(f"{x:.17g}" for x in row) for row in numbers]
    on_root(MPI.COMM_WORLD, lambda: replace_text(Path(path), "\n".join(lines) + "\n"))


class _Lines:
    """The lines of a file that are not blank, one after the other, with messages that say where one is wrong."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        self._rest: Iterator[tuple[int, list[str]]] = (
            (number, words) for number, line in enumerate(self._lines, 1) if (words := line.split())
        )
        self._number = 0

    @property
    def place(self) -> str:
        """File and line."""
        return f"{self._path}, line {self._number}"

    def error(self, expected: str, found: object) -> ValueError:
        """Exception for the present line."""
        return ValueError(f"{self.place}: expected {expected}, found {found}")

    def numbers(self, expected: str, size: int | None = None) -> list[float]:
        """Finite numbers of the next line.

        Args:
            expected: what they are.
            size: how many; None: one or more.
        """
        self._number, words = next(self._rest, (len(self._lines) + 1, ["the end of the file"]))
        try:
            values = [float(word) for word in words]
        except ValueError as error:
            raise self.error(expected, " ".join(words)[:80]) from error
        if size not in (None, len(values)):
            raise self.error(expected, f"{len(values)} numbers")
        if not np.isfinite(values).all():
            raise self.error(f"{expected}, all finite", " ".join(words)[:80])
        return values

    def integers(self, expected: str, low: int, size: int | None = None) -> list[int]:
        """Integers >= low of the next line."""
        values = self.numbers(expected, size)
        if any(value < low or value != int(value) for value in values):
            raise self.error(f"{expected} (integers >= {low})", " ".join(f"{value:g}" for value in values))
        return [int(value) for value in values]
