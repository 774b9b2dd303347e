"""Contact of a shell with itself: potential, forces and tangent against each other and against all pairs."""

import logging
from dataclasses import dataclass, replace

import numpy as np
import pytest
from mpi4py import MPI

from shnapr.contact import LinearKernel, SelfContact, SmoothedKernel
from tigar_x.fem.linear import SolveError
from tigar_x.geometry import shapes
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import disjoint
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline

R_MAX = 0.4
LINEAR, SMOOTHED = LinearKernel(R_MAX, 3.0), SmoothedKernel(R_MAX, 3.0, 0.6)


@dataclass(frozen=True)
class Spring:
    """A user's own kernel, which attracts from afar and repels up close: phi = k (r_max - r)^2 (r_0 - r)."""

    r_max: float = R_MAX
    r_0: float = 0.2
    k: float = 5.0

    def energy(self, r):
        return self.k * np.maximum(self.r_max - r, 0) ** 2 * (self.r_0 - r)

    def slope(self, r):
        a = np.maximum(self.r_max - r, 0)
        return self.k * (2 * a * (r - self.r_0) - a**2)

    def curvature(self, r):
        return np.where(r < self.r_max, self.k * (4 * (self.r_max - r) - 2 * (r - self.r_0)), 0)


KERNELS = {"linear": LINEAR, "smoothed": SMOOTHED, "full": SmoothedKernel(R_MAX, 3.0, 1.0), "own": Spring()}
EVERY_KERNEL = pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
BOTH_DIMENSIONS = pytest.mark.parametrize("d", [2, 3])


@dataclass(frozen=True)
class Cloud:
    """Points that are scattered in the reference configuration and crowded in the current one."""

    quadrature: NodalQuadrature
    x: np.ndarray

    @classmethod
    def of(cls, d, n=40, seed=0):
        rng = np.random.default_rng(seed)
        points = rng.uniform(0, 1.2, (n, d))
        rule = NodalQuadrature(points, rng.uniform(0.5, 2, n), rng.uniform(0.6, 1.5, n))
        return cls(rule, rng.uniform(0, 1.1, (n, d)))

    def contact(self, kernel=LINEAR, r_self=1.2 * R_MAX):
        return SelfContact(self.quadrature, kernel, r_self)


def all_pairs(quadrature, kernel, r_self, x):
    """Energy, homogeneous forces and tangent by a loop over all pairs."""
    (n, d), w, W = x.shape, quadrature.rational, quadrature.weights
    energy, forces, K = 0.0, np.zeros((n, d)), np.zeros((n, d, n, d))
    for a in range(n):
        for b in range(a):
            r = np.linalg.norm(x[a] - x[b])
            if np.linalg.norm(quadrature.points[a] - quadrature.points[b]) <= r_self or r >= kernel.r_max:
                continue
            e, weight = (x[a] - x[b]) / r, W[a] * W[b]
            slope, rr = float(kernel.slope(np.array(r))), np.outer(e, e)
            energy += weight * float(kernel.energy(np.array(r)))
            block = weight * (float(kernel.curvature(np.array(r))) * rr + slope / r * (np.eye(d) - rr))
            forces[a] += weight * slope * e / w[a]
            forces[b] -= weight * slope * e / w[b]
            for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
                K[i, :, j] += sign * block / (w[i] * w[j])
    return energy, forces, K.reshape(n * d, n * d)


def slope_of(f, at, step=1e-6):
    """Central differences of an array-valued function by every entry of ``at``; last axes: those of ``at``."""
    columns = []
    for k in np.ndindex(at.shape):
        e = np.zeros(at.shape)
        e[k] = step
        columns.append((np.asarray(f(at + e)) - np.asarray(f(at - e))) / (2 * step))
    return np.stack(columns, axis=-1)


# -- kernels -----------------------------------------------------------------------------------------------------------


@EVERY_KERNEL
def test_kernel_derivatives(kernel):
    r, h = np.linspace(0.013, 1.2 * R_MAX, 50), 1e-6
    for f, df in ((kernel.energy, kernel.slope), (kernel.slope, kernel.curvature)):
        np.testing.assert_allclose(df(r), (f(r + h) - f(r - h)) / (2 * h), rtol=1e-6, atol=1e-8)
    assert kernel.slope(np.array([0.01]))[0] < -0.1
    for f in (kernel.energy, kernel.slope, kernel.curvature):
        np.testing.assert_array_equal(f(np.array([R_MAX, 1.5 * R_MAX])), 0)


@pytest.mark.parametrize("smoothing", [0.1, 0.6, 1.0])
def test_smoothed_kernel_by_its_pieces(smoothing):
    kernel, k = SmoothedKernel(R_MAX, 3.0, smoothing), 3.0
    onset = (1 - smoothing) * R_MAX
    outer, inner = np.linspace(onset, R_MAX, 9), np.linspace(0, onset, 9)
    np.testing.assert_allclose(kernel.slope(outer), -k / (2 * R_MAX * smoothing) * (R_MAX - outer) ** 2, atol=1e-15)
    np.testing.assert_allclose(kernel.slope(inner), -k * (R_MAX * (1 - smoothing / 2) - inner), rtol=1e-14)
    for f in (kernel.energy, kernel.slope, kernel.curvature):
        below, above = f(np.array([onset - 1e-12, R_MAX - 1e-12])), f(np.array([onset + 1e-12, R_MAX + 1e-12]))
        np.testing.assert_allclose(below, above, atol=1e-9)


def test_smoothing_vanishes_towards_the_linear_kernel():
    r = np.linspace(0, 1.1 * R_MAX, 30)
    for s in (1e-3, 1e-9):
        kernel = SmoothedKernel(R_MAX, 3.0, s)
        np.testing.assert_allclose(kernel.slope(r), LINEAR.slope(r), atol=s)
        np.testing.assert_allclose(kernel.energy(r), LINEAR.energy(r), atol=s)


# -- forces and tangent ------------------------------------------------------------------------------------------------


@BOTH_DIMENSIONS
@EVERY_KERNEL
@pytest.mark.parametrize("seed", [0, 1])
def test_all_pairs(d, kernel, seed):
    cloud = Cloud.of(d, seed=seed)
    got = cloud.contact(kernel).evaluate(cloud.x)
    energy, forces, K = all_pairs(cloud.quadrature, kernel, 1.2 * R_MAX, cloud.x)
    assert got.pairs > 30
    assert got.energy == pytest.approx(energy, rel=1e-12)
    np.testing.assert_allclose(got.forces, forces, atol=1e-12 * np.abs(forces).max())
    np.testing.assert_allclose(got.tangent.toarray(), K, atol=1e-12 * np.abs(K).max())


VARIANTS = {
    "as it is": {},
    "r_max": dict(kernel=replace(SMOOTHED, r_max=0.35)),
    "stiffness": dict(kernel=replace(SMOOTHED, stiffness=4.0)),
    "smoothing": dict(kernel=replace(SMOOTHED, smoothing=0.5)),
    "r_self": dict(r_self=0.55),
    "weights": dict(weights=1.3),
    "rational": dict(rational=0.8),
    "alpha": dict(alpha=0.7),
}


def derivatives(d, kernel=SMOOTHED, r_self=1.2 * R_MAX, weights=1.0, rational=1.0, alpha=1.0):
    """Forces and tangent at ``x = X + [alpha y + (1 - alpha) y_n]/w``, each with its finite differences by y."""
    cloud = Cloud.of(d, n=20)
    scale = np.where(np.arange(20) % 2, weights, 1), np.where(np.arange(20) % 2, rational, 1)
    rule = replace(
        cloud.quadrature, weights=scale[0] * cloud.quadrature.weights, rational=scale[1] * cloud.quadrature.rational
    )
    w, self_contact = rule.rational[:, None], SelfContact(rule, kernel, r_self)
    y_n = np.random.default_rng(5).uniform(-0.05, 0.05, cloud.x.shape)
    y = w * (cloud.x - rule.points) / alpha - (1 - alpha) / alpha * y_n  # the same positions for every variant

    def at(y, **options):
        return self_contact.evaluate(rule.points + (alpha * y + (1 - alpha) * y_n) / w, alpha=alpha, **options)

    got = at(y)
    forces = slope_of(lambda y: at(y, tangent=False).energy, y).reshape(y.shape) / alpha
    tangent = slope_of(lambda y: at(y, tangent=False).forces.ravel(), y)
    return got, forces, tangent


@BOTH_DIMENSIONS
@pytest.mark.parametrize("variant", VARIANTS)
def test_derivatives(d, variant):
    """Forces and tangent are slopes of energy and forces, and the tangent feels every parameter."""
    got, forces, tangent = derivatives(d, **VARIANTS[variant])
    K = got.tangent.toarray()
    np.testing.assert_allclose(got.forces, forces, atol=1e-7 * np.abs(forces).max())
    np.testing.assert_allclose(K, tangent, atol=1e-6 * np.abs(K).max())
    plain = derivatives(d)[0].tangent.toarray()
    assert (np.abs(K - plain).max() > 1e-3 * np.abs(plain).max()) == (variant != "as it is")


@BOTH_DIMENSIONS
@EVERY_KERNEL
def test_action_equals_reaction(d, kernel):
    """No net force and no net moment, whatever the rational weights."""
    cloud = Cloud.of(d, n=200)
    force = cloud.quadrature.rational[:, None] * cloud.contact(kernel).evaluate(cloud.x).forces
    scale, lever = np.abs(force).sum(), cloud.x.T @ force
    assert scale > 1
    assert np.abs(force.sum(axis=0)).max() < 1e-12 * scale
    assert np.abs(lever - lever.T).max() < 1e-12 * scale


def rotation(d, seed=3):
    Q = np.linalg.qr(np.random.default_rng(seed).normal(size=(d, d)))[0]
    Q[0] *= np.linalg.det(Q)
    return Q


@BOTH_DIMENSIONS
def test_rigid_motion_and_numbering(d):
    """Forces and tangent turn with the cloud, do not move with it, and follow its numbering."""
    cloud, Q = Cloud.of(d), rotation(d)
    n, rng = len(cloud.x), np.random.default_rng(4)
    before = cloud.contact().evaluate(cloud.x)
    order = rng.permutation(n)
    rule = NodalQuadrature(
        cloud.quadrature.points[order], cloud.quadrature.weights[order], cloud.quadrature.rational[order]
    )
    after = SelfContact(rule, LINEAR, 1.2 * R_MAX).evaluate(cloud.x[order] @ Q.T + rng.uniform(-3, 3, d))
    assert (after.pairs, before.energy) == (before.pairs, pytest.approx(after.energy, rel=1e-12))
    assert after.distance == pytest.approx(before.distance, rel=1e-12)
    np.testing.assert_allclose(after.forces, before.forces[order] @ Q.T, atol=1e-11)
    K = before.tangent.toarray().reshape(n, d, n, d)[order][:, :, order]
    np.testing.assert_allclose(
        after.tangent.toarray().reshape(n, d, n, d), np.einsum("ki,aibj,lj->akbl", Q, K, Q), atol=1e-11
    )


@BOTH_DIMENSIONS
def test_the_tangent_is_symmetric_and_stores_touching_nodes_only(d):
    cloud = Cloud.of(d, n=300)
    got = cloud.contact(replace(LINEAR, r_max=0.1), 0.12).evaluate(cloud.x)
    K = got.tangent
    K.check_format()
    assert K.blocksize == (d, d)
    assert K.has_sorted_indices
    assert abs(K - K.T).max() == 0
    touching = np.unique(np.flatnonzero(np.abs(got.forces).max(axis=1)))
    assert K.nnz == d * d * (2 * got.pairs + len(touching))


@BOTH_DIMENSIONS
@EVERY_KERNEL
def test_positive_tangent(d, kernel):
    cloud = Cloud.of(d)
    full, positive = (cloud.contact(kernel).evaluate(cloud.x, positive=p) for p in (False, True))
    np.testing.assert_array_equal(full.forces, positive.forces)
    lowest = [np.linalg.eigvalsh(c.tangent.toarray()).min() for c in (full, positive)]
    scale = np.abs(positive.tangent.data).max()
    assert lowest[1] > -1e-12 * scale
    assert lowest[0] < -1e-3 * scale


# -- which pairs -------------------------------------------------------------------------------------------------------


def two_points(reference_gap, gap, **options):
    rule = NodalQuadrature(np.array([[0.0, 0, 0], [reference_gap, 0, 0]]), np.ones(2), np.ones(2))
    return SelfContact(rule, LINEAR, 0.5).evaluate(np.array([[1.0, 1, 1], [1, 1 + gap, 1]]), **options)


def test_neighbours_in_the_reference_configuration_never_interact():
    assert two_points(0.5, 0.1).pairs == 0  # at most r_self counts as a neighbour
    got = two_points(0.5001, 0.1)
    assert (got.pairs, got.distance) == (1, pytest.approx(0.1, rel=1e-14))
    np.testing.assert_allclose(got.forces, [[0, 0.9, 0], [0, -0.9, 0]], rtol=1e-13)


@pytest.mark.parametrize("gap", [R_MAX * (1 + 1e-14), 1.1 * R_MAX, 100.0])
def test_without_contact(gap):
    got = two_points(1.0, gap)
    assert (got.energy, got.pairs, got.distance, got.coincident) == (0.0, 0, np.inf, 0)
    np.testing.assert_array_equal(got.forces, np.zeros((2, 3)))
    assert got.tangent.shape == (6, 6)
    assert got.tangent.nnz == 0
    np.testing.assert_array_equal(got.tangent @ np.ones(6), 0)
    assert two_points(1.0, gap, tangent=False).tangent is None


@BOTH_DIMENSIONS
def test_points_without_weight_take_no_part(d):
    cloud = Cloud.of(d)
    rest = np.arange(40) % 3 > 0
    rule = cloud.quadrature
    some = SelfContact(replace(rule, weights=np.where(rest, rule.weights, 0)), LINEAR, 0.5).evaluate(cloud.x)
    fewer = NodalQuadrature(rule.points[rest], rule.weights[rest], rule.rational[rest])
    alone = SelfContact(fewer, LINEAR, 0.5).evaluate(cloud.x[rest])
    np.testing.assert_array_equal(some.forces[rest], alone.forces)
    np.testing.assert_array_equal(some.forces[~rest], 0)
    assert (some.pairs, some.energy) == (alone.pairs, alone.energy)
    none = SelfContact(replace(rule, weights=np.zeros(40)), LINEAR, 0.5).evaluate(cloud.x)
    assert (none.pairs, none.load, none.energy, none.distance, none.tangent.nnz) == (0, 0.0, 0.0, np.inf, 0)
    assert none.tangent.shape == some.tangent.shape


class Counted(SelfContact):
    searches = 0

    def _search(self, x, reach):
        self.searches += 1
        return super()._search(x, reach)


@BOTH_DIMENSIONS
def test_the_past_does_not_matter(d):
    """Along a path of steps small and large, pairs found before serve while they may; the answer is a fresh one's."""
    cloud, rng = Cloud.of(d, n=150), np.random.default_rng(8)
    followed, x, drift = Counted(cloud.quadrature, LINEAR, 0.5), cloud.x, rng.normal(size=cloud.x.shape)
    steps = 60
    for step in range(steps):
        x = x + R_MAX * (0.01 * drift + (0.5 if step % 20 == 19 else 0.004) * rng.normal(size=x.shape))
        got, fresh = followed.evaluate(x), cloud.contact(r_self=0.5).evaluate(x)
        assert (got.energy, got.pairs, got.distance) == (fresh.energy, fresh.pairs, fresh.distance)
        np.testing.assert_array_equal(got.forces, fresh.forces)
        np.testing.assert_array_equal(got.tangent.toarray(), fresh.tangent.toarray())
    assert 3 <= followed.searches < steps


@BOTH_DIMENSIONS
def test_pairs_serve_the_speed_of_approach_while_points_move_little(d):
    cloud, rng = Cloud.of(d, n=150), np.random.default_rng(18)
    followed, x, v = Counted(cloud.quadrature, LINEAR, 0.5), cloud.x, rng.normal(size=cloud.x.shape)
    steps, speeds = 40, set()
    for step in range(steps):
        dt = R_MAX * (0.05 if step % 10 == 9 else 0.003)
        x = x + dt * v
        found = followed.closing_speed(x, v, dt)
        assert found == cloud.contact(r_self=0.5).closing_speed(x, v, dt) > 0.0
        speeds.add(found)
    assert 2 <= followed.searches < steps / 2
    assert len(speeds) > 2


@BOTH_DIMENSIONS
def test_points_that_meet_along_a_diagonal(d):
    """Found out of reach at first, and moved in place by less than the skin in every component, they interact."""
    diagonal = np.ones(d) / np.sqrt(d)
    rule = NodalQuadrature(np.stack([0 * diagonal, diagonal]), np.ones(2), np.ones(2))
    self_contact = SelfContact(rule, LINEAR, 0.5)
    x = np.stack([0 * diagonal, 1.21 * R_MAX * diagonal])
    assert self_contact.evaluate(x).pairs == 0
    x += [[0.099 * R_MAX], [-0.099 * R_MAX]]
    assert self_contact.evaluate(x).distance == pytest.approx(R_MAX * (1.21 - 0.198 * np.sqrt(d)), rel=1e-12)


# -- neighbours along the surface -------------------------------------------------------------------------------------

GAP, NEAR = 0.05, 0.06


def rows(*ys, elements=20, degree=2):
    """Straight lines of length 1 above each other."""
    return [shapes.line((0, y), (1, y), elements=elements, degree=degree) for y in ys]


def of_shell(geometry, r_max=0.04, r_self=NEAR, **options):
    rule = NodalQuadrature.of(ExtractedSpline(geometry, MPI.COMM_SELF))
    return rule, SelfContact(rule, LinearKernel(r_max, 1.0), r_self, **options)


def pressed(rule, by=0.03):
    """What lies above the line y = GAP/2, moved down."""
    x = rule.points.copy()
    x[x[:, 1] > GAP / 2, 1] -= by
    return x


def said(caplog):
    """Records of contact alone: others tell of compilation."""
    return [record for record in caplog.records if record.name == "shnapr.contact.self_contact"]


def test_patches_that_are_not_joined_touch_however_near_they_start(caplog):
    with caplog.at_level(logging.INFO):
        rule, touching = of_shell(disjoint(*rows(0.0, GAP)))
    got, upper = touching.evaluate(pressed(rule)), rule.points[:, 1] > GAP / 2
    assert got.pairs >= 2 * 41
    assert got.distance == pytest.approx(GAP - 0.03, rel=1e-12)
    assert (got.forces[upper, 1] < 0.0).all()  # as a part of the residual: it is pushed up
    (record,) = said(caplog)
    far = np.hypot(0.025, GAP)  # to the next point but one
    assert far < NEAR < np.hypot(0.05, GAP)
    assert record.levelno == logging.INFO
    assert f"contact: {41 + 2 * 40} pairs of points start nearer than r_self = 0.06, 0 of them" in record.message
    caplog.clear()
    with caplog.at_level(logging.INFO):
        published = of_shell(disjoint(*rows(0.0, GAP)), neighbours="space")[1]
    assert published.evaluate(pressed(rule)).pairs == 0
    assert "pairs of points start nearer than r_self" in caplog.text
    assert "with neighbours = 'space' they never touch" in caplog.text


def test_patches_that_start_within_the_range_of_contact_push_each_other_and_it_is_said(caplog):
    with caplog.at_level(logging.WARNING):
        rule, touching = of_shell(disjoint(*rows(0.0, GAP)), r_max=0.055)
    assert touching.evaluate(rule.points).pairs == 41
    assert "41 of them nearer than r_max = 0.055" in caplog.text
    assert "reduce r_max" in caplog.text


def test_patches_that_start_apart_touch_by_the_published_rule(caplog):
    with caplog.at_level(logging.INFO):
        (rule, one), (_, other) = (of_shell(disjoint(*rows(0.0, 0.1)), neighbours=n) for n in ("surface", "space"))
    assert not said(caplog)
    x = rule.points * (0.7, 0.2)  # so short that neighbours would touch as well
    got, published = one.evaluate(x), other.evaluate(x)
    assert got.pairs == published.pairs > 41
    np.testing.assert_array_equal(got.forces, published.forces)
    np.testing.assert_array_equal(got.tangent.toarray(), published.tangent.toarray())


def test_a_sheet_that_is_folded_touches_itself_and_not_around_the_fold():
    """A hairpin of one patch, and of three that are glued; its arms are nearer than r_self."""
    r, length = GAP / 2, 1.0

    def at(s):
        around = np.clip((s - length) / r, 0.0, np.pi)
        return (
            np.where(s < length, s, np.where(s > length + np.pi * r, 2 * length + np.pi * r - s, length))
            + r * np.sin(around),
            r * (1.0 - np.cos(around)),
        )

    total = 2 * length + np.pi * r
    whole = shapes.interpolated(lambda u: at(total * u), [shapes.uniform(3, 80)])
    ends = np.array([0.0, length, length + np.pi * r, total])
    parts = [
        shapes.interpolated(lambda u, a=a, b=b: at(a + (b - a) * u), [shapes.uniform(3, k)])
        for a, b, k in zip(ends[:-1], ends[1:], (30, 4, 30), strict=True)
    ]
    for geometry in (whole, glued(*parts), disjoint(*parts)):
        rule, touching = of_shell(geometry)
        assert len(touching.apart) > 50
        assert rule.points[touching.apart].max(axis=(0, 1))[0] < length  # around the bend all are neighbours
        got = touching.evaluate(pressed(rule))
        assert got.pairs > 50
        assert got.distance == pytest.approx(GAP - 0.03, rel=1e-2)


def test_the_edges_of_patches_that_touch_are_neighbours():
    """Two sheets in space that meet at an edge, glued or not, and a third one that starts close to them."""
    first, second = (
        shapes.parallelogram((0, 0, 0), (x, 0, 0.05), (0, 0.3, 0), elements=(8, 3), degrees=(2, 2)) for x in (0.4, -0.4)
    )
    above = shapes.parallelogram((-0.4, 0, 0.1), (0.8, 0, 0), (0, 0.3, 0), elements=(16, 3), degrees=(2, 2))
    for geometry in (glued(first, second), disjoint(first, second)):
        assert len(of_shell(geometry)[1].apart) == 0
    rule, touching = of_shell(disjoint(first, second, above))
    assert len(touching.apart) > 0
    assert ((rule.points[touching.apart, 2] > 0.09).sum(axis=1) == 1).all()


# -- hard cases --------------------------------------------------------------------------------------------------------


@BOTH_DIMENSIONS
@pytest.mark.parametrize("offset", [0.0, 1e-14 * R_MAX])
def test_points_in_the_same_place(d, offset, caplog):
    """They repel each other along the line between their reference positions, with a finite tangent; logged once."""
    cloud = Cloud.of(d)
    X, x = cloud.quadrature.points, cloud.x.copy()
    a = 0
    b = int(np.argmax(np.linalg.norm(X - X[a], axis=1)))
    x[b] = x[a]
    x[b, 0] += offset
    self_contact = cloud.contact()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            got = self_contact.evaluate(x)
    assert (got.coincident, len(caplog.records)) == (1, 1)
    assert got.distance <= 1e-13 * R_MAX
    assert np.isfinite(got.forces).all()
    assert np.isfinite(got.tangent.data).all()
    assert abs(got.tangent - got.tangent.T).max() == 0
    only = np.isin(np.arange(40), (a, b))
    pair = replace(cloud.quadrature, weights=np.where(only, cloud.quadrature.weights, 0))
    alone = SelfContact(pair, LINEAR, 0.5).evaluate(x)
    push = pair.weights[[a, b]].prod() * 3.0 * R_MAX
    apart = (X[b] - X[a]) / np.linalg.norm(X[b] - X[a])
    forces = pair.rational[:, None] * alone.forces
    np.testing.assert_allclose(forces[[a, b]], [push * apart, -push * apart], rtol=1e-12)


def test_close_points_are_not_taken_for_one():
    """Just above the limit, the direction is that of the points."""
    got = two_points(1.0, 1e-9)
    assert got.coincident == 0
    np.testing.assert_allclose(got.forces[0], [0, 1.2, 0], rtol=1e-6)
    assert np.isfinite(got.tangent.data).all()


def collide(kernel, speed, mass):
    """Rows of points that close at ``speed`` r_max per step, in implicit steps: gaps, and momenta, after every step.

    ``mass`` is that of a point per weight, in units of what the kernel's stiffness stops in about one step.
    """
    n, r_max, m = 12, kernel.r_max, mass * kernel.stiffness * 0.06
    along = 0.6 * r_max * np.arange(n)
    reference, x = (
        np.concatenate([np.column_stack([along + shift, 0 * along + up]) for shift, up in ((0, 0), (0.1 * r_max, gap))])
        for gap in (2 * r_max, 1.05 * r_max)
    )
    self_contact = SelfContact(NodalQuadrature(reference, np.full(2 * n, 0.06), np.ones(2 * n)), kernel, 1.1 * r_max)
    v = speed * r_max * np.outer(np.repeat([0.5, -0.5], n), [0.0, 1.0])
    gaps, momenta = [], []
    for _ in range(40):
        x_0, v_0 = x, v
        for _ in range(12):
            v = x - x_0
            got = self_contact.evaluate(x)
            residual = (m * (v - v_0) + got.forces).ravel()
            if np.abs(residual).max() < 1e-12 * m * r_max:
                break
            x = x - np.linalg.solve(got.tangent.toarray() + m * np.eye(4 * n), residual).reshape(x.shape)
        else:
            pytest.fail("Newton's method did not converge")
        gaps.append((x[n:, 1] - x[:n, 1]).min() / r_max)
        momenta.append(np.abs(v.sum(axis=0)).max() / (speed * r_max * n))
    return np.array(gaps), np.array(momenta)


@pytest.mark.parametrize("speed", [0.05, 0.3])
@pytest.mark.parametrize(
    "kernel", [LinearKernel(0.1, 1e11), SmoothedKernel(0.1, 1e11, 1.0)], ids=["linear", "smoothed"]
)
def test_rows_that_collide(kernel, speed):
    """They bounce without crossing and keep their momentum; too heavy ones cross, which the gaps would tell."""
    gaps, momenta = collide(kernel, speed, 0.1)
    assert 0.3 < gaps.min() < 0.98
    assert gaps[-1] > 1.0
    assert momenta.max() < 1e-10
    if speed == 0.3:
        assert collide(kernel, speed, 5.0)[0].min() < -1.0


def test_a_fold_of_a_spline():
    """The two halves of a ribbon that is folded onto itself repel each other, but not next to the fold."""
    patch = shapes.parallelogram((0, 0, 0), (2, 0, 0), (0, 0.5, 0), elements=(16, 4), degrees=(2, 2))
    spline = ExtractedSpline(patch, MPI.COMM_SELF)
    rule = NodalQuadrature.of(spline)
    s = rule.points[:, 0] - 1
    x = np.column_stack([np.abs(s), rule.points[:, 1], 0.1 * np.sign(s) * np.minimum(np.abs(s) / 0.2, 1)])
    got = SelfContact(rule, LinearKernel(0.22, 1e3), 0.5).evaluate(x)
    far = np.abs(s) > 0.3
    assert (
        np.sign(s[far]) * got.forces[far, 2] < 0
    ).all()  # the residual pulls the halves together, so x - dx parts them
    np.testing.assert_array_equal(got.forces[np.abs(s) < 0.1], 0)
    total = np.abs(got.forces[:, 2]).sum()
    assert np.abs(got.forces.sum(axis=0)).max() < 1e-12 * total
    assert got.distance == pytest.approx(0.2, rel=1e-12)


@pytest.mark.parametrize(("degree", "elements", "tolerance"), [(1, 24, 0.05), (2, 12, 0.05), (3, 8, 0.2)])
def test_spacing_ratio(degree, elements, tolerance):
    """Nodes of a unit square at a mean spacing of 1/24, on a spline of any degree."""
    patch = shapes.parallelogram(
        (0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(elements, elements), degrees=(degree, degree)
    )
    rule = NodalQuadrature.of(ExtractedSpline(patch, MPI.COMM_SELF))
    ratio = SelfContact(rule, LinearKernel(0.05, 1.0), 0.1).spacing_ratio
    assert ratio == pytest.approx(1 / 24 / 0.05, rel=tolerance)
    assert SelfContact(rule, LinearKernel(0.025, 1.0), 0.1).spacing_ratio == pytest.approx(2 * ratio, rel=1e-12)


def test_the_spacing_at_a_point_is_the_mean_weight_around_it():
    """Of the point itself alone where no other is near; in space its square root."""
    for r_self, areas in ((0.9, 3.0), (1.1, 2.5)):
        for d in (2, 3):
            rule = NodalQuadrature(np.eye(2, d) * np.sqrt(0.5), np.array([2.0, 3.0]), np.ones(2))
            found = SelfContact(rule, LINEAR, r_self).spacing_ratio
            assert found == pytest.approx(areas ** (1 / (d - 1)) / R_MAX, rel=1e-14)


def test_ways_lead_over_points_without_weight_that_take_no_part():
    rule, touching = of_shell(disjoint(*rows(0.0, GAP)))
    for i in touching.apart[7]:
        weights = np.where(np.arange(len(rule.weights)) == i, 0.0, rule.weights)
        fewer = SelfContact(replace(rule, weights=weights), touching.kernel, NEAR).apart
        np.testing.assert_array_equal(fewer, touching.apart[(touching.apart != i).all(axis=1)])


# -- bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize("name", ["r_max", "stiffness"])
@pytest.mark.parametrize("kernel", [LINEAR, SMOOTHED], ids=["linear", "smoothed"])
def test_bad_kernels(kernel, name, value):
    with pytest.raises(ValueError, match=rf"^{name} = {value}: .* required"):
        replace(kernel, **{name: value})


@pytest.mark.parametrize("value", [0.0, -0.5, 1.001, np.nan])
def test_bad_smoothing(value):
    with pytest.raises(ValueError, match=rf"^smoothing = {value}: .* required"):
        replace(SMOOTHED, smoothing=value)


@pytest.mark.parametrize("r_self", [R_MAX, 0.9 * R_MAX])
def test_r_max_reaches_neighbours(r_self):
    with pytest.raises(ValueError, match=rf"kernel\.r_max = {R_MAX} with r_self = {r_self}: kernel\.r_max < r_self"):
        Cloud.of(3).contact(r_self=r_self)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "far"])
def test_bad_r_self(value):
    with pytest.raises(ValueError, match=rf"^r_self = '?{value}'?: .* required"):
        Cloud.of(3).contact(r_self=value)


BAD_RULES = {
    r"quadrature\.points has shape \(40, 4\)": dict(points=np.zeros((40, 4))),
    r"quadrature\.points has shape \(40,\)": dict(points=np.zeros(40)),
    r"quadrature\.points\[3, 1\] = nan": dict(points=np.where(np.arange(80).reshape(40, 2) == 7, np.nan, 0)),
    r"quadrature\.weights has shape \(39,\)": dict(weights=np.ones(39)),
    r"quadrature\.weights\[5\] = -1": dict(weights=np.where(np.arange(40) == 5, -1, 1.0)),
    r"quadrature\.rational\[2\] = 0": dict(rational=np.where(np.arange(40) == 2, 0, 1.0)),
    r"quadrature\.rational\[2\] = inf": dict(rational=np.where(np.arange(40) == 2, np.inf, 1.0)),
}


@pytest.mark.parametrize("message", BAD_RULES)
def test_bad_rules(message):
    with pytest.raises(ValueError, match=f"^{message}.* required"):
        SelfContact(replace(Cloud.of(2).quadrature, **BAD_RULES[message]), LINEAR, 0.5)


def test_bad_configurations():
    cloud = Cloud.of(3)
    with pytest.raises(ValueError, match=r"^x has shape \(39, 3\): shape \(40, 3\) is required"):
        cloud.contact().evaluate(cloud.x[1:])
    with pytest.raises(ValueError, match=r"^alpha = 0.0: .* required"):
        cloud.contact().evaluate(cloud.x, alpha=0.0)
    for bad in (np.nan, np.inf):
        x = cloud.x.copy()
        x[7, 1] = bad
        with pytest.raises(SolveError, match=r"^x, .* not finite"):
            cloud.contact().evaluate(x)


def test_a_search_that_was_stopped_leaves_nothing_behind(monkeypatch):
    """An error in the middle of a search must not leave new positions with old pairs."""
    cloud = Cloud.of(3)
    self_contact = cloud.contact()
    self_contact.evaluate(cloud.x + 5.0 * np.arange(40)[:, None])

    def fail(*_, **__):
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr("shnapr.contact.self_contact.cKDTree", fail)
        with pytest.raises(MemoryError):
            self_contact.evaluate(cloud.x)
    assert self_contact.evaluate(cloud.x).pairs == cloud.contact().evaluate(cloud.x).pairs > 0


def a_pair(distance, W=(2.0, 3.0)):
    """Contact of two points that were far from each other, and where they are now."""
    rule = NodalQuadrature(np.array([[0.0, 0.0], [9.0, 0.0]]), np.array(W), np.array([1.0, 1.4]))
    return SelfContact(rule, LINEAR, 1.0), np.array([[0.0, 0.0], [distance, 0.0]])


def test_load_of_two_points():
    touching, x = a_pair(0.7 * R_MAX)
    assert touching.evaluate(x).load == pytest.approx(2.0 * 3.0 * 3.0 * 0.3 * R_MAX, rel=1e-12)


@pytest.mark.parametrize(("distance", "seen"), [(R_MAX + 1.5 * 0.1, True), (R_MAX + 2.5 * 0.1, False)])
def test_both_of_two_points_may_come_closer(distance, seen):
    """Each moves by 0.1 in the step: what is nearer than r_max + 0.2 may touch within it, with twice the speed."""
    touching, x = a_pair(distance)
    speed = touching.closing_speed(x, np.array([[1.0, 0.0], [-1.0, 0.0]]), 0.1)
    assert speed == pytest.approx(2.0 if seen else 0.0)
