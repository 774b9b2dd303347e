"""Components of finite element functions as linear functions, which every viewer of files understands."""

from collections.abc import Callable, Mapping, Sequence

from dolfinx import fem, mesh

from tigar_x import compat
from tigar_x.compat import IntArray

Components = tuple[fem.Function | Callable[[], fem.Function], Sequence[int]]
"""A function, or what computes it from the present state, and the components of it that make a field."""


class VertexValues:
    """Linear functions with the vertex values of others.

    Args:
        domain: mesh.
        fields: what to copy, by name; what computes a function gives the same one every time.

    Attributes:
        functions: the linear functions, of as many components as were chosen, by name.

    Raises:
        IndexError: a function has no such component.
    """

    def __init__(self, domain: mesh.Mesh, fields: Mapping[str, Components]) -> None:
        self.functions: dict[str, fem.Function] = {}
        self._pairs: list[tuple[fem.Function, IntArray, fem.Function, IntArray]] = []
        self._computed: list[Callable[[], fem.Function]] = []
        vertices = compat.cell_vertices(domain).shape[1]
        for name, (given, components) in fields.items():
            if isinstance(given, fem.Function):
                source = given
            else:
                source = given()
                self._computed.append(given)
            size = len(components)
            target = fem.Function(compat.lagrange_space(domain, 1, size), name=name)
            to = compat.cell_dofs(target.function_space)[:, :vertices].ravel()
            for i, component in enumerate(components):
                scalar, parent = compat.component_space(source.function_space, component)
                origin = parent[compat.cell_dofs(scalar)[:, :vertices].ravel()]
                self._pairs.append((target, size * to + i, source, origin))
            self.functions[name] = target

    def update(self) -> None:
        """Compute what is computed, and copy the present values."""
        for compute in self._computed:
            compute()
        for target, to, source, origin in self._pairs:
            target.x.array[to] = source.x.array[origin]
