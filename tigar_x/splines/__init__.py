"""Splines in finite element bases: extraction, spaces, constraints, calculus, systems, output."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
