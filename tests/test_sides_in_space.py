"""A flow of tetrahedra that a plane divides, with fields that are linear on either side: exact but for rounding."""

from types import SimpleNamespace

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from on_disk import read_vtkhdf_meshes

from coudalfish.surface.cut_cells import CutCells, SideWeights
from coudalfish.surface.facets import FacetWeights, walls_of
from coudalfish.surface.polygons import ZeroSet
from tigar_x import compat
from tigar_x.fem.doubled import DoubledSystem
from tigar_x.fem.linear import direct
from tigar_x.run.plane_field import PlaneField
from varmint import BoundaryForce, Flow, FlowOptions, Measured, PointValues, Traction, WeakVelocity, box, movie
from varmint.errors import integral_by_sides, velocity_errors
from varmint.quantities import flow_rate, kinetic_energy, volume, vorticity, wall_shear_stress

pytestmark = pytest.mark.mpi
WORLD = MPI.COMM_WORLD
NORMAL, PLACE = np.array([0.21, -0.13, 1.0]), 0.47
"""Of a plane that crosses four walls and the edges between them."""
RHO, MU, C, SLOPE = 1.3, 0.2, 7.0, np.array([0.4, -0.9, 1.7])
"""The pressure is its slope times x, with C more above the plane and C less below it; a force balances the slope."""
WALLS = ("left", "right", "bottom", "top", "back")


def shear(x, t=None, s=None):
    """The velocity: what it carries along is not accelerated."""
    return ufl.as_vector([x[1], 0.0, 0.0])


def level(x):
    return x @ NORMAL - PLACE


def pressure(x, s):
    """On a side."""
    return x @ SLOPE + s * C


def divide(flow):
    """What the plane divides, and the force that balances the pressures, on velocities and on kinks, this rank's share.

    All nodes of divided cells have a jump, and kinks as well if the flow has these.
    """
    sides, domain = flow.sides, flow.mesh.domain
    linear, owned = sides.phi.function_space, compat.owned_cells(domain)
    vertices, phi = compat.cell_dofs(linear), level(linear.tabulate_dof_coordinates())
    sides.phi.x.array[:], sides.size.x.array[:] = phi, np.abs(phi)
    cut = CutCells.of(vertices, phi)
    weights = sides.negative.function_space
    weights_there = SideWeights(compat.lagrange_degree(weights), compat.node_points(weights))(cut)
    sides.negative.x.array[compat.cell_dofs(weights)[cut.cells]] = weights_there
    walls = sides.wall.function_space
    on_walls, weights_there = FacetWeights(walls, compat.lagrange_degree(weights))(cut)
    sides.wall.x.array[compat.cell_dofs(walls)[on_walls]] = weights_there
    number = np.empty(len(phi), dtype=np.int64)
    number[vertices] = compat.cell_dofs(flow.V)
    there = sides.phi.copy()
    there.x.array[:] = 0.0
    there.x.array[vertices[cut.cells]] = 1.0
    compat.accumulate(there)
    second, side, cells = np.zeros((len(phi), 4), dtype=bool), np.ones(len(phi)), np.zeros(len(vertices), dtype=bool)
    second[number], side[number[phi < 0.0]], cells[cut.cells] = (there.x.array > 0.0)[:, None], -1.0, True
    second[:, :3] &= sides.is_kinked
    flow.time.is_second[:] = second.ravel()
    mine = cut.only(cut.cells < owned)
    points = ZeroSet.of(mine, compat.cell_vertices(domain)[mine.cells]).quadrature(2)
    load, nodes = np.zeros((2, len(phi), 4)), compat.cell_dofs(flow.V)[points.cells]
    forces = -2.0 * C * points.areas[:, None] * points.normals
    bend = np.einsum("gk,gk->g", points.barycentric, np.abs(phi)[vertices[points.cells]])  # what multiplies kinks
    for part, N in zip(load, (points.barycentric, bend[:, None] * points.barycentric), strict=True):
        np.add.at(part[:, :3], nodes, N[..., None] * forces[:, None])
    return cells, second, side, load.reshape(2, -1)


def scene(speed=1.0, kind="jump"):
    """The flow before its first step, at its speed and without pressures, and its system."""
    mesh = box(WORLD, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (3, 3, 3))
    factor = compat.Constant(mesh.domain, speed)
    open_end = Traction("front", lambda x, t: ufl.as_vector([0.0, 0.0, -(sum(SLOPE[i] * x[i] for i in range(3)) + C)]))
    conditions = [WeakVelocity(WALLS, lambda x, t: factor * shear(x)), open_end]
    flow = Flow(
        mesh, conditions, rho=RHO, mu=MU, dt=0.1, f=tuple(SLOPE / RHO), immersed=kind,
        options=FlowOptions(solver=direct()),
    )  # fmt: skip
    flow.start(velocity=lambda x, t: factor * shear(x))
    *what, load = divide(flow)
    system = DoubledSystem(flow.residual, flow.time.x, flow.bcs, flow.sides.doubled, solver=direct())
    system.divide(*what)
    return SimpleNamespace(flow=flow, system=system, load=load)


def solve(made):
    """The first step, from another velocity; norms of the residual."""
    made.flow.time.predict()
    made.flow.time.x.x.array.reshape(-1, 4)[:, :3] *= 1.05
    norms = []
    for _ in range(8):
        norms.append(made.system.assemble_residual(lambda array: np.add(array, made.load.ravel(), out=array)))
        made.system.assemble_tangent()
        made.system.subtract(made.system.solve())
    return norms


@pytest.fixture(scope="module")
def cut_box():
    """The flow in its first step, solved, and what was measured there."""
    made = scene()
    flow = made.flow
    flow.sides.given[:] = made.load[0]
    norms = solve(made)
    measured = Measured(volume=volume(flow), kinetic=kinetic_energy(flow), through=flow_rate(flow, "right"))
    force = BoundaryForce(flow, *WALLS)()
    yield SimpleNamespace(flow=flow, norms=norms, measured=measured(), force=force)
    flow.time.restore()


def mean_height():
    return PLACE - NORMAL[:2].sum() / 2.0


def test_the_scene_has_cells_with_two_walls_that_the_plane_crosses(cut_box):
    domain, divided = cut_box.flow.mesh.domain, cut_box.flow.sides.doubled.cells
    owned = compat.owned_cells(domain)
    bits = walls_of(domain)[:owned][divided[:owned]]
    number = (bits[:, None] >> np.arange(4) & 1).sum(axis=1)
    counts = [WORLD.allreduce(int((number == n).sum()), op=MPI.SUM) for n in (0, 1, 2)]
    assert min(counts) >= 3


def assert_exact(flow, norms):
    assert norms[-1] < 1e-11 * norms[0]
    x, values = flow.V.tabulate_dof_coordinates(), flow.w.x.array.reshape(-1, 4)
    np.testing.assert_allclose(values[:, :3], np.outer(x[:, 1], (1.0, 0.0, 0.0)), atol=1e-10)
    np.testing.assert_allclose(values[:, 3], pressure(x, np.sign(level(x))), atol=1e-9)
    second, is_second = flow.time.second.x.array.reshape(-1, 4), flow.sides.doubled.second
    np.testing.assert_allclose(second[is_second[:, 3], 3], 2.0 * C, atol=1e-9)
    np.testing.assert_allclose(second[:, :3], 0.0, atol=1e-9)


def test_fields_are_exact_behind_weak_walls_that_the_plane_crosses(cut_box):
    flow = cut_box.flow
    assert_exact(flow, cut_box.norms)
    slopes = [float(g) for g in SLOPE]

    def square(v, p, s):
        return (p - sum(g * x for g, x in zip(slopes, X(flow), strict=True)) - s * C) ** 2

    assert abs(integral_by_sides(flow, square)) < 1e-18
    assert max(velocity_errors(flow, shear, 4).values()) < 1e-10


def test_fields_are_exact_where_velocities_may_be_kinked_as_well():
    """Kinks are unknowns also on weak walls, and none is there."""
    made = scene(kind="jump and kink")
    norms = solve(made)
    assert WORLD.allreduce(int(made.system.second[:, 0].sum()), op=MPI.SUM) > 30
    assert_exact(made.flow, norms)
    made.flow.time.restore()


def X(flow):
    return ufl.SpatialCoordinate(flow.mesh.domain)


def test_where_slopes_of_pressures_differ_weights_inside_and_on_walls_are_exact():
    """At rest the equations of momentum see the difference of the slopes below the plane, and the jump on it."""
    made, D = scene(speed=0.0), np.array([0.6, 1.1, -0.8])
    flow, domain = made.flow, made.flow.mesh.domain
    flow.time.predict()
    x, V = flow.V.tabulate_dof_coordinates(), compat.cell_dofs(flow.V)
    phi, values = level(x), flow.time.x.x.array.reshape(-1, 4)
    values[:, 3] = pressure(x, np.sign(phi)) + np.where(phi < 0.0, x @ D, 0.0)
    flow.time.second.x.array.reshape(-1, 4)[:, 3] = (2.0 * C - x @ D) * made.system.second[:, 3]
    cells, expected = compat.cell_vertices(domain)[: compat.owned_cells(domain)], np.zeros((len(x), 4))
    pieces = flow.sides.pieces()
    whole = np.flatnonzero((level(cells) < 0.0).all(axis=1))
    corners = np.concatenate([pieces.barycentric[pieces.side < 0.0], np.broadcast_to(np.eye(4), (len(whole), 4, 4))])
    of = np.concatenate([pieces.cells[pieces.side < 0.0], whole])
    ends = corners @ cells[of]
    sizes = np.abs(np.linalg.det(ends[:, 1:] - ends[:, :1])) / 6.0
    np.add.at(expected[:, :3], V[of], sizes[:, None, None] * corners.mean(axis=1)[..., None] * D)
    cut = CutCells.of(np.arange(4 * len(cells)).reshape(-1, 4), level(cells).ravel())
    points = ZeroSet.of(cut, cells[cut.cells]).quadrature(2)
    jumps = points.areas * (2.0 * C - points.x @ D)
    forces = jumps[:, None] * points.normals
    np.add.at(expected[:, :3], V[points.cells], points.barycentric[..., None] * forces[:, None])
    found = []

    def keep(array):
        found.append(array.copy())

    made.system.assemble_residual(keep)
    difference = flow.w.copy()
    difference.x.array[:] = found[0][: expected.size] - expected.ravel()
    compat.accumulate(difference)
    np.testing.assert_allclose(difference.x.array.reshape(-1, 4)[:, :3], 0.0, atol=1e-13)
    flow.time.restore()


def test_what_is_measured_is_that_of_both_sides(cut_box):
    found = cut_box.measured
    assert found == pytest.approx({"volume": 1.0, "kinetic": RHO / 6.0, "through": 0.5}, rel=1e-11)
    # on a wall that is upright the pressure is that of the slope in the middle and C times what is above less below
    x, y = [SLOPE[i] + 2.0 * C * NORMAL[i] for i in (0, 1)]
    below = 0.5 * (SLOPE[0] + SLOPE[1]) - C
    np.testing.assert_allclose(cut_box.force, (x, y, -below), atol=1e-9)


def test_nodal_fields_are_those_of_both_sides(cut_box):
    curl = vorticity(cut_box.flow)().x.array.reshape(-1, 3)
    np.testing.assert_allclose(curl, np.broadcast_to([0.0, 0.0, -1.0], curl.shape), atol=1e-10)
    field = wall_shear_stress(cut_box.flow, "right")()
    x, values = field.function_space.tabulate_dof_coordinates(), field.x.array.reshape(-1, 3)
    there = x[:, 0] > 1.0 - 1e-9
    np.testing.assert_allclose(values[there], np.broadcast_to([0.0, -MU, 0.0], values[there].shape), atol=1e-10)


def test_values_and_slopes_at_points_are_those_of_their_side(cut_box):
    flow = cut_box.flow
    points = np.random.default_rng(5).uniform(0.02, 0.98, (40, 3))
    points[::2, 2] = PLACE - points[::2, :2] @ NORMAL[:2] + np.tile([-1e-3, 1e-3], 10)  # close to the plane
    found = PointValues(flow, points)()
    np.testing.assert_allclose(found[:, :3], np.outer(points[:, 1], (1.0, 0.0, 0.0)), atol=1e-10)
    np.testing.assert_allclose(found[:, 3], pressure(points, np.sign(level(points))), atol=1e-9)
    below = PointValues(flow, points[::2], side=-1)()
    np.testing.assert_allclose(below[:, 3], pressure(points[::2], -1.0), atol=1e-9)
    sides = flow.sides
    cells = sides.nearest_divided(points, 9.0)  # cells are 1/3 wide
    assert (cells >= 0).all()
    assert (sides.nearest_divided(points + 10.0, 9.0) == -1).all()
    places = sides.barycentric(cells, points)
    for s in (-1.0, 1.0):
        at = sides.at(cells, places, np.full(len(points), s))
        np.testing.assert_allclose(at[:, 3], pressure(points, s), atol=1e-9)
        grad = sides.mean_gradient_at(cells, places, s)
        expected = np.zeros((3, 3))
        expected[0, 1] = 1.0
        np.testing.assert_allclose(grad, np.broadcast_to(expected, grad.shape), atol=1e-10)


def test_files_have_tetrahedra_on_either_side_of_the_plane(cut_box, tmp_path):
    flow, path = cut_box.flow, WORLD.bcast(tmp_path, root=0) / "flow.vtkhdf"
    movie(flow, path)().once()
    WORLD.barrier()
    ((_, x, cells, fields),) = read_vtkhdf_meshes(path)
    corners = x[cells]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    phi = level(corners)
    side = np.sign(phi.mean(axis=1))
    assert (phi * side[:, None] > -1e-12).all()  # no cell lies on both
    for s, whole in ((-1.0, mean_height()), (1.0, 1.0 - mean_height())):
        assert volumes[side == s].sum() == pytest.approx(whole, rel=1e-12)
        exact = pressure(corners[side == s], s)
        np.testing.assert_allclose(fields["pressure"][cells[side == s]], exact, atol=1e-9)
    np.testing.assert_allclose(fields["velocity"], np.outer(x[:, 1], (1.0, 0.0, 0.0)), atol=1e-10)
    assert len(cells) > 162 + 100
    WORLD.barrier()


def test_pictures_show_nodes_alone_as_without_sides(cut_box):
    """Those of the side of the box with the smallest third coordinate."""
    flow = cut_box.flow
    fields = [PlaneField(flow.w, sides=sides) for sides in (flow.sides, None)]
    np.testing.assert_array_equal(*(field.triangles for field in fields))
    np.testing.assert_array_equal(*(field.values for field in fields))
    if WORLD.rank == 0:
        np.testing.assert_allclose(fields[0].values[:, 3], fields[0].x @ SLOPE[:2] - C, atol=1e-9)


@pytest.mark.parametrize("kind", ["jump", "jump and kink"])
@pytest.mark.parametrize(
    ("cell", "degree", "wanted"),
    [("hexahedron", 1, "mesh: triangles or tetrahedra"), ("tetrahedron", 2, "degree = 2: degree 1")],
)
def test_other_cells_and_degrees_are_refused_by_what_is_allowed(kind, cell, degree, wanted):
    mesh = box(WORLD, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (2, 2, 2), cell)
    walls = WeakVelocity((*WALLS, "front"))
    with pytest.raises(ValueError, match=f"immersed = '{kind}', {wanted} is required"):
        Flow(mesh, walls, rho=RHO, mu=MU, dt=0.1, degree=degree, immersed=kind)
