"""Meshes of flow scenes, with named groups of facets and cells.

Meshes from arrays, from gmsh and from files are in :mod:`varmint.mesh.arrays`, :mod:`varmint.mesh.models` and
:mod:`varmint.mesh.files`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import mesh
from numpy.typing import ArrayLike

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray

Predicate = Callable[[Any], Any]
CELLS = {2: ("triangle", "quadrilateral"), 3: ("tetrahedron", "hexahedron")}
"""Kinds of cells by dimension."""
SIDES = (("left", "right"), ("bottom", "top"), ("back", "front"))
"""Names of the sides of a box at the ends of every axis."""


@dataclass(frozen=True, eq=False)
class NamedMesh:
    """A mesh whose groups of facets and cells have names; the tags 1, 2, ... are those of the names in their order.

    Args:
        domain: mesh.
        facet_tags: tags of the facets, ghosts as well; None: no group of facets.
        cell_tags: tags of the cells, ghosts as well; None: no group of cells.
        facet_names: names of the groups of facets.
        cell_names: names of the groups of cells.
        inner_facet_names: names of the groups that have facets between two cells; they have no measure ``ds``.
    """

    domain: mesh.Mesh
    facet_tags: Any = None
    cell_tags: Any = None
    facet_names: tuple[str, ...] = ()
    cell_names: tuple[str, ...] = ()
    inner_facet_names: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Number of cells on all ranks."""
        return int(self.domain.topology.index_map(self.domain.topology.dim).size_global)

    def __repr__(self) -> str:
        parts = [f"{self.size} {compat.cell_name(self.domain)} cells in {self.domain.geometry.dim}D"]
        parts += [f"facets {', '.join(self.facet_names)}"] if self.facet_names else []
        parts += [f"cells {', '.join(self.cell_names)}"] if self.cell_names else []
        return f"NamedMesh({'; '.join(parts)})"

    def facets(self, *names: str) -> IntArray:
        """Local numbers of the facets of groups, sorted, ghosts as well.

        Args:
            names: of the groups, at least one.

        Raises:
            ValueError: no name, or one that does not exist.
        """
        return _chosen(self.facet_tags, _tags("facet", names, self.facet_names))

    def cells(self, *names: str) -> IntArray:
        """Local numbers of the cells of groups, sorted, ghosts as well.

        Args:
            names: of the groups, at least one.

        Raises:
            ValueError: no name, or one that does not exist.
        """
        return _chosen(self.cell_tags, _tags("cell", names, self.cell_names))

    def ds(self, *names: str, degree: int) -> ufl.Measure:
        """Measure of exterior facets; all measures of one mesh may enter one form.

        Args:
            names: of the groups; none: the whole boundary.
            degree: of the quadrature.

        Raises:
            ValueError: a name does not exist, or its group has facets inside the mesh; no degree >= 0.
        """
        tags = _tags("facet", names, self.facet_names) if names else "everywhere"
        for name in names:
            if name in self.inner_facet_names:
                outer = tuple(other for other in self.facet_names if other not in self.inner_facet_names)
                raise ValueError(f"facet group {name!r} has facets inside the mesh: {_one_of(outer)}")
        return self._measure(ufl.ds, self.facet_tags, tags, degree)

    def dx(self, *names: str, degree: int) -> ufl.Measure:
        """Measure of cells; all measures of one mesh may enter one form.

        Args:
            names: of the groups; none: all cells.
            degree: of the quadrature.

        Raises:
            ValueError: a name does not exist; no degree >= 0.
        """
        tags = _tags("cell", names, self.cell_names) if names else "everywhere"
        return self._measure(ufl.dx, self.cell_tags, tags, degree)

    def _measure(self, kind: ufl.Measure, data: Any, tags: Any, degree: int) -> ufl.Measure:
        metadata = {"quadrature_degree": checks.whole("degree", degree, 0)}
        return kind(domain=self.domain, subdomain_data=data, subdomain_id=tags, metadata=metadata)


def require_named(mesh: Any) -> None:
    """Refuse what is no mesh with names.

    Args:
        mesh: the argument of that name.

    Raises:
        ValueError: it is something else, such as a mesh of dolfinx.
    """
    checks.kind("mesh", mesh, NamedMesh, "a NamedMesh, such as varmint.named(mesh, left=lambda x: x[0] < 1e-9),")


def named(
    domain: mesh.Mesh,
    *,
    cells: Mapping[str, Predicate | Sequence[Predicate]] | None = None,
    **facets: Predicate | Sequence[Predicate],
) -> NamedMesh:
    """Give names to parts of the boundary, and to parts of the mesh, by their coordinates.

    Args:
        domain: mesh.
        cells: for every name of a group of cells one or more functions as below.
        facets: for every name one or more functions from coordinates of shape (3, n) to a mask of shape (n,); a
            facet of the boundary belongs to the group when one of them selects all its vertices.

    Returns:
        The mesh with the names.

    Raises:
        ValueError: no part is named, a part is empty on all ranks, or two parts share a facet or a cell.
    """
    checks.kind("domain", domain, mesh.Mesh, "a mesh of dolfinx")
    if not facets and not cells:
        raise ValueError("parts is empty: name at least one part of the boundary or of the mesh")
    dim = domain.topology.dim
    exterior = compat.exterior_facets(domain)
    sides = {name: np.intersect1d(_located(domain, dim - 1, where), exterior) for name, where in facets.items()}
    parts = {name: _located(domain, dim, where) for name, where in (cells or {}).items()}
    facet_tags, cell_tags = tagged(domain, "boundary facet", sides), tagged(domain, "cell", parts)
    return NamedMesh(domain, facet_tags, cell_tags, tuple(sides), tuple(parts))


def box(
    comm: MPI.Comm,
    lower: ArrayLike,
    upper: ArrayLike,
    elements: Sequence[int],
    cell: str | None = None,
    *,
    diagonal: str = "right",
) -> NamedMesh:
    """Rectangle or box with cells of equal size.

    Args:
        comm: communicator.
        lower: corner with the smallest coordinates, shape (2,) or (3,); unit: length.
        upper: the opposite corner, same shape.
        elements: numbers of intervals along the axes, same shape; simplices are halves or sixths of a cell.
        cell: "triangle" or "quadrilateral", "tetrahedron" or "hexahedron"; None: simplices.
        diagonal: of the rectangles that triangles halve, which rises to the "right" or to the "left", or "alternating"
            between neighbours, which favours no direction.

    Returns:
        The mesh; its sides are "left", "right" (along the first axis), "bottom", "top", and "back", "front".

    Raises:
        ValueError: another dimension, cell or diagonal, a corner that is not above the lower one, or fewer than one
            interval.
    """
    return grid(comm, equal_parts(lower, upper, elements), cell, diagonal=diagonal)


def equal_parts(lower: ArrayLike, upper: ArrayLike, elements: Sequence[int]) -> list[FloatArray]:
    """Lines or planes that cut a rectangle or box into cells of equal size.

    Args:
        lower: see :func:`box`, as the others.
        upper: see there.
        elements: see there.

    Returns:
        For every axis their coordinates, from one side to the other.

    Raises:
        ValueError: another dimension, a corner that is not above the lower one, or fewer than one interval.
    """
    dim = checks.choice("dimension of lower", np.size(lower), (2, 3))
    low, high = checks.array("lower", lower, (dim,)), checks.array("upper", upper, (dim,))
    if not (low < high).all():
        raise ValueError(f"upper = {upper!r}: coordinates > lower = {lower!r} are required")
    if np.shape(elements) != (dim,):
        raise ValueError(f"elements = {elements!r}: one number for each of the {dim} axes is required")
    counts = [checks.whole(f"elements[{i}]", n, 1) for i, n in enumerate(elements)]
    return [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, counts, strict=True)]


def grid(comm: MPI.Comm, lines: Sequence[ArrayLike], cell: str | None = None, *, diagonal: str = "right") -> NamedMesh:
    """Rectangle or box with graded cells.

    Triangles below diagonals that rise to the left are mirror images, with the numbers of their vertices.

    Args:
        comm: communicator.
        lines: for each of two or three axes the increasing coordinates of the grid's lines or planes, from one side
            to the other, two or more; unit: length.
        cell: as for :func:`box`.
        diagonal: as for :func:`box`.

    Returns:
        The mesh; its sides have the names of :func:`box`.

    Raises:
        ValueError: another number of axes, cell or diagonal, or coordinates that do not increase.
    """
    checks.listed("lines", lines)
    dim = checks.choice("number of axes in lines", len(lines), (2, 3))
    kind = getattr(mesh.CellType, checks.choice("cell", CELLS[dim][0] if cell is None else cell, CELLS[dim]))
    checks.kind("comm", comm, MPI.Comm, "a communicator, such as MPI.COMM_WORLD,")
    diagonals = ("right", "left", "alternating") if kind == mesh.CellType.triangle else ("right",)
    mirrored = checks.choice("diagonal", diagonal, diagonals) == "left"
    axes = [checks.array(f"lines[{i}]", line, (None,)) for i, line in enumerate(lines)]
    for i, line in enumerate(axes):
        if len(line) < 2 or not (np.diff(line) > 0.0).all():
            raise ValueError(f"lines[{i}] = {lines[i]!r}: two or more coordinates that increase are required")
    counts = [len(line) - 1 for line in axes]
    make = mesh.create_rectangle if dim == 2 else mesh.create_box
    options = {"diagonal": mesh.DiagonalType.right_left} if diagonal == "alternating" else {}
    domain = make(comm, [np.zeros(dim), np.array(counts, dtype=np.float64)], counts, kind, **options)
    for i, line in enumerate(axes):
        number = np.rint(domain.geometry.x[:, i]).astype(int)
        domain.geometry.x[:, i] = line[counts[0] - number if mirrored and i == 0 else number]
    return named(domain, **sides_of(axes))


def sides_of(lines: Sequence[FloatArray]) -> dict[str, Any]:
    """Predicates of the sides of a rectangle or box by name.

    Args:
        lines: coordinates along every axis, from one side to the other.
    """
    ends = [(i, name, end) for i, line in enumerate(lines) for name, end in zip(SIDES[i], line[[0, -1]], strict=True)]
    sides: dict[str, Any] = {name: lambda x, i=i, end=end: x[i] == end for i, name, end in ends}
    return sides


def tagged(domain: mesh.Mesh, kind: str, groups: Mapping[str, IntArray]) -> Any:
    """Tags 1, 2, ... of groups of facets or cells.

    Args:
        domain: mesh.
        kind: "boundary facet", "facet" or "cell".
        groups: local numbers by name.

    Returns:
        Tags of dolfinx; None without any group.

    Raises:
        ValueError: a group is empty on all ranks, or two share a number.
    """
    if not groups:
        return None
    for name, chosen in groups.items():
        if domain.comm.allreduce(len(chosen), op=MPI.SUM) == 0:
            raise ValueError(f"part {name!r} has no {kind}: its functions must select at least one")
    every = np.concatenate(list(groups.values())).astype(np.int32)
    marks = np.repeat(np.arange(1, len(groups) + 1, dtype=np.int32), [len(chosen) for chosen in groups.values()])
    order = np.argsort(every, kind="stable")
    if domain.comm.allreduce(bool((np.diff(every[order]) == 0).any()), op=MPI.LOR):
        raise ValueError(f"parts {', '.join(map(repr, groups))} overlap: every {kind} may belong to one part only")
    dim = domain.topology.dim - (kind != "cell")
    return mesh.meshtags(domain, dim, every[order], marks[order])


def _one_of(names: Sequence[str]) -> str:
    return f"one of {', '.join(map(repr, names)) or 'nothing'} is required"


def _tags(kind: str, names: Sequence[str], known: Sequence[str]) -> tuple[int, ...]:
    """Tags of groups by their names, each once."""
    if not names:
        raise ValueError(f"no {kind} group is named: {_one_of(known)}")
    for name in names:
        if name not in known:
            raise ValueError(f"{kind} group {name!r} does not exist: {_one_of(known)}")
    return tuple(sorted({known.index(name) + 1 for name in names}))


def _chosen(tags: Any, values: Sequence[int]) -> IntArray:
    return tags.indices[np.isin(tags.values, values)]


def _located(domain: mesh.Mesh, dim: int, where: Predicate | Sequence[Predicate]) -> IntArray:
    predicates = [where] if callable(where) else where
    if not isinstance(predicates, list | tuple) or not all(map(callable, predicates)):
        raise ValueError(f"part = {where!r}: a function of coordinates, or several, is required")
    found = [mesh.locate_entities(domain, dim, predicate) for predicate in predicates]
    return np.unique(np.concatenate(found)).astype(np.int32)
