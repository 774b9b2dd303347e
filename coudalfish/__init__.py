"""Fluid-structure interaction of thin structures immersed in flow, by the dynamic augmented Lagrangian method.

``CouDALFISh.takeStep()`` advances a fluid and a shell by one time step. Source: Kamensky, "Open-source immersogeometric
analysis of fluid-structure interaction using FEniCS and tIGAr", doi:10.1016/j.camwa.2020.01.023.
"""

from tigar_x.front import __version__ as __version__
from tigar_x.front import front

__getattr__, __dir__, __all__ = front(__name__)
