"""The house stands: imports point down, nothing goes in circles, and every module and function is of a size to read."""

import ast
import re
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
BELOW = {"tigar_x": (), "shnapr": ("tigar_x",), "varmint": ("tigar_x",), "coudalfish": ("tigar_x", "shnapr")}
"""What each package may know beside itself."""
GROUND = (
    "tigar_x.moved",
    "tigar_x.front",
    "tigar_x.compat",
    "tigar_x.checks",
    "tigar_x.ranks",
    "tigar_x.fem",
    "tigar_x.run",
)
"""What a flow may know of tigar_x: nothing of splines."""
ON_TOP = ("coudalfish.cli", "coudalfish.__main__")
"""The command line, whose self-test runs a flow: it may know all four packages, and none of them knows it."""
FLOORS = tuple(
    tuple(floor.split())
    for floor in (
        "tigar_x.moved",
        "tigar_x.front",
        "tigar_x.compat",
        "tigar_x.checks",
        "tigar_x.ranks",
        "tigar_x.fem",
        "tigar_x.run",
        "tigar_x.geometry",
        "tigar_x.splines",
        "tigar_x",
        "shnapr.kinematics shnapr.parameters",
        "shnapr.smoothness shnapr.svk shnapr.hyperelastic",
        "shnapr.work",
        "shnapr.loads shnapr.mixed shnapr.stress shnapr.supports",
        "shnapr.conditions",
        "shnapr.planes shnapr.contact",
        "shnapr.shell",
        "shnapr.problems",
        "shnapr",
        "varmint.mesh varmint.profiles",
        "varmint.forms",
        "varmint.conditions",
        "varmint.flow",
        "varmint.quantities varmint.errors",
        "varmint.problems",
        "varmint",
        "coudalfish.surface",
        "coudalfish.sides",
        "coudalfish.step",
        "coudalfish.intervals coudalfish.courant coudalfish.restart",
        "coudalfish.run",
        "coudalfish.coupler",
        "coudalfish.refinement coudalfish.problems coudalfish.valves",
        "coudalfish.valve_pictures",
        "coudalfish",
        "coudalfish.cli",
        "coudalfish.__main__",
    )
)
"""Modules and packages from the ground up: each knows those before it and its own floor. A package's ``__init__`` is
its face, and stands where its contents do, or on top of them."""
MODULE_LINES, FUNCTION_LINES = 350, 60
"""How long a module may be, and a function without its signature and docstring."""
LONGER = {"benchmarks/defaults.py:studies": "a list of settings"}
"""What may be longer, "path" or "path:function", and why."""
DEMO_LINES, SHARED = {"heart_valve": 150, "valve_2d": 150, "others": 100}, 0.15
"""How long a demo may be, and which part of its code may stand in another one."""
HEAVY = ("gmsh", "meshio", "matplotlib", "pyvista", "splipy", "h5py", "slepc4py")


def name_of(path: Path) -> str:
    """Full name of a module of ours; of its package for an ``__init__``."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


DEMOS, BENCHMARKS = (sorted((ROOT / folder).glob("*.py")) for folder in ("demos", "benchmarks"))
MODULES = sorted(path for package in BELOW for path in (ROOT / package).glob("**/*.py"))
NAMES = {name_of(path) for path in MODULES}
each_module = pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
each_of_ours = pytest.mark.parametrize("path", MODULES + BENCHMARKS, ids=lambda path: str(path.relative_to(ROOT)))


def imports(tree: ast.Module, *, top_level_only: bool = False) -> Iterator[str]:
    """Full names of all that is imported, also inside functions and for types only: modules, or names in them."""
    for node in tree.body if top_level_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module or ''}.{alias.name}" for alias in node.names)


def module_of(name: str) -> str | None:
    """The module of ours that an imported name is or lies in; None: none of ours."""
    while name and name not in NAMES:
        name = name.rpartition(".")[0]
    return name or None


def graph_of(sources: dict[str, str]) -> dict[str, set[str]]:
    """For every module those of ours that it imports."""
    found = {name: {module_of(imported) for imported in imports(ast.parse(text))} for name, text in sources.items()}
    return {name: {other for other in others if other and other != name} for name, others in found.items()}


GRAPH = graph_of({name_of(path): path.read_text() for path in MODULES})


def floor_of(module: str) -> int | None:
    """Number of the floor of a module, that of the nearest package of its which has one; None: no floor."""
    for number, floor in enumerate(FLOORS):
        if module in floor:
            return number
    parent = module.rpartition(".")[0]
    return floor_of(parent) if "." in parent else None


def why_forbidden(module: str, imported: str) -> str | None:
    """Why a module of ours must not import another one, or None."""
    package, other = module.split(".")[0], imported.split(".")[0]
    if other != package and other not in BELOW[package] and not module.startswith(ON_TOP):
        return f"{package} must not know {other}"
    if package == "varmint" and other == "tigar_x" and not imported.startswith(GROUND):
        return f"varmint must not know {imported}"
    own, its = floor_of(module), floor_of(imported)
    if own is None or its is None:
        return f"{module if own is None else imported} has no floor"
    return f"{module} must not know {imported}, which is above it" if its > own else None


def circle_in(graph: dict[str, set[str]]) -> list[str] | None:
    """Modules that import each other in a circle; None: there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return None


def long_functions(tree: ast.Module) -> dict[str, int]:
    """Lines of functions that are too long, from the first statement after the docstring to the last."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            body = node.body[ast.get_docstring(node) is not None :]
            lines = node.end_lineno - body[0].lineno + 1 if body else 0
            if lines > FUNCTION_LINES:
                found[node.name] = lines
    return found


# -- imports ----------------------------------------------------------------------------------------------------------


def test_there_are_modules_to_check():
    assert len(MODULES) >= 100
    assert len(BENCHMARKS) >= 30
    assert {name.split(".")[0] for name in NAMES} == set(BELOW)
    assert sum(map(len, GRAPH.values())) > 300


@each_module
def test_imports_point_down(path):
    reasons = [why_forbidden(name_of(path), imported) for imported in GRAPH[name_of(path)]]
    assert not any(reasons), [reason for reason in reasons if reason]


def test_every_floor_is_there_and_every_module_stands_on_one():
    assert {name for floor in FLOORS for name in floor} <= NAMES
    assert [name for name in NAMES if floor_of(name) is None] == []


def test_nothing_goes_in_circles():
    assert circle_in(GRAPH) is None


@each_module
def test_imports_are_by_full_names(path):
    for name in imports(ast.parse(path.read_text())):
        assert not name.startswith("."), name
        assert not name.endswith(".*"), name


@each_module
def test_heavy_libraries_only_inside_functions(path):
    found = [n for n in imports(ast.parse(path.read_text()), top_level_only=True) if n.split(".")[0] in HEAVY]
    assert not found


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("tigar_x.checks", "import shnapr"),
        ("shnapr.work", "from coudalfish import CouDALFISh"),
        ("varmint.mesh.named", "from tigar_x.splines.spline import ExtractedSpline"),
        ("varmint.mesh.named", "from tigar_x.splines import spline"),
        ("coudalfish.coupler", "import varmint.forms.vms"),
        ("tigar_x.fem.newton", "from tigar_x.splines.space import SplineSpace"),
        ("tigar_x.fem.newton", "if TYPE_CHECKING:\n    from tigar_x.run import script"),
        ("varmint.forms.vms", "def f():\n    import varmint.conditions"),
        ("shnapr.loads", "from shnapr import contact"),
        ("coudalfish.sides.fluid", "from coudalfish.coupler import CouDALFISh"),
        ("tigar_x.geometry.patch", "from tigar_x import VERSION"),
        ("varmint.somewhere", "import varmint.mesh.named"),
        ("coudalfish.coupler", "from coudalfish.cli.tell import say"),
    ],
)
def test_an_import_that_points_up_is_found(module, line):
    assert any(why_forbidden(module, imported) for imported in graph_of({module: line})[module])


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("varmint.mesh.named", "from tigar_x.fem import linear"),
        ("coudalfish.coupler", "from shnapr.work import Material"),
        ("tigar_x.splines.space", "from tigar_x.splines.extraction import set_nodal\nimport numpy"),
        ("varmint", "from varmint.flow import Flow"),
        ("coudalfish.cli.problems", "from varmint.flow import Flow"),
    ],
)
def test_an_import_that_points_down_is_none(module, line):
    assert not any(why_forbidden(module, imported) for imported in graph_of({module: line})[module])


@pytest.mark.parametrize(
    "back",
    [
        "from shnapr import stress",
        "def late():\n    import shnapr.stress",
        "if TYPE_CHECKING:\n    from shnapr.stress import Resultants",
    ],
)
def test_a_circle_on_one_floor_is_found(back):
    sources = {
        "shnapr.stress": "import shnapr.loads",
        "shnapr.loads": "from shnapr.planes import RigidPlane",
        "shnapr.planes": back,
    }
    circle = circle_in(graph_of(sources))
    assert circle is not None
    assert set(circle) == set(sources)
    assert circle_in(graph_of(sources | {"shnapr.planes": "import numpy"})) is None


def test_a_circle_through_the_face_of_a_package_is_found():
    sources = {
        "varmint.flow": "from varmint.flow.flow import Flow",
        "varmint.flow.flow": "from varmint.flow import FlowOptions",
    }
    assert circle_in(graph_of(sources)) is not None


# -- sizes ------------------------------------------------------------------------------------------------------------


@each_of_ours
def test_modules_are_short(path):
    lines = len(path.read_text().splitlines())
    assert lines <= MODULE_LINES or str(path.relative_to(ROOT)) in LONGER, lines


@each_of_ours
def test_functions_are_short(path):
    found = long_functions(ast.parse(path.read_text()))
    assert {name: n for name, n in found.items() if f"{path.relative_to(ROOT)}:{name}" not in LONGER} == {}


def test_exceptions_to_the_sizes_are_needed():
    for place in LONGER:
        path, _, function = place.partition(":")
        text = (ROOT / path).read_text()
        assert function in long_functions(ast.parse(text)) if function else len(text.splitlines()) > MODULE_LINES


def test_a_function_that_is_too_long_is_found():
    """Neither its signature nor its docstring counts."""
    signature = "def f(" + ",\n".join(f"a{i}" for i in range(40)) + "):\n"
    documented = signature + '    """First.\n' + "\n" * 40 + '    """\n'
    body = "    x = 1\n" * FUNCTION_LINES
    assert long_functions(ast.parse(documented + body)) == {}
    assert long_functions(ast.parse(documented + body + "    x = 2\n")) == {"f": FUNCTION_LINES + 1}
    inside = "class A:\n" + "".join(f"    {line}\n" for line in (documented + body + "    x = 2\n").splitlines())
    assert long_functions(ast.parse(inside)) == {"f": FUNCTION_LINES + 1}


# -- habits -----------------------------------------------------------------------------------------------------------


@each_module
def test_no_print_assert_or_exit(path):
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        assert not isinstance(node, ast.Assert), f"assert in line {node.lineno}"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in ("print", "exit"), f"{node.func.id} in line {node.lineno}"


@each_module
def test_only_compat_branches_on_a_version(path):
    assert path.parent.name == "compat" or "VERSION" not in path.read_text()


def test_demos_do_not_import_each_other():
    assert DEMOS
    names = {path.stem for path in DEMOS}
    for path in DEMOS:
        assert not names & {name.split(".")[0] for name in imports(ast.parse(path.read_text()))}


def code_of(path: Path) -> list[str]:
    """Lines of a script without blank ones, comments and imports."""
    text = path.read_text()
    nodes = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom))
    imported = {number for node in nodes for number in range(node.lineno, (node.end_lineno or node.lineno) + 1)}
    lines = [line.strip() for i, line in enumerate(text.splitlines(), 1) if i not in imported]
    return [line for line in lines if line and not line.startswith("#")]


def shared(one: list[str], other: list[str]) -> float:
    """Part of the lines of one script that stand in another as well, but for lone punctuation."""
    return sum(line in other and len(line) > 3 for line in one) / len(one)


@pytest.mark.parametrize("path", DEMOS, ids=lambda path: path.stem)
def test_demos_are_short_and_show_each_its_own_problem(path):
    assert len(path.read_text().splitlines()) <= DEMO_LINES.get(path.stem, DEMO_LINES["others"])
    others = {other.stem: shared(code_of(path), code_of(other)) for other in DEMOS if other != path}
    assert max(others.values()) <= SHARED, others


def test_scripts_that_share_lines_are_found():
    assert shared(["a = 1", "b = 2", ")", "c = 3"], ["b = 2", ")"]) == 0.25


def unlisted(text: str) -> list[str]:
    """Modules that the tables of floors, one a package, do not name, each beside its sub-package."""
    package, named = "", set()
    for line in text.split("## Floors")[1].split("\n## ")[0].splitlines():
        cells = line.split("|")
        if len(cells) == 4 and cells[2].strip() == "holds":
            package = cells[1].strip(" `")
        elif len(cells) == 4:
            packages = [f"{package}.{name}" for name in re.findall(r"`(\w+)`", cells[1])]
            named.update(packages, (f"{inner}.{word}" for inner in packages for word in re.findall(r"\w+", cells[2])))
    own = {name for name in NAMES if name.count(".") == 2 and name.split(".")[1] == name.split(".")[2]}  # flow.flow
    return sorted(NAMES - named - own - set(BELOW))


def test_the_layout_in_the_documents_has_every_module():
    text = (ROOT / "docs" / "architecture.md").read_text()
    assert unlisted(text) == []
    assert unlisted(text.replace("petsc_options", "")) == ["tigar_x.fem.petsc_options"]
