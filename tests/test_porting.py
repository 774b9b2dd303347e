"""The code in the documents runs as printed, with what the text says is given."""

import os
from pathlib import Path

import numpy as np
import pytest
from documents import DOCUMENTS, blocks

SKIPPED = "python legacy"
"""Marks a block of a legacy library, which nothing here can run."""

LOADS = """
import ufl
from mpi4py import MPI
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.splines.spline import ExtractedSpline

spline = ExtractedSpline(shapes.line((0, 0), (0, 1), elements=2, degree=2), MPI.COMM_SELF)
time, z = TimeIntegrator(spline.function(), 0.1, generalized_alpha(0.5, 2)), ufl.TestFunction(spline.V)
residual, P, c, rho_s, h = 0 * z[0] * spline.dx, 1.0, 2.0, 3.0, 0.1
"""

LOOP = """
import logging
from pathlib import Path

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from shnapr.supports import clamped
from shnapr.svk import StVenantKirchhoff
from tigar_x import compat
from tigar_x.geometry import shapes
from tigar_x.splines.spline import ExtractedSpline
from varmint.forms.space import equal_order_space
from varmint import box

log, out, n_steps, dt = logging.getLogger("script"), Path("loop"), 2, 0.05
rho, mu, rho_s, thickness = 1.0, 0.1, 1.0, 0.05
named = box(MPI.COMM_WORLD, (0, 0), (2, 1), (16, 8))
mesh_f, ds = named.domain, named.ds("left", "right", "bottom", "top", degree=2)
V = equal_order_space(mesh_f)
w = fem.Function(V, name="w")
pin = compat.pin_component(V, 2, lambda x: np.abs(x).max(axis=0) < 1e-9)
x = ufl.SpatialCoordinate(mesh_f)
inflow = lambda t: ufl.as_vector([6 * x[1] * (1 - x[1]) * t, 0])
line = shapes.line((1, 0.005), (1, 0.6), elements=8, degree=2)
spline_sh = ExtractedSpline(line, MPI.COMM_SELF, zero_dofs=clamped(line, "u0"))
material = StVenantKirchhoff(1e4, 0.4, thickness)
"""

GIVEN = {"residual += follower_pressure": LOADS, "timeInt_f = TimeIntegrator": LOOP}
"""What a block takes for granted, by a line of it."""


@pytest.fixture
def names_of(tmp_path, monkeypatch):
    """Names that the blocks of a document leave, run one after the other in a folder of its own."""

    def run(name):
        (document,) = (path for path in DOCUMENTS if path.name == name)
        codes, names = [code for language, code in blocks(document) if language == "python"], {}
        assert codes
        monkeypatch.chdir(tmp_path)
        for code in codes:
            for line, given in GIVEN.items():
                if line in code:
                    exec(compile(given, f"given to {name}", "exec"), names)
            exec(compile(code, name, "exec"), names)
        return names

    return run


def test_every_block_says_what_it_is():
    """Python that is run, Python of a legacy library, commands, or data."""
    for document in DOCUMENTS:
        for language, _ in blocks(document):
            assert language in ("python", SKIPPED, "sh", "text", ""), f"{document.name}: {language!r}"


def test_porting_runs_as_printed(names_of):
    names = names_of("porting.md")
    assert names["sinks"] == pytest.approx(0.3006, rel=1e-3)
    assert names["by_hand"] == pytest.approx(names["sinks"], rel=1e-9)
    assert names["report"].t > 0.0
    assert np.abs(names["spline_sh"].nodal(names["timeInt_sh"].x)).max() > 0.0
    for left in ("results/roof.pvd", "results/leaflet.pvd", "loop/fluid.vtkhdf", "loop/shell.pvd", "loop/history.csv"):
        assert Path(left).exists(), os.listdir()


def test_a_flow_in_a_script_runs_as_printed(names_of):
    """Poiseuille's flow but near the outlet, whose traction vanishes with the shear: p falls by 8 mu a length."""
    names = names_of("flow.md")
    center, friction = names["center"], names["run"].history["friction_1"]
    np.testing.assert_allclose(center[:2], (1.0, 0.0), atol=1e-3)
    assert center[2] == pytest.approx(0.8, rel=0.05)
    assert len(friction) == 10
    assert friction[-1] == pytest.approx(0.4 * 2.0, rel=0.2)  # mu du/dy times the length, less near the outlet
    for left in ("flow.vtkhdf", "history.csv", "channel.png", "flow.gif", "flow.png"):
        assert Path("results/channel", left).exists()


def test_a_shell_in_a_script_runs_as_printed(names_of):
    """P L^2/(E I) = 4: U = 0.329 L, W = 0.670 L (doi:10.1016/j.finel.2003.11.001), and the support takes the load."""
    names = names_of("shells.md")
    np.testing.assert_allclose(names["tip"], (-0.329, 0.670), atol=5e-3)
    np.testing.assert_allclose(names["shell"].support_force(), (0.0, -0.4), atol=1e-6)
    assert names["frequencies"].shape == (2,)
