"""What the points of a surface see of a velocity that has a kink there."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from coudalfish.surface.meeting import Meeting
from coudalfish.surface.trace import Location, TraceMatrix
from tigar_x.compat import FloatArray


@dataclass(frozen=True, eq=False)
class KinkedMeeting:
    """A meeting that sees kinks as well: nodes n, n + 1, ... stand for those of nodes 0, 1, ...

    Attributes:
        plain: the meeting without them.
        trace: see :class:`coudalfish.surface.meeting.Meeting`.
        penalty: see there.
    """

    plain: Meeting
    trace: TraceMatrix
    penalty: tuple[sp.csr_matrix, FloatArray]

    @classmethod
    def of(cls, plain: Meeting, phi: FloatArray, kink: Any) -> "KinkedMeeting":
        """With the kinks of nodes: a velocity is ``u + psi a`` with ``psi = sum_i N_i |phi_i| - |phi|``.

        Args:
            plain: the meeting without them.
            phi: signed distance at the nodes, of any value where none is near, shape (nodes,).
            kink: mask of the nodes that have one, shape (nodes,).
        """
        (E, w), nodes = plain.penalty, plain.trace.nodes
        values, chosen = phi[nodes], kink[nodes]
        psi = E @ np.abs(values) - np.abs(E @ values)
        E = sp.hstack([E, sp.diags(psi) @ E[:, chosen]], format="csr")
        nodes = np.concatenate([nodes, len(phi) + nodes[chosen]]).astype(nodes.dtype)
        B = E if plain.means is None else (plain.means @ E).tocsr()
        return cls(plain, TraceMatrix(B, nodes), (E, w))

    @property
    def W(self) -> FloatArray:
        """See :class:`coudalfish.surface.meeting.Meeting`."""
        return self.plain.W

    @property
    def active(self) -> Any:
        """See there."""
        return self.plain.active

    @property
    def location(self) -> Location:
        """See there."""
        return self.plain.location

    @property
    def means(self) -> sp.csr_matrix | None:
        """See there."""
        return self.plain.means

    def vertex_functions(self) -> sp.csr_matrix:
        """See there (collective)."""
        return self.plain.vertex_functions()
