"""Node-blocked matrices as arrays: the blocks of a rank's rows, where PETSc keeps them."""

import ctypes
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from tigar_x.compat.release import FloatArray, IntArray

_INT: Any = {4: ctypes.c_int32, 8: ctypes.c_int64}[np.dtype(PETSc.IntType).itemsize]
_OBJECT = ctypes.c_void_p
LongArray = NDArray[np.int64]


@dataclass(frozen=True)
class Pattern:
    """The blocks of a rank's rows.

    Attributes:
        size: rows of a block.
        rows: row of each block, shape (blocks,), those of this rank's own columns first.
        columns: its column, shape (blocks,): one of this rank as it is, one of another rank as number of own columns
            plus its place in ``others``.
        own: number of own columns.
        others: global numbers of columns of other ranks, shape (others,).
        diagonal: place of each row's block on the diagonal, shape (rows,).
        state: changes with the pattern.
    """

    size: int
    rows: LongArray
    columns: LongArray
    own: int
    others: IntArray
    diagonal: LongArray
    state: int


@cache
def _library() -> ctypes.CDLL:
    """The PETSc that petsc4py is linked with."""
    return ctypes.CDLL(PETSc.__file__)


def _call(name: str, *arguments: Any) -> None:
    error = getattr(_library(), name)(*arguments)
    if error:
        raise PETSc.Error(error)


def _parts(A: PETSc.Mat) -> tuple[list[Any], Any]:
    """Handles of the sequential parts of a matrix, and what maps the columns of the second one."""
    if A.getType() == "seqbaij":
        return [_OBJECT(A.handle)], None
    if A.getType() != "mpibaij":
        raise ValueError(f"a matrix of type {A.getType()}: one with blocks, baij, is required")
    own, others, columns = _OBJECT(), _OBJECT(), ctypes.POINTER(_INT)()
    _call("MatMPIBAIJGetSeqBAIJ", _OBJECT(A.handle), *map(ctypes.byref, (own, others, columns)))
    return [own, others], columns


def nonzero_state(A: PETSc.Mat) -> int:
    """A number that changes with the pattern of a matrix."""
    state = ctypes.c_int64()
    _call("MatGetNonzeroState", _OBJECT(A.handle), ctypes.byref(state))
    return state.value


def block_pattern(A: PETSc.Mat) -> Pattern:
    """Where the blocks of an assembled matrix of type baij are.

    Args:
        A: the matrix.

    Raises:
        ValueError: it is of another type, or lacks a block on its diagonal.
    """
    parts, columns_map = _parts(A)
    size, own = A.getBlockSize(), A.getLocalSize()[1] // A.getBlockSize()
    found = [_structure(part) for part in parts]
    rows = np.concatenate([np.repeat(np.arange(len(starts) - 1), np.diff(starts)) for starts, _ in found])
    columns = np.concatenate([indices + k * own for k, (_, indices) in enumerate(found)])
    others = np.empty(0, dtype=PETSc.IntType)
    if len(found) > 1:
        here = int(found[1][1].max(initial=-1)) + 1
        others = np.array([columns_map[i] for i in range(here)], dtype=PETSc.IntType)
    diagonal = np.flatnonzero(rows == columns)
    if len(diagonal) != own:
        raise ValueError(f"{own - len(diagonal)} rows have no block on the diagonal, which is required of all")
    return Pattern(size, rows, columns, own, others, diagonal, nonzero_state(A))


def _structure(part: Any) -> tuple[LongArray, LongArray]:
    """Starts of the rows of blocks of a sequential matrix, and their columns."""
    count, done = _INT(), ctypes.c_int()
    starts, indices = ctypes.POINTER(_INT)(), ctypes.POINTER(_INT)()
    arguments = part, _INT(0), ctypes.c_int(0), ctypes.c_int(1), *map(ctypes.byref, (count, starts, indices, done))
    _call("MatGetRowIJ", *arguments)
    rows = np.ctypeslib.as_array(starts, (count.value + 1,)).astype(np.int64)
    blocks = int(rows[-1])
    columns = np.ctypeslib.as_array(indices, (blocks,)).astype(np.int64) if blocks else np.empty(0, dtype=np.int64)
    _call("MatRestoreRowIJ", *arguments)
    return rows, columns


def block_values(A: PETSc.Mat) -> list[FloatArray]:
    """The blocks themselves, in the order of :func:`block_pattern`: of own columns, and of those of other ranks.

    Args:
        A: matrix of type baij; who writes into the arrays has to tell PETSc by ``A.stateIncrease()``.

    Returns:
        Views, valid as long as the matrix is, each of shape (blocks, columns of a block, rows of a block).
    """
    size, views = A.getBlockSize(), []
    for part in _parts(A)[0]:
        blocks, values = int(_structure(part)[0][-1]), ctypes.POINTER(ctypes.c_double)()
        _call("MatSeqBAIJGetArray", part, ctypes.byref(values))
        shape = blocks, size, size
        views.append(np.ctypeslib.as_array(values, shape) if blocks else np.empty(shape))
        _call("MatSeqBAIJRestoreArray", part, ctypes.byref(values))
    return views
