"""Mesh of a short piece of aorta with the three sinuses of a valve."""

from typing import Any

import numpy as np
from mpi4py import MPI

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from varmint.mesh.models import Region, from_gmsh, set_sizes
from varmint.mesh.named import NamedMesh

SINUSES = 3
MOST = 6
"""Sectors of the aorta that ranks get, at most: narrower ones have too much of a boundary."""


def aortic_root(
    comm: MPI.Comm,
    *,
    size: float,
    swept_size: float | None = None,
    swept: tuple[float, float] = (-0.15, 1.25),
    radius: float = 1.1,
    bottom: float = -0.5,
    top: float = 2.0,
    sinus_radius: float = 0.88,
    sinus_offset: float = 0.55,
    sinus_height: float = 0.68,
) -> NamedMesh:
    """Cylinder about the third axis, united with three spheres at the azimuths 60, 180 and 300 degrees.

    The default lengths are those of the heart valve of D. Kamensky, doi:10.1016/j.camwa.2020.01.023, in centimetres.

    Args:
        comm: communicator; only rank 0 calls gmsh.
        size: of the cells; unit: length, as for all that follows.
        swept_size: of the cells where leaflets move, from where they grow; None: ``size``.
        swept: lowest and highest third coordinate of that region, which is as wide as the cylinder; the free edges of
            the open valve reach up to 1.19, the bellies of the closing one down to -0.12.
        radius: of the cylinder.
        bottom: third coordinate of the inlet.
        top: third coordinate of the outlet.
        sinus_radius: of the spheres.
        sinus_offset: distance of their centres from the axis.
        sinus_height: third coordinate of their centres.

    Returns:
        Tetrahedra with the groups of facets "inlet", "outlet" and "walls".

    Raises:
        ValueError: a length is not positive, ends or the region are not in ascending order, the spheres do not bulge
            out of the cylinder or reach its ends, or cells are to be larger where leaflets move.
        RuntimeError: gmsh is in use.
    """
    lengths = {"size": size, "radius": radius, "sinus_radius": sinus_radius, "sinus_offset": sinus_offset}
    for name, value in lengths.items():
        checks.positive(name, value)
    fine = size if swept_size is None else checks.positive("swept_size", swept_size)
    if fine > size:
        raise ValueError(f"swept_size = {fine!r}: a number up to size = {size!r} is required")
    z_0, z_c, z_1 = (checks.finite(*it) for it in (("bottom", bottom), ("sinus_height", sinus_height), ("top", top)))
    if not z_0 < z_c - sinus_radius < z_c + sinus_radius < z_1:
        raise ValueError(
            f"bottom, sinus_height, top = {z_0:g}, {z_c:g}, {z_1:g}: spheres between the ends are required"
        )
    if not radius - sinus_offset < sinus_radius < sinus_offset + radius:
        raise ValueError(f"sinus_radius = {sinus_radius:g}: spheres that bulge out of the cylinder are required")
    low, high = checks.array("swept", swept, (2,))
    if not low < high:
        raise ValueError(f"swept = {swept!r}: ascending numbers are required")

    def build(gmsh: Any) -> None:
        occ, model = gmsh.model.occ, gmsh.model
        parts = [(3, occ.addCylinder(0.0, 0.0, z_0, 0.0, 0.0, z_1 - z_0, radius))]
        for angle in np.pi / 3.0 + 2.0 * np.pi / SINUSES * np.arange(SINUSES):
            center = sinus_offset * np.cos(angle), sinus_offset * np.sin(angle), z_c
            parts.append((3, occ.addSphere(*center, sinus_radius)))
        whole, _ = occ.fuse(parts[:1], parts[1:])
        occ.synchronize()
        faces: dict[str, list[int]] = {"inlet": [], "outlet": [], "walls": []}
        for _, face in model.getBoundary(whole, oriented=False):
            _, _, lowest, _, _, highest = model.getBoundingBox(2, face)
            flat = highest - lowest < 1e-3 * (z_1 - z_0)
            name = "walls" if not flat else "inlet" if abs(lowest - z_0) < abs(lowest - z_1) else "outlet"
            faces[name].append(face)
        for name, tags in faces.items():
            model.setPhysicalName(2, model.addPhysicalGroup(2, tags), name)
        model.setPhysicalName(3, model.addPhysicalGroup(3, [tag for _, tag in whole]), "fluid")
        shape = {"XMin": -radius, "XMax": radius, "YMin": -radius, "YMax": radius, "ZMin": low, "ZMax": high}
        set_sizes(gmsh, size, [] if fine == size else [Region("Box", fine, shape)])

    return from_gmsh(comm, build, 3, sectors)


def sectors(x: FloatArray, ranks: int) -> IntArray:
    """Ranks of cells: sectors about the third axis, so that each has its part of what lies around this.

    Leaflets, whose cells take longer than others, would be all of one rank in a part of the aorta's length. More than
    :data:`MOST` ranks share the length as well.

    Args:
        x: middles of cells, shape (cells, 3).
        ranks: number of the ranks.

    Returns:
        Shape (cells,).
    """
    along = next(k for k in range(1, ranks + 1) if ranks % k == 0 and ranks // k <= MOST)
    rank, azimuth = np.empty(len(x), dtype=np.int32), np.arctan2(x[:, 1], x[:, 0])
    for k, sector in enumerate(np.array_split(np.argsort(azimuth), ranks // along)):
        for j, part in enumerate(np.array_split(sector[np.argsort(x[sector, 2])], along)):
            rank[part] = along * k + j
    return rank
