"""What a shell consists of: spline, equations and state, with or without a clock."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem
from numpy.typing import ArrayLike
from petsc4py import PETSc

from shnapr.conditions import Load
from shnapr.parameters import constant_of, with_constants
from shnapr.shell.dynamics import check_binding
from shnapr.shell.equations import Displacements
from shnapr.shell.options import ShellOptions
from shnapr.shell.quantities import Places, field_of
from shnapr.shell.supported import supported
from shnapr.work import Material
from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import LinearSolver, chosen, direct
from tigar_x.fem.schemes import Scheme, companion, generalized_alpha, require_scheme
from tigar_x.fem.time_integration import LoadStepper, TimeIntegrator
from tigar_x.geometry.multipatch import MultiPatch
from tigar_x.geometry.patch import Patch
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem

if TYPE_CHECKING:
    from shnapr.contact.self_contact import SelfContact
    from shnapr.shell.membrane_forces import MembraneForces
    from tigar_x.splines.sampling import Sampling

__all__ = ["Scene"]

PREFIX = "shell_"
"""Of the PETSc options of a shell's linear solver."""


class Contact(Protocol):
    """Recipe of contact, such as :class:`shnapr.ContactRecipe`."""

    def of(self, quadrature: NodalQuadrature) -> "SelfContact":
        """The contact between points."""


class Scene(checks.Made):
    """A shell without what solves for it; the arguments and attributes are those of :class:`shnapr.shell.Shell`."""

    _ELSEWHERE: ClassVar[Mapping[str, str]] = {
        "dt": "time.step_size",
        "step_size": "time.step_size",
        "thickness": "material.thickness.value",
    }
    _PARTS = ("spline", "material", "density", "loads", "contact", "solver", "y")

    def __init__(
        self,
        geometry: Patch | MultiPatch | ExtractedSpline,
        material: Material,
        *,
        density: Any = None,
        clamped: Sequence[str] = (),
        pinned: Sequence[str] = (),
        zero_dofs: ArrayLike | Sequence[int] = (),
        constraints: Sequence[sp.spmatrix] = (),
        loads: Sequence[Load] = (),
        contact: Contact | None = None,
        dt: float | None = None,
        scheme: Scheme | None = None,
        updates: Sequence[Callable[[float], None]] = (),
        formulation: Literal["displacement", "mixed"] = "displacement",
        quadrature_degree: int | None = None,
        solver: LinearSolver | PETSc.KSP | None = None,
        options: ShellOptions | None = None,
        comm: MPI.Comm = MPI.COMM_SELF,
        copies: MPI.Comm = MPI.COMM_WORLD,
    ) -> None:
        if density is not None:
            checks.parameter("density", density, checks.not_negative)
        wanted = "a material, such as shnapr's StVenantKirchhoff or Hyperelastic,"
        checks.having("material", material, "energy_density", wanted)
        for i, load in enumerate(checks.listed("loads", loads)):
            checks.having(f"loads[{i}]", load, "term", "a load, such as shnapr's Pressure(1.0)")
        if contact is not None:
            checks.having("contact", contact, "of", "a recipe, such as shnapr's ContactRecipe(kernel, r_self)")
        checks.listed("updates", updates)
        if scheme is not None:
            require_scheme("scheme", scheme)
        if options is not None:
            checks.kind("options", options, ShellOptions, "a ShellOptions")
        if dt is None and scheme is not None:
            raise ValueError("dt = None with a scheme: a time step is required, or neither")
        is_mixed = checks.choice("formulation", formulation, ("displacement", "mixed")) == "mixed"
        if is_mixed and contact is not None:
            raise ValueError("formulation = 'mixed' with contact: formulation = 'displacement' is required")
        self.spline = supported(
            geometry, comm, clamped=clamped, pinned=pinned, zero_dofs=zero_dofs, constraints=constraints,
            quadrature_degree=quadrature_degree,
        )  # fmt: skip
        domain = self.spline.mesh
        self.copies = copies if domain.comm.size == 1 else MPI.COMM_SELF
        self.material = with_constants(domain, material)
        self.density = constant_of(domain, density)
        self.loads = tuple(with_constants(domain, load) for load in loads)
        self.solver = chosen(solver, direct(), PREFIX)
        self.updates = tuple(updates)
        self.options = ShellOptions() if options is None else options
        self.contact = None if contact is None else contact.of(NodalQuadrature.of(self.spline))
        self.y = self.spline.function(name="y")
        self._velocity: fem.Function | None = None
        self._unbound: Displacements | MembraneForces | None = None
        self.time: TimeIntegrator | None = None
        self._equations: Displacements | MembraneForces = self._static_equations(is_mixed)
        if dt is not None:
            self._set_clock(dt, generalized_alpha(0.5, 2) if scheme is None else scheme, 0.0)
        self._is_made = True

    def _static_equations(self, is_mixed: bool) -> "Displacements | MembraneForces":
        scene = (self.spline, self.material, self.density, self.loads)
        if not is_mixed:
            return Displacements(*scene, LoadStepper(self.y, 1.0))
        from shnapr.shell.membrane_forces import MembraneForces

        return MembraneForces(*scene, self.y)

    def __repr__(self) -> str:
        kind = "a curve" if self.spline.dim == 1 else "a surface"
        parts = [f"{kind} of {self.spline.geometry.n} functions", type(self.material).__name__]
        parts += [type(load).__name__ for load in self.loads]
        parts += [] if self.contact is None else ["contact"]
        parts.append("statics" if self.time is None else f"t = {self.time.time:g}, dt = {self.time.step_size:g}")
        return f"Shell({', '.join(parts)})"

    # -- clock --------------------------------------------------------------------------------------------------------

    def bind(self, dt: float, scheme: Scheme, t: float = 0.0) -> None:
        """Give a shell that has no clock one that others have as well, or check that its own agrees.

        Displacement and velocity are then those that it has, such as of a static solve before.

        Args:
            dt: time step; unit: time.
            scheme: of second order; for one of first order, as a flow has, its companion is taken.
            t: time of the present state.

        Raises:
            ValueError: the shell has no density, or a clock of its own that differs.
        """
        wanted = companion(scheme) if scheme.order == 1 else scheme
        if self.time is None:
            statics = self._equations
            self._set_clock(dt, wanted, t)
            self._unbound = statics
        else:
            check_binding(self.time, dt, wanted, t)

    def release(self) -> None:
        """Give back a clock that :meth:`bind` brought and that no step was made with: the shell is what it was before.

        Raises:
            ValueError: the shell has no such clock.
        """
        if self._unbound is None:
            raise ValueError(f"{self!r} has no clock that bind() brought")
        self._equations, self.time, self._unbound = self._unbound, None, None
        self._forget()

    def _set_clock(self, dt: float, scheme: Scheme, t: float) -> None:
        self._in_displacements("a clock")
        if self.density is None:
            raise ValueError("density = None: one is required of a shell that moves in time")
        checks.choice("order of scheme", scheme.order, (2,))
        time = TimeIntegrator(self.y, dt, scheme, t=t, xdot=self._velocity)
        self._equations = Displacements(self.spline, self.material, self.density, self.loads, time)
        self.time = time
        self._forget()

    def _forget(self) -> None:
        for name in ("system", "_energies"):
            self.__dict__.pop(name, None)

    # -- equations ----------------------------------------------------------------------------------------------------

    @property
    def residual(self) -> ufl.Form:
        """Residual without contact, at the level of the equations."""
        return self._equations.residual

    @property
    def tangent(self) -> ufl.Form:
        """Its derivative by the unknown."""
        return self._equations.tangent

    def _in_displacements(self, name: str) -> Displacements:
        if not isinstance(self._equations, Displacements):
            raise ValueError(f"formulation = 'mixed': {name} requires formulation = 'displacement'")
        return self._equations

    @cached_property
    def system(self) -> SplineSystem:
        """Compiled system."""
        of, unknown = self._equations, self._equations.clock.x
        if self.contact is None:
            return SplineSystem(of.space, of.residual, of.tangent, self.solver, unknown=unknown, prefix=PREFIX)
        from shnapr.contact.system import ContactSystem

        return ContactSystem(
            self.spline,
            of.residual,
            of.tangent,
            self.contact,
            unknown=unknown,
            time=self.time,
            solver=self.solver,
            prefix=PREFIX,
        )

    def compile(self) -> None:
        """Compile the forms now instead of at the first solve."""
        _ = self.system

    @property
    def unknowns(self) -> int:
        """Global number of coefficients that move."""
        space = self._equations.space
        return int(space.M.getSize()[1]) - len(space.zero_dofs)

    # -- states -------------------------------------------------------------------------------------------------------

    def start(self, displacement: Any = None, velocity: Any = None) -> None:
        """Set the state at the present time; in statics the load factor is zero again.

        Args:
            displacement: coefficients, shape (functions, nsd), or a UFL vector over the reference configuration (such
                as of ``shell.spline.F``), which is projected; None: undeformed.
            velocity: likewise; None: at rest. Without a clock it is kept for the one that :meth:`bind` brings.

        Raises:
            ValueError: a shape is not allowed.
        """
        y, v = (field_of(self.spline, *data) for data in (("displacement", displacement), ("velocity", velocity)))
        if isinstance(self._equations, Displacements):
            self.y.x.array[:] = y.x.array
        elif displacement is None and velocity is None:
            self._equations.reset()
        else:
            raise ValueError("formulation = 'mixed': it starts undeformed, displacement and velocity are not allowed")
        clock = self._equations.clock
        if isinstance(clock, LoadStepper):
            self._velocity = v
            clock.resume(0.0)
            return
        clock.x_old.x.array[:], clock.xdot_old.x.array[:], clock.xddot_old.x.array[:] = y.x.array, v.x.array, 0.0

    @property
    def load_factor(self) -> float:
        """Part of the loads that the present state carries; 1 in time."""
        clock = self._equations.clock
        return clock.time if isinstance(clock, LoadStepper) else 1.0

    @property
    def positions(self) -> FloatArray:
        """Present positions of this rank's nodes, shape (nodes, nsd); unit: length."""
        return self.spline.node_positions + self.spline.nodal(self.y)

    def at(self, place: "str | ArrayLike | Sampling", *, along: float = 0.5, patch: int = 0) -> Places:
        """Where points of the shell are (collective).

        Args:
            place: name of a side, such as that of a tip; or parameters within a patch, shape (..., parametric
                dimension), of a curve also one number; or a sampling, made once for many states, see
                :mod:`tigar_x.splines.sampling`.
            along: of a side of a surface: how far along it the point is, from 0 to 1.
            patch: whose side or parameters.

        Returns:
            The places, of as many points.

        Raises:
            ValueError: there is no such side or patch, or a parameter lies outside of it.
        """
        return Places.of(self.spline, self.y, place, along, patch)
