"""Spline geometry: bases, patches alone and joined, shapes, files; all of it is data, none of it dolfinx's."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
