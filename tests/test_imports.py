"""A scene pays only for what is in it."""

import json
import os
import subprocess
import sys

import pytest
from mpi_runs import outside
from scenes import sheet_in_flow

from tigar_x.splines.spline_system import SplineSystem

OPTIONAL = {"gmsh", "meshio", "matplotlib", "pyvista", "splipy", "h5py", "slepc4py"}


def modules_loaded_by(statement):
    code = f"import json, sys; {statement}; print(json.dumps(sorted(sys.modules)))"
    env = {key: value for key, value in os.environ.items() if not key.startswith(("OMPI_", "PMIX_", "PMI_"))}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=env)
    return set(json.loads(done.stdout.splitlines()[-1]))


def loaded_by(statement):
    return {name.split(".")[0] for name in modules_loaded_by(statement)}


@pytest.mark.parametrize(
    "package",
    [
        "coudalfish.coupler",
        "varmint.quantities",
        "varmint.mesh.models",
        "shnapr.svk",
        "shnapr.contact.system",
        "tigar_x.geometry.surfaces",
        "tigar_x.fem.eigen",
    ],
)
def test_import_pulls_in_nothing_optional(package):
    assert not loaded_by(f"import {package}") & OPTIONAL


COUPLED = (
    "from coudalfish import CouDALFISh, CouplingOptions, FluidSubproblem, ShellSubproblem, SurfaceBand, StepError;"
    "from varmint import Flow, FlowOptions, Velocity, WeakVelocity, Slip, Traction, Resistance, box;"
    "from shnapr import StVenantKirchhoff, clamped, internal_work, inertia;"
    "from tigar_x import ExtractedSpline, TimeIntegrator, VTUSeries, generalized_alpha"
)
"""What a coupled run without contact imports."""


def test_a_coupled_scene_without_contact_loads_no_mesher_plotter_or_contact():
    loaded = modules_loaded_by(COUPLED)
    assert not {name.split(".")[0] for name in loaded} & OPTIONAL
    unused = ("shnapr.contact", "varmint.mesh.models", "varmint.mesh.session", "tigar_x.run.plane_field")
    assert not {name for name in loaded if name.startswith(unused)}


def test_the_check_sees_an_optional_library():
    assert "meshio" in loaded_by("import coudalfish, meshio")


def test_flow_needs_no_spline_or_shell():
    code = "import varmint.flow, varmint.quantities, tigar_x.run.plane_field, varmint.mesh.files, varmint.mesh.models"
    loaded = modules_loaded_by(code)
    assert not {name.split(".")[0] for name in loaded} & {"shnapr", "coudalfish"}
    assert not [name for name in loaded if name.startswith(("tigar_x.splines", "tigar_x.geometry"))]
    assert "tigar_x.fem.linear" in loaded


def test_no_contact_object_without_contact():
    fsi = sheet_in_flow().fsi
    assert fsi.contactContext_sh is None
    assert fsi.shell.contact is None
    assert type(fsi.shell.system) is SplineSystem
    assert fsi.takeStep().contact is None


def test_the_order_of_constants_is_all_that_importing_changes_in_ufl():
    """As the docstring of tigar_x says."""
    code = """
import importlib, json, pkgutil, sys
import mpi4py.MPI, dolfinx.fem.petsc, ufl.algorithms
def contents(thing):
    if isinstance(thing, type):
        return {key: id(value) for key, value in vars(thing).items()}
    if isinstance(thing, (list, tuple, set)):
        return [id(value) for value in thing]
    return {key: id(value) for key, value in thing.items()} if isinstance(thing, dict) else None
modules = {name: module for name, module in sys.modules.items() if name.split(".")[0] == "ufl"}
def state():
    return {f"{name}.{key}": (id(value), contents(value))
            for name, module in modules.items() for key, value in known[name].items()}
known = {name: {key: value for key, value in vars(module).items() if not key.startswith("__")}
         for name, module in modules.items()}
before = state()
for package in ("tigar_x", "shnapr", "varmint", "coudalfish"):
    for found in pkgutil.walk_packages(importlib.import_module(package).__path__, package + "."):
        importlib.import_module(found.name)
known = {name: {key: getattr(module, key, None) for key in known[name]} for name, module in modules.items()}
after = state()
print(json.dumps([len(before), sorted(key for key in before if before[key] != after[key])]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=outside())
    names, changed = json.loads(done.stdout.splitlines()[-1])
    assert names > 1000
    assert changed == ["ufl.sorting._terminal_cmps"]
