"""Meshes whose cells and facets have names: made here, made by gmsh, or read from files."""

from tigar_x.moved import guide
from varmint.mesh.named import NamedMesh, box, grid, named

__all__ = ["NamedMesh", "box", "grid", "named"]
__getattr__ = guide(__name__)
