"""Front names of a package: loaded when they are first asked for, so that importing the package costs nothing else."""

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from tigar_x.moved import guide

__version__ = "0.1.0"


def front(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package (PEP 562).

    The package's stub, ``__init__.pyi``, is the one list of its front names: type checkers and editors read its
    imports, and so does this function.

    Args:
        package: its path, ``__name__``.

    Returns:
        The three. A name that is not there raises AttributeError, which says where it is if it has moved.
    """
    module = sys.modules[package]
    stub = Path(str(module.__file__)).with_suffix(".pyi")
    imports = [node for node in ast.parse(stub.read_text()).body if isinstance(node, ast.ImportFrom)]
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}
    lost = guide(package)

    def load(name: str) -> Any:
        if name not in homes:
            lost(name)
        there = import_module(homes[name])
        value = getattr(there, name) if hasattr(there, name) else import_module(f"{homes[name]}.{name}")
        setattr(module, name, value)
        return value

    return load, lambda: sorted({*vars(module), *homes}), sorted(homes)


def modules_of(package: str) -> list[str]:
    """Names of the public modules and packages that are in a package: its ``__all__`` where it has no front names."""
    return sorted(found.name for found in iter_modules(sys.modules[package].__path__) if found.name[0] != "_")
