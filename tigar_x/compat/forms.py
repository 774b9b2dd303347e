"""Form compilation: the C flags, the cache key and the time it takes."""

import hashlib
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import ufl
import ufl.sorting
from dolfinx import fem, jit

from tigar_x.compat.jit import safe_cache
from tigar_x.compat.release import VERSION

# UFL, up to 2026.1 at least, orders Constants by their printed count, so that 100 comes before 99 and the cache key of
# a form depends on how many Constants a process made before it; by number the order is stable. Expressions are sorted
# when they are made, in scripts too, so this cannot be confined to compilation.
ufl.sorting._terminal_cmps[ufl.Constant._ufl_typecode_] = ufl.sorting._cmp_coefficient

if VERSION == (0, 9):
    from ufl.algorithms import compute_form_data  # noqa: F401  (a function, of the same name as its module)
    from ufl.form import Form

    _analysis: Any = sys.modules["ufl.algorithms.compute_form_data"]
    _group_form_integrals = _analysis.group_form_integrals

    def _with_disjoint_ids(form: Form, *options: Any, **named: Any) -> Form:
        """Integrals as UFL groups them, but one for each id when some ids have integrals of several degrees.

        This dolfinx finds kernels by their first id, and would take the same one for all of them
        (https://github.com/FEniCS/dolfinx/issues/3735).
        """
        grouped = _group_form_integrals(form, *options, **named)
        kinds = {(itg.integral_type(), itg.subdomain_id()) for itg in grouped.integrals()}
        ids = [(kind, i) for kind, group in kinds for i in group]
        if len(set(ids)) == len(ids):
            return grouped
        return Form([itg.reconstruct(subdomain_id=(i,)) for itg in grouped.integrals() for i in itg.subdomain_id()])

    @contextmanager
    def _ids_disjoint() -> Iterator[None]:
        """Let UFL group integrals so inside the ``with`` statement."""
        _analysis.group_form_integrals = _with_disjoint_ids
        try:
            yield
        finally:
            _analysis.group_form_integrals = _group_form_integrals

else:

    @contextmanager
    def _ids_disjoint() -> Iterator[None]:
        yield


def _processor() -> str:
    """What ``-march=native`` depends on, so that a cache shared between machines never mixes them."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    keys = ("model name", "flags", "Features", "CPU part")
    known = sorted({line for line in lines if line.startswith(keys)})
    return hashlib.sha1("".join([platform.machine(), *known]).encode()).hexdigest()[:12]


# The members of -ffast-math that change neither the meaning of NaN and Inf nor the processor's treatment of denormals:
# -ffinite-math-only would make NaN tests lie, and linking with -ffast-math sets flush-to-zero for the whole process.
C_FLAGS = [
    "-O2",
    "-g0",
    "-march=native",
    "-ftree-vectorize",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fassociative-math",
    "-freciprocal-math",
    f"-DTIGAR_X_PROCESSOR={int(_processor(), 16)}ULL",
]
JIT: dict[str, Any] = {
    "jit_params" if VERSION < (0, 9) else "jit_options": {"cffi_extra_compile_args": C_FLAGS, "timeout": 600}
}
"""Keyword argument of everything in dolfinx that compiles, but for what :func:`_options` adds."""
UNFUSED = ["-O3", "-ffp-contract=off"]
"""More flags for forms in tetrahedra. Sums of products as fused operations are chains of which each waits for the one
before: apart, residuals and tangents of flows take half to two thirds of the time, and those of shells no less."""
_compile_seconds = np.zeros(2)


def cache_folder() -> Path:
    """Folder in which compiled forms are kept; it need not be there yet."""
    (given,) = JIT.values()
    all_options: Any = getattr(jit, "get_parameters" if VERSION < (0, 9) else "get_options")
    return Path(all_options(given)["cache_dir"])


@dataclass(frozen=True)
class CompiledForm:
    """What a form that this process compiled, or loaded from the cache, contains.

    Attributes:
        arguments: number of arguments: 0 a functional, 1 a residual, 2 a tangent.
        cell: name of the mesh's cells.
        dimension: of space.
        integrals: kinds of its integrals, each once.
        coefficients: names of the functions in it, sorted.
        constants: number of Constants in it.
        seconds: wall seconds of compilation, or of loading from the cache.
    """

    arguments: int
    cell: str
    dimension: int
    integrals: tuple[str, ...]
    coefficients: tuple[str, ...]
    constants: int
    seconds: float


_compiled: list[CompiledForm] = []


def compile_seconds() -> float:
    """Wall seconds that this process has spent in building or loading forms and expressions so far [s]."""
    return float(_compile_seconds[0])


def compile_cpu_seconds() -> float:
    """CPU seconds of this process in the same; a compiler that it waits for is another process [s]."""
    return float(_compile_seconds[1])


@contextmanager
def compiling() -> Iterator[None]:
    """Count the time inside the ``with`` statement as compilation."""
    start = np.array([time.perf_counter(), time.process_time()])
    depth = sys.getrecursionlimit()
    # UFL from 2025 on goes about four calls deeper with every level of an expression; stresses have hundreds
    sys.setrecursionlimit(depth if VERSION < (0, 10) else max(depth, 10_000))
    try:
        yield
    finally:
        sys.setrecursionlimit(depth)
        _compile_seconds[:] += np.array([time.perf_counter(), time.process_time()]) - start


def compile_forms(*forms: ufl.Form) -> list[Any]:
    """Compile UFL forms with the project's C flags.

    All signatures are computed before the first compilation, because dolfinx 0.5 numbers coefficients on first use
    and a form's cache key would otherwise depend on what was compiled before it.

    Args:
        forms: UFL forms on one mesh.

    Returns:
        The compiled dolfinx forms, in the same order.
    """
    with compiling():
        for form in forms:
            form.signature()
        return [_compile(form) for form in forms]


def _options(form: ufl.Form) -> dict[str, Any]:
    """Keyword argument with which a form is compiled."""
    if str(form.ufl_domain().ufl_cell()) != "tetrahedron":
        return JIT
    return {name: given | {"cffi_extra_compile_args": [*C_FLAGS, *UNFUSED]} for name, given in JIT.items()}


def _compile(form: ufl.Form) -> Any:
    start = time.perf_counter()
    kinds = sorted({integral.integral_type() for integral in form.integrals()})
    names = sorted(coefficient.name for coefficient in form.coefficients())
    noun = ("functional", "residual", "tangent")[len(form.arguments())]
    functions = f" of {', '.join(dict.fromkeys(names))}" if names else ""
    with safe_cache(f"a {noun}{functions} ({', '.join(kinds)} integrals)"), _ids_disjoint():
        compiled = fem.form(form, **_options(form))
    _compiled.append(
        CompiledForm(
            len(form.arguments()),
            compiled.mesh.topology.cell_type.name,
            int(compiled.mesh.geometry.dim),
            tuple(kinds),
            tuple(names),
            len(form.constants()),
            time.perf_counter() - start,
        )
    )
    return compiled


def compiled_forms() -> tuple[CompiledForm, ...]:
    """The forms that this process has compiled or loaded so far."""
    return tuple(_compiled)
