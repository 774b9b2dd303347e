"""What the scenes in space of benchmarks/space*.py say of the library, and what they are measured by."""

import math
from dataclasses import replace

import numpy as np
import pytest
import ufl
from plane_gaps import slit_flow
from scene import COMM, Coupled, immersed_flow, rigid
from space import IN_SPACE, VALVE_NUMBERS, Fence, HeldSurface, pressure_error, rectangle
from space_bodies import Obstacle, Sphere, ball
from space_contact import Pair
from space_fitted import fitted_drag, fitted_flow
from space_gaps import SLOWED, Hole, Slit
from surface import setting_of
from surface_space import STUDIES

from coudalfish.surface.sheets import Sheets
from tigar_x import compat, generalized_alpha
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline
from varmint import Slip, Traction, box, flow_rate

CONVERGED, JUMP = setting_of("converged", IN_SPACE), setting_of("jump", IN_SPACE)


# -- at rest ----------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_what_flows_at_a_held_dome_under_pressure_goes_down_with_the_mesh_and_up_with_the_pressure():
    dome = HeldSurface(4)
    coarse, fine, light = dome.run(), replace(dome, n=8, per_cell=1.0).run(), replace(dome, jump=1e-3).run()
    assert fine.figures["velocity"] < 0.5 * coarse.figures["velocity"] < 0.02
    assert light.figures["velocity"] == pytest.approx(coarse.figures["velocity"], rel=0.05)
    assert abs(fine.figures["load"]) < 0.01
    assert fine.figures["pressure"] < 0.12
    assert max(coarse.imbalance, fine.imbalance) < 1e-12


@pytest.mark.mpi
@pytest.mark.parametrize("changes", [{"curved": 0.0, "slope": (0.31, 0.17)}, {"weak": True}])
def test_no_volume_passes_a_held_surface_with_a_converged_multiplier(changes):
    found = HeldSurface(4, ramp=2, steps=2, **changes).run(CONVERGED)
    assert abs(found.figures["leak"]) < 1e-7
    assert found.passes.max() == 1


@pytest.mark.mpi
@pytest.mark.parametrize("changes", [{}, {"jump": 1e5}, {"weak": True}, {"curved": 0.0, "slope": (0.31, 0.17)}])
@pytest.mark.parametrize("name", ["jump", "sharp"])
def test_a_held_surface_and_a_pressure_that_jumps_are_in_equilibrium_to_rounding(name, changes):
    """Normals of the shell in place of those of the cut leave velocities of 2e-3 at a jump of one, and 46 at 1e5."""
    surface = HeldSurface(4, ramp=1, steps=2, **changes)
    surface = replace(surface, dt=0.05 * surface.jump**-0.5)
    found = surface.run(setting_of(f"{name}(block_rtol=1e-8)", IN_SPACE))
    for what, limit in {"highest": 1e-7, "velocity": 1e-8, "leak": 1e-8, "load": 1e-4, "pattern": 1e-4}.items():
        assert abs(found.figures[what]) < limit, what
    assert found.figures["pressure"] < (0.08 if surface.curved else 1e-5)  # plain fields: .2
    assert found.passes.max() == 1
    assert found.imbalance < 1e-12


def meetings(scene, monkeypatch):
    """How the surface meets the fluid, step by step."""
    met, place = [], scene.fsi.fluid.place
    monkeypatch.setattr(scene.fsi.fluid, "place", lambda *given, **named: met.append(place(*given, **named)) or met[-1])
    return met


@pytest.mark.mpi
@pytest.mark.parametrize("per_cell", [0.5, 1.0, 2.0, 4.0])
def test_every_point_of_a_held_surface_is_seen_however_fine_it_is(per_cell, monkeypatch):
    """With few points on polygons half of the points had no area where there were eight along a cell."""
    scene = HeldSurface(4, ramp=1, curved=0.0, slope=(0.31, 0.17), per_cell=per_cell).build(JUMP)
    met = meetings(scene, monkeypatch)
    for _ in range(2):
        scene.step()
    x, W = scene.shell.positions, met[-1].W
    assert (W[((x[:, :2] > 0.0) & (x[:, :2] < 1.0)).all(axis=1)] > 0.0).all()
    inside = W[(np.abs(x[:, :2] - 0.5) < 0.25).all(axis=1)]  # functions that go on beyond walls have a part
    assert np.abs(inside / inside.mean() - 1.0).max() < 0.9
    assert W.sum() == pytest.approx(math.sqrt(1.0 + 0.31**2 + 0.17**2), rel=1e-12)
    assert scene.fsi.fluid.speed() < 1e-8


@pytest.mark.mpi
@pytest.mark.parametrize(("per_cell", "warns"), [(8.0, False), (10.0, True)])
def test_a_surface_that_is_finer_than_polygons_can_see_is_told_of(per_cell, warns, caplog):
    HeldSurface(2, ramp=1, curved=0.0, per_cell=per_cell).build(JUMP).step()
    assert ("does not act on all of them" in caplog.text) == (warns and COMM.rank == 0)


def test_a_valve_that_closes_at_once_moves_nothing_with_a_jump():
    """It is 18 cm/s with plain fields, and 179 with a converged multiplier besides."""
    found = replace(VALVE_NUMBERS, n=6, steps=5).run(JUMP)
    assert found.figures["highest"] < 1e-7
    assert found.figures["iterations"] < 25


@pytest.mark.mpi
def test_the_error_of_the_pressure_is_that_of_a_known_one():
    scene = HeldSurface(4).build(IN_SPACE)
    scene.flow.start(pressure=lambda x, t: 2.0 * x[0] - x[2])
    wrong = pressure_error(scene.flow, lambda x: 2.0 * x[:, 0] - x[:, 2] + 3.0, lambda x: np.abs(x[:, 2] - 0.5))
    assert wrong == pytest.approx(3.0, rel=1e-12)
    scene.flow.start(pressure=0.0)
    half = pressure_error(scene.flow, lambda x: 1.0 * (x[:, 2] > 0.4), lambda x: np.abs(x[:, 2] - 0.4))
    assert half == pytest.approx(math.sqrt(0.6), rel=0.02)


@pytest.mark.parametrize("quarter", [False, True])
def test_a_ball_is_a_closed_sphere_whose_normals_point_outwards(quarter):
    center = np.array([0.1, 0.2, -0.3])
    spline = ExtractedSpline(ball(0.5, center, 4, quarter=quarter))
    sheets = Sheets.of(spline)
    x = spline.node_positions - center
    assert np.linalg.norm(x, axis=1) == pytest.approx(np.full(len(x), 0.5), rel=1e-3)
    one, other = x[sheets.cells[:, 1]] - x[sheets.cells[:, 0]], x[sheets.cells[:, 3]] - x[sheets.cells[:, 0]]
    assert (np.einsum("ci,ci->c", np.cross(one, other), x[sheets.cells].mean(axis=1)) > 0.0).all()
    if not quarter:
        assert NodalQuadrature.of(spline).weights.sum() == pytest.approx(math.pi, rel=1e-3)
    else:
        assert (x[:, 1:].min(axis=0) < -0.05).all()
        assert (x[:, 1:].min(axis=0) > -0.15).all()


@pytest.mark.mpi
def test_a_sphere_keeps_its_volume_and_the_pressure_inside_with_a_converged_multiplier():
    sphere = Sphere(6, steps=3)
    lagged, converged = sphere.run(), sphere.run(CONVERGED)
    assert lagged.figures["volume"] < -0.04
    assert abs(converged.figures["volume"]) < 2e-3
    assert abs(converged.figures["load"]) < 0.06
    assert converged.figures["roundness"] > 0.99
    assert converged.imbalance < 1e-12
    jump = sphere.run(JUMP)
    assert jump.figures["velocity"] < 0.5 * converged.figures["velocity"]
    assert abs(jump.figures["volume"]) < 0.6 * abs(converged.figures["volume"])
    assert jump.figures["inside"] == pytest.approx(jump.figures["load"], abs=0.01)  # of polygons in a coarse mesh


# -- a plate with free edges ------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_stream_bends_a_fence():
    found = Fence(4, steps=15).run(CONVERGED)
    assert 0.1 < found.figures["tip"] < 0.5
    assert found.figures["drag"] > 0.2
    assert found.figures["leak"] < 0.02
    assert found.figures["wobble"] < 0.05
    jump = Fence(4, steps=15).run(JUMP)
    assert jump.figures["tip"] == pytest.approx(found.figures["tip"], rel=0.3)
    assert jump.passes.mean() < 1.2


# -- gaps -------------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_more_flows_through_a_wider_slit_and_nothing_through_the_plates():
    narrow, wide = (Slit(gap, n=8, steady=1e-2).run(CONVERGED) for gap in (2.0, 4.0))
    assert 0.2 < narrow.figures["flow"] < wide.figures["flow"] < 1.0
    assert max(abs(narrow.figures["leak"]), abs(wide.figures["leak"])) < 1e-6


def past_an_edge(at_rest, now, n=8):
    """What flows in a few steps past the edge of a plate that is such numbers of cells from a wall at rest and now."""
    h = 1.0 / n
    through = 0.5 * slit_flow(2.0 * h, 0.5)  # and its mirror image, one cell from the wall
    sides = [Traction("left", (1.0, 0.0, 0.0)), Traction("right"), Slip(("bottom", "top", "back", "front"))]
    known = {"rho": 1.0, "mu": 4.0 * through, "dt": h**2 / through, "scheme": generalized_alpha(0.0)}
    flow = immersed_flow(box(COMM, (-1.0, 0.0, 0.0), (1.0, 1.0, h), (2 * n, n, 1)), sides, JUMP, **known)
    corner, along = (0.37 * h, -0.3, -0.5 * h), (0.0, 1.3 - at_rest * h, 0.0)
    plate = rectangle(corner, along, (0.0, 0.0, 2.0 * h), 0.5 * h, degree=1)
    flow.start(pressure=lambda x, t: ufl.conditional(ufl.lt(x[0], corner[0]), 1.0, 0.0))
    scene = Coupled(flow, rigid(plate), JUMP, multiplier=1.0)
    for y in (scene.shell.time.x, scene.shell.time.x_old):
        y.x.array[1::3] += (at_rest - now) * h
    for _ in range(5):
        scene.step()
    (rate,) = compat.compile_forms(flow_rate(flow, "right"))
    return COMM.allreduce(compat.assemble_scalar(rate)) / (through * h)


@pytest.mark.mpi
def test_edges_that_come_to_a_wall_are_tight_and_those_that_leave_it_are_passed():
    """Decided where they rest, a thousandth would pass the one, and of what passes the other, a cell away, 4 %."""
    assert abs(past_an_edge(1.5, 0.05)) < 1e-7
    left, free = past_an_edge(0.0, 1.0), past_an_edge(1.5, 1.0)
    assert free > 0.5
    assert left == pytest.approx(free, rel=0.01)


@pytest.mark.mpi
@pytest.mark.parametrize(("layers", "gaps"), [(1, (1.0, 2.0)), (2, (1.0,))])
def test_with_a_jump_most_of_the_flow_passes_a_slit_of_a_cell_and_more_and_little_a_narrower_one(layers, gaps):
    narrow, *wide = (Slit(gap, n=8, layers=layers, steady=1e-2).run(JUMP).figures["flow"] for gap in (0.25, *gaps))
    assert narrow < 0.3
    assert 0.45 < wide[0] <= wide[-1] < 1.0
    assert len(set(wide)) == len(gaps)


@pytest.mark.mpi
def test_less_than_sampsons_flow_passes_a_hole_of_a_few_cells_and_nothing_its_plate():
    for gap in (2.0, 4.0):
        found = Hole(gap, n=8, steady=1e-2).run(CONVERGED)
        figures = found.figures
        assert {report.attempts for report in found.reports} == {1}
        assert 0.4 < figures["flow"] < 1.0
        assert abs(figures["leak"]) < 1e-6
        # the mean velocity of slow flow with a Reynolds number of 1/2 is that of sqrt(1/(12 pi)) without friction
        assert figures["discharge"] / figures["flow"] == pytest.approx(math.sqrt(0.5 / (12.0 * math.pi)), rel=0.05)


@pytest.mark.mpi
def test_a_function_with_values_of_rounding_at_the_points_inside_is_not_solved_for():
    """Its coefficient would be 1e17, and GMRES of flow and multiplier fail on two ranks."""
    scene = Hole(4.0, n=8).build(CONVERGED)
    assert scene.step().linear_iterations < 70
    assert np.abs(scene.fsi.lam).max() < 1e3  # functions with a corner inside have hundreds


@pytest.mark.slow
def test_flow_through_a_hole_in_a_mesh_that_fits_is_that_of_sampson_and_slower_with_inertia():
    slow, fast = (fitted_flow(Hole(4.0, reynolds=re, length=0.3), around=0.5)["flow"] for re in (0.05, 20.0))
    assert slow == pytest.approx(0.9, abs=0.12)  # the plate is not thin, and the mesh is coarse
    assert fast / slow == pytest.approx(SLOWED[20.0], abs=0.05)


# -- two surfaces in one cell -----------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_two_plates_in_one_cell_hold_a_pressure_and_contact_holds_them_apart():
    pair = Pair(0.5, n=4, steps=5)
    held = pair.run(CONVERGED)
    assert abs(held.figures["force"]) < 0.05
    assert abs(held.figures["leak"]) < 1e-6
    jump = pair.run(JUMP)
    assert jump.figures["velocity"] < 1e-3 * held.figures["velocity"]
    assert abs(jump.figures["force"]) < 1e-4
    scene = replace(pair, touching=True).build(IN_SPACE)
    scene.step()
    load = scene.reports[-1].contact.load
    assert load == pytest.approx(pair.jump, rel=0.15)  # less at the edges


@pytest.mark.mpi
@pytest.mark.parametrize(("apart", "slope"), [(0.1, (0.2, 0.13)), (0.05, (0.0, 0.0))])
def test_the_plate_that_carries_the_jump_has_all_of_it_however_near_the_other_one_is(apart, slope, monkeypatch):
    """Polygons half way between them were the other one's by two fifths."""
    scene = Pair(apart, n=4, slope=slope).build(JUMP)
    met = meetings(scene, monkeypatch)
    for _ in range(2):
        scene.step()
    lower, upper = met[-1].W.reshape(2, -1).sum(axis=1)
    assert lower == 0.0
    assert upper == pytest.approx(math.sqrt(1.0 + slope[0] ** 2 + slope[1] ** 2), rel=2e-3)
    assert abs(scene.reports[-1].monitors.force[2]) == pytest.approx(1e5, rel=1e-3)


# -- a body in a stream -----------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_sphere_in_a_stream_has_about_the_drag_of_a_mesh_that_fits_it():
    found = Obstacle(4, until=2.0).run(CONVERGED)
    assert found.figures["drag"] == pytest.approx(3.66, rel=0.5)


@pytest.mark.slow
def test_the_drag_of_a_sphere_in_meshes_that_fit_goes_to_its_limit():
    assert fitted_drag(0.5)["drag"] == pytest.approx(3.664, rel=0.02)


# -- settings ---------------------------------------------------------------------------------------------------------


def test_a_pressure_that_jumps_alone_is_a_setting():
    setting = setting_of("jump(penalty=20.0)", IN_SPACE)
    options = setting.options
    assert (setting.immersed, options.multiplier, options.fluid_tangent, options.trace, options.penalty) == (
        "jump", "converged", "consistent", "nodes", 20.0,
    )  # fmt: skip
    assert setting.flow.solver is None


def test_every_case_of_the_benchmark_names_figures_that_its_scene_documents():
    for figures, scenes in STUDIES.values():
        for scene in scenes.values():
            assert all(f'"{name}"' in type(scene).run.__doc__ for name in figures)
