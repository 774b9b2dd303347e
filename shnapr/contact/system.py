"""A shell's reduced system with nonlocal contact; a shell without contact takes ``SplineSystem`` itself."""

from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from petsc4py import PETSc

from shnapr.contact.self_contact import ContactForces, SelfContact
from tigar_x import checks, ranks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import LinearSolver, SolveError
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem


class ContactSystem(SplineSystem):
    """Residual and tangent of a shell with the contact between its points.

    Args:
        spline: the midsurface, on one rank.
        residual: UFL residual in ``spline.V`` without contact.
        tangent: its tangent.
        contact: the contact, on the nodal quadrature of the spline.
        unknown: homogeneous displacement.
        time: integrator of the unknown; contact then acts at its intermediate level. None: a static problem.
        positive: whether the tangent of contact leaves out what makes it indefinite.
        solver: linear solver recipe, or a KSP; None: direct.
        prefix: of the PETSc options that go before the recipe's, see :mod:`tigar_x.fem.petsc_options`.

    Attributes:
        contact: as given, or that of a part of the pairs on each rank.
        positive: as given; it may be changed between tangents.
        forces: contact at the state of the last residual; None before the first one.
    """

    forces: ContactForces | None = None

    def __init__(
        self,
        spline: ExtractedSpline,
        residual: ufl.Form,
        tangent: ufl.Form,
        contact: SelfContact,
        *,
        unknown: fem.Function,
        time: TimeIntegrator | None = None,
        positive: bool = False,
        solver: LinearSolver | PETSc.KSP | None = None,
        prefix: str = "",
    ) -> None:
        checks.having("contact", contact, "evaluate quadrature", "a SelfContact")
        super().__init__(spline, residual, tangent, solver, unknown=unknown, prefix=prefix)
        self.contact = contact
        self._spline = spline
        self._y = unknown
        self._time = time
        self.positive = positive
        self._renewed: tuple[Any, ...] | None = None  # the state whose contact is in the tangent

    def share(self, comm: MPI.Comm) -> None:
        """Share the pairs as well, see the base class."""
        super().share(comm)
        if self.is_shared:
            self.contact = self.contact.shared(comm)

    def positions(self) -> FloatArray:
        """Points at which contact acts, at the intermediate level of a time step, shape (nodes, nsd); unit: length."""
        y = self._y.x.array if self._time is None else self._time.x_alpha_array()
        return self._spline.node_positions + y.reshape(-1, self._spline.nsd) / self._spline.node_weights[:, None]

    def _contact(self, *, tangent: bool) -> ContactForces:
        alpha = 1.0 if self._time is None else self._time.x_factor
        return self.contact.evaluate(self.positions(), tangent=tangent, positive=self.positive, alpha=alpha)

    def _state(self) -> tuple[Any, ...]:
        """All that the tangent of contact hangs on."""
        return self.positive, 1.0 if self._time is None else self._time.x_factor, self.positions()

    def _of_pairs(self) -> Any:
        """Tangent of contact; None: no points interact."""
        self._renewed = None
        found, self._renewed = self._contact(tangent=True), self._state()
        return found.tangent if found.pairs else None

    def assemble_residual(self, load: FloatArray | None = None) -> float:
        """Assemble and extract the residual with contact, see the base class."""
        try:
            self.forces = self._contact(tangent=False)
        except SolveError:
            return float("nan")
        forces = self.forces.forces
        return super().assemble_residual(forces if load is None else forces + load)

    def renew_contact(self) -> None:
        """Bring the tangent of contact to the present state and keep that of the form; factors that suit are kept."""
        both = zip(self._renewed or (), self._state(), strict=False)
        present = self._renewed is not None and all(np.array_equal(one, other) for one, other in both)
        if self._part is not None:
            present = ranks.first(self._part.comm, present)
        if not present:
            self.extract_tangent(self._of_pairs())

    def assemble_tangent(self, diagonal: FloatArray | None = None, pairs: Any = None) -> None:
        """Assemble and extract the tangent with contact, see the base class."""
        own = self._of_pairs()
        super().assemble_tangent(diagonal, pairs if own is None else own if pairs is None else own + pairs)
