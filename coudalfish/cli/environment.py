"""Checks of what the library stands on: packages, MPI, PETSc, compiler, cache, files.

What may end the process instead of raising is tried in another one.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib import import_module

from coudalfish.cli.verdict import Check, FaultError, RemarkError

Work = Callable[[], str]
REQUIRED = ("numpy", "scipy", "ufl", "basix", "ffcx", "dolfinx", "splipy", "cffi")
OPTIONAL = {
    "gmsh": "meshes from geometry, such as the channel with a cylinder",
    "meshio": "meshes in files of other programs",
    "matplotlib": "pictures",
    "h5py": "VTKHDF files",
    "slepc4py": "modes on several ranks",
}
"""What not everybody needs, and what for."""
LITTLE = 200
"""Free space for compiled forms below which it is said; unit: MB."""
LONG = 160
"""Characters of an error that are shown."""
SET_UP = "run `make setup` in a checkout, or install them: README.md says what runs on what"


def packages() -> str:
    """All packages that are needed, and a release of dolfinx that is known."""
    missing = {name: why for name in ("petsc4py", *REQUIRED) if (why := _lacking(name))}
    if missing:
        raise FaultError("missing: " + "; ".join(f"{name} ({why})" for name, why in missing.items()), SET_UP)
    try:
        import_module("tigar_x.compat")
    except ImportError as error:
        raise FaultError(str(error), SET_UP) from error
    from tigar_x.run.summary import versions

    return ", ".join(f"{name} {version}" for name, version in versions().items())


def optional() -> str:
    """Packages that not everybody needs."""
    missing = [f"{name} is not there: {use} cannot be had" for name, use in OPTIONAL.items() if _lacking(name)]
    if missing:
        raise RemarkError("\n".join(missing))
    return ", ".join(OPTIONAL)


def _lacking(name: str) -> str:
    """Why a package cannot be imported; empty: it can."""
    try:
        import_module(name)
    except Exception as error:  # a package of another version may raise anything
        return f"{type(error).__name__}: {error}".splitlines()[0]
    return ""


def mpi() -> str:
    """The MPI library is that of who started the processes."""
    from mpi4py import MPI

    size = MPI.COMM_WORLD.size
    told = [int(os.environ[key]) for key in ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE") if os.environ.get(key, "").isdigit()]
    name = MPI.Get_library_version().splitlines()[0].split(",")[0].strip(" \0")
    if told and size not in told:
        raise FaultError(
            f"{told[0]} processes were started that do not see each other: mpi4py uses {name}, mpirun another MPI",
            "start them with the mpirun of that library: that of the environment's bin folder, if it has one",
        )
    return f"{name}, {size} rank{'s' if size > 1 else ''}"


def petsc() -> str:
    """PETSc for real numbers, and its solvers on a small system."""
    import numpy as np
    from petsc4py import PETSc

    if np.dtype(PETSc.ScalarType).kind == "c":
        raise FaultError(
            "PETSc is built for complex numbers",
            "use a build for real ones: on Debian, PETSC_DIR must not name another",
        )
    from tigar_x.fem.linear import PreparedSolver, direct, gmres_ilu

    n = 20
    A = PETSc.Mat().createAIJ((n, n), nnz=3, comm=PETSc.COMM_SELF)
    for i in range(n):
        A[i, i] = 2.0
        if i:
            A[i, i - 1] = A[i - 1, i] = -1.0
    A.assemble()
    x, b = A.createVecs()
    b.set(1.0)
    for solver in (direct(), gmres_ilu(fallback=direct("petsc"))):
        try:
            PreparedSolver(solver, A).solve(b, x)
        except Exception as error:
            raise FaultError(
                f"{solver.name} does not solve a small system: {str(error).splitlines()[0]}",
                "direct solvers need a PETSc with MUMPS, which Debian's and dolfinx's have",
            ) from error
        if not abs(x.max()[1] - n * (n + 2) / 8) < 1e-6 * n**2:
            raise FaultError(
                f"{solver.name} solves a small system wrongly", "PETSc or MUMPS is not sound: install it anew"
            )
    A.destroy()
    from coudalfish.cli.about import solver_packages

    return ", ".join(solver_packages())


def compiler() -> str:
    """The C compiler makes a module with this library's flags, and Python can load it."""
    from tigar_x.compat import C_FLAGS

    code = (
        "import cffi, importlib.util, sys\n"
        "f = cffi.FFI()\n"
        "f.cdef('double twice(double);')\n"
        "f.set_source('_tried', 'double twice(double x) { return x + x; }', extra_compile_args=sys.argv[2:])\n"
        "spec = importlib.util.spec_from_file_location('_tried', f.compile(tmpdir=sys.argv[1], verbose=False))\n"
        "module = importlib.util.module_from_spec(spec)\n"
        "spec.loader.exec_module(module)\n"
        "sys.exit(0 if module.lib.twice(2.0) == 4.0 else 'what it makes does not work')\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        result = subprocess.run([sys.executable, "-c", code, folder, *C_FLAGS], capture_output=True, text=True)
    if result.returncode:
        raise FaultError(
            f"it cannot make a module: {_last(result.stderr)}",
            "install gcc and Python's headers (Debian: gcc, python3-dev); the environment's CC, if it is set"
            f" ({os.environ.get('CC', 'it is not')}), must name a compiler",
        )
    from coudalfish.cli.about import compiler_version

    return compiler_version()


def cache() -> str:
    """The folder of compiled forms can be written, and has space."""
    from tigar_x.compat import cache_folder

    place = cache_folder()
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=place):
            pass
    except OSError as error:
        raise FaultError(
            f"the folder of compiled forms cannot be written: {place}: {error.strerror}",
            "set the environment's XDG_CACHE_HOME to a folder that can be written, on all machines of a run",
        ) from error
    free = shutil.disk_usage(place).free / 1e6
    if free < LITTLE:
        raise RemarkError(f"{place} has {free:.0f} MB left: a scene may need as much for its forms")
    return str(place)


def files() -> str:
    """HDF5 of dolfinx and of h5py write and read, side by side in one process."""
    code = (
        "import mpi4py.MPI, sys, numpy\n"
        "from dolfinx import io, mesh\n"
        "from mpi4py import MPI\n"
        "with io.XDMFFile(MPI.COMM_SELF, sys.argv[1] + '/mesh.xdmf', 'w') as file:\n"
        "    file.write_mesh(mesh.create_unit_square(MPI.COMM_SELF, 2, 2))\n"
        "try:\n"
        "    import h5py\n"
        "except ImportError:\n"
        "    sys.exit()\n"
        "with h5py.File(sys.argv[1] + '/mesh.h5', 'r') as file:\n"
        "    found = file['Mesh/mesh/geometry'][:]\n"
        "sys.exit(0 if found.shape[0] == 9 else 'what was written is not what is read')\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        result = subprocess.run(
            [sys.executable, "-c", code, folder], capture_output=True, text=True, env=outside_of_mpi()
        )
    if result.returncode:
        raise FaultError(
            f"HDF5 does not work: {_last(result.stderr)}",
            "dolfinx and h5py have to use one HDF5 library: take both from the same source",
        )
    return "XDMF and HDF5"


def outside_of_mpi() -> dict[str, str]:
    """The environment of a process that belongs to no MPI run."""
    mine = ("OMPI_", "PMIX_", "PMI_", "OPAL_", "PRTE_", "HYDRA_")
    return {key: value for key, value in os.environ.items() if not key.startswith(mine)}


def _last(text: str) -> str:
    """The line of an error's text that says most: a compiler's first error, else the last one."""
    lines = [line.strip() for line in text.splitlines() if line.strip()] or ["it ended without a word"]
    line = next((line for line in lines if "error: " in line), lines[-1])
    return line if len(line) <= LONG else f"{line[:LONG]} ..."


def _on_root(work: Work) -> Work:
    """The check on rank 0 alone, for what all share."""

    def alone() -> str:
        from mpi4py import MPI

        return work() if MPI.COMM_WORLD.rank == 0 else ""

    return alone


CHECKS = (
    Check("packages", packages),
    Check("more packages", optional),
    Check("MPI", mpi),
    Check("PETSc", petsc, ("packages",)),
    Check("compiler", _on_root(compiler), ("packages",)),
    Check("cache", _on_root(cache), ("packages",)),
    Check("files", _on_root(files), ("packages",)),
)
"""What the library stands on."""
