"""What flows past a sphere and through a hole in meshes that fit, see ``space_bodies.py`` and ``space_gaps.py``."""

from typing import Any

import numpy as np
from scene import COMM
from space_gaps import Hole

from tigar_x import compat
from varmint import Flow, Slip, Traction, Velocity, flow_rate
from varmint.mesh.models import Region, from_gmsh, set_sizes
from varmint.quantities import BoundaryForce


def fitted_drag(size: float, *, reynolds: float = 20.0, degree: int = 2, around: float = 0.25) -> dict[str, float]:
    """Drag of :class:`space_bodies.Obstacle` in steady flow on a mesh that fits the sphere, by gmsh.

    Args:
        size: of the cells far away.
        reynolds: see there.
        degree: of velocity and pressure.
        around: size of the cells at the sphere over that far away.
    """

    def build(gmsh: Any) -> None:
        occ = gmsh.model.occ
        channel, body = occ.addBox(-1.5, 0.0, 0.0, 4.0, 1.0, 1.0), occ.addSphere(0.0, 0.0, 0.0, 0.5)
        occ.cut([(3, channel)], [(3, body)])
        centre = {"Radius": 0.5, "XCenter": 0.0, "YCenter": 0.0, "ZCenter": 0.0}
        _meshed(gmsh, 0, size, Region("Ball", around * size, centre))

    sides = [Velocity("start", (1.0, 0.0, 0.0)), Velocity("body"), Slip("walls"), Traction("end")]
    flow = Flow(from_gmsh(COMM, build, 3), sides, rho=1.0, mu=1.0 / reynolds, degree=degree)
    flow.start((1.0, 0.0, 0.0))
    flow.solve()
    return {"drag": 8.0 * float(BoundaryForce(flow, "body")()[0]), "unknowns": flow.unknowns}


def fitted_flow(hole: Hole, *, around: float = 0.25, thickness: float = 0.05, degree: int = 2) -> dict[str, float]:
    """Flow of :class:`space_gaps.Hole` over that of slow flow through a thin plate, on a mesh that fits one, by gmsh.

    Args:
        hole: which; in the middle of the channel.
        around: size of the cells at the hole over its radius.
        thickness: of the plate over the radius.
        degree: of velocity and pressure.
    """
    R, L = hole.radius, hole.length

    def build(gmsh: Any) -> None:
        occ, half = gmsh.model.occ, 0.5 * thickness * R
        channel = occ.addBox(0.0, 0.0, -L, 0.5, 0.5, 2.0 * L)
        plate = occ.addBox(0.0, 0.0, -half, 0.5, 0.5, 2.0 * half)
        way = occ.addCylinder(0.0, 0.0, -half, 0.0, 0.0, 2.0 * half, R)
        solid, _ = occ.cut([(3, plate)], [(3, way)])
        occ.cut([(3, channel)], solid)
        centre = {"Radius": 1.2 * R, "XCenter": 0.0, "YCenter": 0.0, "ZCenter": 0.0}
        _meshed(gmsh, 2, 0.12, Region("Ball", around * R, centre))

    ends = [Traction("end", (0.0, 0.0, -1.0)), Traction("start"), Slip("walls"), Velocity("body")]
    flow = Flow(from_gmsh(COMM, build, 3), ends, rho=1.0, mu=hole.mu, degree=degree)
    flow.solve()
    (rate,) = compat.compile_forms(flow_rate(flow, "start"))
    return {"flow": 4.0 * compat.assemble_scalar(rate) / hole.slow, "unknowns": flow.unknowns}


def _meshed(gmsh: Any, axis: int, size: float, *regions: Region) -> None:
    """Name the sides of a quarter of a channel along an axis with a body in it, and say how large cells are."""
    model = gmsh.model
    model.occ.synchronize()
    low, high = np.split(np.array(model.getBoundingBox(-1, -1)), 2)
    groups: dict[str, list[int]] = {"start": [], "end": [], "walls": [], "body": []}
    for _, tag in model.getEntities(2):
        box_of = np.split(np.array(model.getBoundingBox(2, tag)), 2)
        on_side = [np.abs(np.array(box_of) - side[k]).max(axis=0)[k] < 1e-4 for side in (low, high) for k in range(3)]
        flat = np.reshape(on_side, (2, 3))
        name = "start" if flat[0, axis] else "end" if flat[1, axis] else "walls" if flat.any() else "body"
        groups[name].append(tag)
    for name, tags in groups.items():
        model.setPhysicalName(2, model.addPhysicalGroup(2, tags), name)
    model.addPhysicalGroup(3, [tag for _, tag in model.getEntities(3)])
    set_sizes(gmsh, size, regions)
