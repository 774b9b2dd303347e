"""Imports point one way: the packages know only what lies below them."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("tigar_x", "shnapr", "varmint", "coudalfish")
GROUND = {"compat", "checks", "ranks", "fem", "run"}
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).glob("**/*.py"))
HEAVY = ("gmsh", "meshio", "matplotlib", "splipy", "h5py", "slepc4py")


def imports(tree, *, top_level_only=False):
    """Full names of all modules that a syntax tree imports."""
    nodes = tree.body if top_level_only else ast.walk(tree)
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def forbidden(package, name):
    """Why a package must not import a name, or None."""
    parts = name.split(".")
    if parts[0] not in PACKAGES or parts[0] == package:
        return None
    below = {"tigar_x": (), "shnapr": ("tigar_x",), "varmint": ("tigar_x",), "coudalfish": ("tigar_x", "shnapr")}
    if parts[0] not in below[package]:
        return f"{package} must not know {parts[0]}"
    if package == "varmint" and len(parts) > 1 and parts[1] not in GROUND:
        return f"varmint must not know tigar_x.{parts[1]}"
    return None


def test_there_are_modules_to_check():
    assert len(MODULES) >= 20
    assert {path.relative_to(ROOT).parts[0] for path in MODULES} == set(PACKAGES)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path):
    package = path.relative_to(ROOT).parts[0]
    reasons = [forbidden(package, name) for name in imports(ast.parse(path.read_text()))]
    assert not any(reasons), [reason for reason in reasons if reason]


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_heavy_libraries_only_inside_functions(path):
    found = [n for n in imports(ast.parse(path.read_text()), top_level_only=True) if n.split(".")[0] in HEAVY]
    assert not found


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_no_star_print_assert_or_exit(path):
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        assert not isinstance(node, ast.Assert), f"assert in line {node.lineno}"
        if isinstance(node, ast.ImportFrom):
            assert all(alias.name != "*" for alias in node.names)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in ("print", "exit"), f"{node.func.id} in line {node.lineno}"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_only_compat_branches_on_a_version(path):
    assert path.parent.name == "compat" or "VERSION" not in path.read_text()


def test_demos_do_not_import_each_other():
    demos = sorted((ROOT / "demos").glob("*.py"))
    assert demos
    names = {path.stem for path in demos}
    for path in demos:
        assert not names & {name.split(".")[0] for name in imports(ast.parse(path.read_text()))}


@pytest.mark.parametrize(
    ("package", "line"),
    [
        ("tigar_x", "import shnapr"),
        ("shnapr", "from coudalfish import CouDALFISh"),
        ("varmint", "from tigar_x.splines.spline import ExtractedSpline"),
        ("varmint", "from tigar_x.splines import spline"),
        ("coudalfish", "import varmint.forms.vms"),
    ],
)
def test_the_check_can_fail(package, line):
    assert any(forbidden(package, name) for name in imports(ast.parse(line)))
