"""Two ribbons tied in a reef knot and pulled tight: contact of thin shells that bend, slide and press on each other.

Each ribbon enters and leaves on its own side, and its bight lies around both strands of the other one. The first is
held where X_1 < -6; the second is pulled along x_1 by a body force where X_1 > 10 and cannot move across there. What
must hold is measured in every step: contact makes neither force nor torque, momentum changes by the load, the supports
and damping alone, backward Euler makes no energy, and no point moves so far that it could pass another one.

Data but for the shape of the knot: D. Kamensky, F. Xu, C.-H. Lee, J. Yan, Y. Bazilevs, M.-C. Hsu, "A contact
formulation based on a volumetric potential", doi:10.1016/j.cma.2017.11.007.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from shnapr.conditions import Damping, DeadLoad
from shnapr.contact.kernels import LinearKernel
from shnapr.contact.piercings import piercings
from shnapr.contact.recipe import ContactRecipe
from shnapr.contact.self_contact import SelfContact
from shnapr.loads import dead_load
from shnapr.problems.knots import Crossings, joined
from shnapr.shell.options import ShellError, ShellOptions, ShellReport
from shnapr.shell.shell import Shell
from shnapr.svk import StVenantKirchhoff
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.schemes import backward_euler
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.multipatch import MultiPatch, disjoint
from tigar_x.geometry.ribbon import CentreLine, ribbon
from tigar_x.run.running import Run
from tigar_x.run.stepping import IntegratorStepper
from tigar_x.splines import sampling
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline

SQUARE_KNOT = 9
"""Determinant of the reef knot with its ends joined: the product of those of two trefoils."""
CENTRE, WIDTH, THICKNESS, DENSITY, DAMPING, HELD, PULLED = 2.0, 0.5, 0.004, 1.0, 1.0, -6.0, 10.0
BODY_FORCE, TIME_STEP, STEPS = 1e3, 2.5e-4, 6000
MATERIAL = StVenantKirchhoff(1e7, 0.3, THICKNESS)
CONTACT = ContactRecipe(LinearKernel(0.15, 1e8), 0.4, spacing=None)
STRAND = (
    *((-9.0, 0.58, 0.0), (-8.0, 0.58, 0.0), (-7.0, 0.58, 0.0), (-5.5, 0.58, 0.0), (-4.2, 0.58, 0.0)),
    *((-1.53, 0.58, 0.45), (0.0, 1.41, -0.55), (1.11, 1.86, -0.27), (1.72, 1.12, 0.5), (1.53, 0.0, 0.73)),
)
"""Points on one strand of the first ribbon, from its end to the middle of its bight, seen from the knot's centre: over
the bight of the second ribbon, down through it and under its strand, and up over both its strands."""
FINE = 7.0
"""Distance along the ribbon from the middle of the bight within which elements are fine."""


def breakpoints(length: float, element: float) -> FloatArray:
    """Ends of the elements along a ribbon, the same from both ends; those beyond FINE are 2.5 times as long."""
    half = length / 2
    coarse = np.linspace(0.0, half - FINE, 1 + round((half - FINE) / (2.5 * element)))
    start = np.concatenate([coarse[:-1], np.linspace(half - FINE, half, 1 + round(FINE / element))])
    return np.concatenate([start, length - start[-2::-1]])


def ribbons(elements_across: int, degree: int = 2) -> MultiPatch:
    """The two ribbons; the second is the first one turned by 180 degrees about the x_2 axis through the centre.

    Args:
        elements_across: a ribbon; those along it are 1.2 times as long in the knot.
        degree: of the splines.
    """
    there = np.array(STRAND)
    points = np.concatenate([there, there[-2::-1] * (1.0, -1.0, 1.0)])
    tied = []
    for turned in ((1.0, 1.0, 1.0), (-1.0, 1.0, -1.0)):
        line = CentreLine.through((CENTRE, 0.0, 0.0) + points * turned)
        along = BSplineBasis(degree, open_knots(degree, breakpoints(line.length, 1.2 * WIDTH / elements_across)))
        tied.append(ribbon(line, WIDTH, (0.0, 0.0, 1.0), along, shapes.uniform(degree, elements_across)))
    return disjoint(*tied)


@dataclass
class Ledger:
    """Balances of a run so far.

    Attributes:
        work: of the load.
        damping: energy that damping took.
        gained: energy that came from nowhere; negative: what backward Euler dissipated.
        largest_gain: of a single step, relative to the work until then or to the energy, whichever is larger.
        force_imbalance: largest change of momentum that no force explains, relative to the load.
        contact_force: largest sum of the contact forces, relative to the sum of their magnitudes.
        contact_torque: largest sum of their torques, likewise.
        distance: smallest distance of points that may touch; unit: length.
        motion: largest displacement of a point in a step, relative to the smallest distance then.
        pairs: largest number of interacting pairs.
        newton_iterations: those of accepted steps.
        substeps: accepted steps.
        failures: attempts that Newton did not solve.
    """

    work: float = 0.0
    damping: float = 0.0
    gained: float = 0.0
    largest_gain: float = -np.inf
    force_imbalance: float = 0.0
    contact_force: float = 0.0
    contact_torque: float = 0.0
    distance: float = np.inf
    motion: float = 0.0
    pairs: int = 0
    newton_iterations: int = 0
    substeps: int = 0
    failures: int = 0


class Knot:
    """The ribbons, loose at first.

    Args:
        elements_across: a ribbon.
        dt: time step.

    Attributes:
        shell: both ribbons.
        time: its integrator.
        quadrature: nodal, exact for momentum.
        force: resultant of the load, shape (3,).
        ledger: the balances.
        row: last step of the history.
    """

    def __init__(self, elements_across: int = 3, dt: float = TIME_STEP) -> None:
        geometry = ribbons(checks.whole("resolution", elements_across, 1))
        held = geometry.dofs(geometry.where(lambda x: x[0] < HELD))
        guided = geometry.dofs(geometry.where(lambda x: x[0] > PULLED), (1, 2))
        spline = ExtractedSpline(geometry, MPI.COMM_SELF, zero_dofs=np.concatenate([held, guided]))
        pull = ufl.conditional(ufl.gt(spline.F[0], PULLED), DENSITY * THICKNESS * BODY_FORCE, 0.0)
        pulled = ufl.as_vector([pull, 0.0, 0.0])
        scene: dict[str, Any] = {"density": DENSITY, "contact": CONTACT, "loads": [DeadLoad(pulled), Damping(DAMPING)]}
        self.shell = Shell(spline, MATERIAL, dt=dt, scheme=backward_euler(2), **scene)
        self.time: Any = self.shell.time
        self._system: Any = self.shell.system
        self._middle = [
            sampling.line(spline, 0, 4 * len(patch.bases[0].breakpoints), patch=k)
            for k, patch in enumerate(geometry.patches)
        ]
        self.quadrature, self._nodal = NodalQuadrature.of(spline), compat.create_vector(spline.V)
        self._result = spline.M.createVecRight()
        load, self._residual = compat.compile_forms(
            dead_load(spline, pulled, ufl.TestFunction(spline.V)), self.shell.residual
        )
        compat.assemble_vector(self._nodal, load)
        self._load = -self._nodal.array_r.reshape(-1, 3)
        self.force: FloatArray = self._load.sum(axis=0)
        spline.M.multTranspose(self._nodal, self._result)
        self.shell.options = ShellOptions(rtol=0.0, atol=1e-6 * float(self._result.norm()), max_iterations=12)
        self.ledger, self.row = Ledger(), dict[str, Any]()
        self.begin()

    def begin(self) -> None:
        """Open the ledger with the present state."""
        self.ledger = Ledger()
        self._momentum, self._energies = self.momentum(), self.energies()

    # -- steps --------------------------------------------------------------------------------------------------------

    def run(self, **options: Any) -> Run:
        """A run, whose steps are halved where Newton fails, see :class:`tigar_x.run.running.Run`."""
        sizes = {"dofs_shell": 3 * self.shell.spline.geometry.n}
        return Run(IntegratorStepper(self.take_step, ShellError, halvings=7, sizes=sizes, shell=self.time), **options)

    def take_step(self, measure: Any = None) -> ShellReport:
        """Advance by one time step, and enter it into the ledger.

        Args:
            measure: has to be None: the supports' forces are what is measured in a step.

        Raises:
            ShellError: the step failed; the state is that before it.
        """
        before = self.shell.y.x.array.copy()
        try:
            report = self.shell.take_step(measure=self._reactions)
        except ShellError:
            self.ledger.failures += 1
            raise
        held = report.measured.sum(axis=0)
        self._enter(report, (self.shell.y.x.array - before).reshape(-1, 3), held)
        return report

    def _enter(self, report: ShellReport, moved: FloatArray, held: FloatArray) -> None:
        ledger, dt = self.ledger, self.time.step_size
        momentum, energies = self.momentum(), self.energies()
        rate = (momentum - self._momentum) / dt + DAMPING * momentum
        imbalance = float(np.abs(rate - self.force - held).max() / self.force[0])
        work, damping = float((self._load * moved).sum()), 2.0 * DAMPING * dt * energies[0]
        gained = float((energies - self._energies).sum()) - work + damping
        self._momentum, self._energies = momentum, energies
        ledger.newton_iterations += report.iterations
        ledger.substeps += 1
        ledger.work += work
        ledger.damping += damping
        ledger.gained += gained
        ledger.largest_gain = max(ledger.largest_gain, gained / max(abs(ledger.work), energies.sum()))
        ledger.force_imbalance = max(ledger.force_imbalance, imbalance)
        distance, contact = self._enter_contact(float(np.linalg.norm(moved, axis=1).max())), self._system.forces
        self.row = dict(zip(("kinetic", "elastic", "contact"), energies, strict=True))
        self.row |= {name: getattr(ledger, name) for name in ("work", "damping", "gained")}
        self.row |= {f"held_{i}": value for i, value in enumerate(held, 1)}
        self.row |= {"force_imbalance": imbalance, "pairs": contact.pairs, "distance": distance}
        self.row |= {name: getattr(ledger, name) for name in ("newton_iterations", "substeps", "failures")}

    def _enter_contact(self, moved: float) -> float:
        """Enter the contact of the step, and return the smallest distance, r_max where nothing touches."""
        ledger, contact = self.ledger, self._system.forces
        distance = min(contact.distance, CONTACT.kernel.r_max)
        ledger.distance = min(ledger.distance, distance)
        ledger.motion = max(ledger.motion, moved / distance)
        ledger.pairs = max(ledger.pairs, contact.pairs)
        if contact.pairs:
            ledger.contact_force = max(ledger.contact_force, _surplus(contact.forces))
            torques = np.cross(self.shell.positions, contact.forces)
            ledger.contact_torque = max(ledger.contact_torque, _surplus(torques))
        return distance

    # -- what is measured ---------------------------------------------------------------------------------------------

    def momentum(self) -> FloatArray:
        """Momentum of the last accepted state; the nodal rule is exact for it."""
        v = self.time.xdot_old.x.array.reshape(-1, 3)
        return np.asarray(DENSITY * THICKNESS * self.quadrature.weights @ v)

    def energies(self) -> FloatArray:
        """Kinetic, elastic and contact energy of the last accepted state."""
        found = self.shell.energies()
        return np.array([found.kinetic, found.elastic, found.contact])

    def _reactions(self) -> FloatArray:
        """Forces of the supports on the control points in the step that was just solved, shape (functions, 3)."""
        spline = self.shell.spline
        compat.assemble_vector(self._nodal, self._residual)
        self._nodal.array_w += self._system.forces.forces.ravel()
        spline.M.multTranspose(self._nodal, self._result)
        forces = np.zeros(spline.geometry.n * 3)
        forces[spline.zero_dofs] = self._result.array_r[spline.zero_dofs]
        return forces.reshape(-1, 3)

    def centre_lines(self) -> tuple[FloatArray, FloatArray]:
        """Present centre lines of the two ribbons as polygons."""
        first, second = (line.positions(self.shell.y) for line in self._middle)
        return first, second

    def crossings(self) -> Crossings:
        """Crossings of the knot with its ends joined."""
        return Crossings.of(joined(*self.centre_lines()))

    @cached_property
    def first(self) -> Any:
        """Mask of the nodes of the first ribbon."""
        spline = self.shell.spline
        functions = spline.geometry.functions
        return functions.patch_of(spline.V.tabulate_dof_coordinates()[:, : functions.dim]) == 0

    def piercings(self) -> int:
        """Number of places where the net of nodes goes through itself."""
        spline = self.shell.spline
        quads = compat.subcells(spline.V)[1]
        return piercings(self.shell.positions, quads, spline.node_positions, CONTACT.r_self)

    @property
    def spacing_ratio(self) -> float:
        """Spacing of the points over r_max within the knot, where it matters."""
        q = self.quadrature
        near = np.abs(q.points[:, 0] - CENTRE) < 2.4
        part = NodalQuadrature(q.points[near], q.weights[near], q.rational[near])
        return SelfContact(part, CONTACT.kernel, CONTACT.r_self).spacing_ratio


def _surplus(vectors: FloatArray) -> float:
    """Magnitude of a sum relative to the sum of the magnitudes."""
    return float(np.linalg.norm(vectors.sum(axis=0)) / np.linalg.norm(vectors, axis=1).sum())
