"""The cache of compiled forms: killed, waiting, damaged, unwritable; what is said meanwhile."""

import errno
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import cffi
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from mpi_runs import outside

from tigar_x import compat
from tigar_x.compat import forms, jit, kernels

OPTIONS = next(iter(forms.JIT.values()))
HERE = "test_jit.area()"
LOOK_UP = jit._ffcx_look_up


def area(comm=MPI.COMM_SELF):
    """Compile a functional."""
    domain = mesh.create_unit_square(comm, 1, 1)
    return compat.assemble_scalar(compat.compile_forms(ufl.as_ufl(2.0) * ufl.dx(domain))[0])


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache for this process."""
    monkeypatch.setitem(OPTIONS, "cache_dir", str(tmp_path / "fenics"))
    return tmp_path / "fenics"


def started(cache, code, **environment):
    """Another process that uses the cache, in a group of its own."""
    env = outside() | {"XDG_CACHE_HOME": str(cache.parent)} | environment
    command = [sys.executable, "-c", f"import test_jit; {code}"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # which what is started in the background ignores
    return subprocess.Popen(command, env=env, **pipes, start_new_session=True, preexec_fn=heard)


def names(folder):
    """Kinds of the files in a cache."""
    return sorted(path.name.partition(".")[2].rpartition(".")[2] for path in Path(folder).glob("libffcx_*"))


def written(folder):
    """Whether a source is being compiled; another process's folders may be gone while they are looked at."""
    with suppress(FileNotFoundError):
        return any(path.stat().st_size for path in folder.rglob("*.c"))
    return False


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_compilation_is_in_nobodys_way(number, cache, monkeypatch):
    monkeypatch.setitem(OPTIONS, "timeout", 5)
    compiler = cache.parent / "compiler"
    compiler.write_text("#!/bin/sh\nsleep 60\n")
    compiler.chmod(0o755)
    with started(cache, HERE, CC=str(compiler)) as process:
        while not written(cache) and process.poll() is None:
            time.sleep(0.001)
        os.killpg(process.pid, number)
    assert not list(cache.glob("*.cached"))
    assert area() == pytest.approx(2.0)
    assert names(cache) == ["c", "cached", "so"]


def test_a_module_is_looked_for_in_the_folder_once(cache, monkeypatch):
    """FFCx reads the names of all modules to find one, at every new mesh of a run otherwise."""
    area()
    sought = []
    monkeypatch.setattr(jit, "_ffcx_look_up", lambda *arguments: sought.append(LOOK_UP(*arguments)) or sought[-1])
    area()
    assert area() == pytest.approx(2.0)
    assert len(sought) <= 1


def test_one_of_two_processes_compiles_and_the_other_waits(cache, caplog):
    """What has the lock for too long is not waited for; a dead process has none."""
    area()
    name = next(cache.glob("*.cached")).name.partition(".")[0]
    for path in cache.glob("libffcx_*"):
        path.unlink()
    code = (
        f"l = test_jit.jit.os.open(r'{cache / 'tigar_x.locks'}', 2); print(test_jit.jit._take(l, '{name}'), flush=True)"
    )
    with started(cache, code + "; test_jit.time.sleep(60)") as process, caplog.at_level(logging.INFO):
        assert process.stdout.readline() == b"True\n"
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(OPTIONS, "timeout", 0.2)
            assert area() == pytest.approx(2.0)
        process.kill()
    said = [record.getMessage() for record in caplog.records]
    assert said[0] == "waiting for another process that compiles a functional (cell integrals)"
    assert "compiling it here, too" in said[1]
    assert said[2] == f"compiling a functional (cell integrals) into {cache}"
    next(cache.glob("*.cached")).unlink()
    caplog.clear()
    with caplog.at_level(logging.INFO):
        area()
    assert [record.getMessage() for record in caplog.records] == said[2:]


def test_a_file_system_without_locks(cache, monkeypatch):
    """All compile, and the first result stays."""

    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(jit.fcntl, "lockf", refuse)
    assert area() == pytest.approx(2.0)
    ready = next(cache.glob("*.cached"))
    before = ready.read_bytes()
    jit._publish(cache / "nothing", cache, ready.name.partition(".")[0])
    assert ready.read_bytes() == before


def test_a_damaged_module_is_compiled_again(cache, tmp_path, monkeypatch, caplog):
    """As it is after a loss of power."""
    area()
    damaged = tmp_path / "damaged"
    shutil.copytree(cache, damaged)
    (library,) = damaged.glob("*.so")
    os.truncate(library, 0)
    monkeypatch.setitem(OPTIONS, "cache_dir", str(damaged))
    assert area() == pytest.approx(2.0)
    assert "cannot be loaded" in caplog.text
    assert library.stat().st_size


def parts():
    """Compile a residual and its tangent that are confined to some cells."""
    domain = mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    V = compat.lagrange_space(domain, 1)
    u, k = fem.Function(V), fem.Function(V)
    residual = (1 + k) * u**3 * ufl.TestFunction(V) * ufl.dx(domain, degree=2)
    return compat.partial_forms(residual, ufl.derivative(residual, u))


def test_what_was_compiled_is_found_by_the_next_process(cache):
    """Keys do not depend on what was compiled before them: dolfinx 0.5 numbers functions on first use."""
    for _ in range(2):
        started(cache, "test_jit.parts()").communicate()
        assert len(list(cache.glob("libffcx_forms_*.c"))) == 2


def test_compilers_do_not_speak_in_the_log(cache, caplog, capfd):
    """What is compiled is said once, and shown where nobody has asked for a level of the log."""
    root = logging.getLogger()
    before = root.handlers[:], root.level
    area()
    assert (root.handlers, root.level) == before
    expected = f"compiling a functional (cell integrals) into {cache}"
    assert capfd.readouterr().err == (f"{expected}\n" if root.level == logging.WARNING else "")
    assert not caplog.records
    next(cache.glob("*.cached")).unlink()
    with caplog.at_level(logging.INFO):
        area()
        area()
    assert [record.getMessage() for record in caplog.records] == [expected]
    assert not capfd.readouterr().err


def test_what_the_compiler_refuses(cache, monkeypatch):
    """Its source stays for a look, and nothing else is changed."""
    root = logging.getLogger()
    before = root.handlers[:], root.level
    with monkeypatch.context() as patch:
        patch.setitem(OPTIONS, "cffi_extra_compile_args", ["-march=no-such-processor"])
        with pytest.raises(cffi.VerificationError):
            area()
    assert names(cache) == ["failed"]
    assert (root.handlers, root.level) == before
    assert area() == pytest.approx(2.0)


@pytest.mark.mpi
def test_a_cache_that_cannot_be_written_is_refused_on_all_ranks(tmp_path, monkeypatch):
    comm = MPI.COMM_WORLD
    (tmp_path / "file").touch()
    monkeypatch.setitem(OPTIONS, "cache_dir", str(tmp_path / "file" / "fenics"))
    message = "file/fenics: Not a directory.*set XDG_CACHE_HOME" if comm.rank == 0 else "failed on r"
    with pytest.raises(RuntimeError, match=message):
        area(comm)


def test_a_cache_that_cannot_be_written_serves_what_is_in_it(cache, monkeypatch):
    area()

    def refuse(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(jit.tempfile, "mkdtemp", refuse)
    assert area() == pytest.approx(2.0)
    next(cache.glob("*.cached")).unlink()
    with pytest.raises(RuntimeError, match=r"Read-only file system.*XDG_CACHE_HOME"):
        area()


def test_functions_in_c_are_compiled_once(cache, monkeypatch):
    source = "int64_t twice(int64_t k) { return 2 * k; }"
    wanted = "tried", "int64_t twice(int64_t);", f"#include <stdint.h>\n{source}"
    assert kernels.c_functions(*wanted).lib.twice(21) == 42
    with monkeypatch.context() as patch:
        patch.setattr(kernels, "_build", None)
        assert kernels.c_functions(*wanted).lib.twice(4) == 8
    with pytest.raises(cffi.VerificationError):
        kernels.c_functions("tried", wanted[1], "no C")
    left = [path.name for path in cache.iterdir() if path.name != jit._LOCKS]
    assert len(left) == 1
    assert left[0].startswith("tigar_x_tried_")
