"""Spline geometry: bases, patches alone and joined, shapes, files; all of it is data, none of it dolfinx's."""
