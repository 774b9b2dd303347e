"""Equations on both sides of a line through cells: what they are where nothing differs, and where something does."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from flows import DT, MU, RHO, assembled, grid, randomise

from coudalfish.surface.cut_cells import CutCells, SideWeights
from coudalfish.surface.polygons import ZeroSet
from tigar_x import compat
from varmint.forms.sides import Sides, sided_residual
from varmint.forms.vms import interior_residual

DEGREE = 4
LINE = np.array([0.6, 0.8]), 0.41
"""Normal of a straight line, and where it is."""
PLANE = np.array([0.48, 0.64, 0.6]), 0.63
"""The same of a plane."""


class Scene:
    """A square or cube that a line or plane divides; all cells count as divided, with weights 0 and 1 where they are
    not."""

    def __init__(self, cell="triangle"):
        self.mesh = grid(cell, 4)
        self.d = d = self.mesh.geometry.dim
        self.V = compat.lagrange_space(self.mesh, 1, 2 * (d + 1))
        self.normal, place = LINE if d == 2 else PLANE
        linear, weights = (
            compat.lagrange_space(self.mesh, 1),
            compat.lagrange_space(self.mesh, DEGREE, discontinuous=True),
        )
        self.phi, self.size, self.negative = fem.Function(linear), fem.Function(linear), fem.Function(weights)
        x = linear.tabulate_dof_coordinates()[:, :d]
        phi = x @ self.normal - place
        self.phi.x.array[:], self.size.x.array[:] = phi, np.abs(phi)
        vertices = compat.cell_dofs(linear)
        c = np.repeat(
            (phi[vertices].max(axis=1) <= 0.0)[:, None].astype(float), compat.cell_dofs(weights).shape[1], axis=1
        )
        self.cut = CutCells.of(vertices, phi)
        c[self.cut.cells] = SideWeights(DEGREE, compat.node_points(weights))(self.cut)
        self.negative.x.array[compat.cell_dofs(weights)] = c
        self.sides = Sides(self.phi, self.size, self.negative)
        self.u, self.rate = fem.Function(self.V), fem.Function(self.V)
        self.dx = ufl.dx(domain=self.mesh, metadata={"quadrature_degree": 2 * DEGREE})

    def parts(self, f):
        d = self.d
        u, a = (ufl.as_vector([f[i + start] for i in range(d)]) for start in (0, d + 1))
        return u, f[d], a, f[2 * d + 1]

    def residual(self, **options):
        u_t, _, a_t, _ = self.parts(self.rate)
        known = dict(rho=RHO, mu=MU, dt=compat.Constant(self.mesh, DT), dx=self.dx) | options
        tests = self.parts(ufl.TestFunction(self.V))
        return sided_residual(self.sides, self.parts(self.u), tests, (u_t, a_t), self.mesh, **known)

    def component(self, *which):
        return np.concatenate([compat.component_space(self.V, i)[1] for i in which])


def test_without_jump_and_kink_the_sides_sum_to_the_whole():
    scene = Scene()
    randomise(scene.u, 1)
    randomise(scene.rate, 2)
    scene.u.x.array[scene.component(3, 4, 5)] = scene.rate.x.array[scene.component(3, 4, 5)] = 0.0
    (v, p, _, _), (w, q, _, _) = scene.parts(scene.u), scene.parts(ufl.TestFunction(scene.V))
    dt = compat.Constant(scene.mesh, DT)
    plain = dict(rho=RHO, mu=MU, v_t=scene.parts(scene.rate)[0], dt=dt, dx=scene.dx)
    whole = interior_residual(v, p, w, q, scene.mesh, divided=True, **plain)
    fine = interior_residual(v, p, w, q, scene.mesh, **plain)
    sided, whole, fine = (assembled(f, scene.V).array for f in compat.compile_forms(scene.residual(), whole, fine))
    own = scene.component(0, 1, 2)
    np.testing.assert_allclose(sided[own], whole[own], atol=1e-12)
    assert np.abs(fine[own] - whole[own]).max() > 1e-4


def test_in_divided_cells_half_of_tau_pushes_the_mass_and_a_time_step_at_most():
    """What two slopes of the pressure at rest drive: tau_M times it, which in other cells is as good as dt/2."""
    scene = Scene()
    (v, p, _, _), (w, q, _, _) = scene.parts(scene.u), scene.parts(ufl.TestFunction(scene.V))
    scene.u.x.array[:] = 0.0
    randomise(scene.u, 3)
    scene.u.x.array[scene.component(0, 1, 3, 4, 5)] = 0.0
    rest, pressure = ufl.as_vector([0.0, 0.0]), scene.component(2)

    def driven(dt, **options):
        known = dict(rho=RHO, mu=MU, v_t=rest, dt=compat.Constant(scene.mesh, dt), dx=scene.dx)
        form = interior_residual(v, p, w, q, scene.mesh, **known, **options)
        return assembled(compat.compile_forms(form)[0], scene.V).array[pressure].copy()

    slow, own = driven(1e6), 0.1 * RHO / MU / 4**2  # about the tau_M of a cell at rest
    half, plain = driven(own, divided=True), driven(1e-6)
    np.testing.assert_allclose(half, 0.5 * slow, atol=1e-6 * np.abs(slow).max())
    assert np.abs(driven(own)).max() < 0.7 * np.abs(slow).max()
    np.testing.assert_allclose(driven(1e-6, divided=True), 2.0 * plain, atol=1e-6 * np.abs(plain).max())


def test_a_pressure_that_jumps_pushes_the_line_and_nothing_else():
    """At rest the power of every velocity that vanishes at the walls is the jump times its flux through the line."""
    scene, jump = Scene(), 3.0
    scene.u.x.array[scene.component(5)] = jump
    scene.u.x.array[scene.component(2)] = -7.0
    R = scene.residual(f=None)
    b = assembled(compat.compile_forms(R)[0], scene.V).array
    x = scene.V.tabulate_dof_coordinates()[:, :2]
    free = ((x > 1e-9) & (x < 1.0 - 1e-9)).all(axis=1)
    W = np.random.default_rng(7).normal(size=(len(x), 2)) * free[:, None]
    momentum = sum(b[compat.component_space(scene.V, i)[1]] @ W[:, i] for i in (0, 1))
    w = fem.Function(scene.V)
    for i in (0, 1):
        w.x.array[compat.component_space(scene.V, i)[1]] = W[:, i]
    divergence = ufl.div(scene.parts(w)[0])
    forms = compat.compile_forms(scene.negative * divergence * scene.dx, divergence * scene.dx)
    through = compat.assemble_scalar(forms[0])  # the flux out of the negative side, all of it through the line
    assert abs(compat.assemble_scalar(forms[1])) < 1e-12
    np.testing.assert_allclose(momentum, jump * through, rtol=1e-11)
    assert abs(through) > 1e-2


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_shear_on_one_side_and_pressures_on_both_are_balanced_by_a_force_between_them(cell):
    """Rest below and a flow along the line or plane above it, which is in the space, and constant pressures: a force
    between both sides balances them, on velocities and on kinks. Nodes on the boundary are left out."""
    scene, c, along = Scene(cell), 3.0, np.array([0.8, -0.6, 0.0])
    d, x = scene.d, scene.V.tabulate_dof_coordinates()
    along, values = along[:d], scene.u.x.array.reshape(-1, 2 * (d + 1))
    phi = x[:, :d] @ scene.normal - (LINE if d == 2 else PLANE)[1]
    values[:, :d], values[:, d] = np.maximum(phi, 0.0)[:, None] * along, -2.0
    values[:, d + 1 : -1], values[:, -1] = -0.5 * along, 2.0 * c
    residual = scene.residual(f=None)
    b = assembled(compat.compile_forms(residual)[0], scene.V).array.reshape(values.shape)
    points = ZeroSet.of(scene.cut, compat.cell_vertices(scene.mesh)[scene.cut.cells]).quadrature(3)
    nodes, force = compat.cell_dofs(scene.V)[points.cells], 2.0 * c * points.normals - MU * along
    N = points.barycentric * points.areas[:, None]
    psi = np.einsum("gk,gk->g", points.barycentric, np.abs(phi[nodes]))
    expected = np.zeros_like(values)
    np.add.at(expected[:, :d], nodes, N[..., None] * force[:, None])
    np.add.at(expected[:, d + 1 : -1], nodes, (psi[:, None] * N)[..., None] * force[:, None])
    inside = ((x[:, :d] > 1e-9) & (x[:, :d] < x[:, :d].max() - 1e-9)).all(axis=1)
    np.testing.assert_allclose(b[inside], expected[inside], atol=1e-13)
    assert np.abs(expected[inside]).max(axis=0)[[*range(d), *range(d + 1, 2 * d + 1)]].min() > 1e-4


@pytest.mark.parametrize("s", [-1.0, 1.0])
def test_a_field_that_bends_at_the_line_is_in_the_space(s):
    """max(phi, 0) is its own interpolant and a kink of minus one half."""
    scene = Scene()
    u = ufl.as_vector([(scene.size + scene.phi) / 2] * 2)
    exact = scene.phi if s > 0 else 0.0
    bent = scene.sides.velocity(u, ufl.as_vector([-0.5, -0.5]), s)[0]
    assert compat.assemble_scalar(compat.compile_forms((bent - exact) ** 2 * scene.dx)[0]) < 1e-28


@pytest.mark.parametrize("s", [-1.0, 1.0])
def test_a_kink_moves_with_the_line(s):
    """The rate at a fixed place is that of psi a, also with a kink that stays the same."""
    scene, v, step = Scene(), np.array([0.3, 0.2]), 1e-3
    scene.u.x.array[:] = np.random.default_rng(3).normal(size=len(scene.u.x.array))
    _, _, a, _ = scene.parts(scene.u)
    of_vectors = compat.lagrange_space(scene.mesh, 1, 2)
    carried = fem.Function(of_vectors), fem.Function(of_vectors)
    nodes, phi = np.empty(len(scene.phi.x.array), dtype=np.int64), scene.phi.x.array.copy()
    nodes[compat.cell_dofs(scene.phi.function_space)] = compat.cell_dofs(of_vectors)
    for f, sign in zip(carried, (np.ones(len(phi)), np.sign(phi)), strict=True):
        f.x.array.reshape(-1, 2)[nodes] = sign[:, None] * v
    sides = Sides(scene.phi, scene.size, scene.negative, carried=carried)
    before = Sides(*(fem.Function(scene.phi.function_space) for _ in range(2)), scene.negative)
    before.phi.x.array[:] = phi + step * v @ scene.normal
    before.size.x.array[:] = np.abs(before.phi.x.array)
    assert (np.sign(before.phi.x.array) == np.sign(phi)).all()
    at_rest = ufl.as_vector([0.0, 0.0])
    rate = sides.rate(at_rest, at_rest, a, s)
    expected = (sides.velocity(at_rest, a, s) - before.velocity(at_rest, a, s)) / step
    e = rate - expected
    forms = compat.compile_forms(ufl.inner(e, e) * scene.dx, ufl.inner(expected, expected) * scene.dx)
    error, size = map(compat.assemble_scalar, forms)
    assert error < 1e-18 * size
    assert size > 1e-2


def test_smoothing_sees_kinks_alone_and_only_where_they_vary():
    scene = Scene()
    difference = compat.compile_forms(scene.residual(smoothing=0.1) - scene.residual(smoothing=0.0))[0]

    def norms():
        b = assembled(difference, scene.V).array
        return [np.abs(b[scene.component(*which)]).max() for which in ((0, 1, 2, 5), (3, 4))]

    scene.u.x.array[scene.component(3, 4)] = 2.0
    assert max(norms()) < 1e-14
    randomise(scene.u, 3)
    others, kinks = norms()
    assert others < 1e-14
    assert kinks > 1e-3
