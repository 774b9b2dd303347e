"""The immersed surface: where its points are in the fluid's mesh, what acts there, and the multiplier."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
