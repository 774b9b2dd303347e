"""Checks of user input: each returns the checked value or raises an exception that says what is allowed."""

import math
import numbers
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def finite(name: str, value: Any) -> float:
    """A finite number, else ValueError."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name} = {value!r}: a finite number is required")
    return number


def positive(name: str, value: Any) -> float:
    """A finite number > 0, else ValueError."""
    number = finite(name, value)
    if number <= 0.0:
        raise ValueError(f"{name} = {value!r}: a number > 0 is required")
    return number


def not_negative(name: str, value: Any) -> float:
    """A finite number >= 0, else ValueError."""
    number = finite(name, value)
    if number < 0.0:
        raise ValueError(f"{name} = {value!r}: a number >= 0 is required")
    return number


def within(name: str, value: Any, low: float, high: float) -> float:
    """A finite number in [low, high], else ValueError."""
    number = finite(name, value)
    if not low <= number <= high:
        raise ValueError(f"{name} = {value!r}: a number from {low:g} to {high:g} is required")
    return number


def entries(name: str, value: Any) -> None:
    """Check that numbers and Constants in a sequence, or a vector Constant, are finite; None and UFL pass unchecked."""
    numbers_in = getattr(value, "value", None)
    if isinstance(numbers_in, np.ndarray):
        array(name, numbers_in, (None,) * numbers_in.ndim)
    elif isinstance(value, Sequence | np.ndarray):
        for i, entry in enumerate(value.tolist() if isinstance(value, np.ndarray) else value):
            parameter(f"{name}[{i}]", entry, finite)


def poisson(name: str, value: Any) -> float:
    """Poisson's ratio in (-1, 0.5], else ValueError."""
    number = finite(name, value)
    if not -1.0 < number <= 0.5:
        raise ValueError(f"{name} = {value!r}: a number in (-1, 0.5] is required")
    return number


def parameter(name: str, value: Any, check: Callable[[str, Any], float]) -> None:
    """Check a parameter that is a number or a dolfinx Constant; a UFL expression passes unchecked."""
    number = getattr(value, "value", value)
    if isinstance(number, numbers.Real):
        check(name, number)
    elif isinstance(number, np.ndarray) and number.ndim == 0:
        check(name, number.item())


def whole(name: str, value: Any, low: int) -> int:
    """An integer >= low, else ValueError."""
    try:
        fits = not isinstance(value, bool) and int(value) == value and value >= low
    except (TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        raise ValueError(f"{name} = {value!r}: an integer >= {low} is required")
    return int(value)


def array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """A finite float array of the given shape (None: any length), else ValueError."""
    try:
        result = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} = {value!r}: an array of numbers is required") from error
    fits = result.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, result.shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{name} has shape {result.shape}: shape {wanted} is required")
    if not np.isfinite(result).all():
        bad = tuple(int(i) for i in np.argwhere(~np.isfinite(result))[0])
        raise ValueError(f"{name}{list(bad)} = {result[bad]}: finite numbers are required")
    return result


def label(name: str, value: str, without: str = "") -> str:
    """Text that can name something in a file: printable, not only dots and blanks, without some characters.

    Args:
        name: of the argument.
        value: the text.
        without: characters that it must not have.

    Raises:
        ValueError: it is no such text.
    """
    if not value.strip(". ") or not value.isprintable() or set(value) & set(without):
        besides = f" other than {' '.join(without)}" if without else ""
        raise ValueError(f"{name} = {value!r}: printable characters{besides} are required")
    return value


def choice(name: str, value: Any, allowed: tuple[Any, ...]) -> Any:
    """One of the allowed values, else ValueError."""
    if value not in allowed:
        raise ValueError(f"{name} = {value!r}: one of {', '.join(map(repr, allowed)) or 'nothing'} is required")
    return value
