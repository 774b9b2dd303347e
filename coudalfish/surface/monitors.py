"""What a run watches: slip, leak and balance of forces after every step."""

from dataclasses import dataclass

import numpy as np

from tigar_x.compat import FloatArray


@dataclass(frozen=True)
class Monitors:
    """Figures of one accepted step, all at the time ``t_alpha`` of its report, at which its equations hold.

    A history of them has that time as its abscissa; displacements and velocities belong to ``t``.

    Attributes:
        normal_slip_rms: root mean square of (u - y').n over the active surface, by reference areas; unit: length/time.
        normal_slip_max: its largest absolute value.
        leak: net volume through the surface per time, ``int (u - y').n`` over its present area; positive along the
            normals of the patches as they are parametrised; unit: length^d/time.
        force: force of the fluid on the shell, components, the one that moved the shell in this step; unit: force.
        force_imbalance: difference between the force taken from the fluid and the force given to the shell, relative
            to the sum of absolute point forces.
    """

    normal_slip_rms: float
    normal_slip_max: float
    leak: float
    force: tuple[float, ...]
    force_imbalance: float


def monitors_of(
    slip: FloatArray,
    n: FloatArray,
    W: FloatArray,
    forces: FloatArray,
    on_fluid: FloatArray,
    on_shell: FloatArray,
    *,
    areas: FloatArray | None = None,
) -> Monitors:
    """Monitors from the arrays of a step.

    Args:
        slip: u - y' at the points, shape (points, d).
        n: normals, shape (points, d).
        W: reference areas, zero at inactive points, shape (points,).
        forces: fluid on shell at the points, shape (points, d).
        on_fluid: sum over the nodes of the forces that the fluid received, shape (d,).
        on_shell: sum over the nodes of the physical forces that the shell received, shape (d,).
        areas: present areas, zero at inactive points, shape (points,); None: W.

    Returns:
        The figures.
    """
    normal = np.einsum("qi,qi->q", slip, n) * (W > 0.0)
    area = float(W.sum())
    total = float(np.abs(forces).sum())
    imbalance = float(np.abs(on_fluid + on_shell).sum())
    return Monitors(
        normal_slip_rms=float(np.sqrt((W * normal**2).sum() / area)) if area else 0.0,
        normal_slip_max=float(np.abs(normal).max(initial=0.0)),
        leak=float(((W if areas is None else areas) * normal).sum()),
        force=tuple(float(f) for f in on_shell),
        force_imbalance=imbalance / total if total else 0.0,
    )
