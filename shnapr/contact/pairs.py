"""What pairs of points that interact do to these: arrays in, arrays and sparse matrices out."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from shnapr.contact.neighbours import IndexArray
from tigar_x import checks
from tigar_x.compat import FloatArray


@dataclass(frozen=True, eq=False)
class ContactForces:
    """Contact in one configuration.

    Attributes:
        energy: E_c; unit: energy (per depth in the plane).
        forces: contribution to the finite element residual, the derivative of E_c by the homogeneous nodal values,
            shape (nodes, d).
        tangent: derivative of ``forces`` by the homogeneous nodal values, with blocks for touching nodes only, shape
            (nodes d, nodes d), symmetric; None: not asked for.
        pairs: number of interacting pairs.
        load: sum of the forces between them without regard to direction; unit: force.
        distance: smallest distance of an interacting pair; inf without any.
        coincident: number of pairs in the same place.
    """

    energy: float
    forces: FloatArray
    tangent: sp.bsr_matrix | None
    pairs: int
    load: float
    distance: float
    coincident: int

    def __post_init__(self) -> None:
        checks.freeze(self)


def gaps(x: FloatArray, pairs: IndexArray) -> tuple[FloatArray, FloatArray]:
    """Vectors from the first to the second point of pairs, and their lengths."""
    gap = np.take(x, pairs[:, 1], axis=0)
    gap -= np.take(x, pairs[:, 0], axis=0)
    return gap, np.sqrt(np.einsum("pi,pi->p", gap, gap))


def ends(pairs: IndexArray, n: int, first: float) -> sp.csc_matrix:
    """Matrix (n, pairs) that adds a pair's value to its second point and ``first`` times it to its first."""
    m = len(pairs)
    signs = np.tile([first, 1.0], m)
    return sp.csc_matrix((signs, pairs.ravel(), np.arange(0, 2 * m + 1, 2)), shape=(n, m))


def by_column(rows: IndexArray, columns: IndexArray, values: IndexArray, n: int) -> sp.csc_matrix:
    """Distinct entries sorted by columns and then by rows, in linear time."""
    table = sp.coo_matrix((values, (rows, columns)), shape=(n, n))
    table.has_canonical_format = True  # no entry twice: nothing to sum
    return table.tocsr().tocsc()


def stiffness(direction: FloatArray, along: FloatArray, across: FloatArray) -> FloatArray:
    """Blocks ``along r r + across (I - r r)`` of pairs, shape (pairs, d, d)."""
    blocks = direction[:, :, None] * direction[:, None, :]
    blocks *= (along - across)[:, None, None]
    for i in range(direction.shape[1]):
        blocks[:, i, i] += across
    return blocks


def assembled(pairs: IndexArray, blocks: FloatArray, w: FloatArray) -> sp.bsr_matrix:
    """Sum over pairs of their block on both diagonals and minus it off them, for homogeneous nodal values."""
    (m, d, _), n = blocks.shape, len(w)
    touching = np.zeros(n, dtype=bool)
    touching[pairs] = True
    nodes = np.flatnonzero(touching)
    diagonal = (ends(pairs, n, 1.0) @ blocks.reshape(m, d * d))[nodes].reshape(-1, d, d) / w[nodes, None, None] ** 2
    values = np.concatenate([-blocks / w[pairs].prod(axis=1)[:, None, None], diagonal])
    number, (i, j) = np.arange(len(values)), pairs.T
    rows, columns = np.concatenate([i, j, nodes]), np.concatenate([j, i, nodes])
    order = by_column(rows, columns, np.concatenate([number[:m], number]), n)  # symmetric: as good as by rows
    data = np.take(values, order.data, axis=0)
    return sp.bsr_matrix((data, order.indices, order.indptr), shape=(n * d, n * d))
