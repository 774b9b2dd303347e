"""Finite element problems: linear solvers, Newton's method, load steps, modes, integration in time."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
