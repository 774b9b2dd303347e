"""Kirchhoff-Love shells in UFL on extracted splines.

One set of forms serves a surface in space and a curve in the plane (a cylindrical shell per unit depth); the dimension
is read from the spline. Sources: Kiendl et al., doi:10.1016/j.cma.2009.08.013 and doi:10.1016/j.cma.2015.03.010.

Materials are in :mod:`~shnapr.svk` and :mod:`~shnapr.hyperelastic`, their virtual work in :mod:`~shnapr.work`, loads
and supports in :mod:`~shnapr.loads` and :mod:`~shnapr.supports`, stresses in :mod:`~shnapr.stress`. Shells meet rigid
planes (:mod:`~shnapr.planes`), themselves and each other (:mod:`~shnapr.contact`).
"""

from tigar_x.front import __version__ as __version__
from tigar_x.front import front

__getattr__, __dir__, __all__ = front(__name__)
