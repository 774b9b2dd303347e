"""The manufactured problem: a membrane that is swept along by a flow, with its exact solution.

The square (0, L)^2 is cut by a membrane that starts as the line x_1 = L/2 and moves with y = V t Y(X_2) e_1,
Y(s) = L s - s^2. Left of it the flow is u = V Y(x_2) e_1, p = 0. Right of it

    u = V Y(x_2) e_1 + S (V t Y'(x_2) e_1 + e_2),   S = V (x_1 - L/2 - V t Y(x_2))/L,   p = -DP,

so that u is continuous and solenoidal, equals the membrane's velocity on it, and pressure and velocity gradient jump.
Body forces on both sides and a load on the membrane make this an exact solution of the coupled problem.

In three dimensions the square is extruded by H with one layer of cells and slip on its top and bottom, as in the
source, and norms are per unit depth. Or the membrane is curved and moves differently everywhere, across a cube
(:data:`CURVED`): with G(x_2, x_3, t) its place along x_1, dG/dt = V Y(x_2, x_3) and a plane field (w_2, w_3) without
divergence, the flow on the right is

    u = V Y e_1 + S w,   S = V (x_1 - G)/L,   w = (w_2 dG/dx_2 + w_3 dG/dx_3, w_2, w_3),

which is the above where G = L/2 + V t Y(x_2) and (w_2, w_3) = (1, 0). w is tangential to surfaces of equal S, so that
the traction that jumps at the membrane is DP n + mu |grad S| w.

The flow's equations are the script's: any that solve Navier and Stokes' do.

Source: D. Kamensky, "Open-source immersogeometric analysis of fluid-structure interaction using FEniCS and tIGAr",
section 5.3.1, doi:10.1016/j.camwa.2020.01.023.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import ufl
from mpi4py import MPI

from coudalfish.coupler import CouDALFISh
from coudalfish.problems.courses import CURVED, EXTRUDED, Shape, course, sum_of_products, vector_of
from shnapr.conditions import DeadLoad
from shnapr.shell import Shell
from shnapr.svk import StVenantKirchhoff
from tigar_x import checks, compat
from tigar_x.fem.linear import direct
from tigar_x.geometry import shapes
from tigar_x.geometry.patch import Patch
from tigar_x.run.script import constants
from tigar_x.splines.spline import ExtractedSpline

DOI = "10.1016/j.camwa.2020.01.023"

# Errors of the published code per unit depth, measured with degree-2 quadrature on a one-layer extrusion.
PUBLISHED_CODE = {
    1: {"L2_u": 7.250e-2, "H1_u": 8.918e-1, "L2_p": 3.656, "L2_y": 1.400e-3, "H1_y": 3.665e-2},
    2: {"L2_u": 5.011e-2, "H1_u": 7.499e-1, "L2_p": 8.388e-1, "L2_y": 1.370e-3, "H1_y": 1.907e-2},
    3: {"L2_u": 1.831e-2, "H1_u": 4.068e-1, "L2_p": 1.434e-1, "L2_y": 7.694e-4, "H1_y": 9.562e-3},
    4: {"L2_u": 6.542e-3, "H1_u": 2.428e-1, "L2_p": 8.882e-2, "L2_y": 3.852e-4, "H1_y": 4.776e-3},
}


@dataclass(frozen=True)
class ProblemData:
    """The problem's data; consistent units."""

    L: float = 1.0
    H: float = 0.25
    V: float = 1.0
    DP: float = 1.0
    T: float = 1.0
    mu: float = 0.1
    rho: float = 1.0
    youngs_modulus: float = 1.0
    poisson_ratio: float = 0.3
    thickness: float = 0.3
    rho_s: float = 1.0
    prestress: float = 10.0
    rho_infinity: float = 0.0
    shape: ClassVar[Shape] = EXTRUDED


@dataclass(frozen=True)
class CurvedData(ProblemData):
    """Data of the curved membrane in a cube.

    Attributes:
        rise: of the dome at rest, over the squares of the distances from its top.
    """

    rise: float = 0.2
    shape: ClassVar[Shape] = CURVED


def data_of(d: int, *, curved: bool) -> ProblemData:
    """Data of the published membrane or of the curved one.

    Raises:
        ValueError: the curved one is asked for in the plane.
    """
    if curved and d == 2:
        raise ValueError("curved = True, dim = 2: a membrane that is curved needs dim = 3")
    return CurvedData() if curved else ProblemData()


def exact_flow(x: Any, t: Any, c: Any, *, left: Any = None, shape: Shape = EXTRUDED) -> SimpleNamespace:
    """The flow at a time, in both parts.

    Args:
        x: position, of 2 or 3 components.
        t: time.
        c: the problem's data, as numbers or Constants.
        left: UFL condition that decides which part it is; None: the position.
        shape: of the membrane.

    Returns:
        Velocity ``u``, pressure ``p`` and body force per mass ``f``, each chosen by side, and ``grad_u`` taken side by
        side, without the jump.
    """
    m, none = course(x, t, c, shape), [0.0] * (len(x) - 1)
    S = c.V * (x[0] - m.G) / c.L
    w, w_rate = vector_of(sum_of_products(m.along, m.dG), m.along), vector_of(sum_of_products(m.along, m.dspeed), none)
    u_left = vector_of(m.speed, none)
    u_right = u_left + S * w
    rate_right = S * w_rate - c.V * m.speed / c.L * w
    left = ufl.lt(x[0], m.G) if left is None else left

    def force(u: Any, rate: Any) -> Any:
        return rate + ufl.grad(u) * u - ufl.div(2 * c.mu / c.rho * ufl.sym(ufl.grad(u)))

    f_left, f_right = force(u_left, ufl.zero(len(x))), force(u_right, rate_right)
    return SimpleNamespace(
        u=ufl.conditional(left, u_left, u_right),
        p=ufl.conditional(left, 0.0, -c.DP),
        grad_u=ufl.conditional(left, ufl.grad(u_left), ufl.grad(u_right)),
        f=ufl.conditional(left, f_left, f_right),
    )


def is_left(x: Any, t: Any, c: Any, s: Any, shape: Shape = EXTRUDED) -> Any:
    """UFL condition of the left part on a side of the membrane, whose left one is 1.

    Args:
        x: position.
        t: time.
        c: the problem's data, as numbers or Constants.
        s: side, -1 or 1; where it is 0 the position decides.
        shape: of the membrane.
    """
    by_position = ufl.conditional(ufl.lt(x[0], course(x, t, c, shape).G), 1.0, -1.0)
    return ufl.gt(ufl.conditional(ufl.eq(s, 0.0), by_position, s), 0.0)


def exact_displacement(X: Any, t: Any, c: Any, shape: Shape = EXTRUDED) -> Any:
    """Displacement of the membrane at reference positions X and a time; c and shape as in :func:`exact_flow`."""
    return t * vector_of(course(X, t, c, shape).speed, [0.0] * (len(X) - 1))


def membrane_load(X: Any, t: Any, c: Any, shape: Shape = EXTRUDED) -> Any:
    """Force per reference area that closes the membrane's balance: inertia is zero, stresses and traction are not.

    Args:
        X: reference position on the membrane.
        t: time.
        c: the problem's data, as numbers or Constants.
        shape: of the membrane; parameters of it are the positions across the first axis.
    """
    m = course(X, t, c, shape)
    dG, dG_0, n = ufl.as_vector(m.dG), ufl.as_vector(m.dG_0), len(m.s)
    metric = ufl.Identity(n) + ufl.outer(dG_0, dG_0)
    strain, inverse, J = (ufl.outer(dG, dG) - ufl.outer(dG_0, dG_0)) / 2, ufl.inv(metric), ufl.sqrt(ufl.det(metric))
    stiffness, nu = c.youngs_modulus * c.thickness / (1 - c.poisson_ratio**2), c.poisson_ratio
    raised = inverse * strain
    forces = c.prestress * inverse + stiffness * (nu * ufl.tr(raised) * inverse + (1 - nu) * raised * inverse)
    towards = [[J * forces[i, j] for i in range(n)] for j in range(n)]
    elastic = [
        sum(ufl.diff(sum_of_products(row, factors), s_j) for row, s_j in zip(towards, m.s, strict=True))
        for factors in (m.dG, *([float(i == k) for i in range(n)] for k in range(n)))
    ]
    shear = c.mu * c.V / c.L * (1 + ufl.dot(dG, dG))
    traction = c.DP * vector_of(1.0, [-g for g in m.dG]) + shear * vector_of(sum_of_products(m.along, m.dG), m.along)
    return -(ufl.as_vector(elastic) + traction) / J


def cells_per_side(level: int) -> int:
    """Fluid cells along a side of the square."""
    return 3 * 2 ** checks.whole("level", level, 0)


def elements_per_side(data: ProblemData, level: int) -> int:
    """Elements of the membrane, of a curved one along each side."""
    return 3 * cells_per_side(level) // 2 if data.shape.curved else 2 ** (level + 3)


def walls_with_velocity(data: ProblemData, d: int) -> tuple[str, ...]:
    """Names of the walls on which the flow is given."""
    return ("left", "right", "bottom", "top", *(("back", "front") if d == 3 and data.shape.curved else ()))


def slippery(data: ProblemData, d: int) -> tuple[str, ...]:
    """Names of the walls along which the flow slips, as nothing changes across."""
    return ("back", "front") if d == 3 and not data.shape.curved else ()


def fluid_box(data: ProblemData, d: int, level: int) -> tuple[list[float], list[float], list[int]]:
    """Size of the fluid's mesh at a refinement level.

    Args:
        data: of the problem.
        d: dimension of space, 2 or 3 (one layer, but around a curved membrane a cube).
        level: refinement level.

    Returns:
        Lowest corner, highest corner, and numbers of cells along the axes.
    """
    N, slack = cells_per_side(level), 3e-8 * data.L  # the membrane's ends lie on the boundary: they have to be inside
    sizes, cells = ([data.L] * 3, [N] * 3) if data.shape.curved else ([data.L, data.L, data.H], [N, N, 1])
    return [-slack] * d, [size + slack for size in sizes[:d]], cells[:d]


def membrane(data: ProblemData, d: int, elements: int, *, projected: bool = False) -> Shell:
    """The membrane: fixed ends, no bending; of linear B-splines, which do not move along the direction of an extrusion.

    A curved one is made of quadratic B-splines, moves in all directions, and has the same prestress in both.

    Args:
        data: of the problem.
        d: dimension of space.
        elements: of the line; of a curved one along each side.
        projected: whether the velocity at t = 0 is projected, as in the published code, or interpolated; a projection
            leaves a small one at the ends, which do not move.

    Returns:
        A shell that gets its clock from the flow.
    """
    patch = _patch(data, d, elements)
    held = patch.open_sides if data.shape.curved else ("u0", "u1")
    along = np.arange(2, d * patch.basis.n, 3) if d == 3 and not data.shape.curved else np.arange(0)
    zero_dofs = np.concatenate([*(patch.side_dofs(side) for side in held), along])
    spline = ExtractedSpline(patch, MPI.COMM_SELF, quadrature_degree=4, zero_dofs=zero_dofs)
    c = constants(spline.mesh, data)
    prestress = (c.prestress, c.prestress if data.shape.curved else 0.0, 0.0)
    shell = Shell(
        spline,
        StVenantKirchhoff(
            c.youngs_modulus,
            c.poisson_ratio,
            c.thickness,
            prestress=prestress[:1] if d == 2 else prestress,
            bending=False,
        ),
        density=c.rho_s,
        loads=[DeadLoad(lambda X, t: membrane_load(X, t, c, data.shape))],
        solver=direct("petsc"),
    )
    speed = data.V * data.shape.profile(list(patch.evaluate(patch.basis.greville).T[1:]), data)
    at_points = patch.basis.interpolate(np.outer(speed, np.eye(d)[0]))
    exact = exact_displacement(spline.F, 1.0, c, data.shape)
    shell.start(velocity=spline.free(d).coefficients(spline.project(exact)) if projected else at_points)
    return shell


def _patch(data: ProblemData, d: int, elements: int) -> Patch:
    corner = (data.L / 2, 0.0, 0.0)
    if d == 2:
        return shapes.line(corner[:2], (data.L / 2, data.L), elements=elements)
    if not data.shape.curved:
        sides = ((0.0, data.L, 0.0), (0.0, 0.0, data.H))
        return shapes.parallelogram(corner, *sides, elements=(elements, 1), degrees=(1, 1))

    def position(u: Any, v: Any) -> list[Any]:
        return [data.shape.rest((data.L * u, data.L * v), data), data.L * u, data.L * v]

    return shapes.interpolated(position, shapes.uniform_bases((2, 2), (elements, elements), 2))


def errors(fsi: CouDALFISh, data: ProblemData, t: float, degree: int) -> dict[str, float]:
    """Norms of the errors, of what is extruded per unit depth; the gradient is compared side by side.

    Args:
        fsi: coupled run of this problem; the flow's unknown has d components of the velocity, then the pressure.
        data: of the problem.
        t: time of the present state.
        degree: of the quadrature in the fluid.

    Returns:
        L2 and H1 norms by name.
    """
    domain, spline, sides = fsi.mesh_f, fsi.spline_sh, fsi.fluid.sides
    d, w, x = domain.geometry.dim, fsi.timeInt_f.x, ufl.SpatialCoordinate(domain)
    c, depth = constants(domain, data), 1.0 if d == 2 or data.shape.curved else data.H
    e_y = fsi.timeInt_sh.x - exact_displacement(spline.F, t, constants(spline.mesh, data), data.shape)

    def squares(v: Any, p: Any, left: Any = None) -> list[Any]:
        exact = exact_flow(x, t, c, left=left, shape=data.shape)
        e, grad_e = v - exact.u, ufl.grad(v) - exact.grad_u
        return [ufl.inner(e, e), ufl.inner(grad_e, grad_e), (p - exact.p) ** 2]

    def square_of_side(i: int) -> Any:
        return lambda v, p, s: squares(v, p, is_left(x, t, c, s, data.shape))[i]

    forms = [ufl.inner(f, f) * spline.dx for f in (e_y, spline.grad(e_y))]
    if sides is None:
        dx = ufl.dx(domain=domain, metadata={"quadrature_degree": degree})
        forms = [f * dx for f in squares(ufl.as_vector([w[i] for i in range(d)]), w[d])] + forms
    values = [compat.assemble_scalar(form) for form in compat.compile_forms(*forms)]
    if sides is not None:
        values = [sides.integral(square_of_side(i), degree) for i in range(3)] + values
    names = ("L2_u", "H1_u", "L2_p", "L2_y", "H1_y")
    return {name: (value / depth) ** 0.5 for name, value in zip(names, values, strict=True)}
