"""Compiled forms that are confined to some of their cells, again and again, without being compiled again."""

from functools import cached_property
from typing import Any

import cffi
import numpy as np
import ufl
from dolfinx import cpp, fem, mesh

from tigar_x.compat.algebra import SplitForm
from tigar_x.compat.forms import compile_forms
from tigar_x.compat.meshes import cell_name, cell_nodes, connectivity, owned_cells
from tigar_x.compat.release import VERSION, IntArray
from tigar_x.compat.spaces import cell_dofs

_FFI = cffi.FFI()
_Kind: Any = getattr(fem, "IntegralType", None) or cpp.fem.IntegralType  # the one since 0.10, the other before
KINDS = {"cell": _Kind.cell, "exterior_facet": _Kind.exterior_facet}
"""Kinds of integrals that can be confined: each entity belongs to one cell."""


class PartialForm:
    """A form whose integrals can be confined to cells that change, and to the facets of these.

    Args:
        form: integrals over cells, either all or tagged ones, and over tagged facets of the boundary.

    Raises:
        ValueError: it has other integrals, or some over all cells beside some over tagged ones.
    """

    def __init__(self, form: ufl.Form) -> None:
        spaces = [part.ufl_function_space() for part in (*form.arguments(), *form.coefficients())]
        self._mesh: Any = spaces[0].mesh
        data = {kind: self._tags(form, kind) for kind in KINDS}
        self._form = ufl.Form([_tagged(integral, data) for integral in form.integrals()])
        self._entities = {kind: self._all(kind, tags) for kind, tags in data.items() if tags is not None}

    @cached_property
    def whole(self) -> Any:
        """The compiled form in all cells."""
        return compile_forms(self._form)[0]

    def _tags(self, form: ufl.Form, kind: str) -> Any:
        """Tags of the entities of integrals of a kind; None: it has none."""
        integrals = [integral for integral in form.integrals() if integral.integral_type() == kind]
        others = {integral.integral_type() for integral in form.integrals()} - set(KINDS)
        if others:
            raise ValueError(f"form has integrals of type {', '.join(sorted(others))}: one of {', '.join(KINDS)}")
        everywhere = [integral.subdomain_id() == "everywhere" for integral in integrals]
        if not integrals:
            return None
        if not any(everywhere):
            return integrals[0].subdomain_data()
        if kind != "cell" or not all(everywhere):
            raise ValueError(f"form has integrals over all entities of type {kind} beside others: tags are required")
        every = np.arange(owned_cells(self._mesh), dtype=np.int32)
        return mesh.meshtags(self._mesh, self._mesh.topology.dim, every, np.zeros(len(every), dtype=np.int32))

    def _all(self, kind: str, tags: Any) -> tuple[IntArray, IntArray, IntArray]:
        """Entities, their tags and their cells, of this rank."""
        if kind == "cell":
            mine = tags.indices < owned_cells(self._mesh)
            return tags.indices[mine], tags.values[mine], tags.indices[mine]
        dim = self._mesh.topology.dim
        connectivity(self._mesh, dim, dim - 1)
        cells = connectivity(self._mesh, dim - 1, dim)
        outer = (np.diff(cells.offsets) == 1)[tags.indices]
        entities, values = tags.indices[outer], tags.values[outer]
        of = cells.array[cells.offsets[entities]]
        mine = of < owned_cells(self._mesh)
        return entities[mine], values[mine], of[mine]

    def on(self, cells: Any) -> Any:
        """The form in some cells, with the present values of all that it contains.

        Args:
            cells: mask of local cells, shape (cells,).

        Returns:
            A compiled form, or a bilinear one as :class:`SplitForm` where several ranks have the mesh.
        """
        spaces = [argument.ufl_function_space() for argument in self._form.arguments()]
        if len(spaces) < 2 or spaces[0] != spaces[1] or self._mesh.comm.size == 1:
            return self._in(cells)
        nodes, owned = cell_dofs(spaces[0]), owned_cells(self._mesh)
        inside = (nodes < spaces[0].dofmap.index_map.size_local).all(axis=1)
        beside = np.flatnonzero((cells & ~inside)[:owned])
        return SplitForm(self._in(cells & inside), self._in(cells & ~inside), nodes[beside])

    def _in(self, cells: Any) -> Any:
        chosen = {kind: (e[cells[of]], v[cells[of]]) for kind, (e, v, of) in self._entities.items()}
        coefficients, positions = self._form.coefficients(), self._positions()
        parts = (
            [argument.ufl_function_space()._cpp_object for argument in self._form.arguments()],
            [coefficients[i]._cpp_object for i in positions],
            [constant._cpp_object for constant in self._form.constants()],
        )
        return self._made(chosen, parts)

    def _positions(self) -> list[int]:
        """Which of the form's coefficients the compiled one contains."""
        compiled = self.whole.ufcx_form
        name = "original_coefficient_position" + ("" if VERSION < (0, 9) else "s")
        return [int(getattr(compiled, name)[i]) for i in range(compiled.num_coefficients)]

    def _made(self, chosen: dict[str, tuple[IntArray, IntArray]], parts: tuple[Any, ...]) -> Any:
        dims = {"cell": self._mesh.topology.dim, "exterior_facet": self._mesh.topology.dim - 1}
        tags = {kind: mesh.meshtags(self._mesh, dims[kind], *found) for kind, found in chosen.items()}
        whole = self.whole
        if VERSION < (0, 9):
            domains = {KINDS[kind]: found for kind, found in tags.items()}
            return type(whole)(whole.ufcx_form, *parts, domains, whole.mesh, _FFI, whole.code)
        forms: Any = fem.forms
        entities = {
            KINDS[kind]: forms.get_integration_domains(
                KINDS[kind], found, sorted(set(self._entities[kind][1].tolist()))
            )
            for kind, found in tags.items()
        }
        address: Any = whole.module.ffi.cast("uintptr_t", whole.module.ffi.addressof(whole.ufcx_form))
        maps: Any = {}
        if VERSION >= (0, 10):
            address, maps = [address], []
        made = type(whole._cpp_object)(address, *parts, entities, maps, whole.mesh)
        return forms.Form(made, whole.ufcx_form, whole.code, whole.module)


def partial_forms(*forms: ufl.Form) -> list[PartialForm]:
    """Forms that share functions, compiled at once: see :func:`tigar_x.compat.forms.compile_forms`.

    Args:
        forms: as :class:`PartialForm` takes them, on one mesh.
    """
    parts = [PartialForm(form) for form in forms]
    for part, whole in zip(parts, compile_forms(*(part._form for part in parts)), strict=True):
        part.whole = whole
    return parts


def _tagged(integral: Any, data: dict[str, Any]) -> Any:
    """An integral over all cells as one over those tagged 0."""
    if integral.subdomain_id() != "everywhere":
        return integral
    return integral.reconstruct(subdomain_id=0, subdomain_data=data[integral.integral_type()])


def equations(residual: ufl.Form, tangent: ufl.Form) -> tuple[Any, Any, Any]:
    """A residual and its tangent, compiled, and this once more as it is assembled in the least time.

    Several ranks with a mesh of tetrahedra assemble it as :class:`tigar_x.compat.SplitForm`, if it can be confined.

    Args:
        residual: residual.
        tangent: its tangent.
    """
    domain: Any = tangent.arguments()[0].ufl_function_space().mesh
    if domain.comm.size > 1 and cell_name(domain) == "tetrahedron":
        try:
            of_residual, of_tangent = partial_forms(residual, tangent)
        except ValueError:
            pass
        else:
            every = np.ones(len(cell_nodes(domain)), dtype=bool)
            return of_residual.whole, of_tangent.whole, of_tangent.on(every)
    whole = compile_forms(residual, tangent)
    return whole[0], whole[1], whole[1]
