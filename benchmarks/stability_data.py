"""Cases of ``stability.py`` whose masses, stiffnesses, penalties, viscosities or time steps are extreme."""

from typing import Any

import numpy as np
from stability_runs import Observed, Reports, case, manufactured, released, through_duct
from stability_scenes import duct

from coudalfish import (
    CouplingOptions,
    PenaltyRule,
)


@case(
    "shell mass rho_s",
    "finite; at most 5 passes on average; velocity errors within 5 % of rho_s = 1",
    *(1e-9, 1e-3, 1.0, 1e2, 1e4),
)
def shell_mass(rho_s: float) -> tuple[Reports, Observed]:
    return manufactured(2, rho_s=rho_s)


@case("shell mass rho_s, level 3", "as at level 2", slow=(1e-9, 1.0, 1e4))
def shell_mass_fine(rho_s: float) -> tuple[Reports, Observed]:
    return manufactured(3, rho_s=rho_s)


@case(
    "shell mass rho_s, released membrane",
    "finite; at most 5 passes on average; energy never grows",
    *(1e-9, 1e-3, 1.0, 1e4),
)
def released_mass(rho_s: float) -> tuple[Reports, Observed]:
    return released(20, rho_s=rho_s)


@case("stiffness x 1e6", "agrees with the fixed sheet to 0.2 %", "prestress of a membrane", "E of a curved shell")
def stiffness(what: str, block_rtol: float = 1e-4) -> tuple[Reports, Observed]:
    """The flexible sheets are pinned at their ends; both are compared with sheets that do not move at all.

    No point may lie on an edge of the fluid's cells, where the smallest motion changes the band.
    """
    shape: dict[str, Any] = {"n": 11, "elements": 24, "place": 1.03}
    shape |= {"elements": 13, "bow": 0.1, "degree": 2} if "shell" in what else {}
    material = {"E": 1e9} if "shell" in what else {"E": 10.0, "prestress": 1e6}
    options = CouplingOptions(block_rtol=block_rtol)
    scenes = duct(options, **shape), duct(options, flexible=True, **shape, **material)
    reports = [through_duct(scene, 30, ramp=20)[0] for scene in scenes][1]
    (fixed, stiff), lam = (scene.fsi.timeInt_f.x.x.array.reshape(-1, 3)[:, :2] for scene in scenes), scenes[0].fsi.lam
    return reports, {
        "velocity differs by": float(np.linalg.norm(stiff - fixed) / np.linalg.norm(fixed)),
        "multiplier differs by": float(np.abs(scenes[1].fsi.lam - lam).max() / np.abs(lam).max()),
        "deflection": float(np.abs(scenes[1].fsi.timeInt_sh.x.x.array).max()),
    }


@case("stiffness x 1e6, block_rtol = 1e-6", "agrees with the fixed sheet to 0.2 %", "prestress of a membrane")
def stiffness_tight(what: str) -> tuple[Reports, Observed]:
    return stiffness(what, 1e-6)


@case(
    "penalty beta = C mu/h",
    "errors at most 3 times the best for C = 0.1 to 10; beyond, converges or names beta",
    *(0.1, 1.0, 4.0, 10.0, 100.0, 1e3, 1e4, 1e6),
)
def penalty(C: float) -> tuple[Reports, Observed]:
    return manufactured(2, CouplingOptions(penalty=PenaltyRule(C, 0.0)))


@case(
    "penalty beta = C mu/h, level 3",
    "errors at most 3 times the best for C = 0.1 to 10; beyond, converges or names beta",
    slow=(0.1, 1.0, 4.0, 10.0, 100.0, 1e3),
)
def penalty_fine(C: float) -> tuple[Reports, Observed]:
    return manufactured(3, CouplingOptions(penalty=PenaltyRule(C, 0.0)))


@case(
    "viscosity mu",
    "finite; from 1e-3 to 1e-6 L2 u grows by at most 30 %",
    *(10.0, 0.1, 1e-3, 1e-4, 1e-6),
)
def viscosity(mu: float) -> tuple[Reports, Observed]:
    return manufactured(2, mu=mu)


@case(
    "viscosity mu, level 3", "finite; from 1e-3 to 1e-6 L2 u grows by at most 30 %", slow=(10.0, 0.1, 1e-3, 1e-4, 1e-6)
)
def viscosity_fine(mu: float) -> tuple[Reports, Observed]:
    return manufactured(3, mu=mu)


@case("viscosity mu, beta = mu/h", "finite, and a warning that beta is too small", *(1e-3, 1e-4, 1e-6))
def viscosity_alone(mu: float) -> tuple[Reports, Observed]:
    return manufactured(2, CouplingOptions(penalty=PenaltyRule(1.0, 0.0)), mu=mu)


@case(
    "time step x, first 5 steps of the manufactured problem",
    "finite; a warning where tau_M degenerates",
    *(1.0, 1e-2, 1e-3, 1e-5),
)
def small_time_step(factor: float) -> tuple[Reports, Observed]:
    return manufactured(2, dt_factor=factor, only=5)


TIME_STEPS = tuple((factor, rho) for factor in (1e-3, 1.0, 1e3) for rho in (None, 0.0, 1.0))


@case("time step x, rho_infinity: duct", "finite over 5 steps", *TIME_STEPS, slow=((1e-2, 0.0), (1e2, 0.0)))
def time_step_duct(value: tuple[float, float | None]) -> tuple[Reports, Observed]:
    factor, rho = value
    scene = duct(dt=0.01 * factor, rho_infinity=rho)
    reports, observed, _ = through_duct(scene, 5)
    return reports, {key: observed[key] for key in ("largest speed", "slip rate", "lam/jump")}


@case(
    "time step x, rho_infinity: closed box",
    "finite over 5 steps; energy bounded; rho_infinity = 0 and backward Euler damp",
    *TIME_STEPS,
    slow=((1e-2, 0.0), (1e2, 0.0)),
)
def time_step_box(value: tuple[float, float | None]) -> tuple[Reports, Observed]:
    factor, rho = value
    return released(5, dt=0.02 * factor, rho_infinity=rho)
