"""Where public modules and names of the release before this one are now: what an import of an old path says.

An old path fails, with the new one in its message. This module is for one release: the next one starts with empty
tables.
"""

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.abc import MetaPathFinder
from types import ModuleType
from typing import NoReturn

_FOLDERS = {
    "tigar_x.fem": "eigen kept line_search linear load_stepping low_rank newton recipes rounding solve"
    " time_integration",
    "tigar_x.run": "checkpoint nodal output restart script vertex_values vtkhdf writing",
    "tigar_x.geometry": "bspline files functions lines locate multipatch patch ribbon shapes surfaces",
    "tigar_x.splines": "constraints extraction measures projection quadrature saved space spline spline_system",
    "varmint.forms": "ale boundary motion solids space vms",
    "varmint.flow": "attachments flow start steady",
    "shnapr.contact": "neighbours",
    "coudalfish.surface": "band exchange monitors multiplier sheets slip trace",
    "coudalfish.sides": "handover mesh_motion scales",
    "coudalfish.step": "acceleration acceptance floors levels options report watch",
}

MODULES = {
    f"{folder.split('.')[0]}.{name}": f"{folder}.{name}" for folder, names in _FOLDERS.items() for name in names.split()
}
"""Modules of today by their old paths."""
MODULES |= {
    "tigar_x.gluing": "tigar_x.geometry.joints",
    "tigar_x.refinement": "tigar_x.run.convergence",
    "varmint.flow_checks": "varmint.flow.checks",
    "varmint.flow_options": "varmint.flow.options",
    "varmint.mesh": "varmint.mesh.named",
    "varmint.mesh_aorta": "varmint.mesh.aorta",
    "varmint.mesh_arrays": "varmint.mesh.arrays",
    "varmint.mesh_checks": "varmint.mesh.checks",
    "varmint.mesh_elements": "varmint.mesh.elements",
    "varmint.mesh_files": "varmint.mesh.files",
    "varmint.mesh_gmsh": "varmint.mesh.models",
    "varmint.mesh_meshio": "varmint.mesh.formats",
    "varmint.mesh_msh": "varmint.mesh.msh",
    "varmint.mesh_scripts": "varmint.mesh.scripts",
    "varmint.mesh_session": "varmint.mesh.session",
    "varmint.pictures": "tigar_x.run.plane_field",
    "shnapr.contact": "shnapr.contact.self_contact",
    "shnapr.contact_kernels": "shnapr.contact.kernels",
    "shnapr.contact_system": "shnapr.contact.system",
    "coudalfish.step": "coudalfish.step.attempt",
    "coudalfish.subproblems": "coudalfish.sides.fluid",
}

_NAMES = {
    ("tigar_x.compat", "tigar_x.compat"): "mixed_space=mixed_lagrange_space",
    ("tigar_x.compat.release", "tigar_x.compat.release"): "table=as_table",
    ("tigar_x.compat.spaces", "tigar_x.compat.spaces"): "mixed_space=mixed_lagrange_space",
    ("tigar_x.extraction", "tigar_x.splines.extraction"): "lagrange_degree=element_degree",
    ("tigar_x.multipatch", "tigar_x.geometry.gluing"): "ALL glued",
    ("tigar_x.output", "tigar_x.splines.vtu"): "VTUSeries",
    ("tigar_x.patch", "tigar_x.geometry.net"): "ControlNet",
    ("tigar_x.ribbon", "shnapr.contact.piercings"): "piercings",
    ("tigar_x.ribbon", "shnapr.problems.knots"): "Crossings",
    ("tigar_x.script", "tigar_x.run.progress"): "Progress Stopwatch Termination peak_rss_mib rss_mib",
    ("tigar_x.script", "tigar_x.run.summary"): "Quantity plain table versions write_summary",
    ("tigar_x.space", "tigar_x.fem.extracted"): "Extracted extracted_matrix",
    ("tigar_x.time_integration", "tigar_x.fem.schemes"): "Scheme backward_euler companion generalized_alpha",
    ("tigar_x.writing", "tigar_x.ranks"): "P PATIENCE all_come gathered on_root portable root_only together tried",
    ("varmint.attachments", "varmint.flow.pressure"): "NEAR pressure_pin",
    ("varmint.attachments", "varmint.flow.clock"): "FlowTime Needs=FlowNeeds",
    ("varmint.conditions", "tigar_x.compat"): "given",
    ("varmint.conditions", "varmint.conditions"): "Fields=FlowFields",
    ("varmint.mesh_checks", "varmint.mesh.checks"): "extruded=extruded_arrays",
    ("varmint.mesh_files", "varmint.mesh.files"): "read=read_mesh",
    ("varmint.solids", "varmint.forms.solids"): "Material=SolidMaterial NeoHookean=NeoHookeanSolid"
    " StVenantKirchhoff=StVenantKirchhoffSolid",
    ("varmint.start", "tigar_x.fem.projection"): "project",
    ("shnapr.stress", "shnapr.stress"): "Solid=MaterialAtPoint",
    ("coudalfish.mesh_motion", "coudalfish.sides.mesh_motion"): "MeshMotion=MovingMesh",
    ("coudalfish.monitors", "coudalfish.surface.monitors"): "measure=monitors_of",
    ("coudalfish.slip", "coudalfish.surface.slip"): "Slip=RelativeSlip",
    ("coudalfish.coupler", "coudalfish.intervals"): "advance",
    ("coudalfish.subproblems", "coudalfish.sides.shell"): "ROUNDING ShellSubproblem",
}

NAMES = {
    f"{old}.{name.partition('=')[0]}": f"{new}.{name.rpartition('=')[2]}"
    for (old, new), names in _NAMES.items()
    for name in names.split()
}
"""Names of today by their old paths, where they are called otherwise, or not in the module of the rest of theirs."""

WITHDRAWN = {"varmint.start": "varies"}
"""Names that no module offers now, by their old modules."""


def home(path: str) -> str | None:
    """Path of today of an old public module or name.

    Args:
        path: with dots, ``tigar_x.linear`` or ``tigar_x.linear.direct``.

    Returns:
        The path; None: none was there, or it still is.
    """
    if path in NAMES or path in MODULES:
        return NAMES.get(path) or MODULES[path]
    module, _, name = path.rpartition(".")
    new = MODULES.get(module)
    return f"{new}.{name}" if new and not name.startswith("_") and hasattr(import_module(new), name) else None


def guide(module: str) -> Callable[[str], NoReturn]:
    """``__getattr__`` of a module or package that names have left.

    Args:
        module: its path, ``__name__``.

    Returns:
        What says where a name is now, and fails. In a package it raises AttributeError, so that ``from package import
        name`` goes on to the modules in it and comes to :class:`Guide`. In a module it raises ImportError: only that
        keeps its words there.
    """

    def lost(name: str) -> NoReturn:
        words = _words(f"{module}.{name}")
        if words and not hasattr(sys.modules[module], "__path__"):
            raise ImportError(words, name=module)
        raise AttributeError(words or f"module {module!r} has no attribute {name!r}")

    return lost


class Guide(MetaPathFinder):
    """The last one whom an import asks: nobody has found the module, and an old path is told the new one."""

    def find_spec(self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> None:
        """Find nothing.

        Args:
            fullname: path of a module that nobody has found.
            path: where to look.
            target: module that is loaded again.

        Raises:
            ImportError: the path is an old one.
        """
        words = _words(fullname) if fullname.startswith(("tigar_x.", "varmint.", "shnapr.", "coudalfish.")) else None
        if words:
            raise ImportError(words, name=fullname)


def install() -> None:
    """Append the guide to those whom an import asks, once."""
    if not any(isinstance(finder, Guide) for finder in sys.meta_path):
        sys.meta_path.append(Guide())


def _words(path: str) -> str | None:
    """What to say of an old path: where it is, and what of an old module is elsewhere."""
    new = home(path)
    if new is None:
        return None
    elsewhere: dict[str, list[str]] = {}
    for old_name, new_name in NAMES.items():
        module, name = old_name.rsplit(".", 1)
        if module == path:
            there, called = new_name.rsplit(".", 1)
            elsewhere.setdefault(there, []).append(name if name == called else f"{name} (called {called})")
    besides = ", ".join(f"{', '.join(names)} in {there}" for there, names in elsewhere.items())
    gone = ", ".join(WITHDRAWN.get(path, "").split())
    return (
        f"{path} is now {new}"
        + (f"; of its names, {besides}" if besides else "")
        + (f"; no longer public: {gone}" if gone else "")
    )
