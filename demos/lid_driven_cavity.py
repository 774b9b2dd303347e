"""Regularised lid-driven cavity: steady flow against an exact solution, of any degree on triangles or quadrilaterals.

On the unit square the velocity

    u_1 = 8 (x^4 - 2 x^3 + x^2) (4 y^3 - 2 y),    u_2 = -8 (4 x^3 - 6 x^2 + 2 x) (y^4 - y^2)

with the pressure p = sin(pi x) sin(pi y) balances the body force that is made from it. It is imposed weakly on the
whole boundary; a constant velocity may be added to it. With degree k the errors of the velocity fall with h^k in the
seminorm of H1 and with h^(k+1) in L2.

Source: D. Kamensky, "Open-source immersogeometric analysis of fluid-structure interaction using FEniCS and tIGAr",
section 5.1, doi:10.1016/j.camwa.2020.01.023.
"""

from pathlib import Path
from typing import Any, Literal

import ufl
from mpi4py import MPI

from tigar_x import checks, compat
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.convergence import Study, doubled, refine
from tigar_x.run.plane_field import PlaneField
from tigar_x.run.summary import write_summary
from tigar_x.run.vtkhdf import VTKHDFSeries
from tigar_x.run.writing import claim
from varmint.conditions import WeakVelocity
from varmint.flow import Flow, FlowOptions
from varmint.forms.space import split
from varmint.mesh import box
from varmint.quantities import Measured, squared_divergence

DOI = "10.1016/j.camwa.2020.01.023"
TOY = {"degree": 1, "elements": 4, "levels": 2}
SIDES = ("left", "right", "bottom", "top")


def exact(x: Any) -> tuple[Any, Any]:
    """Velocity and pressure."""
    X, Y = x[0], x[1]
    u_1 = 8 * (X**4 - 2 * X**3 + X**2) * (4 * Y**3 - 2 * Y)
    u_2 = -8 * (4 * X**3 - 6 * X**2 + 2 * X) * (Y**4 - Y**2)
    return ufl.as_vector([u_1, u_2]), ufl.sin(ufl.pi * X) * ufl.sin(ufl.pi * Y)


def force(x: Any, drift: tuple[float, float], nu: Any) -> Any:
    """Body force per mass that keeps the exact flow steady."""
    u, p = exact(x)
    velocity = u + ufl.as_vector(drift)
    return ufl.grad(u) * velocity + ufl.grad(p) - nu * ufl.div(ufl.grad(u) + ufl.grad(u).T)


def build(
    elements: int,
    degree: int = 1,
    cells: str = "triangle",
    reynolds: float = 100.0,
    drift: tuple[float, float] = (0.0, 0.0),
    share: float = 1.0,
    comm: MPI.Comm = MPI.COMM_WORLD,
    **options: Any,
) -> Flow:
    """The flow at rest, with a share of the force that belongs to the exact solution."""
    mesh = box(comm, (0.0, 0.0), (1.0, 1.0), (elements, elements), cells)
    nu = 1.0 / checks.positive("reynolds", reynolds)
    return Flow(
        mesh,
        [WeakVelocity(SIDES, lambda x, t: exact(x)[0] + ufl.as_vector(drift))],
        rho=1.0,
        mu=nu,
        degree=degree,
        f=lambda x, t: share * force(x, drift, nu),
        options=FlowOptions(**({"C_I": 6.0 * degree**4, "pin_at": (0.0, 0.0)} | options)),
    )


def errors(flow: Flow, degree: int | None = None, drift: tuple[float, float] = (0.0, 0.0)) -> dict[str, float]:
    """Norms of the errors; the pressure is compared up to a constant. Quadrature of degree 2 k unless given."""
    domain = flow.mesh.domain
    u, p = exact(ufl.SpatialCoordinate(domain))
    v, p_h = split(flow.w)
    e = v - u - ufl.as_vector(drift)
    dx = flow.mesh.dx(degree=2 * flow.degree if degree is None else degree)
    dx_p = flow.mesh.dx(degree=max(10, 2 * flow.degree))
    forms = compat.compile_forms(
        ufl.inner(ufl.grad(e), ufl.grad(e)) * dx, ufl.inner(e, e) * dx, (p_h - p) ** 2 * dx_p, (p_h - p) * dx_p
    )
    H1, L2, square, mean = (compat.assemble_scalar(form) for form in forms)
    return {"H1_u": H1**0.5, "L2_u": L2**0.5, "L2_p": max(square - mean**2, 0.0) ** 0.5}


def solved(flow: Flow) -> Flow:
    """The flow, steady."""
    flow.solve()
    return flow


def main(
    degree: int = 1,
    elements: int = 8,
    levels: int = 4,
    cells: Literal["triangle", "quadrilateral"] = "triangle",
    reynolds: float = 100.0,
    out: Path = Path("results/lid_driven_cavity"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Solve for the steady flow in a regularised cavity on finer and finer meshes, and compare with the exact one.

    Args:
        degree: of velocity and pressure.
        elements: per side on the coarsest mesh; doubled from level to level.
        levels: number of meshes, 2 or more.
        cells: of the mesh.
        reynolds: Reynolds number.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write a ParaView file and a picture of the finest level.

    Returns:
        The summary.
    """
    k = checks.whole("degree", degree, 1)

    def compiled(n: int) -> Flow:
        flow = build(n, k, cells, reynolds)
        flow.compile()
        return flow

    expected = {"H1_u": float(k), "L2_u": k + 1.0}
    claim(out, overwrite=overwrite)
    study, flow = refine(solved, errors, doubled(elements, levels), expected, compiled)
    if viz:
        d = flow.mesh.domain.geometry.dim
        with VTKHDFSeries(
            out / "cavity.vtkhdf", flow.mesh.domain, velocity=(flow.w, (0, 1)), pressure=(flow.w, (d,))
        ) as f:
            f.write(0.0)
        draw(out / "lid_driven_cavity.png", PlaneField(flow.w), study)

    inputs = {"degree": k, "elements": elements, "levels": levels, "cells": cells, "reynolds": reynolds}
    divergence = Measured(square=squared_divergence(flow))()["square"] ** 0.5
    summary = write_summary(
        out,
        "lid_driven_cavity",
        inputs,
        errors_true=errors(flow, 2 * k + 8),
        monitors={"divergence": divergence},
        dofs_fluid=flow.unknowns,
        **study.results(),
    )
    if MPI.COMM_WORLD.rank == 0:
        print(f"degree {k} on {cells}s, Re = {reynolds:g} (doi:{DOI})")
        print(study.table())
    return summary


@root_only
def draw(path: Path, field: PlaneField, study: Study) -> None:
    """Speed with streamlines, and the errors against run time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    field.shade(left, (field.values[:, :2] ** 2).sum(axis=1) ** 0.5, "speed", cmap="viridis")
    field.streamlines(left, density=1.2)
    study.draw(right)
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
