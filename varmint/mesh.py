"""Parts of a mesh's boundary."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import mesh

Predicate = Callable[[Any], Any]


def boundary_measures(
    domain: mesh.Mesh, *, quadrature_degree: int, **parts: Predicate | Sequence[Predicate]
) -> dict[str, ufl.Measure]:
    """Measures of named parts of the boundary; all of one call may enter one residual.

    Args:
        domain: mesh.
        quadrature_degree: degree of the integrals.
        parts: for every name one or more functions from coordinates of shape (3, n) to a mask of shape (n,); a facet
            belongs to the part when one of them selects all its vertices.

    Returns:
        Exterior facet measure of every part.

    Raises:
        ValueError: no part is named, a part has no facet on any rank, or two parts share one.
    """
    if not parts:
        raise ValueError("parts is empty: name at least one part of the boundary")
    dim = domain.topology.dim - 1
    facets = {name: _select(domain, dim, where) for name, where in parts.items()}
    for name, chosen in facets.items():
        if domain.comm.allreduce(len(chosen), op=MPI.SUM) == 0:
            raise ValueError(f"part {name!r} has no boundary facet: its functions must select at least one")
    every = np.concatenate(list(facets.values()))
    marks = np.repeat(np.arange(1, len(facets) + 1, dtype=np.int32), [len(chosen) for chosen in facets.values()])
    order = np.argsort(every, kind="stable")
    if domain.comm.allreduce(bool((np.diff(every[order]) == 0).any()), op=MPI.LOR):
        raise ValueError(f"parts {', '.join(map(repr, parts))} overlap: every facet may belong to one part only")
    tags = mesh.meshtags(domain, dim, every[order], marks[order])
    ds = ufl.ds(domain=domain, subdomain_data=tags, metadata={"quadrature_degree": quadrature_degree})
    return {name: ds(i) for i, name in enumerate(facets, 1)}


def _select(domain: mesh.Mesh, dim: int, where: Predicate | Sequence[Predicate]) -> Any:
    predicates = [where] if callable(where) else where
    found = [mesh.locate_entities_boundary(domain, dim, predicate) for predicate in predicates]
    return np.unique(np.concatenate(found)).astype(np.int32)
