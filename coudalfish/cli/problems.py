"""Small problems with known answers: splines, a shell, a flow, both coupled, and that on two ranks."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from coudalfish.cli.environment import outside_of_mpi
from coudalfish.cli.verdict import FaultError, RemarkError
from coudalfish.coupler import CouDALFISh
from shnapr.conditions import DeadLoad
from shnapr.shell import Shell
from shnapr.svk import StVenantKirchhoff
from tigar_x import compat
from tigar_x.geometry import shapes
from tigar_x.splines.spline import ExtractedSpline
from varmint.conditions import Velocity
from varmint.flow import Flow, FlowOptions
from varmint.mesh import box
from varmint.quantities import BoundaryForce

COMPARE = "compare with what `make test` says; if it fails as well, the installation is not sound, else report it"
MU, DT = 0.1, 0.1
PATIENCE = 300
"""Seconds that two ranks may take."""


def _must(holds: bool, what: str) -> None:
    if not holds:
        raise FaultError(what, COMPARE)


def extraction() -> str:
    """Spline functions add up to one, and projections converge as theory says."""
    errors = []
    for elements in (4, 8, 16):
        line = shapes.line((0.0, 0.0), (1.0, 0.5), elements=elements, degree=2)
        spline = ExtractedSpline(line, MPI.COMM_SELF)
        ones, sums = spline.M.createVecs()
        ones.set(1.0)
        spline.M.mult(ones, sums)
        off = float(np.abs(sums.array_r - 1.0).max())
        _must(off < 1e-12, f"the functions of a spline do not add up to one: {1 + off:.6g}")
        exact = ufl.sin(3 * spline.F[0])
        (form,) = compat.compile_forms((spline.project(exact) - exact) ** 2 * spline.dx)
        errors.append(compat.assemble_scalar(form) ** 0.5)
    rate = float(np.log2(errors[-2] / errors[-1]))
    _must(2.7 < rate < 3.3, f"projections onto quadratic splines converge with order {rate:.2f} instead of 3")
    return f"functions add up to one; projections converge with order {rate:.2f} (theory: 3)"


def shell() -> str:
    """A clamped strip under a small load bends as a beam."""
    load, length, modulus, nu, thickness = 1e-4, 1.0, 1e3, 0.3, 0.1
    strip = Shell(
        shapes.line((0.0, 0.0), (length, 0.0), elements=4, degree=4),
        StVenantKirchhoff(modulus, nu, thickness),
        clamped=("u0",),
        loads=[DeadLoad((0.0, -load))],
    )
    strip.solve()
    found = float(strip.at("u1").displacement.ravel()[-1])
    stiffness = modulus * thickness**3 / 12 / (1 - nu**2)
    known = -load * length**4 / (8 * stiffness)
    _must(
        abs(found - known) < 1e-5 * abs(known), f"the tip of a clamped strip moves by {found:.6g}, not by {known:.6g}"
    )
    return f"a clamped strip under load: its tip moves by {found:.6g} (theory: {known:.6g})"


def _shear() -> Flow:
    """Flow between plates 0 < y < 1 with the velocity y, in a box of length 2."""
    channel = box(MPI.COMM_WORLD, (0, 0), (2, 1), (16, 8))

    def velocity(x: Any, t: Any) -> Any:
        return ufl.as_vector([x[1], 0.0 * x[0]])

    walls = [Velocity(("left", "right", "bottom", "top"), velocity)]
    flow = Flow(channel, walls, rho=1.0, mu=MU, dt=DT, immersed="plain", options=FlowOptions(pressure="pin"))
    flow.start(velocity)
    return flow


def flow() -> str:
    """The force of a shear flow on the plate that moves."""
    sheared = _shear()
    drag = float(sheared.take_step(measure=BoundaryForce(sheared, "top")).measured[0])
    known = -2.0 * MU
    _must(abs(drag - known) < 1e-6, f"the force of a shear flow on a plate is {drag:.6g}, not {known:.6g}")
    return f"the force of a shear flow on a plate: {drag:.6g} (theory: {known:.6g})"


def flap() -> dict[str, Any]:
    """Three steps of an elastic flap in the shear flow (collective).

    Returns:
        Displacement of its tip, force on it, and how far the forces are from balance.
    """
    line = shapes.line((0.95, 0.0), (0.95, 0.6), elements=8, degree=2)
    elastic = Shell(line, StVenantKirchhoff(1e4, 0.3, 0.03), density=1.0, clamped=("u0",))
    fsi = CouDALFISh(_shear(), elastic)
    monitors = [fsi.takeStep().monitors for _ in range(3)]
    return {
        "tip": elastic.at("u1").displacement.ravel().tolist(),
        "force": [float(value) for one in monitors if one is not None for value in one.force],
        "imbalance": max(one.force_imbalance for one in monitors if one is not None),
    }


def coupled() -> str:
    """A flap bends with the flow, and what it takes from the fluid is what it gets."""
    found = flap()
    x, off = found["tip"][0], found["imbalance"]
    _must(0.01 < x < 0.6, f"a flap in a flow is moved by {x:.3g}: between 0.01 and 0.6 is expected, with the flow")
    _must(off < 1e-10, f"the fluid's force on a flap and the flap's on the fluid differ by {off:.1e} of their size")
    return f"a flap bends with the flow by {x:.3g}; forces balance to {off:.0e}"


def two_ranks() -> str:
    """The same flap on two ranks."""
    if MPI.COMM_WORLD.size > 1:
        return f"everything above was done on {MPI.COMM_WORLD.size} ranks"
    mpirun = shutil.which("mpirun", path=str(Path(sys.executable).parent)) or shutil.which("mpirun")
    if mpirun is None:
        raise RemarkError("mpirun is not there: runs use one processor")
    environment = outside_of_mpi() | {"OMP_NUM_THREADS": "1"}
    options = []
    if "Open MPI" in MPI.Get_library_version():
        options = ["--oversubscribe"]
        if os.geteuid() == 0:  # which it would refuse
            environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    command = [mpirun, "-n", "2", *options, sys.executable, "-m", "coudalfish.cli.problems"]
    advice = f"try `{' '.join(command)}`; mpirun has to belong to the MPI library of mpi4py"
    try:
        result = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=PATIENCE)
        other = json.loads(result.stdout.splitlines()[-1])
    except subprocess.TimeoutExpired:
        raise FaultError(f"a flap on two ranks takes more than {PATIENCE} s", advice) from None
    except (IndexError, ValueError):
        lines = [line for line in result.stderr.splitlines() if line.strip()]
        raise FaultError(f"two ranks fail: {(lines or ['they end without a word'])[-1]}", advice) from None
    if other["ranks"] != 2:
        raise FaultError(f"mpirun starts {other['ranks']} rank twice instead of two ranks", advice)
    alone = flap()
    off = np.abs(np.subtract(other["force"], alone["force"])).max() / np.abs(alone["force"]).max()
    _must(bool(off < 1e-6), f"forces on a flap differ by {off:.1e} between one rank and two")
    return f"forces on the flap are the same to {max(off, 1e-16):.0e}"


if __name__ == "__main__":
    result = json.dumps({"ranks": MPI.COMM_WORLD.size, **flap()})
    if MPI.COMM_WORLD.rank == 0:
        sys.stdout.write(result + "\n")
