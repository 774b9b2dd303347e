"""A flow as a series of files."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from tigar_x.run.vertex_values import Components
from tigar_x.run.vtkhdf import VTKHDFSeries
from varmint.flow.flow import Flow


def movie(flow: Flow, path: Path | str, **more: Components) -> Callable[..., VTKHDFSeries]:
    """What writes velocity, pressure and, where the mesh moves, its displacement, as a run takes it.

    ``movie(flow, path)().once()`` writes the present state alone. Where fields differ on both sides of a surface every
    time has a mesh of its own, with pieces of the cells that are divided; others have one mesh for all times.

    Args:
        flow: the flow.
        path: file name ending in ``.vtkhdf``.
        more: further fields, see :class:`tigar_x.run.vtkhdf.VTKHDFSeries`.

    Returns:
        A function of ``after``, see :class:`tigar_x.run.running.Run`.
    """
    d = int(flow.mesh.domain.geometry.dim)
    fields: dict[str, Components] = {"velocity": (flow.w, tuple(range(d))), "pressure": (flow.w, (d,))}
    if flow.moving is not None:
        fields["mesh_displacement"] = (flow.moving.time.x, tuple(range(d)))
    every: dict[str, Any] = {**fields, **more}
    if flow.sides is not None:
        from tigar_x.run.vtkhdf_sided import SidedVTKHDFSeries  # other flows need nothing of it

        return partial(SidedVTKHDFSeries, path, flow.mesh.domain, flow.sides, **every)
    return partial(VTKHDFSeries, path, flow.mesh.domain, **every)
