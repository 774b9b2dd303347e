"""Numbers of materials and loads as dolfinx Constants, so that other numbers compile nothing again."""

from dataclasses import fields, is_dataclass, replace
from numbers import Real
from typing import Any, TypeVar, get_args

import numpy as np
from dolfinx import mesh

from tigar_x import compat

T = TypeVar("T")


def with_constants(domain: mesh.Mesh, data: T) -> T:
    """Copy of a frozen dataclass in which numbers are Constants.

    Those of fields that may hold an expression (their type is ``Any``, or has it among others) are meant: one number,
    or a sequence of numbers as a vector. What is hidden in functions stays as it is.

    Args:
        domain: mesh whose forms they enter.
        data: a material, a load or the like; what is no dataclass comes back as it is.

    Returns:
        The copy.
    """
    if not is_dataclass(data) or isinstance(data, type):
        return data
    found = {}
    for item in fields(data):
        if item.init and (item.type is Any or Any in get_args(item.type)):
            constant = _constant(domain, getattr(data, item.name))
            if constant is not None:
                found[item.name] = constant
    return replace(data, **found)


def constant_of(domain: mesh.Mesh, value: Any) -> Any:
    """A Constant in place of a number or of a sequence of numbers; anything else as it is."""
    constant = _constant(domain, value)
    return value if constant is None else constant


def _constant(domain: mesh.Mesh, value: Any) -> compat.Constant | None:
    """Constant of a number or of a sequence of numbers; None of anything else."""
    if _is_number(value):
        return compat.Constant(domain, float(value))
    if isinstance(value, list | tuple | np.ndarray) and len(value) and all(map(_is_number, value)):
        return compat.Constant(domain, np.array(value, dtype=float))
    return None


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool | np.bool_)
