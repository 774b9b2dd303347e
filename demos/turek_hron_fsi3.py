"""An elastic beam behind a cylinder in a channel, FSI3: a thick solid in the mesh of the flow, which moves along.

The beam (length 0.35, thickness 0.02) is attached to a cylinder of diameter 0.1 in the channel (0, 2.5) x (0, 0.41). It
is a St. Venant-Kirchhoff solid that shares nodes with the fluid; the mesh of the fluid follows it as a fictitious
elastic solid, stiffer where cells are compressed or small. The fluid enters with a parabola of mean speed 2, which
comes up within two seconds, and leaves freely.

What is compared are mean and amplitude, half the sum and half the difference of the last maximum and minimum, of the
displacement of the beam's end (0.6, 0.2) and of drag and lift on cylinder and beam together, and their frequencies:
those of Turek and Hron, doi:10.1007/3-540-34596-5_15.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from mpi4py import MPI

from tigar_x import PlaneField, Results, against, backward_euler, direct, draw, generalized_alpha, over_time, script
from tigar_x.run.results import with_results
from varmint import BoundaryForce, ElasticMotion, Flow, FlowOptions, NodeValues, Solid, Traction, Velocity, movie
from varmint.forms.solids import StVenantKirchhoffSolid
from varmint.mesh.models import channel_with_cylinder
from varmint.profiles import parabola
from varmint.quantities import vorticity

DOI = "10.1007/3-540-34596-5_15"
TOY = {"size": 0.12, "beam_size": 0.03, "degree": 1, "dt": 0.01, "until": 0.1}
HEIGHT, SPEED, RAMP, TIP, HELD = 0.41, 2.0, 2.0, (0.6, 0.2), ("inlet", "outlet", "walls", "cylinder", "beam_root")
RHO, NU, SHEAR_MODULUS, POISSON_RATIO = 1e3, 1e-3, 2e6, 0.4
KINDS = ("mean", "amplitude", "frequency")
PUBLISHED = {"u_x": (-2.69e-3, 2.53e-3, 10.9), "u_y": (1.48e-3, 34.38e-3, 5.3)}
PUBLISHED |= {"drag": (457.3, 22.66, 10.9), "lift": (2.22, 149.78, 5.3)}


@dataclass(frozen=True)
class Beam:
    """The beam in its channel, discretised.

    Attributes:
        size: of the cells away from cylinder and beam.
        beam_size: of the cells at cylinder and beam, at most the beam's thickness.
        degree: of velocity, pressure and the mesh's displacement.
        dt: time step.
        scheme: of time integration; generalized alpha has rho_infinity = 1/2, backward Euler damps the beam.
    """

    size: float = 0.03
    beam_size: float = 0.008
    degree: int = 2
    dt: float = 2e-3
    scheme: Literal["backward euler", "generalized alpha"] = "generalized alpha"

    def build(self, **options: Any) -> Flow:
        """Fluid and beam at rest."""
        sizes = {"size": self.size, "cylinder_size": self.beam_size}
        mesh = channel_with_cylinder(MPI.COMM_WORLD, length=2.5, beam=(0.35, 0.02), **sizes)
        scheme = backward_euler() if self.scheme == "backward euler" else generalized_alpha(0.5)
        moving = ElasticMotion(mesh, dict.fromkeys(HELD), self.dt, scheme, self.degree, cells=("fluid",))
        solid = Solid(StVenantKirchhoffSolid(2.0 * SHEAR_MODULUS * (1.0 + POISSON_RATIO), POISSON_RATIO, RHO))
        sides = [Velocity(("walls", "cylinder")), Velocity("beam_root", (0.0, 0.0)), Traction("outlet")]
        sides.append(Velocity("inlet", parabola(HEIGHT, SPEED, RAMP)))
        chosen = FlowOptions(**({"rtol": 1e-5, "solver": direct()} | options))
        known = {"rho": RHO, "mu": RHO * NU, "degree": self.degree, "dt": self.dt, "scheme": scheme}
        return Flow(mesh, sides, **known, moving=moving, solid=solid, options=chosen)


@with_results
def main(results: Results, beam: Beam, until: float = 7.0) -> dict[str, Any]:
    """Follow the beam from rest until it flaps, and compare its oscillations with the published ones.

    Args:
        until: end; the beam flaps regularly from about t = 5 on.
    """
    flow = beam.build()
    y, curl = flow.moving.time.x, vorticity(flow)
    force, tip = BoundaryForce(flow, "cylinder", "interface"), NodeValues(y, [TIP])
    history = {"t_alpha": "t_alpha", ("u_x", "u_y"): tip, ("drag", "lift"): "measured"}
    history["smallest_volume_ratio"] = flow.moving.smallest_volume_ratio
    files = movie(flow, results.out / "flow.vtkhdf", vorticity=(curl, (0,)))
    run = results.run(flow, until=until, frames=60, series=[files], measure=force, history=history).through()
    past, found, known, panels = run.history, {}, {}, []
    last = past.since(past.t[-1] - 1.0)
    for name, published in PUBLISHED.items():
        over, y_axis = ("t_alpha", ("force", "N/m")) if name in ("drag", "lift") else ("t", ("displacement", "m"))
        oscillation = past.course(name, over).last(1.0).oscillation()
        found |= {f"{name}_{k}": v for k in KINDS if np.isfinite(v := getattr(oscillation, k))}
        known |= {f"{name}_{k}": value for k, value in zip(KINDS, published, strict=True)}
        levels = {"published range": published[0] - published[1], "_": published[0] + published[1]}
        panels.append(over_time(last, {name: name}, y=y_axis, time="s", over=over, levels=levels))
    if results.viz:
        swirl = PlaneField(curl(), y).signed("vorticity", "1/s", share=0.1, length="m")
        picture = PlaneField(flow.w, y).speed("m/s", length="m"), swirl, panels[:2], panels[2:]
        draw(results.out / "turek_hron_fsi3.png", *picture, size=(5.5, 2.2))
    smallest = {"smallest_volume_ratio": past["smallest_volume_ratio"].min()}
    return results.of_run(run, doi=DOI, qoi=against(found, known, DOI), monitors=smallest)


if __name__ == "__main__":
    script.command_line(main)
