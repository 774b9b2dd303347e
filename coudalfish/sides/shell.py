"""The shell as the coupling sees it: a residual on a spline that every rank holds whole."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem
from petsc4py import PETSc

from coudalfish.sides.handover import check_residual
from coudalfish.surface.sheets import Normals, Sheets
from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import LinearSolver
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem

if TYPE_CHECKING:  # a shell without contact imports none
    from shnapr.contact import ContactForces, SelfContact

ROUNDING = 1e-15
"""Rounding error of a residual relative to the terms in it."""


class ShellSubproblem:
    """A shell on a spline that every rank holds whole.

    Args:
        spline_sh: the midsurface, on ``MPI.COMM_SELF``.
        residual_sh: residual built from the expressions of ``timeInt_sh``.
        timeInt_sh: integrator of the homogeneous displacement.
        solver: linear solver recipe, or a KSP of one rank; None: direct. PETSc options go first, under ``shell_``.
        tangent: UFL tangent; None: the derivative of the residual.
        updates: called with t_alpha at the start of every step.
        contact: contact of the shell, or of several in one spline, with itself, on ``NodalQuadrature.of(spline_sh)``;
            None: there is none, and no object for it.

    Attributes:
        quadrature: the immersed points.
        sheets: how they hang together.
        normals: gives the normals at the intermediate level, shape (points, d).
        contact: as given.

    Raises:
        ValueError: the spline is distributed, or the residual is not built from the integrator's expressions.
    """

    def __init__(
        self,
        spline_sh: ExtractedSpline,
        residual_sh: ufl.Form,
        timeInt_sh: TimeIntegrator,
        *,
        solver: LinearSolver | PETSc.KSP | None = None,
        tangent: ufl.Form | None = None,
        updates: Sequence[Callable[[float], None]] = (),
        contact: "SelfContact | None" = None,
    ) -> None:
        checks.kind("spline_sh", spline_sh, ExtractedSpline, "ExtractedSpline(patch, MPI.COMM_SELF)")
        checks.kind("residual_sh", residual_sh, ufl.Form, "a form, such as the residual of a shell,")
        checks.kind("timeInt_sh", timeInt_sh, TimeIntegrator, "a TimeIntegrator of the displacement")
        checks.listed("updates", updates)
        if contact is not None:
            checks.having("contact", contact, "evaluate quadrature", "a SelfContact")
        check_residual(residual_sh, timeInt_sh, spline_sh.mesh)
        self.spline = spline_sh
        self.timeInt = timeInt_sh
        self.updates = tuple(updates)
        self.contact = contact
        self.quadrature = NodalQuadrature.of(spline_sh) if contact is None else contact.quadrature
        y: fem.Function = timeInt_sh.x
        jacobian = ufl.derivative(residual_sh, y) if tangent is None else tangent
        forms = residual_sh, jacobian
        self.system: Any
        if contact is None:
            self.system = SplineSystem(spline_sh, *forms, solver, unknown=y, prefix="shell_")
        else:
            from shnapr.contact.system import ContactSystem

            self.system = ContactSystem(
                spline_sh, *forms, contact, unknown=y, time=timeInt_sh, solver=solver, prefix="shell_"
            )
        self.sheets = Sheets.of(spline_sh)
        self.normals = Normals(spline_sh, timeInt_sh, self.sheets.sign)

    def share(self, comm: MPI.Comm) -> None:
        """Integrate, extract and look at pairs of points in contact by parts on the ranks of a flow (collective).

        Args:
            comm: of the flow.
        """
        self.system.share(comm)

    def __repr__(self) -> str:
        contact = "" if self.contact is None else ", contact"
        return f"ShellSubproblem({self.spline.vector.n} coefficients, {len(self.quadrature.points)} points{contact})"

    def _physical(self, array: FloatArray) -> FloatArray:
        return array.reshape(-1, self.spline.nsd) / self.quadrature.rational[:, None]

    def positions(self) -> FloatArray:
        """Points at the intermediate level, shape (points, d); unit: length."""
        return self.quadrature.points + self._physical(self.timeInt.x_alpha_array())

    def velocity(self) -> FloatArray:
        """Velocity y'_alpha of the points, or that of the last state between steps, shape (points, d)."""
        time = self.timeInt
        return self._physical(time.xdot_alpha_array() if time.in_step else time.xdot_old.x.array)

    def assemble_residual(self, forces: FloatArray) -> float:
        """Assemble the residual with the coupling forces.

        Args:
            forces: fluid on shell at the points, shape (points, d).

        Returns:
            Euclidean norm of the extracted residual; unit: force.
        """
        return self.system.assemble_residual(-forces / self.quadrature.rational[:, None])

    def momentum_scale(self) -> float:
        """Size of the terms that balance in the shell: the last tangent times the motion in this step; unit: force."""
        return self.system.product_norm(self.timeInt.x.x.array - self.timeInt.x_old.x.array)

    def rounding(self) -> FloatArray:
        """Rounding error of positions at the points, from the shell's own size, shape (points, d); unit: length."""
        x = self.quadrature.points + self._physical(self.timeInt.x.x.array)
        return ROUNDING * (x - x.mean(axis=0))

    def force_of(self, displacement: FloatArray) -> float:
        """Norm of the last tangent times a displacement of the points, shape (points, d); unit: force.

        The signs alternate from point to point, as those of rounding may: a smooth displacement would meet no
        resistance in a sheet that is straight.
        """
        signs = 1.0 - 2.0 * (np.arange(len(displacement)) % 2)
        return self.system.product_norm((signs * self.quadrature.rational)[:, None] * np.abs(displacement))

    @cached_property
    def displacements(self) -> sp.csr_matrix:
        """Displacements of the points by the coefficients that are free, shape (points d, coefficients)."""
        rows, d = self.spline.rows, self.spline.nsd
        free = np.ones(rows.shape[1])
        free[self.spline.zero_dofs] = 0.0
        return (sp.diags(np.repeat(1.0 / self.quadrature.rational, d)) @ rows @ sp.diags(free)).tocsr()

    def coupling_norm(self, forces: FloatArray) -> float:
        """Norm of point forces on the spline's functions; unit: force."""
        return float(np.linalg.norm(self.system.extract(forces / self.quadrature.rational[:, None])))

    @property
    def touching(self) -> "ContactForces | None":
        """Contact at the state of the last residual; None where no points interact."""
        forces = None if self.contact is None else self.system.forces
        return forces if forces is not None and forces.pairs else None

    def closing_ratio(self) -> float:
        """Largest approach in a step of two points that may interact, relative to the range of contact (collective)."""
        if self.contact is None:
            return 0.0
        x, v, dt = self.positions(), self.velocity(), self.timeInt.step_size
        if not (np.isfinite(x).all() and np.isfinite(v).all()):
            return np.inf
        return self.system.contact.closing_speed(x, v, dt) * dt / self.contact.kernel.r_max

    def renew_contact(self) -> None:
        """Bring the tangent's part of contact, and nothing else of it, to the present state."""
        if self.contact is not None:
            self.system.renew_contact()

    def assemble_tangent(self, W: FloatArray, penalty: float, *, positive: bool = False) -> None:
        """Assemble the tangent with the penalty's part, which is diagonal before extraction.

        Args:
            W: reference areas, zero at inactive points, shape (points,).
            penalty: beta.
            positive: whether to leave out what makes the tangent of contact indefinite.
        """
        if self.contact is not None:
            self.system.positive = positive
        diagonal = self.timeInt.xdot_factor * penalty * W / self.quadrature.rational**2
        self.system.assemble_tangent(np.repeat(diagonal[:, None], self.spline.nsd, axis=1))

    def solve(self) -> None:
        """Solve for the increment and subtract it.

        Raises:
            SolveError: the linear solver failed.
        """
        self.system.subtract(self.system.solve())

    def spacing(self, x: FloatArray) -> float:
        """Largest distance between neighbouring points along the element edges of the deformed shell.

        Args:
            x: positions of the points, shape (points, d).

        Returns:
            Unit: length.
        """
        a, b = (np.take(x, points, axis=0) for points in self.sheets.neighbours)
        return float(np.linalg.norm(a - b, axis=1).max(initial=0.0))
