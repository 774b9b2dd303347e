"""Outlets with a resistance of any size: the steps, their answers and their costs do not depend on it."""

from functools import cache

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from flows import assembled
from scenes import free_sheet

from coudalfish import CouDALFISh
from tigar_x import compat
from tigar_x.fem.linear import direct, gmres_ilu
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from varmint.conditions import Resistance, Velocity
from varmint.flow import Flow, FlowOptions
from varmint.mesh import box
from varmint.quantities import Measured, flow_rate, outlet

COMM = MPI.COMM_WORLD
SOLVERS = pytest.mark.parametrize("solver", [direct(), gmres_ilu(1, rtol=1e-3)], ids=["direct", "gmres"])
MU = 0.05


def inflow(x, t):
    """A pulsating parabola."""
    profile = 4 * x[1] * (1 - x[1]) * (1 + 0.5 * ufl.sin(6 * t))
    if len(x) == 3:
        profile *= 4 * x[2] * (1 - x[2])
    return ufl.as_vector([profile] + [0 * x[0]] * (len(x) - 1))


@cache
def duct_mesh(d):
    """One, because two would be distributed in different ways."""
    return box(COMM, (0.0,) * d, (2.0, 1.0, 1.0)[:d], (8, 4, 4)[:d])


def duct(d, *outlets, solver=None, steady=False, **given):
    """A duct with a prescribed inflow, whose walls are all other sides without an outlet."""
    mesh = duct_mesh(d)
    open_sides = {outlet.on for outlet in outlets}
    walls = tuple(name for name in mesh.facet_names if name not in {"left", *open_sides})
    conditions = [Velocity(walls), Velocity("left", inflow), *outlets]
    options = FlowOptions(solver=solver, **given.pop("options", {}))
    return Flow(mesh, conditions, rho=1.0, mu=MU, dt=None if steady else 0.02, options=options, **given)


def velocity(flow):
    """Values of this rank's own nodes."""
    d = flow.mesh.domain.geometry.dim
    return flow.w.x.array.reshape(-1, d + 1)[: flow.V.dofmap.index_map.size_local, :d].copy()


def largest(values):
    return COMM.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX)


def compared(make, resistances, steps=3):
    """Velocities and Newton iterations of all resistances against those of the first one."""
    found = []
    for R in resistances:
        flow = make(R)
        reports = [flow.take_step() if flow.time is not None else flow.solve() for _ in range(steps)]
        found.append((velocity(flow), sum(report.iterations for report in reports)))
    (expected, iterations), *others = found
    assert largest(expected) > 0.5
    return [(largest(v - expected), n - iterations) for v, n in others]


@pytest.mark.mpi
@SOLVERS
@pytest.mark.parametrize("d", [2, 3])
def test_a_duct_with_a_given_inflow_does_not_feel_the_size_of_a_resistance(d, solver):
    """What flows in flows out, against whatever pressure."""
    found = compared(lambda R: duct(d, Resistance("right", R), solver=solver), [0.0, 1e2, 1e5, 1e8, 1e10])
    for (error, more), bound in zip(found, [1e-6, 1e-6, 1e-6, 1e-5], strict=True):
        assert error < bound
        assert more <= 0


@pytest.mark.mpi
@pytest.mark.parametrize("scheme", [backward_euler(), generalized_alpha(0.0)], ids=["euler", "alpha"])
def test_nor_does_it_with_other_schemes(scheme):
    for error, more in compared(lambda R: duct(2, Resistance("right", R), scheme=scheme), [0.0, 1e5, 1e10]):
        assert error < 1e-5
        assert more <= 0


@pytest.mark.mpi
def test_steady_flow_against_a_large_resistance():
    for error, _ in compared(lambda R: duct(2, Resistance("right", R), steady=True), [0.0, 1e5, 1e8], steps=1):
        assert error < 1e-6


@pytest.mark.mpi
@SOLVERS
@pytest.mark.parametrize("R", [1e5, 1e8, 1e10])
def test_several_outlets_share_the_flow_in_the_inverse_ratio_of_their_resistances(solver, R):
    flow = duct(2, Resistance("right", R), Resistance("top", R / 3, 7.0), solver=solver)
    rates = Measured(**{name: flow_rate(flow, name) for name in ("left", "right", "top")})
    for _ in range(3):
        before = rates()
        flow.take_step()
        pressures = {name: float(outlet(flow, name).pressure.value) for name in ("right", "top")}
    found, level = rates(), flow.time.x_factor
    for name, resistance, behind in (("right", R, 0.0), ("top", R / 3, 7.0)):
        in_equations = level * found[name] + (1 - level) * before[name]
        assert pressures[name] == pytest.approx(behind + resistance * in_equations, rel=1e-9)
        assert outlet(flow, name).flow_rate() == pytest.approx(found[name], rel=1e-12)  # the clock has moved
    with pytest.raises(ValueError, match=r"^name = 'left': one of 'right', 'top' is required"):
        outlet(flow, "left")
    assert found["right"] + found["top"] == pytest.approx(-found["left"], rel=1e-6)
    assert found["right"] == pytest.approx(-0.25 * found["left"], rel=100 / R + 1e-6)


@pytest.mark.mpi
@pytest.mark.parametrize("solver", [direct(), gmres_ilu()], ids=["direct", "gmres"])
def test_a_sheet_in_a_duct_does_not_feel_the_size_of_a_resistance(solver):
    """The tolerances of the coupling refer to what acts in the flow, not to the outlet's pressure."""
    tips, passes = [], []
    for R in (0.0, 1e5, 1e8):
        mesh = duct_mesh(2)
        conditions = [Velocity(("bottom", "top")), Velocity("left", inflow), Resistance("right", R)]
        flow = Flow(mesh, conditions, rho=1.0, mu=MU, dt=0.02, immersed="plain", options=FlowOptions(solver=solver))
        sheet = free_sheet(ends=((0.9, 0.2), (1.0, 0.7)), dt=0.02)
        fsi = CouDALFISh(flow, sheet.shell)
        passes.append(sum(fsi.takeStep().passes for _ in range(4)))
        tips.append(sheet.y.x.array.copy())
    assert np.abs(tips[0]).max() > 1e-3
    for tip in tips[1:]:
        np.testing.assert_allclose(tip, tips[0], atol=1e-4 * np.abs(tips[0]).max())
    assert max(passes) <= passes[0] + 1


@pytest.mark.mpi
def test_a_consistent_start_has_the_pressure_of_its_flow_rate():
    flow = duct(2, Resistance("right", 1e3, 5.0))
    flow.start(lambda x, t: ufl.as_vector([4 * x[1] * (1 - x[1]), 0 * x[0]]))
    rate = Measured(Q=flow_rate(flow, "right"))()["Q"]
    flow.consistent_start()
    (outlet,) = flow.rank_one
    assert float(outlet.pressure.value) == pytest.approx(5.0 + 1e3 * rate, rel=1e-12)
    pressures = flow.w.x.array.reshape(-1, 3)[:, 2]
    at_outlet = np.isclose(flow.V.tabulate_dof_coordinates()[:, 0], 2.0)
    np.testing.assert_allclose(pressures[at_outlet], 5.0 + 1e3 * rate, atol=3.0)


@pytest.mark.mpi
def test_rounding_of_a_flow_rate_is_that_of_its_terms_times_what_the_resistance_makes_of_it():
    """``|l| R alpha_f sum_i |l_i w_i|`` with the load l of the free velocities at the outlet."""
    flow = duct(2, Resistance("right", 1e3))
    flow.take_step()
    (form,) = compat.compile_forms(flow.rank_one[0].load)
    load = assembled(form, flow.V)
    owned = load.getLocalSize()
    load.array_w[flow.system.constrained[flow.system.constrained < owned]] = 0.0
    terms = np.abs(load.array_r * flow.w.x.array[:owned]).sum()
    expected = load.norm() * 1e3 * flow.time.x_factor * COMM.allreduce(terms, op=MPI.SUM)
    found = flow.system._low_rank.rounding(compat.petsc_vector(flow.w))
    assert found == pytest.approx(expected, rel=1e-10) != 0.0
