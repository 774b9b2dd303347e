"""Kirchhoff-Love shells in UFL on extracted splines.

One set of forms serves a surface in space and a curve in the plane (a cylindrical shell per unit depth); the dimension
is read from the spline. Sources: Kiendl et al., doi:10.1016/j.cma.2009.08.013 and doi:10.1016/j.cma.2015.03.010.
"""
