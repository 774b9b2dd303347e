"""What the points of a surface see of a flow whose pressure jumps there, and whose velocity may have a kink.

The flow knows the surface as the zero line of a linear function phi. Points see it there, not where the surface is: a
force beside the place of the jump would make a pair with it, and move the fluid by its moment.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from dolfinx import fem

from coudalfish.surface.meeting import Meeting
from coudalfish.surface.trace import Location, TraceMatrix, trace_matrix
from tigar_x.compat import FloatArray


@dataclass(frozen=True, eq=False)
class KinkedMeeting:
    """A meeting on the zero line that sees kinks as well: nodes n, n + 1, ... stand for those of nodes 0, 1, ...

    Attributes:
        plain: the meeting of the surface where it is.
        location: on the zero line in cells that it divides.
        trace: see :class:`coudalfish.surface.meeting.Meeting`.
        penalty: see there.
    """

    plain: Meeting
    location: Location
    trace: TraceMatrix
    penalty: tuple[sp.csr_matrix, FloatArray]

    @classmethod
    def of(
        cls, plain: Meeting, space: fem.FunctionSpace, location: Location, phi: FloatArray, kink: Any
    ) -> "KinkedMeeting":
        """With the kinks of nodes: a velocity is ``u + psi a`` with ``psi = sum_i N_i |phi_i| - |phi|``.

        Args:
            plain: the meeting of the surface where it is.
            space: scalar linear space of one component of the velocity.
            location: its places, on the zero line in divided cells.
            phi: signed distance at the nodes over the length of kinks, of any value where none is near, shape (nodes,).
            kink: mask of the nodes that have one, shape (nodes,).
        """
        (_, w), fine = plain.penalty, trace_matrix(space, location)
        E, nodes = fine.B, fine.nodes
        values, chosen = phi[nodes], kink[nodes]
        psi = E @ np.abs(values) - np.abs(E @ values)
        E = sp.hstack([E, sp.diags(psi) @ E[:, chosen]], format="csr")
        nodes = np.concatenate([nodes, len(phi) + nodes[chosen]]).astype(nodes.dtype)
        B = E if plain.means is None else (plain.means @ E).tocsr()
        return cls(plain, location, TraceMatrix(B, nodes), (E, w))

    @property
    def W(self) -> FloatArray:
        """See :class:`coudalfish.surface.meeting.Meeting`."""
        return self.plain.W

    @property
    def active(self) -> Any:
        """See there."""
        return self.plain.active

    @property
    def means(self) -> sp.csr_matrix | None:
        """See there."""
        return self.plain.means

    def vertex_functions(self) -> sp.csr_matrix:
        """See there (collective)."""
        return self.plain.vertex_functions()


def onto_zero_line(location: Location, phi: FloatArray, corners: FloatArray, divided: Any) -> Location:
    """Places in divided triangles moved along the gradient of a linear function to where it is zero.

    They count to the cells in which they were, whose functions are continued where they leave them.

    Args:
        location: the places.
        phi: the function at the vertices of the cells, shape (cells, 3).
        corners: the vertices, shape (cells, 3, 2); unit: length.
        divided: mask of the cells, in which the function has two signs, shape (cells,).
    """
    here = np.flatnonzero(location.owned)
    here = here[divided[location.cells[here]]]
    cells, at = location.cells[here], location.barycentric.copy()
    two = np.linalg.inv(corners[cells, 1:] - corners[cells, :1])  # gradients of barycentric coordinates, as columns
    slopes = np.concatenate([-two.sum(axis=2, keepdims=True), two], axis=2)
    gradient = np.einsum("cdi,ci->cd", slopes, phi[cells])
    steps = np.einsum("ci,ci->c", at[here], phi[cells]) / np.einsum("cd,cd->c", gradient, gradient)
    at[here] -= steps[:, None] * np.einsum("cdi,cd->ci", slopes, gradient)
    return Location(location.cells, at, location.active)
