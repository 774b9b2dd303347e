"""Whether the schemes of fluid and shell belong to one intermediate level."""

import math

from tigar_x.fem.schemes import companion
from tigar_x.fem.time_integration import TimeIntegrator


def check_schemes(timeInt_f: TimeIntegrator, timeInt_sh: TimeIntegrator) -> None:
    """Check that both sides impose their equations, highest rates included, at one level.

    The shell's scheme is the fluid's own or, where its equation has second rates, its companion. A pressure that the
    fluid's scheme averages would be that of another time.

    Args:
        timeInt_f: the flow's integrator; the last component of its unknown is the pressure.
        timeInt_sh: the shell's integrator.

    Raises:
        ValueError: the levels differ, or the pressure is integrated in time.
    """
    fluid, shell = timeInt_f.scheme, timeInt_sh.scheme
    if fluid.order != 1:
        raise ValueError(f"order of the fluid's scheme = {fluid.order}: 1 is required")
    for name in ("alpha_f", "alpha_m"):
        own, wanted = getattr(shell, name), getattr(fluid, name)
        if not math.isclose(own, wanted):
            raise ValueError(
                f"{name}: fluid {wanted:.6g}, shell {own:.6g}: both sides must share the levels of one scheme: give the"
                f" shell {_remedy(name, shell.order)}"
            )
    pressure = timeInt_f.x.ufl_shape[0] - 1
    if fluid.alpha_f != 1.0 and pressure not in timeInt_f.algebraic:
        raise ValueError(
            f"algebraic = {tuple(sorted(timeInt_f.algebraic))} of the fluid's integrator: ({pressure},) is required,"
            " the pressure, which is not integrated in time"
        )


def _remedy(name: str, order: int) -> str:
    if order == 1:
        return "the fluid's own"
    same = f"{companion.__name__}(scheme of the fluid)"
    if name == "alpha_f":
        return f"{same}, or the same rho_infinity"
    return f"{same}, or first_order_alpha_m=True, which generalized_alpha of order 2 has for this"
