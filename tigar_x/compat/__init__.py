"""The one place that knows which dolfinx it runs on.

Everything in the four packages that differs between dolfinx releases is spelled here, once, one theme a module; no
other module asks for a version. A release is supported when the test suite has run on it: 0.5 (Debian 12), 0.9
(Debian 13) and 0.11 (the PyPI wheel dolfinx-solver-real). ``make test``, ``make test-trixie`` and ``make test-wheel``
run it.
"""

from tigar_x.compat.algebra import (
    accumulate,
    apply_values,
    assemble_matrix,
    assemble_scalar,
    assemble_vector,
    constrained_dofs,
    create_matrix,
    create_vector,
    free_dropped,
    freed_with,
    petsc_vector,
    pin_component,
)
from tigar_x.compat.forms import C_FLAGS, compile_cpu_seconds, compile_forms, compile_seconds
from tigar_x.compat.meshes import (
    bounding_box_tree,
    candidate_cells,
    cell_name,
    cell_vertices,
    create_mesh,
    owned_cells,
)
from tigar_x.compat.release import VERSION, FloatArray, IntArray
from tigar_x.compat.spaces import (
    cell_dofs,
    component_space,
    interpolate,
    lagrange_space,
    mixed_space,
    node_points,
    subcells,
    tabulate,
)

__all__ = [
    "VERSION",
    "FloatArray",
    "IntArray",
    "C_FLAGS",
    "compile_cpu_seconds",
    "compile_forms",
    "compile_seconds",
    "interpolate",
    "cell_dofs",
    "component_space",
    "lagrange_space",
    "mixed_space",
    "node_points",
    "subcells",
    "tabulate",
    "bounding_box_tree",
    "candidate_cells",
    "cell_name",
    "cell_vertices",
    "create_mesh",
    "owned_cells",
    "accumulate",
    "apply_values",
    "assemble_matrix",
    "assemble_scalar",
    "assemble_vector",
    "constrained_dofs",
    "create_matrix",
    "create_vector",
    "free_dropped",
    "freed_with",
    "petsc_vector",
    "pin_component",
]
