"""Elements with numbered groups, as mesh generators and their files have them, made into arrays with named groups."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tigar_x import checks
from tigar_x.compat import FloatArray
from varmint.mesh.checks import FACETS, MeshArrays, Numbers, number_rows

CELLS = {
    "triangle": ("triangle", "line", [0, 1, 2]),
    "quad": ("quadrilateral", "line", [0, 1, 3, 2]),
    "tetra": ("tetrahedron", "triangle", [0, 1, 2, 3]),
    "hexahedron": ("hexahedron", "quad", [0, 1, 3, 2, 4, 5, 7, 6]),
}
"""For meshio's name of a cell: dolfinx's name, the kind of its facets, and where dolfinx's vertices are in its own."""
FLAT = 1e-10
"""Relative to its size, how far the vertices of a plane mesh may be from one z."""


@dataclass(frozen=True, eq=False)
class Block:
    """Elements of one kind.

    Args:
        kind: meshio's name, such as "line", "quad" or "tetra10".
        vertices: of every element, shape (elements, vertices per element), in the generator's order.
        numbers: of the group of every element, 0 for none, shape (elements,).
    """

    kind: str
    vertices: Numbers
    numbers: Numbers

    @property
    def dimension(self) -> int:
        """Dimension of the elements."""
        flat = {"vertex": 0, "line": 1, "triangle": 2, "quad": 2, "polygon": 2}
        return next((dim for start, dim in flat.items() if self.kind.startswith(start)), 3)


@dataclass(frozen=True, eq=False)
class Elements:
    """Elements of all kinds over one set of points.

    Args:
        place: where they come from, for messages.
        points: shape (points, 2 or 3).
        blocks: the elements.
        labels: names of groups by dimension and number.
    """

    place: str
    points: FloatArray
    blocks: Sequence[Block]
    labels: Mapping[tuple[int, int], str] = field(default_factory=dict)

    def arrays(self, names: Mapping[str, int] | None = None) -> MeshArrays:
        """The cells of the highest dimension, and the groups of these and of their facets.

        Args:
            names: numbers of groups by the names that they are given; the others have their label, or their number.

        Raises:
            ValueError: cells that are mixed or not linear, a plane mesh not at one z, a number that no group has, two
                groups with one name, an element in two groups, or a facet in a group that no cell has.
        """
        dim = max((block.dimension for block in self.blocks), default=0)
        cells, sides = self._merged(dim), self._merged(dim - 1)
        if dim < 2:
            raise ValueError(
                f"{self.place} has no cells: triangles, quadrilaterals, tetrahedra or hexahedra are required"
            )
        kind = self._only("cells", cells, tuple(CELLS))
        cell, side, order = CELLS[kind]
        vertices, cell_numbers = cells[kind]
        tagged = {name: (rows[numbers != 0], numbers[numbers != 0]) for name, (rows, numbers) in sides.items()}
        tagged = {name: found for name, found in tagged.items() if len(found[0])}
        if tagged:
            self._only("facets with a group", tagged, (side,))
        rows, numbers = tagged.get(side, (np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)))
        cell_names, side_names = self._named(dim, cell_numbers, names), self._named(dim - 1, numbers, names)
        _check_names(names or {}, [*cell_names.values(), *side_names.values()])
        self._check_once("cells", vertices, cell_numbers, cell_names)
        self._check_once("facets", rows, numbers, side_names)
        facets = {name: rows[numbers == number] for name, number in side_names.items()}
        self._check_sides(vertices[:, order][:, FACETS[cell]], facets)
        groups = {name: np.flatnonzero(cell_numbers == number) for name, number in cell_names.items()}
        return MeshArrays(cell, vertices[:, order], self._coordinates(dim, vertices), facets, groups)

    def _only(self, what: str, found: Mapping[str, Any], allowed: Sequence[str]) -> str:
        """The one kind of elements that there is."""
        kinds = tuple(found)
        if len(kinds) > 1 or kinds[0] not in allowed:
            given, wanted = " and ".join(map(repr, kinds)), ", ".join(map(repr, allowed))
            raise ValueError(f"{self.place} has {what} {given}: linear ones of one kind, of {wanted}, are required")
        return kinds[0]

    def _merged(self, dim: int) -> dict[str, tuple[Numbers, Numbers]]:
        """Vertices and numbers of the elements of a dimension, by their kind."""
        kinds = dict.fromkeys(block.kind for block in self.blocks if block.dimension == dim and len(block.vertices))
        every = {kind: [block for block in self.blocks if block.kind == kind] for kind in kinds}
        return {
            kind: (
                np.concatenate([block.vertices for block in blocks]).astype(np.int64),
                np.abs(np.concatenate([block.numbers for block in blocks]).astype(np.int64)),
            )
            for kind, blocks in every.items()
        }

    def _named(self, dim: int, numbers: Numbers, names: Mapping[str, int] | None) -> dict[str, int]:
        """Numbers of the groups of a dimension by their names."""
        given = {number: name for name, number in (names or {}).items()}
        found: dict[str, int] = {}
        for number in (int(number) for number in np.unique(numbers[numbers != 0])):
            name = given.get(number, self.labels.get((dim, number), str(number)))
            if name in found:
                raise ValueError(
                    f"groups {found[name]} and {number} of {self.place} are both {name!r}: two names are required, "
                    "in the file or by names"
                )
            found[name] = number
        return found

    def _check_once(self, what: str, rows: Numbers, numbers: Numbers, names: Mapping[str, int]) -> None:
        """Refuse elements that are twice there, with the numbers of two groups."""
        if not len(names) > 1:
            return
        same = number_rows(np.sort(rows, axis=1))
        order = np.lexsort((numbers, same))
        twice = np.flatnonzero((np.diff(same[order]) == 0) & (np.diff(numbers[order]) != 0))
        if len(twice):
            name = {number: name for name, number in names.items()} | {0: "none"}
            both = " and ".join(repr(name[int(numbers[i])]) for i in order[twice[0] : twice[0] + 2])
            raise ValueError(
                f"{self.place} has {what} in groups {both}: one at most is required; "
                "a condition or a measure takes several groups, so let groups share nothing"
            )

    def _check_sides(self, sides: Numbers, facets: Mapping[str, Numbers]) -> None:
        """Refuse facets in a group that no cell has; ``sides`` has shape (cells, facets per cell, vertices)."""
        for name, rows in facets.items():
            near = sides[np.isin(sides, rows).all(axis=2)]
            numbers = number_rows(np.sort(np.concatenate([near, rows]), axis=1))
            alone = ~np.isin(numbers[len(near) :], numbers[: len(near)])
            if alone.any():
                place = ", ".join(f"{value:.6g}" for value in self.points[rows[alone.argmax()]].mean(axis=0))
                raise ValueError(
                    f"{self.place} has group {name!r} with {alone.sum()} of {len(rows)} facets, such as that at "
                    f"({place}), beside no cell of the mesh: where some cells are in groups gmsh leaves out all "
                    "others; a group of the cells beside the facets is required as well"
                )

    def _coordinates(self, dim: int, cells: Numbers) -> FloatArray:
        x = np.asarray(self.points, dtype=np.float64)
        if x.shape[1] < dim:
            raise ValueError(f"{self.place} has points with {x.shape[1]} coordinates: {dim} are required")
        if x.shape[1] > dim:
            used = x[np.unique(cells)]
            z, size = used[:, dim], np.ptp(used[:, :dim], axis=0).max()
            if not np.ptp(z) <= FLAT * size:
                raise ValueError(
                    f"{self.place} has z from {z.min():g} to {z.max():g}: a plane mesh at one z is required"
                )
        return x[:, :dim]


def _check_names(names: Mapping[str, int], known: Sequence[int]) -> None:
    numbers = tuple(sorted(set(known)))
    for name, number in names.items():
        checks.choice(f"names[{name!r}]", number, numbers)
    if len(set(names.values())) < len(names):
        raise ValueError(f"names = {dict(names)!r}: a number of its own for each name is required")
