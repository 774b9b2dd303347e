"""The main job: errors, orders, memory and rank-independence of the manufactured fluid-membrane problem."""

from dataclasses import replace

import breakdown
import numpy as np
import pytest
import ufl
from mpi4py import MPI
from load import load_demo
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives

from coudalfish import CouplingOptions, PenaltyRule
from coudalfish.problems import manufactured as problem
from tigar_x import compat, script

DEMO = load_demo("manufactured")
NORMS = ("L2_u", "H1_u", "L2_p", "L2_y", "H1_y")
CURVED_SHARP = {"L2_u": 3.174e-3, "H1_u": 0.2169, "L2_p": 0.03163, "L2_y": 2.068e-4}
"""True errors of level 2 with twice the time step."""

# Errors of an independent implementation of the published algorithm in the plane, with degree-2 quadrature in the fluid
# and the membrane's initial velocity projected (as published) or interpolated.
PUBLISHED = {
    ("projected", 1): (7.620e-2, 0.9204, 2.665, 1.381e-3, 3.644e-2),
    ("projected", 2): (5.330e-2, 0.7927, 0.7787, 1.387e-3, 1.911e-2),
    ("projected", 3): (1.909e-2, 0.4193, 0.1416, 7.681e-4, 9.548e-3),
    ("projected", 4): (6.714e-3, 0.2491, 0.0863, 3.767e-4, 4.762e-3),
    ("interpolated", 1): (7.910e-2, 0.9329, 2.604, 2.064e-3, 3.667e-2),
    ("interpolated", 2): (5.831e-2, 0.8743, 0.5489, 1.467e-3, 1.924e-2),
    ("interpolated", 3): (1.910e-2, 0.4201, 0.1412, 7.636e-4, 9.526e-3),
    ("interpolated", 4): (6.730e-3, 0.2494, 0.0861, 3.757e-4, 4.755e-3),
}


def fitted_orders(summaries):
    """Orders in h of the true errors by least squares over all given levels."""
    log_h = [-s["inputs"]["level"] * np.log(2.0) for s in summaries]
    return {n: np.polyfit(log_h, np.log([s["errors_true"][n] for s in summaries]), 1)[0] for n in NORMS}


@pytest.mark.parametrize(("start", "level"), PUBLISHED)
def test_reference_preset_reproduces_the_published_algorithm(start, level, tmp_path):
    summary = DEMO.main(level=level, preset="reference", initial_velocity=start, out=tmp_path, viz=False)
    for norm, published in zip(NORMS, PUBLISHED[start, level], strict=True):
        assert summary["errors"][norm] == pytest.approx(published, rel=0.01), norm
    assert 2.5 <= summary["block_iterations_mean"] <= 3.1


def test_the_preset_is_the_best_that_there_is(tmp_path):
    """Sharp in the plane, and a pressure that jumps in space, where sharp is more accurate as well."""
    chosen = {d: DEMO.main(dim=d, level=0, out=tmp_path / str(d), viz=False)["inputs"] for d in (2, 3)}
    assert [chosen[d]["preset"] for d in (2, 3)] == ["sharp", "jump"]
    assert [chosen[d]["options"]["multiplier"] for d in (2, 3)] == ["converged", "converged"]
    errors = {p: DEMO.main(dim=3, level=0, preset=p, out=tmp_path / p, viz=False)["errors"] for p in ("plain", "sharp")}
    assert errors["sharp"]["L2_u"] < 0.55 * errors["plain"]["L2_u"]
    assert errors["sharp"]["H1_u"] < 0.6 * errors["plain"]["H1_u"]
    assert errors["sharp"]["L2_p"] < 0.1 * errors["plain"]["L2_p"]


def curved(level, preset, tmp_path):
    """The curved membrane across a cube, with twice the time step."""
    return DEMO.main(
        dim=3, curved=True, level=level, preset=preset, dt_factor=2.0, out=tmp_path / str(level), viz=False
    )


def test_a_curved_membrane_in_space_with_sharp_fields_has_errors_of_order_two_and_one(tmp_path):
    coarse, fine = (curved(level, "sharp", tmp_path) for level in (1, 2))
    for norm, order in {"L2_u": 1.8, "H1_u": 0.9, "L2_p": 1.5, "L2_y": 1.8}.items():
        assert np.log2(coarse["errors_true"][norm] / fine["errors_true"][norm]) > order, norm
    for norm, expected in CURVED_SHARP.items():
        assert fine["errors_true"][norm] == pytest.approx(expected, rel=0.03), norm
    assert fine["block_iterations_max"] == 1
    assert fine["monitors"]["force_imbalance_max"] < 1e-13


def test_sharp_preset_has_errors_of_order_two_and_one(tmp_path):
    coarse, fine = (DEMO.main(level=k, preset="sharp", out=tmp_path / str(k), viz=False) for k in (2, 3))
    for norm, expected in {"L2_u": 4.42e-4, "H1_u": 0.0509, "L2_p": 2.51e-3, "L2_y": 2.58e-5}.items():
        assert fine["errors_true"][norm] == pytest.approx(expected, rel=0.03), norm
    for norm, order in {"L2_u": 1.8, "H1_u": 0.95, "L2_p": 1.4, "L2_y": 1.9}.items():
        assert np.log2(coarse["errors_true"][norm] / fine["errors_true"][norm]) > order, norm
    assert fine["block_iterations_max"] == 1


@pytest.mark.parametrize("level", [1, 2, 3, 4])
def test_one_layer_reference_equals_the_published_code(level, tmp_path):
    """Same equations, same mesh, same stopping test: the same errors, in three passes a step."""
    summary = DEMO.main(dim=3, level=level, preset="reference", out=tmp_path, viz=False)
    for norm, published in problem.PUBLISHED_CODE[level].items():
        assert summary["errors"][norm] == pytest.approx(published, rel=2e-3), norm
    assert summary["block_iterations_mean"] == pytest.approx(3.0, abs=0.1)


def odd_orders(dim, relaxation):
    """Orders between levels 3 and 4 of the reference with no parameter equal to one or zero."""
    data = problem.ProblemData(L=1.3, H=0.4, V=0.8, DP=2.0, mu=0.07, rho=1.6, rho_s=2.5, rho_infinity=0.5)
    penalty = PenaltyRule(1.7, 0.0)
    options = replace(CouplingOptions.reference(), penalty=penalty, relaxation=relaxation, scale_m=1e-2, scale_c=1e-2)
    errors = []
    for level in (3, 4):
        steps = 2 * problem.cells_per_side(level)
        *_, fsi = DEMO.build(dim, level, steps, options, projected=True, data=data)
        for _ in range(steps):
            fsi.takeStep()
        errors.append(problem.errors(fsi, data, data.T, 8))
    return {norm: np.log2(errors[0][norm] / errors[1][norm]) for norm in NORMS}


@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_orders_survive_other_data(dim):
    orders = odd_orders(dim, relaxation=0.0)
    assert orders["L2_u"] >= 1.3
    assert orders["H1_u"] >= 0.6
    assert orders["L2_y"] >= 0.9
    assert orders["H1_y"] >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_a_relaxed_multiplier_leaks_but_keeps_the_orders_of_the_flow(dim):
    """The leak r lam/beta of first order takes over the membrane's error."""
    orders = odd_orders(dim, relaxation=0.02)
    assert orders["L2_u"] >= 1.0
    assert orders["H1_u"] >= 0.5
    assert orders["L2_y"] >= 0.3


def test_plain_preset_converges(tmp_path):
    """With dt proportional to h over levels 2 to 5, and below the published code's errors at level 4 in every norm."""
    summaries = [DEMO.main(level=n, preset="plain", out=tmp_path / str(n), viz=False) for n in (2, 3, 4, 5)]
    orders = fitted_orders(summaries)
    assert orders["H1_u"] >= 0.5
    assert orders["L2_u"] >= 1.0
    assert orders["L2_y"] >= 0.9
    published = problem.PUBLISHED_CODE[4]
    assert all(summaries[2]["errors"][norm] < published[norm] for norm in NORMS)
    assert summaries[3]["errors"]["H1_u"] < 0.12
    assert all(s["monitors"]["force_imbalance_max"] < 1e-12 for s in summaries)
    assert summaries[3]["rss_mib_end"] - summaries[3]["rss_mib_step_10"] < 4.0


@pytest.mark.slow
def test_reference_preset_converges(tmp_path):
    summaries = [
        DEMO.main(level=level, preset="reference", out=tmp_path / str(level), viz=False) for level in (2, 3, 4, 5)
    ]
    orders = fitted_orders(summaries)
    assert orders["H1_u"] >= 0.5
    assert orders["L2_u"] >= 1.4
    assert orders["L2_y"] >= 0.9


def test_the_load_of_the_published_membrane_is_that_of_its_equation():
    """It was derived by hand, with T = prestress + K (V t Y')^2 / 2 along the membrane."""
    c, t, X = problem.ProblemData(L=1.3, V=0.8, DP=2.0, mu=0.07, poisson_ratio=0.2), 0.7, (0.65, 0.4, 0.1)
    slope, bend, K = c.V * t * (c.L - 2 * X[1]), -2.0 * c.V * t, c.youngs_modulus * c.thickness / (1 - 0.2**2)
    shear = c.mu * c.V / c.L * (1 + slope**2)
    along_x_1 = (c.prestress + 1.5 * K * slope**2) * bend + c.DP + shear * slope
    expected = [-along_x_1, -K * slope * bend + c.DP * slope - shear, 0.0]
    for d in (2, 3):
        load = problem.membrane_load(ufl.as_vector(X[:d]), t, c)
        assert number(load) == pytest.approx(expected[:d], rel=1e-12)


def number(vector):
    """Values of a vector without fields."""
    found = apply_derivatives(apply_algebra_lowering(vector))
    return [float(found[i]) for i in range(len(found))]


def test_the_curved_membrane_alone_is_where_its_load_wants_it():
    """Without a flow, with the order of quadratic splines; the load was derived from strains, not from virtual work."""
    data, errors = problem.CurvedData(L=1.3, V=0.8, DP=0.0, mu=0.0, poisson_ratio=0.2, prestress=2.0, rise=0.3), []
    for elements in (4, 8):
        shell = problem.membrane(data, 3, elements)
        shell.solve()
        c = script.constants(shell.spline.mesh, data)
        e = shell.y - problem.exact_displacement(shell.spline.F, 1.0, c, problem.CURVED)
        square = compat.assemble_scalar(compat.compile_forms(ufl.inner(e, e) * shell.spline.dx)[0])
        errors.append(square**0.5)
    assert errors[1] < 2e-3
    assert np.log2(errors[0] / errors[1]) > 2.7


def test_a_wrong_body_force_does_not_converge(tmp_path, monkeypatch):
    """The same bounds fail when the flow is driven by another force: the convergence test can tell."""
    right = problem.exact_flow

    def wrong(x, t, c, **which):
        exact = right(x, t, c, **which)
        exact.f = exact.f + 5.0 * ufl.as_vector([x[1], -x[0]])
        return exact

    monkeypatch.setattr(problem, "exact_flow", wrong)
    summaries = [DEMO.main(level=n, preset="plain", out=tmp_path / str(n), viz=False) for n in (2, 3, 4)]
    orders = fitted_orders(summaries)
    assert orders["L2_u"] < 0.5
    assert orders["L2_y"] < 0.5
    assert summaries[2]["errors"]["L2_u"] > 5 * problem.PUBLISHED_CODE[4]["L2_u"]


@pytest.mark.slow
def test_a_curved_membrane_with_a_pressure_that_jumps_is_between_plain_and_sharp_ones(tmp_path):
    """Orders in L2 and H1 of the velocity: 1.1 and .6 with plain fields, 1.2 and .7 with "jump", 2 and 1 with sharp."""
    found = {p: [curved(level, p, tmp_path / p) for level in (2, 3)] for p in ("plain", "jump", "sharp")}
    errors = {p: {n: [s["errors_true"][n] for s in found[p]] for n in NORMS} for p in found}
    for norm in ("L2_u", "H1_u", "L2_p"):
        for coarse_or_fine in (0, 1):
            plain, jump, sharp = (errors[p][norm][coarse_or_fine] for p in found)
            assert sharp < jump < plain, norm
    for norm, order in {"L2_u": 1.9, "H1_u": 0.95, "L2_p": 0.9, "L2_y": 1.8}.items():
        assert np.log2(np.divide(*errors["sharp"][norm])) > order, norm
    assert np.log2(np.divide(*errors["jump"]["H1_u"])) > 0.6
    assert max(s["block_iterations_max"] for p in ("jump", "sharp") for s in found[p]) == 1


@pytest.mark.mpi
def test_every_number_of_ranks_gives_the_same_errors_of_a_curved_membrane(tmp_path, monkeypatch):
    """With sharp fields and tight blocks; a single pass leaves 5e-5 of the error of the pressure."""

    class Tight(CouplingOptions):
        @classmethod
        def sharp(cls):
            return CouplingOptions.sharp(block_rtol=1e-9, block_atol=1e-13)

    monkeypatch.setattr(DEMO, "CouplingOptions", Tight)
    options = {"level": 1, "preset": "sharp", "dt_factor": 4.0, "viz": False}
    parallel = DEMO.main(dim=3, curved=True, out=tmp_path, **options)["errors"]
    monkeypatch.setattr(DEMO, "MPI", SelfOnly)
    alone = DEMO.main(dim=3, curved=True, out=tmp_path / "alone", **options)["errors"]
    for norm in NORMS:
        assert parallel[norm] == pytest.approx(alone[norm], rel=1e-7), norm


@pytest.mark.mpi
@pytest.mark.parametrize("dim", [2, 3])
def test_every_number_of_ranks_gives_the_same_errors(dim, tmp_path, monkeypatch):
    """With direct solves and tight blocks the errors do not depend on the ranks; the figures are those of one rank."""

    class Tight:
        reference, sharp, converged = CouplingOptions.reference, CouplingOptions.sharp, CouplingOptions.converged

        def __new__(cls):
            return CouplingOptions(block_rtol=1e-11, block_atol=1e-14)

    monkeypatch.setattr(DEMO, "CouplingOptions", Tight)
    parallel = DEMO.main(dim=dim, level=1, preset="plain", out=tmp_path, viz=False)["errors"]
    monkeypatch.setattr(DEMO, "MPI", SelfOnly)
    alone = DEMO.main(dim=dim, level=1, preset="plain", out=tmp_path / "alone", viz=False)["errors"]
    for norm in NORMS:
        assert parallel[norm] == pytest.approx(alone[norm], rel=1e-8), norm


class SelfOnly:
    """Stands for mpi4py.MPI with a world of one rank, so that every rank computes the whole problem."""

    COMM_WORLD = COMM_SELF = MPI.COMM_SELF


@pytest.mark.parametrize("preset", ["reference", "plain"])
def test_the_profile_of_a_step_finds_all_its_parts(preset, tmp_path):
    """They are found by files and names of functions, which may change."""
    found = breakdown.main(level=1, preset=preset, steps=2, out=tmp_path)["shares"]
    assert set(found) == {*breakdown.PARTS, "the rest"}
    assert all(found[part] > 0.0 for part in breakdown.PARTS)
    assert sum(found.values()) == pytest.approx(1.0)
