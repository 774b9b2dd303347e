"""What the points of a surface see of a flow whose pressure jumps there, and whose velocity may have a kink.

The flow knows the surface as the zero line of a linear function phi. Points see it there, not where the surface is: a
force beside the place of the jump would make a pair with it, and move the fluid by its moment.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from dolfinx import fem

from coudalfish.surface.meeting import Meeting, NormalForces
from coudalfish.surface.trace import Location, TraceMatrix
from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray


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
            location: its places, on the zero line in divided cells; in the same cells.
            phi: signed distance at the nodes over the length of kinks, of any value where none is near, shape (nodes,).
            kink: mask of the nodes that have one, shape (nodes,).
        """
        (at, w), seen, each = plain.penalty, plain.seen, space.mesh.geometry.dim + 1
        values, column = compat.tabulate(space, location.barycentric[location.owned, 1:]), at.indices.reshape(-1, each)
        phi, kinked = phi[seen], kink[seen]
        of_nodes = phi[column]
        psi = np.einsum("pi,pi->p", values, np.abs(of_nodes)) - np.abs(np.einsum("pi,pi->p", values, of_nodes))
        second = len(seen) - 1 + np.cumsum(kinked)  # the column of a node's kink
        there = np.ones((len(column), 2 * each), dtype=bool)
        there[:, each:] = kinked[column]
        starts = np.zeros(len(location.cells) + 1, dtype=np.int32)
        starts[1:][location.owned] = there.sum(axis=1)
        columns = np.hstack([column, second[column]])[there].astype(np.int32)
        nodes = np.concatenate([seen, len(kink) + seen[kinked]]).astype(seen.dtype)
        data = np.hstack([values, psi[:, None] * values])[there]
        E = sp.csr_matrix((data, columns, np.cumsum(starts)), shape=(len(starts) - 1, len(nodes)))
        B = E if plain.means is None else plain.means @ E
        return cls(plain, location, TraceMatrix(B, nodes), (E, w))

    @property
    def seen(self) -> IntArray:
        """See :class:`coudalfish.surface.meeting.Meeting`."""
        return self.trace.nodes

    @property
    def W(self) -> FloatArray:
        """See there."""
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

    def normal_forces(
        self, functions: sp.csr_matrix, n: FloatArray, trace: sp.csr_matrix | None = None
    ) -> NormalForces | None:
        """See there (collective)."""
        return self.plain.normal_forces(functions, n, self.penalty[0] if trace is None else trace)
