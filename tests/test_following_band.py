"""Flows that go on on another mesh, and bands of small cells that follow the shell."""

from functools import cache, partial

import numpy as np
import pytest
from mpi4py import MPI
from dome import sheet
from mpi_runs import SAME_RUN
from scipy.spatial import cKDTree
from test_repeated_steps import changed

from coudalfish import CouDALFISh, CouplingOptions, StepError
from coudalfish.problems import manufactured as problem
from coudalfish.refinement import Band, FollowingBand
from coudalfish.restart import CoupledState
from coudalfish.sides.transfer import PointsElsewhere
from shnapr import Shell, StVenantKirchhoff
from tigar_x import compat, direct, generalized_alpha, script
from tigar_x.compat import forms
from tigar_x.fem.linear import SolveError
from tigar_x.ranks import gathered
from tigar_x.run.restart import Restart
from varmint import Flow, FlowOptions, Measured, Slip, Traction, WeakVelocity, box, movie, squared_divergence
from varmint.mesh.refined import Refinement

DATA = problem.ProblemData()
TIGHT = {"block_rtol": 1e-11, "block_atol": 1e-14}
OPTIONS = {
    "plain": CouplingOptions(**TIGHT),
    "jump": CouplingOptions.converged(fluid_tangent="consistent", **TIGHT),
    "jump and kink": CouplingOptions.sharp(**TIGHT),
}
STEPS = 16


def membrane_flow(kind, mesh, *, start=True):
    """Flow of the manufactured membrane."""
    c = script.constants(mesh.domain, DATA)

    def exact(name):
        return lambda x, t: getattr(problem.exact_flow(x, t, c), name)

    known = {"rho": c.rho, "mu": c.mu, "f": exact("f"), "dt": DATA.T / STEPS, "immersed": kind}
    chosen = FlowOptions(pin_at=[0.0, 0.0], solver=direct())
    walls = WeakVelocity(problem.walls_with_velocity(DATA, 2), exact("u"))
    flow = Flow(mesh, walls, **known, scheme=generalized_alpha(0.5), options=chosen)
    if start:
        flow.start(exact("u"), exact("p"), projected=True)
    return flow


def square(level):
    """Its mesh."""
    return box(MPI.COMM_WORLD, *problem.fluid_box(DATA, 2, level))


def membrane(kind, level=2):
    """Membrane on a uniform mesh."""
    shell = problem.membrane(DATA, 2, 16)
    return CouDALFISh(membrane_flow(kind, square(level)), shell, OPTIONS[kind], multiplier=DATA.DP)


def values(fsi):
    """What is there after a step, whatever the ranks have of it; the rate of the pressure has no meaning."""
    time, V = fsi.timeInt_f, fsi.timeInt_f.x.function_space
    owned = V.dofmap.index_map.size_local
    fields = [f.x.array.reshape(-1, 3)[:owned, : 2 + (name in ("x", "second"))] for name, f in time.state.items()]
    rows = V.mesh.comm.bcast(gathered(V.mesh.comm, np.hstack([V.tabulate_dof_coordinates()[:owned, :2], *fields])))
    rows = rows[np.lexsort(np.round(rows[:, :2], 6).T)]
    clock = np.array([time.time, float(time.t.value), time.step_size])
    return [fsi.timeInt_sh.x.x.array, fsi.lam, clock, rows]


@pytest.mark.mpi
@pytest.mark.parametrize("kind", list(OPTIONS))
def test_a_flow_that_goes_on_on_the_same_mesh_is_the_same(kind):
    """All that a step follows from is transferred: fields, rates, second blocks, clock."""
    whole, moved = membrane(kind), membrane(kind)
    for fsi in (whole, moved):
        for _ in range(3):
            fsi.takeStep()
    before = [array.copy() for array in values(moved)]
    moved.move_to(membrane_flow(kind, square(2), start=False))
    for found, expected in zip(values(moved), before, strict=True):
        assert np.abs(found - expected).max() <= 1e-12 * max(1.0, np.abs(expected).max())
    for fsi in (whole, moved):
        for _ in range(2):
            fsi.takeStep()
    for found, expected in zip(values(moved), values(whole), strict=True):
        assert np.abs(found - expected).max() <= max(1e-8, SAME_RUN) * max(1.0, np.abs(expected).max())


@pytest.mark.mpi
def test_points_of_other_ranks_have_the_values_of_the_mesh():
    mesh, fine = square(1), Refinement(square(1)).mesh(lambda x: np.where(x[:, 0, 0] < 0.3, 0.05, np.inf))
    space = compat.lagrange_space(mesh.domain, 1)
    nodes = compat.cell_dofs(space)
    linear = space.tabulate_dof_coordinates()[:, :2] @ [2.0, -3.0]
    other = compat.lagrange_space(fine.domain, 1)
    x = other.tabulate_dof_coordinates()[: other.dofmap.index_map.size_local, :2]
    found = PointsElsewhere(mesh.domain, x).values(lambda cells, b: (b * linear[nodes[cells]]).sum(axis=1)[:, None])
    assert np.allclose(found[:, 0], x @ [2.0, -3.0], rtol=0.0, atol=1e-13)
    with pytest.raises(ValueError, match="outside the old one"):
        PointsElsewhere(mesh.domain, x + 0.5)


def followed(kind, *, level=3, base=1, ahead=4, band=None, **more):
    """Membrane in a band of cells as small as those of a level."""
    size = 2**0.5 * DATA.L / problem.cells_per_side(level) * (1 + 1e-6)
    shell = problem.membrane(DATA, 2, 32)
    options = {"options": OPTIONS[kind], "multiplier": DATA.DP, "ahead": ahead} | more
    return FollowingBand(
        Refinement(square(base)),
        partial(membrane_flow, kind),
        shell,
        Band(size, **{"growth": 1.0} | (band or {})),
        **options,
    )


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["plain", pytest.param("jump", marks=pytest.mark.slow), "jump and kink"])
def test_a_band_follows_the_membrane(kind):
    """Its displacement is as accurate as on a uniform mesh of small cells, and the divergence stays bounded."""
    following = followed(kind)
    fsi, at_once, later, last, moved = following.fsi, 0.0, 0.0, np.inf, False
    for _ in range(STEPS):
        before = divergence(following.flow)
        fsi.takeStep()
        after = divergence(following.flow)
        later, at_once = (max(later, after / last), max(at_once, before / last)) if moved else (later, at_once)
        last, moved = after, following.follow()
    assert 2 <= following.number <= 8
    assert at_once < {"jump and kink": 2.5}.get(kind, 1.3)  # kinks are not there before the next step
    assert later < 1.2
    assert following.flow.mesh.size < 0.8 * square(3).size
    assert fsi.timeInt_f.time == pytest.approx(DATA.T)
    assert fsi.fluid.mesh_size == pytest.approx(DATA.L / problem.cells_per_side(3), rel=1e-6)
    assert problem.errors(fsi, DATA, DATA.T, 8)["L2_y"] < 1.3 * uniform_errors(kind)["L2_y"]


def divergence(flow):
    """Its norm in L2."""
    return Measured(square=squared_divergence(flow))()["square"] ** 0.5


@cache
def uniform_errors(kind):
    """Errors on a uniform mesh of small cells."""
    shell = problem.membrane(DATA, 2, 32)
    fsi = CouDALFISh(membrane_flow(kind, square(3)), shell, OPTIONS[kind], multiplier=DATA.DP)
    for _ in range(STEPS):
        fsi.takeStep()
    return problem.errors(fsi, DATA, DATA.T, 8)


@pytest.mark.mpi
def test_a_step_that_fails_after_a_change_restores_the_state_on_the_new_mesh():
    following = followed("jump and kink", ahead=1)
    while not following.follow():
        following.fsi.takeStep()
    fsi = following.fsi
    before = [array.copy() for array in values(fsi)]

    def fail(*_, **__):
        raise SolveError("as told")

    with changed(fsi.fluid, assemble_tangent=fail), pytest.raises(StepError, match="as told"):
        fsi.takeStep()
    for found, expected in zip(values(fsi), before, strict=True):
        assert np.array_equal(found, expected)
    fsi.takeStep()


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["plain", "jump and kink"])
def test_a_run_goes_on_from_a_checkpoint_on_a_mesh_that_was_made_anew(kind, tmp_path):
    """On the mesh around the same points, wherever the shell has come since."""
    whole = followed(kind, ahead=2)
    folder = MPI.COMM_WORLD.bcast(tmp_path)
    while whole.number < 2:
        whole.fsi.takeStep()
        whole.follow()
    whole.fsi.takeStep()
    Restart(folder, CoupledState(whole.fsi)).write()
    resumed = followed(kind, ahead=2, expected=whole.expected)
    Restart(folder, CoupledState(resumed.fsi)).read()
    for found, expected in zip(values(resumed.fsi), values(whole.fsi), strict=True):
        assert np.abs(found - expected).max() <= 1e-12 * max(1.0, np.abs(expected).max())
    for following in (whole, resumed):
        following.fsi.takeStep()
        following.follow()
    for found, expected in zip(values(resumed.fsi), values(whole.fsi), strict=True):
        assert np.abs(found - expected).max() <= max(1e-8, SAME_RUN) * max(1.0, np.abs(expected).max())


def test_cells_are_small_where_the_shell_is_and_not_beside_it():
    """The extent of a cell counts in the direction of the shell alone."""
    sheet = np.stack(np.meshgrid(*2 * [np.linspace(0.0, 1.0, 41)], [0.5]), axis=-1).reshape(-1, 3)
    sizes = Band(0.1, reach=0.5, growth=1.0).around(sheet)
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.2]]) * 0.5 + [0.25, 0.25, 0.0]
    for above, wanted in ((0.45, 0.1), (0.55, 0.1), (0.6, 0.15), (0.35, 0.1), (0.25, 0.2)):
        assert sizes(np.add(corners, [0.0, 0.0, above])[None])[0] == pytest.approx(wanted, abs=0.005)


@pytest.mark.parametrize("reach", [2.0, 0.3])
def test_the_shell_moves_for_as_long_as_was_asked(reach):
    """Through cells that are small on all of its way, however narrow the band is."""
    following = followed("plain", ahead=6, band={"reach": reach})
    following.fsi.takeStep()
    while not following.follow():
        following.fsi.takeStep()
    shell, expected = following.fsi.shell, cKDTree(following.expected)
    for time in np.linspace(0.0, 6 * following.fsi.step_size, 50):
        assert expected.query(shell.positions() + time * shell.velocity())[0].max() < 0.5 * reach * following.band.size


@pytest.mark.slow
def test_another_mesh_compiles_nothing(tmp_path, monkeypatch):
    """In a cache of its own, in which nothing is when the run begins."""
    monkeypatch.setitem(next(iter(forms.JIT.values())), "cache_dir", tmp_path)
    following = followed("jump and kink", ahead=1)
    following.fsi.takeStep()
    files = sorted(tmp_path.iterdir())
    while not following.follow():
        following.fsi.takeStep()
    following.fsi.takeStep()
    assert len(files) > 4
    assert sorted(tmp_path.iterdir()) == files


def test_a_flow_that_does_not_fit_is_refused_and_changes_nothing():
    fsi = membrane("plain")
    fsi.takeStep()
    before, fluid = [array.copy() for array in values(fsi)], fsi.fluid
    wrong = {
        "outside the old one": membrane_flow("plain", box(MPI.COMM_WORLD, [-1.0, 0.0], [1.0, 1.0], [4, 4])),
        "fields and the scheme": membrane_flow("jump", square(2)),
        "coupled with nothing": membrane("plain").fluid,
    }
    for message, flow in wrong.items():
        with pytest.raises(ValueError, match=message):
            fsi.move_to(flow)
    assert fsi.fluid is fluid
    for found, expected in zip(values(fsi), before, strict=True):
        assert np.array_equal(found, expected)
    with pytest.raises(AttributeError, match="another CouDALFISh is required"):
        fsi.fluid = fluid


@pytest.mark.parametrize("kind", ["plain", "jump"])
@pytest.mark.mpi
def test_a_band_follows_a_sheet_in_space(kind):
    walls = [Slip(("left", "right", "bottom", "top")), Traction("back"), Traction("front", (0.0, 0.0, -3.0))]
    known = {"rho": 1.0, "mu": 0.1, "dt": 0.05, "scheme": generalized_alpha(0.5), "immersed": kind}
    shell = Shell(sheet(4), StVenantKirchhoff(4.0, 0.3, 0.05), density=1.0, clamped=("u0", "u1", "v0", "v1"))

    def make(mesh):
        return Flow(mesh, walls, **known, options=FlowOptions(solver=direct()))

    base, options = box(MPI.COMM_WORLD, (0.0,) * 3, (1.0,) * 3, (3,) * 3), OPTIONS[kind]
    following = FollowingBand(Refinement(base), make, shell, Band(0.4, 0.3), ahead=2, options=options)
    for _ in range(4):
        following.fsi.takeStep()
        following.follow()
    assert following.number > 1
    assert following.flow.mesh.size > 1.5 * base.size
    assert following.fsi.timeInt_f.time == pytest.approx(0.2)


def test_a_run_writes_a_file_for_every_mesh(tmp_path):
    following = followed("plain", ahead=2)
    series = following.series(lambda flow, k: movie(flow, tmp_path / f"fluid_{k}.vtkhdf"))
    run = following.fsi.run(steps=12, out=tmp_path, series=[series], history={"leak": "monitors.leak"}, overwrite=True)
    for _ in run:
        following.follow()
    assert following.number > 1
    assert len(list(tmp_path.glob("fluid_*.vtkhdf"))) >= following.number - 1
    assert len(run.history["leak"]) == 12
