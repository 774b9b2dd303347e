"""Front names of the packages: what is offered, where it comes from, and that nothing comes before it is asked for."""

import ast
import importlib
import pkgutil
import tomllib
from pathlib import Path

import pytest
from test_imports import modules_loaded_by

import tigar_x

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("tigar_x", "varmint", "shnapr", "coudalfish")


def stub(package):
    """Front names and their modules, as a type checker sees them."""
    body = ast.parse((ROOT / package / "__init__.pyi").read_text()).body
    return {alias.asname: node.module for node in body if isinstance(node, ast.ImportFrom) for alias in node.names}


def packages():
    """All packages and the packages in them."""
    for name in PACKAGES:
        yield name
        found = pkgutil.iter_modules(importlib.import_module(name).__path__)
        yield from (f"{name}.{inner.name}" for inner in found if inner.ispkg)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_front_name_is_the_one_of_its_module(package):
    front, names = importlib.import_module(package), stub(package)
    assert len(names) > 10
    assert front.__all__ == sorted(names)
    assert set(names) <= set(dir(front))
    for name, module in names.items():
        there = importlib.import_module(module)
        assert getattr(front, name) is getattr(there, name, None) or getattr(front, name).__name__ == f"{module}.{name}"


def test_no_front_name_is_two_things():
    names = [name for package in PACKAGES for name in stub(package)]
    assert len(names) == len(set(names))


@pytest.mark.parametrize("package", sorted(packages()))
def test_every_package_says_what_it_offers(package):
    offered = importlib.import_module(package).__all__
    assert offered
    assert len(offered) == len(set(offered))
    space = {}
    exec(f"from {package} import *", space)
    assert set(offered) <= set(space)


def test_there_is_one_version():
    versions = {importlib.import_module(package).__version__ for package in PACKAGES}
    assert versions == {tigar_x.__version__}
    assert f"\nversion: {tigar_x.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "tigar_x.front.__version__"}
    for package in PACKAGES:
        assert {"py.typed", "__init__.pyi"} <= set(project["tool"]["setuptools"]["package-data"][package])


def test_the_fronts_load_nothing_before_they_are_asked():
    loaded = modules_loaded_by(f"import {', '.join(PACKAGES)}")
    own = {name for name in loaded if name.split(".")[0] in PACKAGES}
    assert own == {"tigar_x.front", "tigar_x.moved", *PACKAGES}
    assert not {"dolfinx", "ufl", "scipy", "petsc4py"} & loaded


def test_a_front_name_loads_what_it_stands_on_alone():
    loaded = modules_loaded_by("from varmint import Velocity")
    assert "varmint.conditions" in loaded
    assert not {"varmint.quantities", "varmint.mesh.aorta", "tigar_x.geometry"} & loaded
