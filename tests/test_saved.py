"""Saved extractions come back whole, on any number of ranks, and bad files are named."""

import json
import subprocess
import sys

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from splines import WORLD, integral, quarter

from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.patch import Patch
from tigar_x.ranks import on_root
from tigar_x.splines.constraints import smooth_joints
from tigar_x.splines.saved import load_extraction, save_extraction
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear

pytestmark = pytest.mark.mpi


@pytest.fixture
def folder(tmp_path):
    """One folder for all ranks, below one that has to be made."""
    return WORLD.bcast(tmp_path, root=0) / "kept"


def half(left):
    bases = [BSplineBasis(p, open_knots(p, np.linspace(0, 1, n + 1))) for p, n in ((2, 3), (2, 2))]
    s, t = (g.ravel(order="F") for g in np.meshgrid(*[b.greville for b in bases], indexing="ij"))
    return Patch.from_points(
        bases, np.column_stack([s + (not left), t, 0 * s]), side_names={"wall": (0, int(not left))}
    )


MODELS = {
    "arc": lambda: (quarter(), (), "tensor"),
    "cylinder": lambda: (quarter([(1.0, 0.0), (1.0, 0.5), (1.0, 2.0)]), (), "simplex"),
    "joined": lambda: (m := glued(half(True), half(False)), [smooth_joints(m)], "tensor"),
}


def model(name, comm=WORLD):
    geometry, constraints, cells = MODELS[name]()
    fixed = geometry.side_dofs("u0") if name != "joined" else geometry.side_dofs("wall", patch=0)
    return ExtractedSpline(geometry, comm, cells=cells, quadrature_degree=6, zero_dofs=fixed, constraints=constraints)


def solution(s):
    """Coefficients of a mass-like problem with the spline's conditions."""
    u, v, w = s.function(), ufl.TestFunction(s.V), s.rationalize
    f = ufl.as_vector([1.0 + s.F[0] ** 2, *([s.F[1]] * (s.nsd - 1))])
    R = (ufl.inner(w(u), w(v)) + ufl.inner(s.grad(w(u)), s.grad(w(v))) - ufl.inner(f, w(v))) * s.dx
    solve_linear(SplineSystem(s, R, ufl.derivative(R, u), unknown=u))
    return s.vector.coefficients(u)


@pytest.mark.parametrize("name", MODELS)
def test_round_trip(name, folder):
    s = model(name)
    save_extraction(folder / "shell.npz", s)
    WORLD.barrier()
    loaded = load_extraction(folder / "shell.npz")
    np.testing.assert_array_equal(loaded.geometry.control, s.geometry.control)
    np.testing.assert_array_equal(loaded.zero_dofs, s.zero_dofs)
    assert loaded.quadrature_degree == 6
    assert loaded.vector.M.size == s.vector.M.size
    size = integral(1.0 * s.dx)
    assert integral(1.0 * loaded.dx) == pytest.approx(size, rel=1e-14)
    assert integral(1.0 * loaded.ds("u0")) == pytest.approx(integral(1.0 * s.ds("u0")), rel=1e-13)
    np.testing.assert_allclose(solution(loaded), solution(s), rtol=0, atol=1e-13)
    if name == "joined":
        np.testing.assert_array_equal(loaded.geometry.side_functions(1, 0, 1), s.geometry.side("wall", patch=1))


@pytest.mark.parametrize("name", MODELS)
def test_a_file_of_one_rank_is_read_on_all_and_the_other_way_round(name, folder):
    expected = solution(model(name, MPI.COMM_SELF))
    save_extraction(folder / "alone.npz", model(name, MPI.COMM_SELF))
    save_extraction(folder / "together.npz", model(name))
    WORLD.barrier()
    np.testing.assert_allclose(solution(load_extraction(folder / "alone.npz")), expected, rtol=0, atol=1e-12)
    again = load_extraction(folder / "together.npz", MPI.COMM_SELF)
    np.testing.assert_allclose(solution(again), expected, rtol=0, atol=1e-12)


def test_what_is_not_saved_is_refused(folder):
    save_extraction(folder / "shell.npz", model("arc"))
    WORLD.barrier()
    s = load_extraction(folder / "shell.npz")
    with pytest.raises(ValueError, match=r"points\[0\] is no node"):
        s.geometry.functions.evaluate(np.array([[0.123]]))
    with pytest.raises(ValueError, match="a saved extraction has fields of its own functions only"):
        s.space((quarter().functions, 1))
    with pytest.raises(ValueError, match="cells = 'simplex'"):
        ExtractedSpline(s.geometry, cells="simplex")
    with pytest.raises(ValueError, match="layers = 2"):
        s.geometry.side_functions(0, 0, 0, layers=2)
    with pytest.raises(ValueError, match="name = 'rim': one of 'u0', 'u1'"):
        s.ds("rim")


def spoil(path, how):
    """A damaged copy of a saved extraction."""
    content = path.read_bytes()
    if how == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif how == "text":
        path.write_text("3\n2 2\n")
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "array":
        with path.open("wb") as file:
            np.save(file, np.ones(3))
    elif how == "damaged":  # in the middle of a compressed array
        path.write_bytes(content[:400] + bytes(64) + content[464:])
    else:
        data = dict(np.load(path))
        if how == "format":
            record = json.loads(str(data["record"])) | {"format": 99}
            data["record"] = np.array(json.dumps(record))
        elif how == "record":
            data["record"] = np.array("[1, 2")
        elif how == "list":
            data["record"] = np.array("[1, 2]")
        elif how == "missing":
            del data["control"]
        elif how == "rows":
            data["M_row"] = data["M_row"] + 10**6
        np.savez(path, **data)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("truncated", "not a saved extraction, or a truncated one"),
        ("text", "not a saved extraction, or a truncated one"),
        ("empty", "not a saved extraction, or a truncated one"),
        ("array", "not a saved extraction, or a truncated one"),
        ("damaged", "not a saved extraction, or a truncated one"),
        ("record", "not a saved extraction: its record is none"),
        ("list", "not a saved extraction: its record is none"),
        ("format", "format 99 was found, 1 is required"),
        ("missing", "control missing"),
        ("rows", "do not fit together"),
    ],
)
def test_damaged_files_are_named(how, message, tmp_path):
    path = WORLD.bcast(tmp_path) / "shell.npz"
    save_extraction(path, model("arc", MPI.COMM_SELF))
    on_root(WORLD, lambda: spoil(path, how))
    for comm in (MPI.COMM_SELF, WORLD):
        with pytest.raises(ValueError, match=message) as error:
            load_extraction(path, comm)
        assert str(path) in str(error.value)


def test_missing_file():
    with pytest.raises(FileNotFoundError, match=r"nowhere\.npz: there is no such file"):
        load_extraction("nowhere.npz")


@pytest.mark.skipif(WORLD.size > 1, reason="starts a process of one rank")
def test_nothing_of_the_generator_is_needed(tmp_path):
    """Another process, which makes no patch, integrates over what the file holds."""
    path = tmp_path / "shell.npz"
    save_extraction(path, model("cylinder", MPI.COMM_SELF))
    program = (
        "import sys; from mpi4py import MPI\n"
        "from tigar_x import compat; from tigar_x.splines.saved import load_extraction\n"
        f"s = load_extraction({str(path)!r}, MPI.COMM_SELF)\n"
        "print(compat.assemble_scalar(compat.compile_forms(1.0 * s.dx)[0]))\n"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert float(shown) == pytest.approx(np.pi, rel=1e-6)
