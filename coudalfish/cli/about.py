"""What there is: versions, solvers, ranks, memory, compiler, cache."""

import os
import platform
import shlex
import subprocess
import sysconfig
from importlib import import_module, metadata
from pathlib import Path

PACKAGES = (
    "mumps",
    "superlu_dist",
    "suitesparse",
    "hypre",
    "ml",
    "strumpack",
    "pastix",
    "ptscotch",
    "parmetis",
    "cuda",
)
"""What PETSc may have been built with."""
NAMES = ("mpi4py", "petsc4py", "slepc4py", "splipy", "gmsh", "meshio", "matplotlib", "h5py", "pyvista")


def about() -> str:
    """All of it, one thing a line (collective)."""
    from mpi4py import MPI

    from coudalfish.cli.demos import folder
    from tigar_x.compat import C_FLAGS
    from tigar_x.front import __version__
    from tigar_x.run.summary import versions

    known = {"coudalfish": __version__, **versions(), **{name: _version(name) for name in NAMES}}
    rows = {
        "versions": ", ".join(f"{name} {version}" for name, version in known.items()),
        "installed in": str(Path(__file__).resolve().parents[2]),
        "examples in": str(folder()),
        "ranks": f"{MPI.COMM_WORLD.size}, by {MPI.Get_library_version().splitlines()[0].strip(chr(0))}",
        "PETSc has": ", ".join(solver_packages()) or "no packages",
        "compiler": compiler_version(),
        "its flags": " ".join(C_FLAGS),
        "compiled forms": compiled(),
        "machine": f"{platform.machine()}, {len(os.sched_getaffinity(0))} processors for this process, {memory()}",
    }
    width = max(map(len, rows))
    return "\n".join(f"{name:{width}}  {text}" for name, text in rows.items())


def _version(name: str) -> str:
    try:
        return str(getattr(import_module(name), "__version__", "")) or metadata.version(name)
    except Exception:  # a package of another version may raise anything
        return "is missing"


def solver_packages() -> list[str]:
    """Packages that PETSc was built with, and SLEPc where it can be imported."""
    from petsc4py import PETSc

    found = [name for name in PACKAGES if PETSc.Sys.hasExternalPackage(name)]
    return found if _version("slepc4py") == "is missing" else [*found, "slepc"]


def compiler_version() -> str:
    """The C compiler that makes forms, and its version."""
    command = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
    try:
        told = subprocess.run([command[0], "--version"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return f"{command[0]}, which does not say its version"
    return f"{command[0]}: {(told.splitlines() or ['it says nothing'])[0]}"


def compiled() -> str:
    """Where compiled forms are kept, and what that amounts to."""
    from tigar_x.compat import cache_folder

    place = cache_folder()
    sizes = [path.stat().st_size for path in place.glob("libffcx_*")] if place.is_dir() else []
    number = len(list(place.glob("libffcx_*.cached"))) if sizes else 0
    return f"{number} in {place}, {sum(sizes) / 1e6:.0f} MB; they may be deleted, and are made again"


def memory() -> str:
    """Memory of the machine."""
    info = Path("/proc/meminfo")
    if not info.exists():
        return "memory unknown"
    sizes = {line.split(":")[0]: int(line.split()[1]) / 2**20 for line in info.read_text().splitlines()}
    return f"{sizes.get('MemTotal', 0.0):.1f} GB of memory, {sizes.get('MemAvailable', 0.0):.1f} GB of it free"
