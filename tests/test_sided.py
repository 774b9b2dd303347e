"""Flows whose pressure jumps and whose velocity is kinked at an immersed curve."""

import pytest
import ufl
from mpi4py import MPI

from coudalfish import CouDALFISh, CouplingOptions
from coudalfish.problems import manufactured as problem
from tigar_x import compat, generalized_alpha
from tigar_x.run import script
from varmint import Flow, FlowOptions, Resistance, WeakVelocity, box
from varmint.errors import integral_by_sides

pytestmark = pytest.mark.mpi
SIDES = ("left", "right", "bottom", "top")
FINAL = {"trace": "exact", "multiplier_direction": "vector", "fluid_tangent": "consistent"}


def membrane(immersed, level=2, **options):
    """The manufactured problem before its first step."""
    data = problem.ProblemData()
    mesh = box(MPI.COMM_WORLD, *problem.fluid_box(data, 2, level))
    c = script.constants(mesh.domain, data)

    def exact(name):
        return lambda x, t: getattr(problem.exact_flow(x, t, c), name)

    flow = Flow(
        mesh, WeakVelocity(SIDES, exact("u")), rho=c.rho, mu=c.mu, f=exact("f"),
        dt=0.5 / problem.cells_per_side(level), scheme=generalized_alpha(data.rho_infinity), immersed=immersed,
        options=FlowOptions(pin_at=[0.0, 0.0]),
    )  # fmt: skip
    flow.start(exact("u"), exact("p"), projected=True)
    shell = problem.membrane(data, 2, 2 ** (level + 3))
    return flow, CouDALFISh(flow, shell, CouplingOptions.converged(**FINAL | options), multiplier=data.DP)


def test_the_membrane_has_the_errors_of_fields_that_jump_and_bend():
    flow, fsi = membrane("jump and kink")
    reports = [fsi.takeStep() for _ in range(24)]
    assert max(report.passes for report in reports) == 1
    assert max(abs(report.monitors.leak) for report in reports) < 1e-6
    found = errors(flow, fsi)
    for name, limit in {"L2_u": 1.9e-3, "H1_u": 0.112, "L2_p": 8e-3, "L2_y": 1.25e-4}.items():
        assert 0.5 * limit < found[name] < limit, (name, found)


def errors(flow, fsi):
    """Norms of errors at the end, side by side."""
    data, domain = problem.ProblemData(), flow.mesh.domain
    c, t = script.constants(domain, data), compat.Constant(domain, fsi.timeInt_f.time)
    x = ufl.SpatialCoordinate(domain)

    def exact(s):
        by_place = ufl.lt(x[0], c.L / 2 + c.V * t * (c.L * x[1] - x[1] ** 2))
        side = ufl.conditional(by_place, 1.0, -1.0)  # normals point to the left
        return problem.exact_flow(x, t, c, left=ufl.gt(ufl.conditional(ufl.eq(s, 0.0), side, s), 0.0))

    squares = {
        "L2_u": lambda v, p, s: ufl.inner(v - exact(s).u, v - exact(s).u),
        "H1_u": lambda v, p, s: ufl.inner(ufl.grad(v) - exact(s).grad_u, ufl.grad(v) - exact(s).grad_u),
        "L2_p": lambda v, p, s: (p - exact(s).p) ** 2,
    }
    result = {name: integral_by_sides(flow, square) ** 0.5 for name, square in squares.items()}
    spline = fsi.spline_sh
    e_y = fsi.timeInt_sh.x - problem.exact_displacement(
        spline.F, fsi.timeInt_f.time, script.constants(spline.mesh, data)
    )
    (form,) = compat.compile_forms(ufl.inner(e_y, e_y) * spline.dx)
    return result | {"L2_y": compat.assemble_scalar(form) ** 0.5}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": None}, "dt = None"),
        ({"degree": 2}, "degree = 2"),
        ({"cell": "quadrilateral"}, "triangles in the plane"),
        ({"conditions": Resistance(SIDES, resistance=1.0)}, "no Resistance"),
        ({"immersed": "kink"}, "immersed"),
    ],
)
def test_what_cannot_differ_on_both_sides_is_refused(change, message):
    given = {"conditions": WeakVelocity(SIDES), "rho": 1.0, "mu": 0.1, "dt": 0.1, "immersed": "jump and kink"} | change
    mesh = box(MPI.COMM_WORLD, (0.0, 0.0), (1.0, 1.0), (3, 3), given.pop("cell", None))
    with pytest.raises(ValueError, match=message):
        Flow(mesh, given.pop("conditions"), **given)
