"""Checks of a flow before anything is computed."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from mpi4py import MPI

from tigar_x import checks, compat
from tigar_x.fem.schemes import Scheme, companion, require_scheme
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.conditions import Condition, Resistance
from varmint.flow.options import FlowOptions
from varmint.forms.motion import ElasticMotion, MeshMotion
from varmint.forms.solids import Solid
from varmint.mesh.named import NamedMesh, require_named

log = logging.getLogger(__name__)

AT_SURFACE = ("plain", "jump", "jump and kink")
"""What the fields of a flow may know of an immersed surface."""


def check_kinds(mesh: Any, conditions: Any, scheme: Any, moving: Any, solid: Any, options: Any) -> None:
    """Check that the parts of a flow are what they should be.

    Args:
        mesh: mesh with names.
        conditions: conditions on facet groups.
        scheme: of time integration.
        moving: motion of the mesh; None: it is fixed.
        solid: solid in the flow; None: none.
        options: how the flow is discretised.

    Raises:
        ValueError: one is something else, such as a mesh of dolfinx, or a class instead of an object of it.
    """
    require_named(mesh)
    for i, condition in enumerate(checks.listed("conditions", conditions)):
        checks.kind(f"conditions[{i}]", condition, Condition, "a condition, such as Velocity('walls'),")
    require_scheme("scheme", scheme)
    if moving is not None:
        checks.kind("moving", moving, MeshMotion, "a PrescribedMotion or an ElasticMotion of the mesh")
    if solid is not None:
        checks.kind("solid", solid, Solid, "a Solid, such as Solid(NeoHookeanSolid(E, nu, density)),")
    checks.kind("options", options, FlowOptions, "FlowOptions")


def check_numbers(rho: Any, mu: Any, dt: Any, scheme: Scheme, moving: Any, solid: Any) -> None:
    """Check the numbers and the attachments of a flow.

    Args:
        rho: density.
        mu: dynamic viscosity.
        dt: time step; None: steady flow.
        scheme: of time integration.
        moving: motion of the mesh; None: it is fixed.
        solid: solid in the flow; None: none.

    Raises:
        ValueError: one is not allowed, or does not go with another.
    """
    checks.parameter("rho", rho, checks.positive)
    checks.parameter("mu", mu, checks.not_negative if dt is not None else _positive_if_steady)
    if dt is not None:
        checks.positive("dt", dt)
    elif moving is not None or solid is not None:
        raise ValueError("dt = None: a time step is required where the mesh moves or a solid is in the flow")
    if moving is not None and dt != moving.time.step_size:
        raise ValueError(f"dt = {dt!r}: that of the moving mesh, {moving.time.step_size!r}, is required")
    if moving is not None and companion(scheme) != moving.time.scheme:
        raise ValueError(f"scheme = {scheme!r}: that of the moving mesh is required")
    if solid is not None and not isinstance(moving, ElasticMotion):
        raise ValueError(f"moving = {moving!r}: a solid in the flow requires an ElasticMotion of the other cells")


def check_clock(time: TimeIntegrator, moving: Any) -> None:
    """Check that flow and mesh are at the same time and take the same step.

    Args:
        time: of the flow.
        moving: motion of the mesh; None: it is fixed.

    Raises:
        ValueError: they differ.
    """
    if moving is None:
        return
    for name, own, other in (("dt", time.step_size, moving.time.step_size), ("t", time.time, moving.time.time)):
        if own != other:
            raise ValueError(f"{name} = {own!r}: that of the moving mesh, {other!r}, is required")


def _positive_if_steady(name: str, value: Any) -> float:
    if checks.not_negative(name, value) == 0.0:
        raise ValueError(
            f"{name} = {value!r}: a number > 0 is required in steady flow, whose stabilisation has no bound"
            " where the fluid rests"
        )
    return float(value)


def check_cover(mesh: NamedMesh, conditions: Sequence[Condition]) -> None:
    """Check that every boundary facet has one condition (collective).

    Args:
        mesh: mesh with named facets.
        conditions: conditions of the flow.

    Raises:
        ValueError: a facet has none or a group has two, or a group does not exist.
    """
    domain = mesh.domain
    if not conditions:
        raise ValueError("conditions is empty: every boundary facet needs one")
    named = [mesh.facets(*condition.groups) for condition in conditions]
    exterior = compat.exterior_facets(domain)
    exterior = exterior[exterior < domain.topology.index_map(domain.topology.dim - 1).size_local]
    covered = np.unique(np.concatenate(named))
    counts = np.array([len(np.setdiff1d(exterior, covered)), len(exterior)])
    missing, total = domain.comm.allreduce(counts, op=MPI.SUM)
    if missing:
        used = {name for condition in conditions for name in condition.groups}
        free = [name for name in mesh.facet_names if name not in used]
        raise ValueError(
            f"{missing} of {total} boundary facets have no condition: facet groups without one are"
            f" {', '.join(map(repr, free)) or 'none, but some facets belong to no group'}"
        )
    seen: set[str] = set()
    for condition in conditions:
        for name in condition.groups:
            if name in seen:
                raise ValueError(f"facet group {name!r} has two conditions: one is allowed")
            seen.add(name)


def fields_at_surface(
    immersed: Any,
    mesh: NamedMesh,
    conditions: Sequence[Condition],
    *,
    degree: int,
    dt: float | None,
    moving: Any,
    solid: Any,
) -> str | None:
    """What the fields of a flow know of a surface that is immersed in it: by default what docs/defaults.md chooses.

    Args:
        immersed: True, or one of ``AT_SURFACE``; False: there is no surface.
        mesh: of the flow.
        conditions: on its boundary.
        degree: of its fields.
        dt: time step; None: steady flow.
        moving: motion of the mesh; None: it is fixed.
        solid: solid in the flow; None: none.

    Returns:
        One of ``AT_SURFACE``; None: there is no surface.

    Raises:
        ValueError: the choice is none, or what it names is not possible in this flow.
    """
    kind = checks.choice("immersed", immersed, (False, True, *AT_SURFACE))
    reasons = (
        (dt is None, "dt = None: a flow that advances in time"),
        (degree != 1, f"degree = {degree}: degree 1"),
        (compat.cell_name(mesh.domain) not in ("triangle", "tetrahedron"), "mesh: triangles or tetrahedra"),
        (moving is not None, "moving: a mesh that is fixed"),
        (solid is not None, "solid: None"),
        (any(isinstance(condition, Resistance) for condition in conditions), "conditions: no Resistance"),
    )
    missing = next((what for found, what in reasons if found), None)
    if kind is False:
        return None
    if kind is not True:
        if missing and kind != "plain":
            raise ValueError(f"immersed = {kind!r}, {missing} is required")
        return str(kind)
    if missing:
        log.info("fields at an immersed surface are 'plain': for others, %s is required", missing)
        return "plain"
    best = "jump" if mesh.domain.geometry.dim == 3 else "jump and kink"
    log.info("fields at an immersed surface are '%s'", best)
    return best
