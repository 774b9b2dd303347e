"""A band of small cells that follows the shell through the fluid.

```python
meshes = Refinement(base)                                  # of varmint.mesh.refined; base is a mesh of large cells
following = FollowingBand(meshes, make_flow, shell, Band(size=0.02), ahead=20)
for report in following.fsi.run(until=1.0):
    following.follow()                                     # between two steps
```

The mesh is made from the base anew when the shell is about to leave the small cells: they lie where it is and will be
for some steps, and behind it cells are as large as those of the base. The flow on the new mesh gets the state of the
old one, see :mod:`coudalfish.sides.transfer`. It changes between steps alone, so that a step that fails restores a
state on the mesh that it began with.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.spatial import cKDTree

from coudalfish.coupler import CouDALFISh
from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.objects import ImmersedFlow, fluid_side
from coudalfish.step.options import CouplingOptions
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.ranks import first, gathered

SizesOfCells = Callable[[FloatArray], FloatArray]
LEAVES = 0.8
"""Part of the band's reach by which the next step may take the shell away from where it was expected."""


NAMES = np.array([1.0, 0.6180339887, 0.4142135624])
"""What makes one number of a corner's coordinates, by which cells that share it know it."""


class Meshes(Protocol):
    """What makes meshes, such as varmint's ``Refinement``."""

    def mesh(self, sizes: SizesOfCells) -> Any:
        """A mesh whose cells have edges as short as a function of their corners asks for (collective)."""


@dataclass(frozen=True)
class Band:
    """How small cells are near the shell.

    Attributes:
        size: length that edges of cells may have there; unit: length.
        reach: how far from the shell they are as small, in ``size``.
        growth: by how much edges may be longer per distance beyond.
    """

    size: float
    reach: float = 2.0
    growth: float = 0.5

    def __post_init__(self) -> None:
        checks.positive("size", self.size)
        checks.positive("reach", self.reach)
        checks.positive("growth", self.growth)

    def around(self, x: FloatArray) -> SizesOfCells:
        """Largest edges of cells by their corners, shape (cells, d + 1, d).

        Args:
            x: points of the shell, no farther apart than ``size``, shape (points, d); unit: length.
        """
        tree = cKDTree(x)

        def sizes(corners: FloatArray) -> FloatArray:
            # from each corner to where the shell is nearest, and how far the cell goes in that direction
            places = corners.reshape(-1, corners.shape[-1])
            _, one, corner = np.unique(places @ NAMES[: corners.shape[-1]], return_index=True, return_inverse=True)
            away, nearest = tree.query(places[one])
            towards = (x[nearest] - places[one]) / np.maximum(away, np.finfo(float).tiny)[:, None]
            corner = corner.reshape(corners.shape[:2])
            extent = np.einsum("cid,cjd->cij", towards[corner], corners)
            beyond = away[corner] - extent.max(axis=2) + np.einsum("cii->ci", extent)
            beyond = np.maximum(beyond.min(axis=1) - self.reach * self.size, 0.0)
            return np.asarray(self.size + self.growth * beyond)

        return sizes


class FollowingBand:
    """A shell in a flow whose cells are small where the shell is (collective).

    Args:
        meshes: makes the meshes.
        make_flow: function of a mesh that makes the flow there, each with the same conditions and options; its state
            counts for the first one alone.
        shell: see :class:`coudalfish.coupler.CouDALFISh`.
        band: how small cells are.
        ahead: for how many steps the shell moves within the small cells at its present velocity.
        options: of the coupling, see there.
        multiplier: see there.
        expected: points around which the first mesh is made, as a run that goes on had them; None: those of the shell.

    Attributes:
        fsi: what is coupled; its flow is another one after :meth:`follow`.
        flow: the present flow.
        number: of meshes that were made, the first one among them.
    """

    def __init__(
        self,
        meshes: Meshes,
        make_flow: Callable[[Any], ImmersedFlow],
        shell: Any,
        band: Band,
        *,
        ahead: int = 20,
        options: CouplingOptions | None = None,
        multiplier: float | FloatArray = 0.0,
        expected: FloatArray | None = None,
    ) -> None:
        checks.having("meshes", meshes, "mesh", "what makes meshes, such as Refinement(base),")
        checks.kind("band", band, Band, "a Band")
        self._meshes, self._make, self.band, self.ahead = meshes, make_flow, band, checks.whole("ahead", ahead, 1)
        self.flow, side = self._side(_points(shell) if expected is None else expected)
        self.fsi, self.number = CouDALFISh(side, shell, options, multiplier=multiplier), 1

    def _side(self, x: FloatArray) -> tuple[ImmersedFlow, FluidSubproblem]:
        """A flow on a mesh around points, and as a side of the coupling."""
        self._expected, sizes = cKDTree(x), self.band.around(x)
        mesh = self._meshes.mesh(sizes)
        flow = self._make(mesh)
        corners = compat.cell_vertices(mesh.domain)
        shortest = compat.shortest_edges(mesh.domain)[: compat.owned_cells(mesh.domain)]
        near = gathered(mesh.domain.comm, shortest[sizes(corners[: len(shortest)]) <= self.band.size])
        size = first(mesh.domain.comm, None if near is None else float(np.median(near)))
        return flow, fluid_side(flow, mesh_size=size)

    @property
    def expected(self) -> FloatArray:
        """Points around which the present mesh was made, shape (points, d); unit: length."""
        return np.asarray(self._expected.data)

    def follow(self) -> bool:
        """Make the mesh anew if the shell is about to leave the small cells (collective); whether it was made.

        What fails leaves everything as it was.
        """
        shell, comm = self.fsi.shell, self.fsi.fluid.comm
        then = shell.positions() + self.fsi.step_size * shell.velocity()
        if first(comm, float(self._expected.query(then)[0].max())) <= self._allowed:
            return False
        expected = self._expected
        try:
            flow, side = self._side(self._swept())
            self.fsi.move_to(side)
        except BaseException:
            self._expected = expected
            raise
        self.flow, self.number = flow, self.number + 1
        return True

    @property
    def _allowed(self) -> float:
        """How far the shell may come away from where it was expected."""
        return LEAVES * self.band.reach * self.band.size

    def _swept(self) -> FloatArray:
        """Where the points of the shell are and will be."""
        x, v = self.fsi.shell.positions(), self.fsi.shell.velocity()
        time = self.ahead * self.fsi.step_size
        count = 1 + int(np.ceil(float(np.linalg.norm(v, axis=1).max()) * time / self._allowed))
        return np.concatenate([x + t * v for t in np.linspace(0.0, time, count + 1)])

    def series(self, make: Callable[[Any, int], Callable[..., Any]]) -> "ChangingSeries":
        """What writes the flow in a run: other files for every mesh.

        Args:
            make: function of the flow and of the number of its mesh, from 1, that gives what a run takes, such as
                ``lambda flow, k: movie(flow, out / f"fluid_{k}.vtkhdf")``.
        """
        return ChangingSeries(self, make)


class ChangingSeries:
    """Writes a flow whose mesh changes, for each mesh by a series of its own, see :meth:`FollowingBand.series`."""

    def __init__(self, following: FollowingBand, make: Callable[[Any, int], Callable[..., Any]]) -> None:
        self._following, self._make, self._number = following, make, 0
        self._series: Any = None

    def write(self, t: float) -> None:
        """Write the present state."""
        if self._number != self._following.number:
            self.close()
            self._number = self._following.number
            self._series = self._make(self._following.flow, self._number)()
        self._series.write(t)

    def close(self) -> None:
        """Close the present series."""
        if hasattr(self._series, "close"):
            self._series.close()


def _points(shell: Any) -> FloatArray:
    """Points of a shell that is coupled with nothing yet."""
    x = shell.positions
    return np.asarray(x() if callable(x) else x)[:, : shell.spline.nsd]
