"""Taylor-Green vortex: unsteady flow against an exact solution, on a fixed or a moving mesh, in the plane or extruded.

In the square (-pi, pi)^2 with impermeable walls without friction

    u = exp(-2 nu t) (sin x cos y, -cos x sin y),    p = rho/4 exp(-4 nu t) (cos 2x + cos 2y)

decays without a body force. The number of steps is that of the cells per side unless it is given, so that with the
implicit midpoint rule the errors of the velocity in the seminorm of H1 fall with h^k for degree k = 1, 2. The moving
mesh is displaced by A sin y_1 sin y_2 sin(2 pi t/T) (1, 1). In space the square is extruded by one layer of cells, with
the same walls in front and behind; all norms are per unit depth.

Source: D. Kamensky, "Open-source immersogeometric analysis of fluid-structure interaction using FEniCS and tIGAr",
section 5.2, doi:10.1016/j.camwa.2020.01.023.
"""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.convergence import Study, doubled, refine
from tigar_x.run.output import CSVSeries
from tigar_x.run.pictures import Colours
from tigar_x.run.plane_field import PlaneField
from tigar_x.run.summary import write_summary
from tigar_x.run.vtkhdf import VTKHDFSeries
from tigar_x.run.writing import claim
from varmint.conditions import Slip
from varmint.flow import Flow, FlowOptions
from varmint.forms import ale
from varmint.forms.motion import PrescribedMotion
from varmint.forms.space import split
from varmint.mesh import box
from varmint.quantities import Measured, kinetic_energy, volume

DOI = "10.1016/j.camwa.2020.01.023"
TOY = {"elements": 4, "levels": 2, "moving_mesh": True}
REYNOLDS, END, AMPLITUDE = 100.0, 1.0, 0.2
SIDES = ("left", "right", "bottom", "top")


def velocity(x: Any, t: Any, nu: float = 1.0 / REYNOLDS) -> Any:
    """Exact velocity."""
    plane = [ufl.sin(x[0]) * ufl.cos(x[1]), -ufl.cos(x[0]) * ufl.sin(x[1])]
    return ufl.exp(-2 * nu * t) * ufl.as_vector(plane + [0.0] * (len(x) - 2))


def pressure(x: Any, t: Any, nu: float = 1.0 / REYNOLDS) -> Any:
    """Exact pressure for the density one."""
    return ufl.exp(-4 * nu * t) * (ufl.cos(2 * x[0]) + ufl.cos(2 * x[1])) / 4


def displacement(y: Any, t: Any) -> Any:
    """Displacement of the moving mesh."""
    s = AMPLITUDE * ufl.sin(y[0]) * ufl.sin(y[1]) * ufl.sin(2 * ufl.pi * t / END)
    return s * ufl.as_vector([1.0, 1.0] + [0.0] * (len(y) - 2))


def build(
    elements: int,
    degree: int = 1,
    *,
    dim: int = 2,
    moving_mesh: bool = False,
    steps: int | None = None,
    rho_infinity: float = 1.0,
    cells: str | None = None,
    viscosity_factor: float = 1.0,
    comm: MPI.Comm = MPI.COMM_WORLD,
    **options: Any,
) -> Flow:
    """The vortex at t = 0, projected onto the mesh."""
    low, high, counts = [-np.pi] * 2, [np.pi] * 2, [elements] * 2
    sides = SIDES
    if dim == 3:
        low, high, counts = [*low, 0.0], [*high, 2 * np.pi / elements], [*counts, 1]
        sides = (*SIDES, "back", "front")
    kind = cells or ("triangle" if dim == 2 else "tetrahedron")
    mesh = box(comm, low, high, counts, kind)
    scheme, dt = generalized_alpha(rho_infinity), END / (elements if steps is None else steps)
    moving = PrescribedMotion(mesh, displacement, dt, scheme) if moving_mesh else None
    flow = Flow(
        mesh,
        [Slip(sides, strong_if_moving=True)],
        rho=1.0,
        mu=viscosity_factor / REYNOLDS,
        degree=degree,
        dt=dt,
        scheme=scheme,
        moving=moving,
        options=FlowOptions(**({"C_I": 6.0 * degree**4, "pin_at": low} | options)),
    )
    flow.start(velocity, projected=True)
    return flow


def errors(flow: Flow, degree: int | None = None) -> dict[str, float]:
    """Norms of the errors at the end, per unit depth. Quadrature of degree 2 k unless given."""
    domain, motion = flow.mesh.domain, flow.fields.motion_end
    x, t = ale.position(domain, motion), fem.Constant(domain, flow.time.time)
    e = split(flow.w)[0] - velocity(x, t)
    grad_e = ale.gradient(e, motion)
    dx = flow.mesh.dx(degree=2 * flow.degree if degree is None else degree)
    forms = compat.compile_forms(
        *(ale.per_volume(ufl.inner(f, f), motion) * dx for f in (grad_e, e)), fem.Constant(domain, 1.0) * dx
    )
    H1, L2, size = (compat.assemble_scalar(form) for form in forms)
    depth = 1.0 if domain.geometry.dim == 2 else size / (2 * np.pi) ** 2
    return {"H1_u": (H1 / depth) ** 0.5, "L2_u": (L2 / depth) ** 0.5}


def run(flow: Flow, measure: Any = None) -> Flow:
    """The flow at the end."""
    while flow.time.time < END - 1e-9 * END:
        flow.take_step(measure)
    return flow


def main(
    dim: Literal[2, 3] = 2,
    degree: int = 1,
    elements: int = 8,
    levels: int = 3,
    moving_mesh: bool = False,
    cells: Literal["triangle", "quadrilateral", "tetrahedron", "hexahedron"] | None = None,
    rho_infinity: float = 1.0,
    out: Path = Path("results/taylor_green"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Follow the decaying vortex on finer and finer meshes with as many time steps, and compare with the exact one.

    Args:
        dim: dimension of space, 2 or 3 (one layer).
        degree: of velocity and pressure.
        elements: per side on the coarsest mesh, and time steps; doubled from level to level.
        levels: number of meshes, 2 or more.
        moving_mesh: whether the mesh moves.
        cells: of the mesh; default: triangles or tetrahedra.
        rho_infinity: spectral radius of the time integration at infinite frequency; 1 is the implicit midpoint rule.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write ParaView files, the history of the energy and a picture of the finest level.

    Returns:
        The summary.
    """
    k = checks.whole("degree", degree, 1)

    def compiled(n: int) -> Flow:
        flow = build(n, k, dim=dim, moving_mesh=moving_mesh, rho_infinity=rho_infinity, cells=cells)
        flow.compile()
        return flow

    expected = {"H1_u": float(min(k, 2))}
    claim(out, overwrite=overwrite)
    study, flow = refine(run, errors, doubled(elements, levels), expected, compiled)
    balance = Measured(kinetic_energy=kinetic_energy(flow), volume=volume(flow))()
    if viz:
        rerun(out, build(elements, k, dim=dim, moving_mesh=moving_mesh, rho_infinity=rho_infinity, cells=cells))
        field = PlaneField(flow.w, None if flow.moving is None else flow.moving.time.x)
        draw(out / "taylor_green.png", field, flow.time.time, study)

    inputs = {
        "dim": dim,
        "degree": k,
        "elements": elements,
        "levels": levels,
        "moving_mesh": moving_mesh,
        "cells": cells,
        "rho_infinity": rho_infinity,
    }
    summary = write_summary(
        out,
        "taylor_green",
        inputs,
        errors_true=errors(flow, 2 * k + 8),
        monitors=balance,
        dofs_fluid=flow.unknowns,
        **study.results(),
    )
    if MPI.COMM_WORLD.rank == 0:
        print(f"{dim}D, degree {k}, {'moving' if moving_mesh else 'fixed'} mesh, Re = {REYNOLDS:g} (doi:{DOI})")
        print(study.table())
    return summary


def rerun(out: Path, flow: Flow) -> None:
    """The coarsest run again, with files of its steps."""
    domain, d = flow.mesh.domain, flow.mesh.domain.geometry.dim
    fields: dict[str, Any] = {"velocity": (flow.w, tuple(range(d))), "pressure": (flow.w, (d,))}
    if flow.moving is not None:
        fields["mesh_displacement"] = (flow.moving.time.x, tuple(range(d)))
    measured = Measured(kinetic_energy=kinetic_energy(flow), volume=volume(flow))
    columns = ("kinetic_energy", "volume", "newton_iterations")
    with (
        VTKHDFSeries(out / "flow.vtkhdf", domain, **fields) as movie,
        CSVSeries(out / "history.csv", columns) as history,
    ):
        while flow.time.time < END - 1e-9 * END:
            report = flow.take_step()
            movie.write(report.t)
            history.write(report.t, *measured().values(), report.iterations)


@root_only
def draw(path: Path, field: PlaneField, t: float, study: Study) -> None:
    """Pressure with streamlines at the end, and the errors against run time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    field.shade(left, field.values[:, -1], Colours("pressure", "-", palette="RdBu_r"), length="-")
    field.streamlines(left, density=1.2)
    left.set_title(f"t = {t:.3g}")
    study.draw(right, unit="-")
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
