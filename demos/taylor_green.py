"""Taylor-Green vortex: unsteady flow against an exact solution, on a fixed or a moving mesh, in the plane or extruded.

In the square (-pi, pi)^2 with impermeable walls without friction

    u = exp(-2 nu t) (sin x cos y, -cos x sin y),    p = rho/4 exp(-4 nu t) (cos 2x + cos 2y)

decays without a body force. The number of steps is that of the cells per side unless it is given, so that with the
implicit midpoint rule the errors of the velocity in the seminorm of H1 fall with h^k for degree k = 1, 2. The moving
mesh is displaced by A sin y_1 sin y_2 sin(2 pi t/T) (1, 1). In space the square is extruded by one layer of cells, with
the same walls in front and behind; all norms are per unit depth.
Source: D. Kamensky, section 5.2, doi:10.1016/j.camwa.2020.01.023.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI

from tigar_x import Colours, PlaneField, Results, checks, draw, generalized_alpha, script, with_results
from varmint import Flow, FlowOptions, PrescribedMotion, Slip, box, movie, velocity_errors
from varmint.quantities import Measured, kinetic_energy, volume

TOY = {"elements": 4, "levels": 2, "moving_mesh": True}
REYNOLDS, END, AMPLITUDE = 100.0, 1.0, 0.2


def velocity(x: Any, t: Any) -> Any:
    """Exact velocity."""
    plane = [ufl.sin(x[0]) * ufl.cos(x[1]), -ufl.cos(x[0]) * ufl.sin(x[1])]
    return ufl.exp(-2 * t / REYNOLDS) * ufl.as_vector(plane + [0.0] * (len(x) - 2))


def displacement(y: Any, t: Any) -> Any:
    """Displacement of the moving mesh."""
    both = AMPLITUDE * ufl.sin(y[0]) * ufl.sin(y[1]) * ufl.sin(2 * ufl.pi * t / END)
    return ufl.as_vector([both, both] + [0.0] * (len(y) - 2))


@dataclass(frozen=True)
class Vortex:
    """How the vortex is discretised.

    Attributes:
        dim: dimension of space, 2 or 3 (one layer).
        degree: of velocity and pressure.
        moving_mesh: whether the mesh moves.
        cells: of the mesh; default: triangles or tetrahedra.
        rho_infinity: spectral radius of the time integration at infinite frequency; 1 is the implicit midpoint rule.
    """

    dim: Literal[2, 3] = 2
    degree: int = 1
    moving_mesh: bool = False
    cells: Literal["triangle", "quadrilateral", "tetrahedron", "hexahedron"] | None = None
    rho_infinity: float = 1.0

    def build(self, elements: int, comm: MPI.Comm = MPI.COMM_WORLD, **options: Any) -> Flow:
        """The vortex at t = 0, projected onto a mesh of so many elements per side."""
        d, low, high = self.dim, (-np.pi, -np.pi, 0.0), (np.pi, np.pi, 2 * np.pi / elements)
        cells = self.cells or ("triangle" if d == 2 else "tetrahedron")
        mesh = box(comm, low[:d], high[:d], (elements, elements, 1)[:d], cells)
        clock = {"dt": END / elements, "scheme": generalized_alpha(self.rho_infinity)}
        moving = PrescribedMotion(mesh, displacement, **clock) if self.moving_mesh else None
        chosen = FlowOptions(**({"C_I": 6.0 * self.degree**4, "pin_at": low[:d]} | options))
        fluid = {"rho": 1.0, "mu": 1.0 / REYNOLDS, "degree": checks.whole("degree", self.degree, 1)}
        flow = Flow(
            mesh, [Slip(mesh.facet_names, strong_if_moving=True)], **fluid, **clock, moving=moving, options=chosen
        )
        flow.start(velocity, projected=True)
        return flow


def errors(flow: Flow, degree: int | None = None) -> dict[str, float]:
    """Norms of the errors at the end, per unit depth. Quadrature of degree 2 k unless given."""
    depth = 1.0 if flow.mesh.domain.geometry.dim == 2 else 2 * np.pi * flow.time.step_size / END
    return {name: error / depth**0.5 for name, error in velocity_errors(flow, velocity, degree).items()}


@with_results(elements=8, levels=3)
def main(results: Results, vortex: Vortex) -> dict[str, Any]:
    """Follow the decaying vortex on finer and finer meshes with as many time steps, and compare with the exact one."""
    rates = {"H1_u": float(min(checks.whole("degree", vortex.degree, 1), 2))}
    study, flow = results.refine(lambda flow: flow.run(until=END, show=False).through(), errors, rates, vortex.build)
    if results.viz:
        again, path = vortex.build(results.inputs["elements"]), results.out / "flow.vtkhdf"
        energy = Measured(kinetic_energy=kinetic_energy(again), volume=volume(again))
        columns = {"energy": energy, "newton_iterations": "iterations"}
        results.run(again, until=END, series=[movie(again, path)], history=columns, show=False).through()
        field, look = PlaneField(flow.w, flow.moving and flow.moving.time.x), Colours("pressure", "-", palette="RdBu_r")
        pressure = field.panel(field.values[:, -1], look, length="-", density=1.2, title="at the end")
        draw(results.out / "taylor_green.png", pressure, study.draw)
    balance = Measured(kinetic_energy=kinetic_energy(flow), volume=volume(flow))()
    more = {"errors_true": errors(flow, 2 * vortex.degree + 8), "monitors": balance, "dofs_fluid": flow.unknowns}
    return results.convergence(study, f"{vortex}, Re = {REYNOLDS:g}", **more)


if __name__ == "__main__":
    script.command_line(main)
