"""Finite element problems: linear solvers, Newton's method, load steps, modes, integration in time."""
