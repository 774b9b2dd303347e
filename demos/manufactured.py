"""A membrane swept along by a flow: the manufactured fluid-structure benchmark.

The square (0, L)^2 is cut by a membrane that starts as the line x_1 = L/2 and moves with y = V t Y(X_2) e_1,
Y(s) = L s - s^2. Left of it the flow is u = V Y(x_2) e_1, p = 0. Right of it

    u = V Y(x_2) e_1 + S (V t Y'(x_2) e_1 + e_2),   S = V (x_1 - L/2 - V t Y(x_2))/L,   p = -DP,

so that pressure and velocity gradient jump. Body forces on both sides and a load on the membrane make this exact. In
space the square is extruded, with norms per unit depth, or the membrane is curved and moves differently everywhere
(`coudalfish.problems.manufactured`). Source: D. Kamensky, section 5.3.1 of doi:10.1016/j.camwa.2020.01.023.
"""

from functools import partial
from typing import Any, Literal

from mpi4py import MPI

from coudalfish import CouDALFISh, CouplingOptions
from coudalfish.problems import manufactured as problem
from shnapr import Shell
from tigar_x import Colours, PlaneField, Results, VTUSeries, against, checks, generalized_alpha, script
from tigar_x.run.figure import draw, lines
from tigar_x.run.results import with_results
from tigar_x.splines import sampling
from varmint import Flow, FlowOptions, Slip, WeakVelocity, box, movie

TOY = {"level": 1, "dt_factor": 1.0}


def build(
    d: int, level: int, steps: int, how: CouplingOptions, solver: Any = None, *, projected: bool, data: Any, **more: Any
) -> tuple[Flow, Shell, CouDALFISh]:
    """Flow and membrane at a refinement level, and both coupled, before the first step."""
    mesh = box(MPI.COMM_WORLD, *problem.fluid_box(data, d, level))
    c = script.constants(mesh.domain, data)

    def exact(name: str) -> Any:
        return lambda x, t: getattr(problem.exact_flow(x, t, c, shape=data.shape), name)

    conditions = [WeakVelocity(problem.walls_with_velocity(data, d), exact("u")), *map(Slip, problem.slippery(data, d))]
    known = {"rho": c.rho, "mu": c.mu, "f": exact("f"), "dt": data.T / steps, "immersed": "plain"} | more
    scheme, chosen = generalized_alpha(data.rho_infinity), FlowOptions(pin_at=[0.0] * d, solver=solver)
    flow = Flow(mesh, conditions, **known, scheme=scheme, options=chosen)
    flow.start(exact("u"), exact("p"), projected=True)
    shell = problem.membrane(data, d, problem.elements_per_side(data, level), projected=projected)
    return flow, shell, CouDALFISh(flow, shell, how, multiplier=data.DP)


@with_results(checkpoint_every=0)
def main(
    results: Results,
    dim: Literal[2, 3] = 2,
    level: int = 2,
    preset: Literal["reference", "plain", "jump", "sharp"] | None = None,
    curved: bool = False,
    dt_factor: float = 1.0,
    initial_velocity: Literal["projected", "interpolated"] | None = None,
) -> dict[str, Any]:
    """Run the manufactured fluid-membrane benchmark and check it against its exact solution.

    Args:
        dim: dimension of space, 2 or 3 (one layer).
        level: refinement level: 3 * 2^level fluid cells per side, 2^(level + 3) membrane elements.
        preset: published, plain fields, a pressure that jumps, as in space by default, or, in the plane, sharp fields.
        curved: whether the membrane is curved and moves differently everywhere, across a cube (dim = 3).
        dt_factor: time step relative to the published one, T/(2 N).
        initial_velocity: of the membrane, projected as published (default of the reference) or interpolated.
    """
    data, out, preset = problem.data_of(dim, curved=curved), results.out, preset or ("sharp" if dim == 2 else "jump")
    steps = max(1, round(2 * problem.cells_per_side(level) / checks.positive("dt_factor", dt_factor)))
    start = initial_velocity or ("projected" if preset == "reference" else "interpolated")
    presets = {"reference": CouplingOptions.reference, "plain": CouplingOptions, "sharp": CouplingOptions.sharp}
    presets["jump"] = partial(CouplingOptions.converged, fluid_tangent="consistent")
    options, immersed = presets[preset](), {"jump": "jump", "sharp": "jump and kink"}.get(preset, "plain")
    flow, shell, fsi = build(dim, level, steps, options, projected=start == "projected", data=data, immersed=immersed)
    fields = {"velocity": shell.time.xdot_old, "multiplier": lambda: fsi.lam, "normal": fsi.shell.normals}
    files = movie(flow, out / "fluid.vtkhdf"), partial(VTUSeries, out / "shell", shell.spline, y=shell.y, **fields)
    columns = {"t_alpha": "t_alpha", "passes": "passes"}
    columns |= {name: f"monitors.{name}" for name in ("normal_slip_rms", "leak", "force")}
    run = results.run(fsi, steps=steps, series=files, history=columns).through()
    if not run.finished:
        return {}
    if results.viz:
        wall, middle = (shell.at(sampling.line(shell.spline, 0, 257, at=place, patch=0)) for place in (0.0, 0.5))
        X, t, field = middle.reference.T, fsi.timeInt_f.time, PlaneField(flow.w, sides=flow.sides)
        pressure = Colours("pressure", "force/area", -1.5 * data.DP, 0.5 * data.DP, "RdBu_r")
        look = {"title": f"t = {t:.3g}: pressure, streamlines, membrane", "length": "length", "density": 1.1}
        left = field.panel(field.values[:, dim], pressure, immersed=[wall.position], **look)
        exact = data.V * t * data.shape.profile(X[1:], data)
        courses = {"exact": (X[1], exact), "computed": (X[1], middle.displacement[:, 0])}
        axes = {"x": ("$X_2$", "length"), "y": ("displacement $y_1$", "length"), "title": "membrane"}
        draw(out / "manufactured.png", left, lines(courses, **axes, styles={"exact": {"color": "0.6", "linewidth": 4}}))
    measured, true = (problem.errors(fsi, data, data.T, degree) for degree in (2, 8))
    qoi = against(measured, {} if curved else problem.PUBLISHED_CODE.get(level, {}), problem.DOI)
    inputs = {"preset": preset, "initial_velocity": start, "options": options}
    return results.of_run(run, doi=problem.DOI, qoi=qoi, errors=measured, errors_true=true, inputs=inputs)


if __name__ == "__main__":
    script.command_line(main)
