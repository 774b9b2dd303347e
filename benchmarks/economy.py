"""What a scene pays for: modules it imports, forms it compiles, matrices and functions it makes.

`python benchmarks/economy.py` runs eight small scenes, each in a process and with a cache of compiled forms of its own,
and prints a table. Numbers of modules, forms, matrices and functions are the same on any machine; seconds are not.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("tigar_x", "shnapr", "varmint", "coudalfish")
HEAVY = ("gmsh", "meshio", "matplotlib", "splipy", "h5py", "slepc4py", "PIL", "scipy.optimize", "scipy.spatial")
"""Modules that are not every scene's: what they take is a tenth of a second and more, or megabytes."""


def plane_flow() -> Any:
    """Unsteady flow over a fixed mesh in the plane."""
    import ufl
    from mpi4py import MPI

    from varmint.conditions import Traction, Velocity
    from varmint.flow import Flow
    from varmint.mesh import box

    def inflow(x: Any, t: Any) -> Any:
        return ufl.as_vector([4.0 * x[1] * (1.0 - x[1]), 0.0])

    conditions = [Velocity("left", inflow), Velocity(("bottom", "top")), Traction("right")]
    flow = Flow(box(MPI.COMM_WORLD, (0, 0), (2, 1), (8, 4)), conditions, rho=1.0, mu=0.1, dt=0.1)
    flow.take_step()
    return flow


def steady_cavity() -> Any:
    """Steady flow in a square with a lid that moves."""
    from mpi4py import MPI

    from varmint.conditions import Velocity
    from varmint.flow import Flow
    from varmint.mesh import box

    conditions = [Velocity("top", (1.0, 0.0)), Velocity(("left", "right", "bottom"))]
    flow = Flow(box(MPI.COMM_WORLD, (0, 0), (1, 1), (8, 8)), conditions, rho=1.0, mu=0.1)
    flow.solve()
    return flow


def static_shell() -> Any:
    """A clamped plate under its own weight."""
    from shnapr import DeadLoad, Shell, StVenantKirchhoff
    from tigar_x.geometry import shapes

    plate = shapes.plate(lengths=(1.0, 1.0), elements=(4, 4), degrees=(2, 2))
    weight = DeadLoad((0.0, 0.0, -10.0))
    shell = Shell(plate, StVenantKirchhoff(1e6, 0.3, 0.02), clamped=plate.open_sides, loads=[weight])
    shell.solve()
    return shell


def touching_shell() -> Any:
    """Two clamped strips, of which one is pressed onto the other."""
    import ufl

    from shnapr import ContactRecipe, DeadLoad, LinearKernel, Shell, StVenantKirchhoff
    from tigar_x.geometry import shapes
    from tigar_x.geometry.multipatch import disjoint

    strips = disjoint(*(shapes.line((0.0, height), (1.0, height), elements=16, degree=2) for height in (0.0, 0.1)))
    contact = ContactRecipe(LinearKernel(0.08, 1e5), 0.09)
    pressed = DeadLoad(lambda x, t: t * ufl.as_vector([0.0, -ufl.conditional(ufl.gt(x[1], 0.05), 1.0, 0.0)]))
    shell = Shell(strips, StVenantKirchhoff(1e5, 0.3, 0.05), clamped=("u0",), loads=[pressed], contact=contact)
    shell.solve()
    return shell


def coupled() -> Any:
    """A flexible flap in a channel, with plain fields."""
    return _flap("plain")


def sharp() -> Any:
    """A flexible flap in a channel, with fields that know its sides: README's run."""
    return _flap("jump and kink")


def _flap(immersed: Any) -> Any:
    import ufl
    from mpi4py import MPI

    from coudalfish import CouDALFISh
    from shnapr import Shell, StVenantKirchhoff
    from tigar_x.geometry import shapes
    from varmint import Flow, FlowOptions, WeakVelocity, box

    def inflow(x: Any, t: Any) -> Any:
        return ufl.as_vector([6 * x[1] * (1 - x[1]) * ufl.min_value(t / 0.2, 1), 0])

    channel = box(MPI.COMM_WORLD, (0, 0), (3, 1), (24, 8))
    walls, pinned = WeakVelocity(("left", "right", "bottom", "top"), inflow), FlowOptions(pressure="pin", pin_at=(3, 0))
    flow = Flow(channel, [walls], rho=1.0, mu=0.05, dt=0.01, immersed=immersed, options=pinned)
    line = shapes.line((1, 0.005), (1, 0.6), elements=12, degree=2)
    flap = Shell(line, StVenantKirchhoff(1e4, 0.4, 0.03), density=1.0, clamped=("u0",))
    fsi = CouDALFISh(flow, flap)
    fsi.takeStep()
    return fsi


def coupled_in_space() -> Any:
    """A flexible plate in a stream of tetrahedra, with plain fields."""
    from mpi4py import MPI

    from coudalfish import CouDALFISh
    from shnapr import Shell, StVenantKirchhoff
    from tigar_x.geometry import shapes
    from varmint import Flow, Slip, Traction, Velocity, box

    channel = box(MPI.COMM_WORLD, (0, 0, 0), (2, 1, 1), (8, 4, 4))
    sides = [Velocity("left", (1, 0, 0)), Velocity("bottom"), Slip(("top", "back", "front")), Traction("right")]
    flow = Flow(channel, sides, rho=1.0, mu=0.05, dt=0.01, immersed="plain")
    plate = shapes.parallelogram((0.7, 0, 0.2), (0, 0.6, 0), (0, 0, 0.6), elements=(4, 4), degrees=(2, 2))
    fsi = CouDALFISh(flow, Shell(plate, StVenantKirchhoff(1e4, 0.4, 0.03), density=1.0, clamped=("u0",)))
    fsi.takeStep()
    return fsi


def beam_in_flow() -> Any:
    """A thick beam behind a cylinder, in a mesh that moves along: FSI3 on a coarse mesh."""
    from load import load_demo

    demo = load_demo("turek_hron_fsi3")
    flow = demo.Beam(size=0.12, beam_size=0.03, degree=1, dt=0.01).build()
    flow.take_step()
    return flow


SCENES: dict[str, Callable[[], Any]] = {
    scene.__name__: scene
    for scene in (
        plane_flow,
        steady_cavity,
        static_shell,
        touching_shell,
        coupled,
        sharp,
        coupled_in_space,
        beam_in_flow,
    )
}


def costs(name: str) -> dict[str, Any]:
    """What one scene takes in this process: meant to be the only one of it."""
    from mpi4py import MPI  # noqa: F401  (dolfinx's wheel finds its MPI library only after this)
    from dolfinx import fem

    functions = [0]
    make = fem.Function.__init__

    def counted(self: Any, *args: Any, **kwargs: Any) -> None:
        functions[0] += 1
        make(self, *args, **kwargs)

    fem.Function.__init__ = counted
    before, start = set(sys.modules), time.perf_counter()
    scene = SCENES[name]()
    wall = time.perf_counter() - start
    from tigar_x import compat

    loaded = set(sys.modules) - before
    return {
        "scene": type(scene).__name__,
        "modules": sorted(name for name in loaded if name.split(".")[0] in PACKAGES),
        "heavy": [heavy for heavy in HEAVY if heavy in sys.modules],
        "all_modules": len(sys.modules),
        "forms": [
            {"arguments": f.arguments, "coefficients": f.coefficients, "constants": f.constants}
            for f in compat.compiled_forms()
        ],
        "functions": functions[0],
        "compile_s": compat.compile_seconds(),
        "wall_s": wall,
    }


def measured(name: str, cache: str | None = None) -> dict[str, Any]:
    """Costs of a scene in a process of its own, with the number of PETSc matrices that it made.

    Args:
        name: of the scene.
        cache: folder of compiled forms; None: the usual one.

    Raises:
        RuntimeError: the scene failed.
    """
    mine = ("OMPI_", "PMIX_", "PMI_", "OPAL_", "PETSC_OPTIONS")
    env = {key: value for key, value in os.environ.items() if not key.startswith(mine)} | {"OMP_NUM_THREADS": "1"}
    if cache is not None:
        env["XDG_CACHE_HOME"] = cache
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "petsc.log"
        command = [sys.executable, __file__, "--scene", name]
        done = subprocess.run(command, capture_output=True, text=True, env=env | {"PETSC_OPTIONS": f"-log_view :{log}"})
        if done.returncode:
            raise RuntimeError(f"{name} failed:\n{done.stderr[-2000:]}")
        rows = [line.split() for line in log.read_text().splitlines()]
    made = sum(int(row[1]) for row in rows if len(row) > 2 and row[0] == "Matrix" and row[1].isdigit())
    return json.loads(done.stdout.splitlines()[-1]) | {"matrices": made}


def import_seconds(package: str, runs: int = 3) -> float:
    """Least wall seconds that importing a package takes in a new process, beyond an interpreter that does nothing."""

    def seconds(code: str) -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
        return time.perf_counter() - start

    return min(seconds(f"import {package}") for _ in range(runs)) - min(seconds("pass") for _ in range(runs))


def main() -> None:
    """Print one scene as JSON, or the table of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", choices=sorted(SCENES), help="one scene, in this process, as JSON")
    parser.add_argument("--warm", action="store_true", help="use the cache of compiled forms there is")
    given = parser.parse_args()
    if given.scene:
        print(json.dumps(costs(given.scene)))
        return
    print("| scene | modules | ours | heavy ones | forms | compile s | matrices | functions |\n" + "| --- " * 8 + "|")
    for name in SCENES:
        with tempfile.TemporaryDirectory() as cache:
            found = measured(name, None if given.warm else cache)
        numbers = (found["all_modules"], len(found["modules"]), ", ".join(found["heavy"]) or "-", len(found["forms"]))
        more = (f"{found['compile_s']:.1f}", found["matrices"], found["functions"])
        print("|", " | ".join(map(str, (name, *numbers, *more))), "|", flush=True)
    for package in PACKAGES:
        print(f"import {package}: {import_seconds(package):.2f} s")


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    main()
