"""Parts of a mesh's boundary."""

from collections.abc import Callable
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import mesh


def facet_measure(domain: mesh.Mesh, *where: Callable[[Any], Any], quadrature_degree: int) -> ufl.Measure:
    """Measure of the boundary facets that predicates select.

    Args:
        domain: mesh.
        where: each maps coordinates of shape (3, n) to a mask of shape (n,); a facet is selected when one of them
            selects all its vertices.
        quadrature_degree: degree of the integrals.

    Returns:
        Exterior facet measure of exactly these facets.

    Raises:
        ValueError: no facet on any rank is selected.
    """
    dim = domain.topology.dim - 1
    facets = np.unique(np.concatenate([mesh.locate_entities_boundary(domain, dim, one) for one in where]))
    if domain.comm.allreduce(len(facets), op=MPI.SUM) == 0:
        raise ValueError(f"where = {where!r} selects no boundary facet; at least one is needed")
    tags = mesh.meshtags(domain, dim, facets, np.ones(len(facets), dtype=np.int32))
    return ufl.ds(domain=domain, subdomain_data=tags, metadata={"quadrature_degree": quadrature_degree})(1)
