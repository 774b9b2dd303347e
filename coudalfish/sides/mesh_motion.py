"""A fluid mesh that moves: what the coupling asks of its motion, and where its cells are.

Forms are assembled on the mesh at rest, with the pull-back in them; immersed points live among displaced cells.
"""

import math
from typing import Protocol

from dolfinx import mesh

from tigar_x import compat
from tigar_x.compat import FloatArray
from tigar_x.fem.time_integration import TimeIntegrator


class MovingMesh(Protocol):
    """Motion of a fluid mesh, such as those of ``varmint.forms.motion``.

    Attributes:
        time: second-order integrator of the displacement, at the level of the flow's.
        degree: polynomial degree of the displacement.
    """

    time: TimeIntegrator
    degree: int

    def move(self) -> None:
        """Displace the mesh to the end of the step, starting from the predictor (collective).

        Raises:
            SolveError: no displacement was found.
        """

    def check(self) -> None:
        """Check the mesh at the end of the step (collective).

        Raises:
            SolveError: a cell is inside out.
        """


def check_displacement(motion: MovingMesh, mesh_f: mesh.Mesh) -> None:
    """Check that points can be located in the displaced mesh.

    Args:
        motion: motion of the mesh.
        mesh_f: fluid mesh.

    Raises:
        ValueError: the displacement lives on another mesh, or its cells do not stay affine simplices.
    """
    if motion.time.x.function_space.mesh is not mesh_f:
        raise ValueError("moving displaces another mesh: the fluid's is required")
    if motion.degree != 1:
        raise ValueError(
            f"moving has a displacement of degree {motion.degree}: 1 is required, points are located in affine cells"
        )


def check_levels(motion: MovingMesh, timeInt_f: TimeIntegrator) -> None:
    """Check that mesh and flow share clock and intermediate level.

    Args:
        motion: motion of the mesh.
        timeInt_f: the flow's integrator.

    Raises:
        ValueError: they do not, or the mesh's integrator is of another order than 2.
    """
    own, flow = motion.time, timeInt_f
    if not (
        math.isclose(own.time, flow.time, abs_tol=1e-12 * flow.step_size)
        and math.isclose(own.step_size, flow.step_size)
    ):
        raise ValueError(
            f"clocks (t, dt): fluid {flow.time, flow.step_size}, mesh {own.time, own.step_size}: they must be equal"
        )
    if own.scheme.order != 2 or not math.isclose(own.scheme.alpha_f, flow.scheme.alpha_f):
        raise ValueError(
            f"order, alpha_f of the mesh: {own.scheme.order}, {own.scheme.alpha_f}: 2 and the fluid's"
            f" {flow.scheme.alpha_f} are required"
        )


def displacement_of_cells(motion: MovingMesh) -> FloatArray:
    """Displacement of the vertices of this rank's cells at the intermediate level, where immersed points are.

    Args:
        motion: motion of the mesh.

    Returns:
        Shape (owned cells, vertices, d); unit: length.
    """
    V = motion.time.x.function_space
    cells = compat.cell_dofs(V)[: compat.owned_cells(V.mesh)]
    return motion.time.x_alpha_array().reshape(-1, V.mesh.geometry.dim)[cells]
