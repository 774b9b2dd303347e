"""Every public name says what it is, what it takes and what it gives."""

import importlib
import inspect
import pkgutil

import pytest

PACKAGES = ("tigar_x", "shnapr", "varmint", "coudalfish")


def modules():
    for package in PACKAGES:
        root = importlib.import_module(package)
        yield root
        for info in pkgutil.walk_packages(root.__path__, package + "."):
            yield importlib.import_module(info.name)


MODULES = {module.__name__: module for module in modules()}


def public(module):
    """Public functions, classes and methods that a module defines, by qualified name."""
    for name, thing in vars(module).items():
        if name.startswith("_") or getattr(thing, "__module__", None) != module.__name__:
            continue
        if inspect.isfunction(thing):
            yield name, thing
        elif inspect.isclass(thing):
            yield name, thing
            for key, member in vars(thing).items():
                function = member.__func__ if isinstance(member, classmethod | staticmethod) else member
                function = function.fget if isinstance(function, property) else function
                if not key.startswith("_") and inspect.isfunction(function):
                    yield f"{name}.{key}", function


def parameters(function):
    names = list(inspect.signature(function).parameters)
    return [name for name in names if name not in ("self", "cls")]


@pytest.mark.parametrize("name", MODULES)
def test_public_names_are_documented(name):
    module = MODULES[name]
    assert inspect.getdoc(module)
    for qualified, thing in public(module):
        doc = inspect.getdoc(thing)
        assert doc, qualified
        if inspect.isfunction(thing) and parameters(thing):
            described = "Args:" in doc or all(word in doc for word in parameters(thing)) or len(doc.splitlines()) == 1
            assert described, f"{qualified} does not describe {parameters(thing)}"


@pytest.mark.parametrize("name", MODULES)
def test_public_functions_are_typed(name):
    for qualified, thing in public(MODULES[name]):
        if inspect.isfunction(thing):
            hints = thing.__annotations__
            missing = [p for p in [*parameters(thing), "return"] if p not in hints]
            assert not missing, f"{qualified}: {missing}"


@pytest.mark.parametrize("name", [name for name in MODULES if name in PACKAGES])
def test_packages_name_their_source(name):
    assert "doi:" in inspect.getdoc(MODULES[name])
