"""The band of fluid cells around an immersed surface, where stabilisation parameters are scaled."""

import numpy as np
from dolfinx import fem, mesh
from numpy.typing import NDArray

from coudalfish.surface.trace import Location
from tigar_x import checks, compat

MARKED = 1e-8
"""A vertex is marked when its basis function exceeds this at an immersed point."""


class BandScale(fem.Function):
    """A field that a band keeps up to date; a residual that has one needs its band."""


class SurfaceBand:
    """Two cell-wise fields that the fluid's form may use; the coupler rebuilds them every step.

    The band is all cells that touch a vertex of a cut cell (Kamensky, doi:10.1016/j.camwa.2020.01.023).

    Args:
        mesh_f: fluid mesh.
        scales: the two fields, constant in cells; None: they are made here.

    Attributes:
        scale_m: factor of tau_M, one outside the band.
        scale_c: divisor of tau_C, one outside the band.
    """

    def __init__(self, mesh_f: mesh.Mesh, scales: tuple[fem.Function, fem.Function] | None = None) -> None:
        checks.kind("mesh_f", mesh_f, mesh.Mesh, "a mesh of dolfinx, such as the domain of a NamedMesh,")
        if scales is None:
            cells = compat.lagrange_space(mesh_f, 0)
            scales = BandScale(cells, name="scale_m"), BandScale(cells, name="scale_c")
        self.scale_m, self.scale_c = scales
        cells = self.scale_m.function_space
        self._cell_dof = compat.cell_dofs(cells)[:, 0]
        vertices = compat.lagrange_space(mesh_f, 1)
        self._vertex_dofs = compat.cell_dofs(vertices)
        self._vertices_by_corner = np.ascontiguousarray(self._vertex_dofs.T)
        self._mark = fem.Function(vertices, name="mark")
        self._outside: fem.Function | None = None
        self.clear()

    def clear(self) -> None:
        """No surface: all scales are one."""
        self.scale_m.x.array[:] = 1.0
        self.scale_c.x.array[:] = 1.0

    def update(self, location: Location, *, scale_m: float, scale_c: float) -> None:
        """Rebuild the band (collective).

        Args:
            location: where the immersed points lie.
            scale_m: factor of tau_M in the band, in (0, 1].
            scale_c: divisor of tau_C in the band, in (0, 1].

        Raises:
            ValueError: a scale is out of range.
        """
        for name, value in (("scale_m", scale_m), ("scale_c", scale_c)):
            checks.within(name, checks.positive(name, value), 0.0, 1.0)
        mark = self._mark.x.array
        mark[:] = 0.0
        mine = location.owned
        touched = location.barycentric[mine] > MARKED
        mark[self._vertex_dofs[location.cells[mine]][touched]] = 1.0
        compat.accumulate(self._mark)
        inside = self._cell_dof[np.logical_or.reduce((mark > 0.0)[self._vertices_by_corner])]
        self.clear()
        self.scale_m.x.array[inside] = scale_m
        self.scale_c.x.array[inside] = scale_c

    def surrounded(self, space: fem.FunctionSpace) -> NDArray[np.bool_]:
        """Mask of the local nodes of a blocked space all of whose cells are in the band (collective).

        Args:
            space: Lagrange space on the mesh, all components of which live at the same nodes.
        """
        if self._outside is None or self._outside.function_space != space:
            self._outside = fem.Function(space)
        at = self._outside.x.array.reshape(-1, space.dofmap.index_map_bs)
        beyond = np.minimum(self.scale_m.x.array, self.scale_c.x.array)[self._cell_dof] >= 1.0
        at[:] = 0.0
        at[compat.cell_dofs(space)[beyond], 0] = 1.0
        if space.mesh.comm.size > 1:
            compat.accumulate(self._outside)
        return np.asarray(at[:, 0] == 0.0)
