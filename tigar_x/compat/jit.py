"""The cache of compiled forms, so that no process is in the way of another, alive or dead.

FFCx compiles in the cache itself, and every other process waits for as long as the source lies there without a result:
one that was killed blocks all later ones. Within :func:`safe_cache` a module is compiled in a folder of its own inside
the cache and renamed into its place when it is complete. Locks, which the system takes from a dead process, let others
wait for it rather than compile the same; where a file system has none, all compile, and the first result stays.
Names and contents of the cache are FFCx's own.
"""

import errno
import fcntl
import io
import logging
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ffcx.codegeneration.jit as ffcx_jit
from mpi4py import MPI

log = logging.getLogger(__name__)

_LOCKS = "tigar_x.locks"  # one byte of it belongs to each module, so that no file is left behind by a module
_PART = ".part"  # suffix of a folder in which a module is compiled
_ffcx_look_up = ffcx_jit.get_cached_module
_ffcx_compile = ffcx_jit._compile_objects
_loaded: dict[Path, Any] = {}  # modules of this process: to find one FFCx reads the whole folder


@contextmanager
def safe_cache(what: str) -> Iterator[None]:
    """Let FFCx use its cache as this module's docstring says, inside the ``with`` statement.

    Args:
        what: what is compiled, for messages.

    Raises:
        RuntimeError: from within FFCx, when something has to be compiled and the cache cannot be written.
    """
    cache = _Cache(what)
    before = ffcx_jit.get_cached_module, ffcx_jit._compile_objects
    ffcx_jit.get_cached_module, ffcx_jit._compile_objects = cache.look_up, cache.compile
    try:
        yield
    finally:
        ffcx_jit.get_cached_module, ffcx_jit._compile_objects = before
        cache.release()


def build_once(name: str, ready: Path, what: str, build: Callable[[], None], timeout: int = 600) -> None:
    """Build a file of the cache unless it is there, while other processes wait for it.

    Args:
        name: of the module, which ends with a hexadecimal digest.
        ready: the file.
        what: is built, for messages.
        build: makes the file, the last thing that it does.
        timeout: how long another process is waited for [s].

    Raises:
        RuntimeError: it has to be built and the cache cannot be written.
    """
    if ready.exists():
        return
    cache = _Cache(what)
    cache.open(ready.parent)
    try:
        cache.wait(name, timeout)
        if not ready.exists():
            with _compilers_log_kept():
                build()
    finally:
        cache.release()


class _Cache:
    """What takes the place of FFCx's functions while one thing is compiled."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._locks: int | None = None

    def look_up(self, name: str, objects: list[str], folder: Path, timeout: int) -> tuple[Any, Any]:
        """A module of the cache; (None, None), and its lock is held if there are locks, when it has to be compiled."""
        found = _load(name, objects, folder)
        if found is None:
            self.open(folder)
            self.wait(name, timeout)
            found = _load(name, objects, folder)  # by another process meanwhile
        if found is None:
            return None, None
        self.release()
        return found

    def compile(
        self,
        declarations: str,
        things: Any,
        objects: list[str],
        name: str,
        options: Any,
        folder: Path,
        *more: Any,
        **named: Any,
    ) -> Any:
        """Compile a module apart, then put it where FFCx looks for it."""
        if self._locks is not None:
            _clear(folder, self._locks, name)
        part = Path(tempfile.mkdtemp(prefix=f"{name}.", suffix=_PART, dir=folder))
        _say(f"compiling {self._what} into {folder}")
        start = time.perf_counter()
        try:
            with _compilers_log_kept():
                code = _ffcx_compile(declarations, things, objects, name, options, part, *more, **named)
            _publish(part, folder, name)
        except Exception:
            source = part / f"{name}.c"
            source.touch()
            os.replace(source, folder / source.name)  # FFCx renames it to .failed
            raise
        finally:
            shutil.rmtree(part, ignore_errors=True)
            self.release()
        log.debug("%s took %.1f s", self._what, time.perf_counter() - start)
        return code

    def release(self) -> None:
        """Give the lock back."""
        if self._locks is not None:
            os.close(self._locks)
            self._locks = None

    def open(self, folder: Path) -> None:
        """Make the cache's folder if it is not there, and open the locks in it."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            os.rmdir(tempfile.mkdtemp(suffix=_PART, dir=folder))
        except OSError as error:
            raise RuntimeError(
                f"{self._what} cannot be compiled into the cache {folder}: {error.strerror}. Compiled forms are kept "
                "in the folder fenics of XDG_CACHE_HOME, or of ~/.cache: set XDG_CACHE_HOME to a folder that can be "
                "written, on all machines of a run"
            ) from error
        try:
            self._locks = os.open(folder / _LOCKS, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:  # of another user in a shared cache
            log.debug("no locks in %s: %s", folder, error)

    def wait(self, name: str, timeout: int) -> None:
        """Take the lock of a module; wait for who has it, but not for ever."""
        end, told = time.monotonic() + timeout, False
        while self._locks is not None:
            held = _take(self._locks, name)
            if held is None:
                self.release()
            elif held:
                return
            elif time.monotonic() > end:
                log.warning(
                    "another process compiles %s for more than %d s: compiling it here, too", self._what, timeout
                )
                self.release()
            elif not told:
                _say(f"waiting for another process that compiles {self._what}")
                told = True
            else:
                time.sleep(0.05)


def _take(locks: int, name: str) -> bool | None:
    """Take the lock of a module without waiting: whether it is held now; None: the file system has no locks."""
    try:
        fcntl.lockf(locks, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _byte(name))
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        log.debug("locks do not work here: %s", error)
        return None
    return True


def _byte(name: str) -> int:
    """Where in the file of locks a module's is: by the last digits of its name, a hexadecimal digest."""
    return int(name[-12:], 16)


def _load(name: str, objects: list[str], folder: Path) -> tuple[Any, Any] | None:
    """A complete module of the cache; None: there is none. A damaged one is forgotten."""
    ready = folder / f"{name}.c.cached"
    if not ready.exists():
        return None
    if (module := _loaded.get(ready)) is not None:
        return [getattr(module.lib, key) for key in objects], module
    try:
        found = _ffcx_look_up(name, objects, folder, 1)
    except ImportError as error:
        log.warning("%s in %s cannot be loaded (%s): compiling it again", name, folder, error)
        ready.unlink(missing_ok=True)
        return None
    if found[0] is None:
        return None
    _loaded[ready] = found[1]
    return found


def _clear(folder: Path, locks: int, mine: str) -> None:
    """Remove the folders of processes that died while they compiled ``mine`` and others, whose locks are free."""
    for part in folder.glob(f"*{_PART}"):
        name = part.name.split(".")[0]
        if name == mine:
            shutil.rmtree(part, ignore_errors=True)
        elif name.startswith("libffcx_") and _take(locks, name):
            shutil.rmtree(part, ignore_errors=True)
            fcntl.lockf(locks, fcntl.LOCK_UN, 1, _byte(name))


def _publish(part: Path, folder: Path, name: str) -> None:
    """Rename a complete module into the cache, what makes it visible last, unless another one is there already."""
    ready = f"{name}.c.cached"
    if (folder / ready).exists():  # others may have loaded it, and on NFS must not lose it
        return
    for path in [*part.glob(f"{name}.*.so"), *part.glob(f"{name}.*.pyd"), part / f"{name}.c", part / ready]:
        with path.open("rb") as file:
            os.fsync(file.fileno())  # a truncated library would crash who loads it
        os.replace(path, folder / path.name)


@contextmanager
def _compilers_log_kept() -> Iterator[None]:
    """Keep the command lines of compilers, which distutils logs by the root logger and its level, out of the log."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    root.handlers[:] = [logging.StreamHandler(io.StringIO())]
    try:
        yield
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)


def _say(text: str) -> None:
    """Log what a user waits for; where nobody has chosen a level it is shown all the same."""
    log.info(text)
    if log.getEffectiveLevel() == logging.WARNING and MPI.COMM_WORLD.rank == 0:
        sys.stderr.write(text + "\n")
