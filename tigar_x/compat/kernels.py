"""Functions in C that are compiled once and kept beside the compiled forms."""

import hashlib
import importlib.machinery
import importlib.util
import os
import shutil
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

import cffi

from tigar_x.compat.forms import cache_folder, compiling
from tigar_x.compat.jit import build_once

FLAGS = ["-O3", "-g0", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros"]
"""Products are rounded before they are added, as NumPy's are: what is zero by symmetry stays zero."""


def c_functions(name: str, declarations: str, source: str) -> Any:
    """Module of functions, compiled if the cache lacks it.

    Every process may call this by itself; of several one compiles, and the others wait for it.

    Args:
        name: of the module.
        declarations: of types and functions, as cffi takes them.
        source: in C.

    Returns:
        Module with the functions, ``lib``, and the types, ``ffi``.

    Raises:
        RuntimeError: it has to be compiled and the cache cannot be written.
        cffi.VerificationError: the compiler fails.
    """
    parts = declarations, source, *FLAGS, sys.version, cffi.__version__, sysconfig.get_platform()
    module = f"tigar_x_{name}_{hashlib.sha1('|'.join(parts).encode()).hexdigest()}"
    ready = cache_folder() / f"{module}{importlib.machinery.EXTENSION_SUFFIXES[0]}"
    with compiling():
        build_once(module, ready, f"the C functions of {name}", lambda: _build(module, declarations, source, ready))
    spec: Any = importlib.util.spec_from_file_location(module, ready)
    result = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(result)
    return result


def _build(module: str, declarations: str, source: str, ready: Path) -> None:
    """Compile in a folder apart, and rename what is complete into its place."""
    part = tempfile.mkdtemp(prefix=f"{module}.", suffix=".part", dir=ready.parent)
    try:
        builder = cffi.FFI()
        builder.cdef(declarations)
        builder.set_source(module, source, extra_compile_args=FLAGS)
        built = Path(builder.compile(tmpdir=part))
        with built.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(built, ready)
    finally:
        shutil.rmtree(part, ignore_errors=True)
