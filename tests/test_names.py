"""One name, one thing: what two public classes or functions are called, and how."""

import ast
import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MODULES = sorted(
    p for package in ("tigar_x", "varmint", "shnapr", "coudalfish") for p in (ROOT / package).rglob("*.py")
)
SPOKEN_WITH_THEIR_MODULE = {"box", "line"}
"""A box of shapes is a volume, one of a flow is its mesh; shapes' line is a curve, sampling's the points on one."""
OF_THE_PAPER = {"takeStep"}


def definitions(tree):
    """Public classes, functions and names of types (all but constants) that a module defines."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            yield node.targets[0].id


def twice(sources):
    """Names that several modules define, each with the modules; constants, loggers and type variables aside."""
    found = defaultdict(list)
    for module, text in sources.items():
        for name in definitions(ast.parse(text)):
            if not name.startswith("_") and not name.isupper() and name != "log":
                found[name].append(module)
    return {name: modules for name, modules in found.items() if len(modules) > 1}


def test_no_public_name_is_two_things():
    found = twice({str(path.relative_to(ROOT)): path.read_text() for path in MODULES})
    assert {name: where for name, where in found.items() if name not in SPOKEN_WITH_THEIR_MODULE} == {}
    assert set(found) == SPOKEN_WITH_THEIR_MODULE


def test_a_name_of_two_things_is_found():
    sources = {"a": "class Solid:\n    pass\nlog = 1", "b": "Solid = A | B\nlog = 1", "c": "def solid():\n    pass"}
    assert twice(sources) == {"Solid": ["a", "b"]}


def test_functions_and_methods_are_in_snake_case():
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and node.name not in OF_THE_PAPER:
                # a letter of mathematics may be a capital, between underscores
                assert all(re.fullmatch(r"[a-z0-9]*|[A-Z]", word) for word in node.name.split("_")), (path, node.name)
