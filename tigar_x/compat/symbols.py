"""Symbols that stand for numbers, and users' functions of them, which are asked once for an expression."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from tigar_x.compat.release import VERSION

log = logging.getLogger(__name__)

Data = Callable[[Any, Any], Any] | Sequence[Any] | Any
"""Data of a problem: numbers, UFL or Constants, or a function of position and time that returns UFL."""

_OF_UFL: tuple[type[Exception], ...] = (TypeError, ValueError, AttributeError)
if VERSION < (0, 9):
    _OF_UFL += (ufl.log.UFLException,)


def _refuse(self: Any, *_: Any) -> Any:
    raise TypeError(f"{self} is an expression without a value, of which no number can be made")


class Constant(fem.Constant):
    """A number of a form that may change, of which Python makes no number unless ``.value`` asks for it.

    In UFL and dolfinx it is a Constant as any other. Their own is evaluated for ever by ``math.sin(t)`` (UFL 2022), or
    gives the value of the moment, which the form then keeps for good.
    """

    def __float__(self) -> float:
        raise TypeError(
            f"{self} stands for a number that may change: ufl.sin(t) in place of math.sin(t), numpy.sin(t) or the like"
            " is required in forms; t.value is the number of the moment"
        )

    __complex__ = __int__ = __round__ = __float__

    def evaluate(self, x: Any, mapping: Any, *others: Any, **options: Any) -> Any:
        """UFL's evaluation of expressions; what they contain has to be given numbers by the mapping."""
        if self in mapping:
            return super().evaluate(x, mapping, *others, **options)
        try:
            return float(self)
        except TypeError as error:
            log.error("%s", error)  # UFL replaces the error by one without words
            raise


@contextmanager
def _without_values() -> Iterator[None]:
    """Inside the ``with`` statement nothing in UFL becomes a number but numbers.

    Else an expression with a Constant takes for ever (UFL 2022), or has for good the value that it had at first.
    """
    names = ("__float__", "__complex__", "__round__", "__int__", "__index__")
    kept = [(owner, name, vars(owner)[name]) for owner in (Expr, fem.Constant) for name in names if name in vars(owner)]
    for owner, name, _ in kept:
        setattr(owner, name, _refuse)
    try:
        yield
    finally:
        for owner, name, method in kept:
            setattr(owner, name, method)


def ask(name: str, function: Callable[..., Any], *arguments: Any, passing: tuple[type[Exception], ...] = ()) -> Any:
    """What a user's function makes of UFL expressions.

    Args:
        name: what messages call it.
        function: the function.
        arguments: UFL expressions.
        passing: errors that are the function's own and tell enough.

    Raises:
        ValueError: it has treated them as numbers.
    """
    try:
        with _without_values():
            return function(*arguments)
    except passing:
        raise
    except _OF_UFL as error:
        raise ValueError(
            f"{name}: the function that was given ends with {type(error).__name__}: {error}. It is asked for a UFL"
            " expression of UFL expressions: ufl.sin(t) in place of math.sin(t) or numpy.sin(t), and"
            " ufl.conditional(ufl.lt(t, 1.0), a, b) in place of 'a if t < 1.0 else b'"
        ) from error


def is_function(data: Any) -> bool:
    """Whether data are a user's function, and no UFL expression, which can be called as well."""
    return callable(data) and not isinstance(data, Expr)


def given(name: str, data: Any, x: Any, t: Any) -> Any:
    """Data as they are, or what a user's function makes of position and time.

    Args:
        name: what messages call it.
        data: UFL, numbers or a function.
        x: position.
        t: time.

    Raises:
        ValueError: the function treats UFL expressions as numbers.
    """
    return ask(name, data, x, t) if is_function(data) else data
