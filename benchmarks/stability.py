"""Stiff and extreme cases of the coupled library: what ran, what was refused, what was observed.

Every case is a function of one value of its range and gives an :class:`Outcome`; `tests/test_extremes.py` asserts on
the same outcomes that this script tabulates. The scenes are plane and small:

- a duct with slip walls and a sheet across it, loaded by a jump of traction between inflow and outflow;
- a closed box with a membrane clamped at two opposite walls, or with a free sheet in a uniform flow;
- the manufactured problem of `demos/manufactured.py`.
"""

import csv
import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from load import load_demo, on_ranks

from coudalfish import (
    CouDALFISh,
    CouplingOptions,
    FluidSubproblem,
    PenaltyRule,
    ShellSubproblem,
    StepError,
    StepReport,
    SurfaceBand,
)
from coudalfish.problems import manufactured as problem
from shnapr.loads import inertia
from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy, virtual_work
from tigar_x import compat
from tigar_x.fem.linear import direct
from tigar_x.fem.schemes import Scheme, backward_euler, generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.geometry.patch import Patch
from tigar_x.run import script
from tigar_x.run.progress import rss_mib
from tigar_x.splines.spline import ExtractedSpline
from varmint.forms.boundary import stable_neumann, weak_dirichlet
from varmint.forms.space import equal_order_space, split
from varmint.forms.vms import interior_residual
from varmint.mesh import named

TIGHT = CouplingOptions(block_rtol=1e-11, block_atol=1e-13)
HEADER = ("case", "value", "result", "passes mean/max", "observed", "message")


# -- scenes -----------------------------------------------------------------------------------------------------------


def schemes(rho_infinity: float | None) -> tuple[Scheme, Scheme]:
    """Schemes of the flow and of the sheet; None: backward Euler."""
    if rho_infinity is None:
        return backward_euler(1), backward_euler(2)
    return generalized_alpha(rho_infinity), generalized_alpha(rho_infinity, 2, first_order_alpha_m=True)


def flow(
    domain: mesh.Mesh,
    dt: float,
    rho_infinity: float | None,
    boundary: Callable[..., ufl.Form],
    pins: Callable[[Any], list[Any]],
    *,
    rho: float,
    mu: float,
    grad_div: float | None = None,
    velocity: tuple[float, float] = (0.0, 0.0),
) -> FluidSubproblem:
    """A plane flow that starts with a uniform velocity.

    Args:
        boundary: the boundary's part of the residual, from v, p, their test functions, rho and mu.
        pins: strong conditions, from the space.
        grad_div: coefficient of the grad-div stabilisation of Taylor-Hood elements; None: equal orders with VMS.
    """
    V = equal_order_space(domain) if grad_div is None else compat.mixed_lagrange_space(domain, (2, 2), (1, 1))
    w = fem.Function(V, name="w")
    for i, value in enumerate(velocity):
        w.x.array[compat.component_space(V, i)[1]] = value
    time = TimeIntegrator(w, dt, schemes(rho_infinity)[0], algebraic=(2,))
    (v, p), (v_t, _), (z, q) = split(time.x_alpha), split(time.xdot_alpha), split(ufl.TestFunction(V))
    c_rho, c_mu = (fem.Constant(domain, float(value)) for value in (rho, mu))
    band = SurfaceBand(domain) if grad_div is None else None
    if band is None:
        dx, gamma = (
            ufl.dx(domain=domain, metadata={"quadrature_degree": 5}),
            fem.Constant(domain, float(grad_div or 0.0)),
        )
        sigma = 2 * c_mu * ufl.sym(ufl.grad(v)) - p * ufl.Identity(2)
        residual = c_rho * ufl.inner(v_t + ufl.grad(v) * v, z) + ufl.inner(sigma, ufl.grad(z))
        residual = (residual + (q + gamma * ufl.div(z)) * ufl.div(v)) * dx
    else:
        scales = {"scale_m": band.scale_m, "scale_c": band.scale_c}
        residual = interior_residual(v, p, z, q, domain, rho=c_rho, mu=c_mu, v_t=v_t, dt=time.dt, **scales)
    residual += boundary(v, p, z, q, c_rho, c_mu)
    return FluidSubproblem(domain, residual, time, bcs=pins(V), band=band, solver=direct(), density=rho, viscosity=mu)


def sheet(
    patch: Patch,
    dt: float,
    rho_infinity: float | None,
    fixed: Any,
    *,
    E: float = 10.0,
    thickness: float = 0.05,
    rho_s: float = 1.0,
    prestress: float = 0.0,
    displacement: Any = None,
    velocity: Any = None,
) -> SimpleNamespace:
    """A St. Venant-Kirchhoff sheet, without bending where its splines are linear.

    Args:
        fixed: spline coefficients that do not move.
        displacement: initial displacement of the control points.
        velocity: their initial velocity.
    """
    spline = ExtractedSpline(patch, MPI.COMM_SELF, quadrature_degree=4, zero_dofs=fixed)
    y, z = spline.function(displacement, name="y"), ufl.TestFunction(spline.V)
    time = TimeIntegrator(y, dt, schemes(rho_infinity)[1], xdot=spline.function(velocity))
    numbers = (E, thickness, rho_s, prestress)
    c_E, h, c_rho, N = (fem.Constant(spline.mesh, float(value)) for value in numbers)
    material = StVenantKirchhoff(c_E, 0.3, h, prestress=(N,), bending=patch.bases[0].degree > 1)
    residual = virtual_work(spline, lambda y: strain_energy(spline, material, y), time.x_alpha, z)
    residual += inertia(spline, time.xddot_alpha, z, density=c_rho, thickness=h)
    energy = strain_energy(spline, material, time.x_old)
    energy += c_rho * h / 2 * ufl.inner(time.xdot_old, time.xdot_old) * spline.dx
    return SimpleNamespace(problem=ShellSubproblem(spline, residual, time, solver=direct("petsc")), energy=energy)


def duct(
    options: CouplingOptions | None = None,
    *,
    n: int = 12,
    dt: float = 0.01,
    rho: float = 1.0,
    mu: float = 0.01,
    rho_infinity: float | None = 0.0,
    jump: float = 1.0,
    place: float = 1.0,
    bow: float = 0.0,
    elements: int | None = None,
    degree: int = 1,
    flexible: bool = False,
    slip: bool = True,
    grad_div: float | None = None,
    **material: float,
) -> SimpleNamespace:
    """Duct (0, 2) x (0, 1) with walls, loaded by a traction at its inflow, with a sheet across its middle.

    Args:
        n: fluid cells across.
        place: where the sheet stands; 1 is a line of the mesh.
        bow: height of its arc.
        elements: of the sheet; None: points half a fluid cell apart.
        flexible: whether only the ends of the sheet are fixed, or all of it.
        slip: whether the fluid slips along the walls.
    """
    domain = mesh.create_rectangle(MPI.COMM_WORLD, [[0.0, 0.0], [2.0, 1.0]], [2 * n, n], mesh.CellType.triangle)
    load = fem.Constant(domain, np.array([float(jump), 0.0]))
    ends = named(domain, inlet=lambda x: np.isclose(x[0], 0.0), outlet=lambda x: np.isclose(x[0], 2.0))
    inlet, outlet = ends.ds("inlet", degree=2), ends.ds("outlet", degree=2)

    def boundary(v: Any, p: Any, z: Any, q: Any, rho: Any, mu: Any) -> ufl.Form:
        loaded = stable_neumann(v, z, domain, inlet, rho=rho, traction=load)
        return loaded + stable_neumann(v, z, domain, outlet, rho=rho)

    def pins(V: Any) -> list[Any]:
        def walls(x: Any) -> Any:
            return np.isclose(x[1], 0.0) | np.isclose(x[1], 1.0)

        return [compat.pin_component(V, i, walls) for i in ((1,) if slip else (0, 1))]

    fluid = flow(domain, dt, rho_infinity, boundary, pins, rho=rho, mu=mu, grad_div=grad_div)
    line = shapes.line((place, 0.0), (place, 1.0), elements=elements or 2 * n // degree, degree=degree)
    s = line.points[:, 1]
    arc = line.points + np.outer(4.0 * bow * s * (1.0 - s), (1.0, 0.0))
    patch = Patch.from_points(line.bases, arc)
    clamped = np.concatenate([patch.side_dofs(side) for side in ("u0", "u1")])
    shell = sheet(patch, dt, rho_infinity, clamped if flexible else np.arange(2 * len(arc)), **material)
    fsi = CouDALFISh(fluid, shell.problem, options)
    v = split(fluid.timeInt.x)[0]
    return SimpleNamespace(
        fsi=fsi,
        load=load,
        outflow=v[0] * outlet,
        length=shell.problem.quadrature.weights.sum(),
    )


def box(
    options: CouplingOptions | None = None,
    *,
    n: int = 8,
    dt: float = 0.02,
    rho: float = 1.0,
    mu: float = 0.01,
    rho_infinity: float | None = None,
    velocity: tuple[float, float] = (0.0, 0.0),
    free: bool = False,
    amplitude: float = 0.1,
    angle: float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
    **material: float,
) -> SimpleNamespace:
    """Closed unit box with a membrane between two walls, released from a wave, or with a free sheet in a uniform flow.

    Args:
        velocity: of the walls and of everything at the start.
        free: whether the sheet is free and straight.
        amplitude: of the wave, which leaves the volumes on both sides alone.
        angle: of the scene in space.
        shift: of the scene in space, after the rotation.
    """
    domain = mesh.create_rectangle(MPI.COMM_WORLD, [[0.0, 0.0], [1.0, 1.0]], [n, n], mesh.CellType.triangle)
    Q = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    domain.geometry.x[:, :2] = domain.geometry.x[:, :2] @ Q.T + shift
    g = fem.Constant(domain, Q @ velocity)

    def boundary(v: Any, p: Any, z: Any, q: Any, rho: Any, mu: Any) -> ufl.Form:
        walls = ufl.ds(domain=domain, metadata={"quadrature_degree": 2})
        return weak_dirichlet(v, p, z, q, g, domain, walls, rho=rho, mu=mu)

    def pins(V: Any) -> list[Any]:
        return [compat.pin_component(V, 2, lambda x: np.hypot(x[0] - shift[0], x[1] - shift[1]) < 0.1 / n)]

    fluid = flow(domain, dt, rho_infinity, boundary, pins, rho=rho, mu=mu, velocity=tuple(Q @ velocity))
    straight = shapes.line(*([(0.35, 0.25), (0.45, 0.75)] if free else [(0.47, 0.0), (0.47, 1.0)]), elements=2 * n)
    patch = Patch.from_points(straight.bases, straight.points @ Q.T + shift)
    s = straight.points[:, 1]
    wave = np.outer(0.0 * s if free else amplitude * np.sin(2.0 * np.pi * s), Q[:, 0])
    clamped = [] if free else np.concatenate([patch.side_dofs(side) for side in ("u0", "u1")])
    shell = sheet(
        patch, dt, rho_infinity, clamped, displacement=wave, velocity=np.tile(Q @ velocity, (len(s), 1)), **material
    )
    fsi = CouDALFISh(fluid, shell.problem, options)
    u = split(fluid.timeInt.x_old)[0]
    kinetic = rho / 2 * ufl.inner(u, u) * ufl.dx(domain=domain)
    return SimpleNamespace(fsi=fsi, rotation=Q, start=wave, energies=(kinetic, shell.energy))


# -- running ----------------------------------------------------------------------------------------------------------

Reports = list[StepReport]
Observed = dict[str, float]


@dataclass(frozen=True)
class Outcome:
    """What a case did at one value.

    Attributes:
        case: its name.
        value: the value.
        result: "ran", "refused" before the first step, or "stopped" by a StepError.
        passes: block passes of every step.
        observed: figures by name.
        message: the warnings and the error that the user sees.
    """

    case: str
    value: Any
    result: str
    passes: tuple[int, ...]
    observed: Mapping[str, float]
    message: str

    @property
    def passes_mean(self) -> float:
        """Mean over the steps."""
        return float(np.mean(self.passes)) if self.passes else math.nan

    @property
    def passes_max(self) -> int:
        """Largest of any step."""
        return max(self.passes, default=0)

    def cells(self) -> tuple[str, ...]:
        """Row of the table, see ``HEADER``."""
        observed = ", ".join(f"{name} {value:.3g}" for name, value in self.observed.items())
        passes = f"{self.passes_mean:.2f}/{self.passes_max}" if self.passes else "-"
        value = f"{self.value:g}" if isinstance(self.value, float) else str(self.value)
        return self.case, value, self.result, passes, observed, self.message or "-"


@dataclass(frozen=True)
class Case:
    """A case: what must hold, the values that the fast tests and the slow ones take, and how to run one."""

    bound: str
    values: tuple[Any, ...]
    slow: tuple[Any, ...]
    run: Callable[[Any], tuple[Reports, Observed]]


CASES: dict[str, Case] = {}


def case(name: str, bound: str, *values: Any, slow: tuple[Any, ...] = ()) -> Callable[[Any], Any]:
    """Enter a function of one value, which gives step reports and figures, as a case."""

    def enter(run: Callable[[Any], tuple[Reports, Observed]]) -> Callable[[Any], tuple[Reports, Observed]]:
        CASES[name] = Case(bound, values, slow, run)
        return run

    return enter


class _Listener(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.said: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.said.append(record.getMessage())


@contextmanager
def listening() -> Iterator[list[str]]:
    """The warnings of the coupling, which are then not shown."""
    log, listener = logging.getLogger("coudalfish"), _Listener()
    before = log.level, log.propagate
    log.addHandler(listener)
    log.setLevel(logging.WARNING)
    log.propagate = False
    try:
        yield listener.said
    finally:
        log.removeHandler(listener)
        log.setLevel(before[0])
        log.propagate = before[1]


@cache
def outcome(name: str, value: Any) -> Outcome:
    """Run a case at one value, once per process."""
    with listening() as said:
        try:
            reports, observed = CASES[name].run(value)
            result = "ran"
        except StepError as error:
            reports, observed, result = [error.report], {"t": error.report.t}, "stopped"
            said[:] = [text for text in said if str(error) not in text] + [str(error)]
        except ValueError as error:
            reports, observed, result = [], {}, "refused"
            said.append(str(error))
    passes = tuple(report.passes for report in reports)
    return Outcome(name, value, result, passes, observed, "; ".join(said))


def advance(fsi: CouDALFISh, steps: int, before: Callable[[int], None] | None = None) -> Reports:
    """Take steps; a state that is accepted although it is not finite is a defect of the library."""
    reports = []
    for n in range(steps):
        if before is not None:
            before(n)
        reports.append(fsi.takeStep())
        for values in (fsi.timeInt_f.x.x.array, fsi.timeInt_sh.x.x.array, fsi.lam):
            if not np.isfinite(values).all():
                raise FloatingPointError(f"step {n} was accepted with values that are not finite")
    return reports


def through_duct(
    scene: SimpleNamespace, steps: int, *, jump: float = 1.0, ramp: int = 1
) -> tuple[Reports, Observed, list[float]]:
    """Load the duct smoothly over ``ramp`` steps; slip, outflow and multiplier, the outflow's rate at every step."""
    fsi, (outflow,) = scene.fsi, compat.compile_forms(scene.outflow)
    dt, rates = fsi.timeInt_f.step_size, []

    def load(n: int) -> None:
        if n:
            rates.append(compat.assemble_scalar(outflow))
        scene.load.value[0] = jump * 0.5 * (1.0 - math.cos(math.pi * min(1.0, (n + 1) / ramp)))

    reports = advance(fsi, steps, load)
    rates.append(compat.assemble_scalar(outflow))
    leak = [report.monitors.leak / scene.length for report in reports if report.monitors]
    observed = {
        "slip": dt * sum(leak),
        "slip rate": leak[-1],
        "outflow": dt * sum(rates),
        "outflow rate": rates[-1],
        "largest speed": fsi.fluid.speed(),
        "lam/jump": float(fsi.lam @ fsi.shell.quadrature.weights) / scene.length / jump,
    }
    return reports, observed, rates


def manufactured(
    level: int,
    options: CouplingOptions | None = None,
    *,
    dt_factor: float = 1.0,
    only: int | None = None,
    **data: float,
) -> tuple[Reports, Observed]:
    """The manufactured problem at a level, all of it or its first steps; errors with quadrature of degree 2."""
    chosen, steps = replace(problem.ProblemData(), **data), round(2 * problem.cells_per_side(level) / dt_factor)
    build = load_demo("manufactured").build
    *_, fsi = build(2, level, steps, options or CouplingOptions(), direct(), projected=False, data=chosen)
    reports = advance(fsi, only or steps)
    return reports, problem.errors(fsi, chosen, fsi.timeInt_f.time, 2)


def energy(scene: SimpleNamespace) -> Callable[[], float]:
    """Kinetic and elastic energy, and that of the multiplier's springs ``sum W lam^2 dt/(2 beta)``."""
    fsi, forms = scene.fsi, [compat.compile_forms(form)[0] for form in scene.energies]
    W = fsi.shell.quadrature.weights

    def total() -> float:
        springs = float((W * fsi.lam**2).sum()) * fsi.timeInt_f.step_size / (2.0 * fsi.penalty)
        return sum(compat.assemble_scalar(form) for form in forms) + springs

    return total


def released(steps: int, options: CouplingOptions | None = None, **scene: Any) -> tuple[Reports, Observed]:
    """The membrane in the closed box; energies relative to the initial one."""
    system = box(options, **({"prestress": 1.0} | scene))
    total = energy(system)
    history = [total()]
    reports = []
    for _ in range(steps):
        reports += advance(system.fsi, 1)
        history.append(total())
    figures = np.array(history) / history[0]
    return reports, {
        "largest rise per step": float(np.diff(figures).max()),
        "largest": float(figures.max()),
        "last": float(figures[-1]),
    }


# -- cases ------------------------------------------------------------------------------------------------------------


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


@case(
    "pressure jump, dt = 0.01/sqrt(jump)",
    "slip after the load change = jump dt/beta within 20 %",
    *((1.0, 0.0, 1e-3), (1e3, 0.1, 1e-3), (1e5, 0.0, 1e-3), (1e5, 0.1, 1e-3), (1e5, 0.1, 0.02)),
    slow=((1.0, 0.1, 1e-3), (1e5, 0.0, 0.02)),
)
def jump(value: tuple[float, float, float]) -> tuple[Reports, Observed]:
    """Value: jump, bow of the sheet, scale_c. A smooth load of 60 steps leaves little of the springs' ringing."""
    load, bow, scale_c = value
    scene = duct(CouplingOptions(scale_c=scale_c), dt=0.01 / load**0.5, jump=0.0, bow=bow)
    reports, observed, _ = through_duct(scene, 80, jump=load, ramp=60)
    law = load * scene.fsi.timeInt_f.step_size / reports[-1].penalty
    return reports, {
        "slip/law": observed["slip"] / law,
        "outflow/law": observed["outflow"] / law,
        "largest speed/sqrt(jump)": observed["largest speed"] / load**0.5,
        "slip ratio": reports[-1].slip_ratio,
    }


@case(
    "pressure jump at rest, dt = 0.01, beta = 5e3",
    "spurious velocity proportional to the jump",
    *(1.0, 1e2, 1e3, 1e4, 1e5),
)
def spurious(load: float) -> tuple[Reports, Observed]:
    scene = duct(CouplingOptions(scale_c=1e-3, penalty=5e3), jump=0.0, bow=0.1)
    reports, observed, _ = through_duct(scene, 30, jump=load, ramp=20)
    return reports, {
        "largest speed/jump": observed["largest speed"] / load,
        "slip/law": observed["slip"] / (load * 0.01 / 5e3),
        "outflow/jump": observed["outflow"] / load,
        "slip ratio": reports[-1].slip_ratio,
    }


@case("pressure jump, dt = 0.01, defaults", "finite, and a warning that beta is too small", *(1e2, 1e4, 1e5))
def jump_too_large(load: float) -> tuple[Reports, Observed]:
    reports, observed, _ = through_duct(duct(jump=load), 20, jump=load)
    return reports, {"slip rate": observed["slip rate"], "slip ratio": reports[-1].slip_ratio}


@case(
    "leak with r > 0",
    "steady leak = r jump/((1 + r) beta) within 10 %",
    *((0.1, 1.0), (0.1, 1e3), (1e-2, 1.0)),
    slow=((1e-2, 1e3), (1e-3, 1.0)),
)
def leak(value: tuple[float, float]) -> tuple[Reports, Observed]:
    """Value: r, jump."""
    r, load = value
    beta = 5.0 * load**0.5
    options = CouplingOptions(scale_c=1e-3, penalty=beta, relaxation=r, relaxation_mode="uniform")
    steps = {0.1: 110, 1e-2: 380}.get(r, 1500)
    scene = duct(options, dt=0.01 / load**0.5, jump=0.0, bow=0.1)
    reports, observed, _ = through_duct(scene, steps, jump=load, ramp=60)
    law = r * load / ((1.0 + r) * beta)
    return reports, {"leak/law": observed["slip rate"] / law, "outflow/law": observed["outflow rate"] / law}


@case(
    "impulsive load 2e4, then -1e5 in one step",
    "finite in at most 100 passes",
    *("as published", "default penalty", "dt x 20", "light", "limp"),
)
def impulsive(what: str) -> tuple[Reports, Observed]:
    valve = {"E": 1e7, "thickness": 0.04, "rho_s": 1.0} | ({"rho_s": 1e-6} if what == "light" else {})
    valve |= {"E": 1e4} if what == "limp" else {}
    published = CouplingOptions(penalty=500.0, relaxation=1e-5, relaxation_mode="uniform", scale_c=1e-3)
    options = CouplingOptions(scale_c=1e-3) if what == "default penalty" else published
    dt = 5e-5 * (20.0 if what == "dt x 20" else 1.0)
    scene = duct(options, mu=0.03, dt=dt, jump=0.0, flexible=True, degree=2, **valve)

    def load(n: int) -> None:
        scene.load.value[0] = 2e4 if n < 15 else -1e5

    reports = advance(scene.fsi, 30, load)
    return reports, {
        "passes at the change": float(reports[15].passes),
        "largest speed": scene.fsi.fluid.speed(),
        "deflection": float(np.abs(scene.fsi.timeInt_sh.x.x.array).max()),
        "second attempts": float(sum(report.attempts > 1 for report in reports)),
    }


@case("energy: backward Euler, mu", "never grows", *(0.01, 1e-4, 1e-6))
def energy_backward_euler(mu: float) -> tuple[Reports, Observed]:
    return released(60, mu=mu)


@case("energy: generalized-alpha, rho_infinity", "bounded", *(0.0, 0.5, 1.0))
def energy_generalized_alpha(rho: float) -> tuple[Reports, Observed]:
    return released(60, mu=1e-4, rho_infinity=rho)


@case(
    "point spacing / h",
    "a warning beyond 0.75, and the leak that follows",
    *(0.1, 0.5, 0.7, 1.0, 1.5, 3.0),
)
def spacing(ratio: float) -> tuple[Reports, Observed]:
    scene = duct(CouplingOptions(scale_c=1e-3), jump=0.0, bow=0.05, elements=round(12 / ratio))
    reports, observed, rates = through_duct(scene, 100, ramp=60)
    law = 0.01 / reports[-1].penalty
    return reports, {
        "outflow/law": observed["outflow"] / law,
        "slip/law": observed["slip"] / law,
        "outflow rate": float(np.mean(rates[-40:])),
    }


@case(
    "rotated and translated axes (angle, shift)",
    "same answer to solver tolerance",
    *((0.7, 0.0, 0.0), (2.1, 3.0, -5.0), (0.0, 100.0, -30.0)),
)
def rotated(value: tuple[float, float, float]) -> tuple[Reports, Observed]:
    angle, *shift = value
    results = []
    for position in ({}, {"angle": angle, "shift": tuple(shift)}):
        scene = box(TIGHT, prestress=1.0, **position)
        reports = advance(scene.fsi, 10)
        nodal = scene.fsi.timeInt_f.x.x.array.reshape(-1, 3)
        y = scene.fsi.spline_sh.nodal(scene.fsi.timeInt_sh.x)
        results.append((nodal[:, :2] @ scene.rotation, nodal[:, 2], y @ scene.rotation, scene.fsi.lam))
    names = ("u differs by", "p differs by", "y differs by", "multiplier differs by")
    return reports, {
        name: float(np.abs(b - a).max() / np.abs(a).max()) for name, a, b in zip(names, *results, strict=True)
    }


@case(
    "free sheet in uniform flow, direction",
    "translates exactly; p constant and multiplier 0 to solver tolerance",
    *(f"{45 * k} degrees" for k in range(8)),
)
def uniform(direction: str) -> tuple[Reports, Observed]:
    angle = math.radians(float(direction.split()[0]))
    velocity = (0.3 * math.cos(angle), 0.3 * math.sin(angle))
    scene = box(TIGHT, velocity=velocity, free=True, dt=0.1, rho_infinity=0.5)
    reports = advance(scene.fsi, 5)
    y, w = scene.fsi.spline_sh.nodal(scene.fsi.timeInt_sh.x), scene.fsi.timeInt_f.x.x.array.reshape(-1, 3)
    return reports, {
        "translation off by": float(np.abs(y - 0.5 * np.array(velocity)).max()),
        "velocity off by": float(np.abs(w[:, :2] - velocity).max()),
        "pressure varies by": float(np.ptp(w[:, 2])),
        "multiplier": float(np.abs(scene.fsi.lam).max()),
    }


@case(
    "Taylor-Hood elements in the duct, jump and grad-div",
    "slip after the load change = jump dt/beta within 20 %",
    *((1.0, 1.0), (1.0, 100.0), (1e5, 100.0)),
)
def taylor_hood(value: tuple[float, float]) -> tuple[Reports, Observed]:
    """Value: jump, grad-div coefficient over sqrt(rho jump) times length."""
    load, grad_div = value
    scene = duct(n=6, dt=0.01 / load**0.5, jump=0.0, bow=0.1, grad_div=grad_div * load**0.5)
    reports, observed, _ = through_duct(scene, 80, jump=load, ramp=60)
    law = load * scene.fsi.timeInt_f.step_size / reports[-1].penalty
    return reports, {
        "slip/law": observed["slip"] / law,
        "outflow/law": observed["outflow"] / law,
        "largest speed/sqrt(jump)": observed["largest speed"] / load**0.5,
    }


@case("ranks", "same errors as on one rank to 1e-8", slow=(2, 3))
def ranks(n: int) -> tuple[Reports, Observed]:
    one, many = (errors_on(size) for size in (1, n))
    return [], {f"{name} differs by": abs(many[name] - one[name]) / one[name] for name in one}


def errors_on(n: int) -> Observed:
    """Errors of the manufactured problem on n processes, with direct solves and tight block tolerances."""
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import stability as s, json; "
    code += "e = s.manufactured(2, s.TIGHT)[1]; print(json.dumps(e)) if not s.MPI.COMM_WORLD.rank else None"
    return dict(on_ranks(n, "-c", code))


def long_advance(fsi: CouDALFISh, steps: int, chunk: int = 100) -> Reports:
    """Take steps and keep only the last reports, which would take memory themselves."""
    reports: Reports = []
    for _ in range(steps // chunk):
        reports = advance(fsi, chunk)
    return reports


@case(
    "long run: steps, sheet, r",
    "memory flat, multiplier does not drift",
    *((600, "straight", 0.0), (600, "arc", 0.0)),
    slow=((10_000, "straight", 0.0), (10_000, "arc", 0.0), (10_000, "arc", 1e-2), (10_000, "elastic", 0.0)),
)
def long_run(value: tuple[int, str, float]) -> tuple[Reports, Observed]:
    """A duct under a steady jump: in the second half of the run, with the springs at rest, nothing should change."""
    steps, form, r = value
    shape: dict[str, Any] = {"arc": {"bow": 0.1}, "elastic": {"flexible": True, "prestress": 10.0}}.get(form, {})
    scene = duct(CouplingOptions(penalty=50.0, relaxation=r, relaxation_mode="uniform"), n=4, jump=0.0, **shape)
    fsi, W = scene.fsi, scene.fsi.shell.quadrature.weights
    reports, *_ = through_duct(scene, 100, ramp=60)
    reports = long_advance(fsi, steps // 2 - 100)
    lam, memory = fsi.lam.copy(), rss_mib()
    reports = long_advance(fsi, steps // 2)
    drift = fsi.lam - lam
    return reports, {
        "memory grows by [MiB]": rss_mib() - memory,
        "multiplier drifts by": float(np.abs(drift).max()),
        "its mean by": abs(float(drift @ W)) / scene.length,
        "slip rms": reports[-1].monitors.normal_slip_rms if reports[-1].monitors else math.nan,
        "largest speed": fsi.fluid.speed(),
    }


# -- table ------------------------------------------------------------------------------------------------------------


def main(out: Path = Path("results/stability"), slow: bool = False, only: str = "") -> None:
    """Run the cases, print their table as Markdown and write it, and a CSV.

    Args:
        out: folder of the results.
        slow: whether to run the slow values as well.
        only: run the cases whose name contains this.
    """
    out.mkdir(parents=True, exist_ok=True)
    chosen = {name: entry for name, entry in CASES.items() if only in name}
    lines = [f"| {' | '.join(HEADER)} |", f"|{' --- |' * len(HEADER)}"]
    print("\n".join(lines))
    rows = []
    for name, entry in chosen.items():
        for value in entry.values + (entry.slow if slow else ()):
            rows.append(outcome(name, value))
            lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in rows[-1].cells())} |")
            print(lines[-1], flush=True)
    bounds = [
        "| case | must hold |",
        "| --- | --- |",
        *(f"| {name} | {entry.bound} |" for name, entry in chosen.items()),
    ]
    (out / "stability.md").write_text("\n".join([*lines, "", *bounds, ""]))
    with open(out / "stability.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("case", "value", "result", "passes_mean", "passes_max", "observed", "message"))
        for row in rows:
            observed = "; ".join(f"{name} = {value:.6g}" for name, value in row.observed.items())
            writer.writerow((row.case, row.value, row.result, row.passes_mean, row.passes_max, observed, row.message))
    print(f"\nwritten: {out / 'stability.md'}, {out / 'stability.csv'}")


if __name__ == "__main__":
    script.command_line(main)
