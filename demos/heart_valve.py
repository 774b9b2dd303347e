"""A heart valve of three leaflets that a pressure difference opens and, reversed, closes.

The aorta is a cylinder of radius 1.1 with three spherical sinuses. The leaflets are bicubic surfaces, clamped along
their posts and their attached edge: Kirchhoff-Love shells with nonlocal contact. At the inlet acts a traction of 2e4,
from t = 0.1 on one of -1e5: the valve opens, and closes abruptly on a small leak. Centimetres, grams, seconds.
Source: D. Kamensky, doi:10.1016/j.camwa.2020.01.023, section 6; the leaflets are :func:`tigar_x.surfaces.trileaflet`'s.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import ufl
from mpi4py import MPI

from coudalfish import CouDALFISh, CouplingOptions
from coudalfish.valve_pictures import histories, leaflets_movie
from coudalfish.valves import Leaflets, quantities
from shnapr import ContactRecipe, Hyperelastic, LinearKernel, Shell, StVenantKirchhoff, lee_sacks
from shnapr.stress import largest_principal, resultants
from tigar_x import Colours, VTUSeries, checks, direct, disjoint, generalized_alpha, script, surfaces, two_level
from tigar_x.run.results import Results, with_results
from tigar_x.splines.projection import Projected
from varmint import Flow, FlowOptions, Measured, PointValues, Resistance, Traction, Velocity, aortic_root, movie
from varmint.quantities import flow_rate

TOY = {"resolution": 6, "until": 2e-4, "frames": 4}
SVK = StVenantKirchhoff(1e7, 0.4, thickness=0.04)
CONTACT = ContactRecipe(LinearKernel(r_max=0.035, stiffness=1e11), r_self=0.045, neighbours="space")
TENSION = Colours("largest membrane force", "dyn/cm", 0.0, 1.5e5)


@dataclass(frozen=True)
class Data:
    """The problem's data; as published, leaflets start nearer than r_max at the posts, where they touch freely."""

    rho: float = 1.0
    mu: float = 0.03
    radius: float = 1.1
    systolic: float = 2e4
    diastolic: float = -1e5
    reversal: float = 0.1
    rho_s: float = 1.0
    leaflet: StVenantKirchhoff = SVK
    contact: ContactRecipe = CONTACT


def pressure(waveform: str, t: Any, c: Data) -> Any:
    """Traction at the inlet: a step, or a pulse of the same levels with smooth flanks of a fifth of the systole."""
    if waveform == "step":
        return ufl.conditional(ufl.lt(t, c.reversal - 1e-9), c.systolic, c.diastolic)
    starts = t / (c.reversal / 5), (t - c.reversal) / (c.reversal / 5) + 0.5
    up, down = ((1 - ufl.cos(ufl.pi * ufl.max_value(0.0, ufl.min_value(1.0, s)))) / 2 for s in starts)
    return c.systolic * up + (c.diastolic - c.systolic) * down


@dataclass(frozen=True)
class Valve:
    """The valve, discretised.

    Attributes:
        resolution: cells of the fluid across the aorta where the leaflets move, 4 or more.
        grading: size of the cells elsewhere, relative to theirs.
        leaflet_elements: of a leaflet from post to post, 0.8 times as many across; 0: to suit the fluid's cells.
        degree: of the leaflets' splines, 2 or more.
        material: of the leaflets, St. Venant-Kirchhoff or isotropic Lee-Sacks.
        waveform: of the traction at the inlet, the published step or a smooth pulse.
        outlet_resistance: pressure by flow rate at the outlet [dyn s/cm^5].
        dt: time step [s].
        preset: published algorithm, or plain fields (default with a resistance), that jump (else), or jump and bend.
    """

    resolution: int = 16
    grading: float = 1.0
    leaflet_elements: int = 0
    degree: int = 3
    material: Literal["svk", "lee-sacks"] = "svk"
    waveform: Literal["step", "pulse"] = "step"
    outlet_resistance: float = 0.0
    dt: float = 5e-5
    preset: Literal["reference", "plain", "jump", "sharp"] | None = None

    def __post_init__(self) -> None:
        for name, least in (("resolution", 4), ("leaflet_elements", 0), ("degree", 2)):
            checks.whole(name, getattr(self, name), least)
        checks.within("grading", self.grading, 1.0, 10.0)
        checks.not_negative("outlet_resistance", self.outlet_resistance)
        vars(self).update(preset=self.preset or ("plain" if self.outlet_resistance else "jump"))

    def flow(self, mesh: Any, data: Data, solver: Any = None) -> Flow:
        """Blood at rest on a mesh of the aorta."""
        inlet = Traction("inlet", lambda x, t: ufl.as_vector([0.0, 0.0, pressure(self.waveform, t, data)]))
        R, fields = self.outlet_resistance, {"jump": "jump", "sharp": "jump and kink"}.get(str(self.preset), "plain")
        conditions = [inlet, Resistance("outlet", R) if R else Traction("outlet"), Velocity("walls")]
        known = {"rho": data.rho, "mu": data.mu, "dt": self.dt, "scheme": generalized_alpha(0.0)}
        fill = 2 if self.preset == "reference" else 1
        solver = solver or two_level(fill, rtol=1e-5, rebuild_growth=float("inf"), fallback=direct())
        return Flow(mesh, conditions, **known, immersed=fields, options=FlowOptions(solver=solver))

    def leaflets(self, data: Data) -> Shell:
        """Leaflets at rest."""
        along = self.leaflet_elements or max(4, round(0.9 * self.resolution / data.radius))
        elements = along, max(1 if self.leaflet_elements else 3, round(0.8 * along))
        geometry = disjoint(*surfaces.trileaflet(radius=data.radius, elements=elements, degrees=(self.degree,) * 2))
        structure = {"density": data.rho_s, "clamped": ("post_0", "post_1", "attachment"), "contact": data.contact}
        pericardium = Hyperelastic(lee_sacks(676080.0, 132848.0, 38.1878), data.leaflet.thickness)  # bovine
        material = data.leaflet if self.material == "svk" else pericardium
        return Shell(geometry, material, **structure, quadrature_degree=4)

    def build(self, data: Data, options: Any = None, solver: Any = None) -> tuple[Flow, Shell, CouDALFISh]:
        """Blood and leaflets at rest, and both coupled by ``CouplingOptions``; the solver is that of the flow."""
        size = 2.0 * data.radius / self.resolution
        mesh = aortic_root(MPI.COMM_WORLD, size=self.grading * size, swept_size=size, radius=data.radius)
        flow, leaflets, published = self.flow(mesh, data, solver), self.leaflets(data), self.preset == "reference"
        reference = CouplingOptions.reference(penalty=500.0, relaxation=1e-5, block_rtol=1e-2) if published else None
        return flow, leaflets, CouDALFISh(flow, leaflets, options or reference)


@with_results(checkpoint_every=500)
def main(results: Results, valve: Valve, until: float = 0.2, frames: int = 80) -> dict[str, Any]:
    """Open and close a heart valve of three leaflets.

    Args:
        until: end [s].
        frames: number of pictures and ParaView files of the whole run.
    """
    out, (flow, shell, fsi) = results.out, valve.build(Data())
    leaflets, rate = Leaflets(shell), Measured(q=flow_rate(flow, "inlet"))
    values = PointValues(flow, [(0, 0, -0.3), (0, 0, 1.7)])
    tension = Projected(shell.spline, largest_principal(resultants(shell.spline, shell.material, shell.y).n))
    fields = {"velocity": shell.time.xdot_old, "tension": tension, "multiplier": lambda: fsi.lam}
    look = {"length": "cm", "time": "s", "box": ((-1.15, -1.15, -0.3), (1.15, 1.15, 1.5))}
    files = [movie(flow, out / "fluid.vtkhdf"), partial(VTUSeries, out / "leaflets", shell.spline, y=shell.y, **fields)]
    files.append(leaflets_movie(out / "leaflets.gif", leaflets, tension, TENSION, **look))
    history = {"flow_rate": lambda: -rate()["q"], ("pressure_before", "pressure_behind"): lambda: values()[:, 3]}
    run = results.run(fsi, until=until, frames=frames, series=files, history=history | leaflets.columns())
    for _ in run:
        if run.writes:
            run.extra["piercings"] = max(run.extra.get("piercings", 0), shell.piercings())
    if run.finished and results.viz:
        histories(out / "histories.png", run.history, length="cm", time="s", force="dyn")
    monitors = {"piercings": run.extra.get("piercings", 0), "asymmetry_max": run.history["asymmetry"].max()}
    near = {"range_of_contact": shell.contact.kernel.r_max, "points_to_range_of_contact": shell.contact.spacing_ratio}
    monitors |= near | {"cell_size": fsi.fluid.mesh_size}
    more = {"cells": flow.mesh.size, "nodes_shell": len(shell.positions), "inputs": {"data": Data()}}
    return results.of_run(run, qoi=quantities(run.history, Data().reversal), monitors=monitors, **more)


if __name__ == "__main__":
    script.command_line(main)
