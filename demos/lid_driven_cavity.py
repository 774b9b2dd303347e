"""Steady flow in a square with a regularised lid: convergence to an exact solution at any Reynolds number.

In the unit square the velocity

    u_1 = 8 (x^4 - 2 x^3 + x^2) (4 y^3 - 2 y),    u_2 = -8 (4 x^3 - 6 x^2 + 2 x) (y^4 - y^2)

with the pressure p = sin(pi x) sin(pi y) balances the body force that is made from it. It is imposed weakly on the
whole boundary. With degree k the errors of the velocity fall with h^k in the seminorm of H1 and with h^(k+1) in L2.

Source: D. Kamensky, "Open-source immersogeometric analysis of fluid-structure interaction using FEniCS and tIGAr",
section 5.1, doi:10.1016/j.camwa.2020.01.023.
"""

from typing import Any, Literal

import ufl
from mpi4py import MPI

from tigar_x import PlaneField, Results, checks, compat, draw, script, with_results
from varmint import Flow, FlowOptions, Measured, WeakVelocity, box, movie, squared_divergence, velocity_errors
from varmint.forms.space import split

Cells = Literal["triangle", "quadrilateral"]
TOY = {"degree": 1, "elements": 4, "levels": 2}


def exact(x: Any) -> tuple[Any, Any]:
    """Velocity and pressure."""
    X, Y = x[0], x[1]
    u_1 = 8 * (X**4 - 2 * X**3 + X**2) * (4 * Y**3 - 2 * Y)
    u_2 = -8 * (4 * X**3 - 6 * X**2 + 2 * X) * (Y**4 - Y**2)
    return ufl.as_vector([u_1, u_2]), ufl.sin(ufl.pi * X) * ufl.sin(ufl.pi * Y)


def force(x: Any, nu: float, drift: Any = None) -> Any:
    """Body force per mass that keeps the exact flow steady, in a frame that may drift."""
    u, p = exact(x)
    velocity = u if drift is None else u + drift
    return ufl.grad(u) * velocity + ufl.grad(p) - nu * ufl.div(ufl.grad(u) + ufl.grad(u).T)


def build(elements: int, degree: int = 1, cells: str = "triangle", reynolds: float = 100.0, **options: Any) -> Flow:
    """The flow at rest."""
    mesh, nu = box(MPI.COMM_WORLD, (0, 0), (1, 1), (elements, elements), cells), 1.0 / reynolds
    walls = WeakVelocity(("left", "right", "bottom", "top"), lambda x, t: exact(x)[0])
    chosen = FlowOptions(**({"C_I": 6.0 * degree**4, "pin_at": (0.0, 0.0)} | options))
    return Flow(mesh, [walls], rho=1.0, mu=nu, degree=degree, f=lambda x, t: force(x, nu), options=chosen)


def errors(flow: Flow, degree: int | None = None, drift: tuple[float, float] = (0.0, 0.0)) -> dict[str, float]:
    """Norms of the errors; the pressure is compared up to a constant. Quadrature of degree 2 k unless given."""
    found = velocity_errors(flow, lambda x, t: exact(x)[0] + ufl.as_vector(drift), degree)
    e, dx = (
        split(flow.w)[1] - exact(ufl.SpatialCoordinate(flow.mesh.domain))[1],
        flow.mesh.dx(degree=max(10, 2 * flow.degree)),
    )
    square, mean = map(compat.assemble_scalar, compat.compile_forms(e**2 * dx, e * dx))
    return {**found, "L2_p": max(square - mean**2, 0.0) ** 0.5}


@with_results(elements=8, levels=4)
def main(results: Results, degree: int = 1, cells: Cells = "triangle", reynolds: float = 100.0) -> dict[str, Any]:
    """Solve for the steady flow in a regularised cavity on finer and finer meshes, and compare with the exact one.

    Args:
        degree: of velocity and pressure.
        cells: of the mesh.
        reynolds: Reynolds number.
    """
    k, Re = checks.whole("degree", degree, 1), checks.positive("reynolds", reynolds)
    study, flow = results.refine(Flow.solve, errors, {"H1_u": k, "L2_u": k + 1}, lambda n: build(n, k, cells, Re))
    if results.viz:
        movie(flow, results.out / "cavity.vtkhdf")().once()
        draw(results.out / "lid_driven_cavity.png", PlaneField(flow.w).speed("-", length="-", density=1.2), study.draw)
    true, divergence = errors(flow, 2 * k + 8), Measured(square=squared_divergence(flow))()["square"] ** 0.5
    more = {"errors_true": true, "monitors": {"divergence": divergence}, "dofs_fluid": flow.unknowns}
    return results.convergence(study, f"degree {k} on {cells}s, Re = {reynolds:g}", **more)


if __name__ == "__main__":
    script.command_line(main)
