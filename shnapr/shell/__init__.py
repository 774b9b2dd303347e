"""A shell as one object: geometry, material, supports and loads become residual, system, solves and steps."""

from shnapr.shell.options import ShellError, ShellOptions, ShellReport
from shnapr.shell.quantities import Energies, Places
from shnapr.shell.shell import Shell

__all__ = ["Energies", "Places", "Shell", "ShellError", "ShellOptions", "ShellReport"]
