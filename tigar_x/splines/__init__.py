"""Splines in finite element bases: extraction, spaces, constraints, calculus, systems, output."""
