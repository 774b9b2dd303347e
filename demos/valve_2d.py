"""Two leaflets that a pulsating channel flow opens and lets swing back: the plane valve.

The channel (0, 8) x (0, 1.61) has a straight leaflet of length 0.7 clamped to each wall at x_1 = 2; their tips leave a
gap of 0.21. The fluid enters with u_1 = 5 (sin 2 pi t + 1.1) x_2 (1.61 - x_2), which comes up linearly within the first
two steps, sticks to the walls and leaves freely. Both leaflets are St. Venant-Kirchhoff shells, patches of one spline.
Velocities on inlet and walls are imposed weakly, and all time integration is generalized-alpha with rho_infinity = 0.

The displacement of the top tip along the channel is compared with a solution on a mesh that fits the leaflets, and its
peaks and troughs with the published ones (`coudalfish.problems.valve_2d`). In three dimensions the channel is extruded
by its depth with one layer of cells and slip on its ends, as in the source.

Source: Kamensky et al., section 4.7, doi:10.1016/j.cma.2014.10.040; discretised as in doi:10.1016/j.camwa.2020.01.023.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI

from coudalfish import CouDALFISh, CouplingOptions, fluid_side
from coudalfish.problems.valve_2d import DOI, PUBLISHED, known_points, off_body_fitted, swings
from shnapr import Shell, StVenantKirchhoff
from tigar_x import PlaneField, Results, VTUSeries, checks, compat, generalized_alpha, sampling, script, with_results
from tigar_x.geometry import multipatch, shapes
from tigar_x.run.figure import draw, over_time
from tigar_x.run.summary import against, deviations
from varmint import Flow, FlowOptions, Measured, Slip, Traction, WeakVelocity, box, kinetic_energy, movie, vorticity
from varmint.mesh.arrays import mirrored_box

TOY = {"elements": 6, "leaflet_elements": 6, "until": 0.15, "dt_factor": 1.5}
LENGTH, HEIGHT, PLACE, SPAN = 8.0, 1.61, 2.0, 0.7  # the last two of the leaflets; consistent units
RHO, MU, RHO_S, SVK = 100.0, 10.0, 100.0, StVenantKirchhoff(5.6e7, 0.4, thickness=0.0212)


def inflow(x: Any, t: Any, dt: Any) -> Any:
    """Velocity at the inlet, UFL."""
    pulse = 5.0 * (ufl.sin(2 * ufl.pi * t) + 1.1) * ufl.min_value(t / (2.0 * dt), 1.0)
    return ufl.as_vector([pulse * x[1] * (HEIGHT - x[1]), *[0.0] * (len(x) - 1)])


@dataclass(frozen=True)
class Valve:
    """The valve, discretised.

    Attributes:
        dim: dimension of space, 2 or 3 (one layer).
        elements: fluid cells across the channel, five times as many along it.
        leaflet_elements: Bezier elements of each leaflet.
        degree: of the leaflets, at least 2.
        preset: published coupling, plain fields, or, the default in the plane, sharp ones with two sides of leaflets.
        smoothing: relaxation of a multiplier that lags towards its means over vertices; 0: none; default: the preset's.
        steps_per_element: the published time step is 3 over this times the elements.
        dt_factor: time step relative to the published one.
        mirrored: whether the cells below the channel's axis mirror those above, for an even number of elements;
            default: but for the reference preset, where the number is even; the published mesh is not mirrored.
        invariant_metric: whether the stabilisation's element metric does not depend on the numbering of vertices.
    """

    dim: Literal[2, 3] = 2
    elements: int = 16
    leaflet_elements: int = 16
    degree: int = 2
    preset: Literal["reference", "plain", "sharp"] | None = None
    smoothing: float | None = None
    steps_per_element: int = 32
    dt_factor: float = 1.0
    mirrored: bool | None = None
    invariant_metric: bool = False

    def __post_init__(self) -> None:
        for name, least in (("elements", 1), ("leaflet_elements", 2), ("degree", 2), ("steps_per_element", 1)):
            checks.whole(name, getattr(self, name), least)
        checks.not_negative("smoothing", self.smoothing or 0.0)
        checks.positive("dt_factor", self.dt_factor)
        preset = self.preset or ("sharp" if self.dim == 2 else "plain")
        if self.smoothing is not None and preset == "sharp":
            raise ValueError(f"smoothing = {self.smoothing}, preset = 'sharp': 'plain' or 'reference' is required")
        mirrored = preset != "reference" and self.elements % 2 == 0 if self.mirrored is None else self.mirrored
        vars(self).update(preset=preset, mirrored=mirrored)

    def leaflets(self, material: StVenantKirchhoff = SVK, depth: float = 1.0) -> Shell:
        """Both leaflets, bottom and top, with normals along the channel; nothing moves along an extrusion."""
        size, patches = {"elements": self.leaflet_elements, "degree": self.degree}, []
        for k, (low, high) in enumerate(((0.0, SPAN), (HEIGHT - SPAN, HEIGHT))):
            line = shapes.line((PLACE, low), (PLACE, high), **size, side_names={"wall": (0, k), "tip": (0, 1 - k)})
            patches.append(line if self.dim == 2 else shapes.extruded(line, (0.0, 0.0, depth)))
        geometry = multipatch.disjoint(*patches)
        across = range(2, 3 * geometry.n, 3) if self.dim == 3 else ()
        return Shell(geometry, material, density=RHO_S, clamped=["wall"], zero_dofs=across, quadrature_degree=4)

    def build(
        self, options: Any = None, solver: Any = None, *, material: Any = SVK, depth: float = 1.0, rho_inf: float = 0.0
    ) -> tuple[Flow, Shell, CouDALFISh]:
        """Fluid and leaflets at rest, and both coupled."""
        d, n, dt = self.dim, self.elements, self.dt_factor * 3.0 / (self.steps_per_element * self.elements)
        grid = partial(mirrored_box, original="upper") if self.mirrored else box
        mesh = grid(MPI.COMM_WORLD, (0.0,) * d, (LENGTH, HEIGHT, depth)[:d], (5 * n, n, 1)[:d])
        sides = [WeakVelocity("left", partial(inflow, dt=compat.Constant(mesh.domain, dt))), Traction("right")]
        sides += [WeakVelocity(("bottom", "top")), *([Slip(("back", "front"))] if d == 3 else [])]
        immersed = "jump and kink" if self.preset == "sharp" else "plain"
        known = {"rho": RHO, "mu": MU, "dt": dt, "scheme": generalized_alpha(rho_inf), "immersed": immersed}
        flow = Flow(mesh, sides, **known, options=FlowOptions(invariant_metric=self.invariant_metric, solver=solver))
        presets = {"reference": CouplingOptions.reference(block_rtol=1e-2), "sharp": CouplingOptions.sharp()}
        smoothed = {} if self.smoothing is None else {"relaxation": self.smoothing, "relaxation_mode": "smoothed"}
        how = options or presets.get(self.preset, CouplingOptions()).with_(**smoothed)
        leaflets = self.leaflets(material, depth)
        return flow, leaflets, CouDALFISh(fluid_side(flow, mesh_size=HEIGHT / n), leaflets, how)


@with_results(checkpoint_every=0)
def main(results: Results, valve: Valve, until: float = 3.0) -> dict[str, Any]:
    """Let the pulsating flow move two leaflets, and compare the top one's tip with what is known of it.

    Args:
        until: end.
    """
    flow, shell, fsi = valve.build()
    spin, fluid, dt = vorticity(flow), Measured(kinetic_fluid=kinetic_energy(flow)), fsi.step_size
    state = {"y": shell.y, "velocity": shell.time.xdot_old, "multiplier": lambda: fsi.lam}
    files = [partial(VTUSeries, results.out / "shell", shell.spline, **state)]
    files += [movie(flow, results.out / "fluid.vtkhdf", vorticity=(spin, range(1 if valve.dim == 2 else 3)))]
    history = {
        **{"t_alpha": "t_alpha", "passes": "passes"},
        ("bottom_x", "bottom_y", "top_x", "top_y"): lambda: [shell.at("tip", patch=k).displacement[:2] for k in (0, 1)],
        "inflow": lambda report: float(inflow((0.0, HEIGHT / 2.0), report.t, dt)[0]) * 2.0 * HEIGHT / 3.0,
        **{"leak": "monitors.leak", "normal_slip": "monitors.normal_slip_max", "fluid": fluid},
        ("kinetic_shell", "elastic"): lambda: [(stored := shell.energies()).kinetic, stored.elastic],
    }
    run = results.run(fsi, until=until, frames=60, series=files, history=history).through()
    past, sides = run.history, ("top", "bottom")
    found = {f"{side}_{name}": x for side in sides for name, x in swings(past.course(f"{side}_x")).items()}
    if run.finished and results.viz:
        seen = {"length": "length", "immersed": sampling.line(shell.spline, 0, 81, at=0.0).positions(shell.y)}
        speed = PlaneField(flow.w, sides=flow.sides).speed("length/time", title=f"t = {past.t[-1]:.3g}", **seen)
        vortices = PlaneField(spin()).signed("vorticity", "1/time", share=0.5, **seen)
        y, tips = ("displacement along $x_1$", "length"), {f"{side} tip": f"{side}_x" for side in ("top", "bottom")}
        motion = over_time(past, tips, y=y, time="time", points=known_points(), styles={"bottom tip": {"ls": "--"}})
        draw(results.out / "valve_2d.png", speed, vortices, motion, columns=1, size=(11.0, 2.8))
    monitors = {"asymmetry_max": np.abs(past["top_x"] - past["bottom_x"]).max()}
    monitors["leaked_share"] = np.abs(past["leak"]).sum() / past["inflow"].sum()  # a layer has the depth 1
    off = off_body_fitted(past.t, past["top_x"])
    inputs, qoi = {"options": fsi.options}, against(found | off, PUBLISHED, DOI)
    return results.of_run(run, doi=DOI, qoi=qoi, errors=deviations(qoi) | off or None, monitors=monitors, inputs=inputs)


if __name__ == "__main__":
    script.command_line(main)
