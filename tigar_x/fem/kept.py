"""A matrix that can be brought back after its values have been replaced."""

from petsc4py import PETSc

from tigar_x import compat


class KeptMatrix:
    """Copies a matrix when it is replaced, and only then, because most steps keep their tangents and do not fail.

    Args:
        A: the matrix, whose pattern stays.
    """

    def __init__(self, A: PETSc.Mat) -> None:
        self._A = A
        self._copy: PETSc.Mat | None = None
        self._wanted = self._copied = False

    def remember(self, wanted: bool) -> None:
        """From now on the present values are those to bring back, if they are wanted at all."""
        self._wanted, self._copied = wanted, False

    def replacing(self) -> None:
        """To be called before the values are replaced."""
        if not self._wanted or self._copied:
            return
        if self._copy is None:
            self._copy = self._A.duplicate(copy=True)
            compat.freed_with(self, self._copy)
        else:
            self._A.copy(self._copy, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._copied = True

    def bring_back(self) -> None:
        """Put the remembered values back where they have been replaced."""
        if self._copied and self._copy is not None:
            self._copy.copy(self._A, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._copied = False
