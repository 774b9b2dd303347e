"""A scene pays only for what is in it: modules that it imports, forms that it compiles, functions that it makes."""

from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec

import economy
import pytest

SPLINES = ("shnapr", "coudalfish", "tigar_x.geometry", "tigar_x.splines")
FLOWS = ("varmint", "coudalfish")
OUTPUT = ("tigar_x.run",)
CONTACT = ("shnapr.contact",)
SPACE = tuple(
    f"coudalfish.surface.{name}"
    for name in ("films", "in_space", "net", "on_polygons", "pockets", "surfaces", "triangles", "boxes")
)
"""For surfaces that divide tetrahedra."""
SIDES = (
    *SPACE,
    "coudalfish.sides.sided_fluid",
    *(f"coudalfish.surface.{name}" for name in ("cut_cells", "divided_mesh", "enriched", "in_plane", "interface")),
    "tigar_x.fem.divided",
    "tigar_x.fem.doubled",
    "varmint.flow.sides",
    "varmint.forms.sides",
)
"""For fields that know the sides of a surface."""
CONVERGED = ("coudalfish.step.condensed", "coudalfish.step.converged", "coudalfish.surface.hats")
FOLLOWING = ("coudalfish.refinement", "coudalfish.sides.transfer", "varmint.mesh.refined")
"""For meshes that are made anew on the way."""
ONE_MATERIAL = ("shnapr.hyperelastic", "shnapr.mixed", "shnapr.planes", "tigar_x.geometry.surfaces")

# What a scene has not: modules, and features of forms by the fields that bring them.
UNUSED = {
    "plane_flow": (*SPLINES, *OUTPUT),
    "steady_cavity": (*SPLINES, *OUTPUT),
    "static_shell": (*FLOWS, *OUTPUT, *CONTACT, "tigar_x.splines.saved", "tigar_x.geometry.files"),
    "touching_shell": (*FLOWS, *OUTPUT),
    "coupled": (*OUTPUT, *FOLLOWING, *CONTACT, *ONE_MATERIAL, *SIDES, *CONVERGED),
    "sharp": (*OUTPUT, *FOLLOWING, *CONTACT, *ONE_MATERIAL, *SPACE),
    "coupled_in_space": (*OUTPUT, *FOLLOWING, *CONTACT, *ONE_MATERIAL, *SIDES, *CONVERGED),
    "beam_in_flow": SPLINES,
}
FIELDS = {
    "mesh_displacement": "a mesh that moves",
    "scale_m": "an immersed surface",
    "negative": "sides of it",
    "_old": "time",
}
FEATURES = {
    "plane_flow": {"time"},
    "steady_cavity": set(),
    "static_shell": set(),
    "touching_shell": set(),
    "coupled": {"an immersed surface", "time"},
    "sharp": {"sides of it", "time"},
    "coupled_in_space": {"an immersed surface", "time"},
    "beam_in_flow": {"a mesh that moves", "time"},
}
HEAVY = {"plane_flow": set(), "steady_cavity": set(), "beam_in_flow": {"gmsh", "scipy.spatial"}}
SPLINES_NEED = {"scipy.optimize", "scipy.spatial"}  # as scipy.interpolate does
MOST = {  # forms and functions
    "plane_flow": (2, 7),
    "steady_cavity": (2, 5),
    "static_shell": (3, 2),
    "touching_shell": (4, 2),
    "coupled": (8, 12),
    "sharp": (10, 26),
    "coupled_in_space": (8, 20),
    "beam_in_flow": (6, 16),
}


@pytest.fixture(scope="module")
def found():
    """Costs of all scenes, each measured in a process of its own."""
    with ThreadPoolExecutor(2) as pool:
        return dict(zip(economy.SCENES, pool.map(measured, economy.SCENES), strict=True))


def measured(name):
    """None where what the scene needs is not there."""
    return None if name == "beam_in_flow" and find_spec("gmsh") is None else economy.measured(name)


def of(found, name):
    if found[name] is None:
        pytest.skip("gmsh is not there")
    return found[name]


def within(modules, parts):
    return [name for name in modules if any(name == part or name.startswith(part + ".") for part in parts)]


def test_every_scene_is_measured(found):
    assert set(found) == set(UNUSED) == set(FEATURES) == set(MOST)
    assert len(found) == 8


@pytest.mark.parametrize("name", UNUSED)
def test_a_scene_imports_nothing_that_it_does_not_use(name, found):
    costs = of(found, name)
    assert not within(costs["modules"], UNUSED[name])
    assert set(costs["heavy"]) <= HEAVY.get(name, SPLINES_NEED)


@pytest.mark.parametrize("name", FEATURES)
def test_forms_have_no_features_that_the_scene_has_not(name, found):
    fields = [field for form in of(found, name)["forms"] for field in form["coefficients"]]
    assert {feature for key, feature in FIELDS.items() if any(key in field for field in fields)} == FEATURES[name]


@pytest.mark.parametrize("name", MOST)
def test_a_scene_compiles_and_makes_no_more_than_it_did(name, found):
    costs = of(found, name)
    forms, functions = MOST[name]
    assert len(costs["forms"]) <= forms
    assert costs["functions"] <= functions
    assert costs["matrices"] > 0


def test_the_check_sees_what_is_imported(found):
    modules = found["touching_shell"]["modules"]
    assert within(modules, CONTACT)
    assert within(modules, SPLINES)
    assert set(within(found["sharp"]["modules"], SIDES)) == set(SIDES) - set(SPACE)
    assert not within(["shnapr.contacts", "tigar_x.runs"], (*CONTACT, *OUTPUT))
