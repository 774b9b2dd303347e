"""Checks of user input: each returns the checked value or raises an exception that says what is allowed."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, ClassVar

import numpy as np
import ufl
from numpy.typing import ArrayLike, NDArray

from tigar_x.compat import FloatArray, IntArray


def finite(name: str, value: Any) -> float:
    """A finite number, else ValueError; texts that look like one, truth values and arrays of one number are none."""
    try:
        no_number = isinstance(value, str | bytes | bool | np.bool_) or getattr(value, "ndim", 0) > 0
        number = math.nan if no_number else float(value)
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


def poisson(name: str, value: Any) -> float:
    """Poisson's ratio in (-1, 0.5], else ValueError."""
    number = finite(name, value)
    if not -1.0 < number <= 0.5:
        raise ValueError(f"{name} = {value!r}: a number in (-1, 0.5] is required")
    return number


def parameter(name: str, value: Any, check: Callable[[str, Any], float]) -> None:
    """Check a parameter that is a number or a scalar dolfinx Constant; a UFL scalar passes unchecked.

    Args:
        name: what messages call it.
        value: the parameter.
        check: of numbers.

    Raises:
        ValueError: it is nothing of that, or a number that the check refuses.
    """
    if not isinstance(value, ufl.core.expr.Expr):
        check(name, value)
        return
    _scalar(name, value)
    known = _number(value)
    if known is not None:
        check(name, known)


def vector(name: str, value: Any, *sizes: int) -> Any:
    """UFL vector of a sequence of numbers, Constants and UFL scalars, or of a vector that is UFL or a Constant.

    Args:
        name: what messages call it.
        value: the vector.
        sizes: numbers of entries that it may have; none: any.

    Returns:
        The vector.

    Raises:
        ValueError: it is nothing of that, has another shape, or an entry is not finite.
    """
    wanted = " or ".join(f"({size},)" for size in sizes) or "(any,)"
    entries: list[Any] = []
    if isinstance(value, ufl.core.expr.Expr):
        shape, result = value.ufl_shape, value
    elif isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes):
        shape, result = np.shape(value) if isinstance(value, np.ndarray) else (len(value),), None
        entries = value.tolist() if isinstance(value, np.ndarray) else list(value)
    else:
        raise ValueError(f"{name} = {value!r}: a vector of shape {wanted} is required")
    if len(shape) != 1 or (sizes and shape[0] not in sizes):
        raise ValueError(f"{name} has shape {shape}: shape {wanted} is required")
    for i, entry in enumerate(entries):
        parameter(f"{name}[{i}]", entry, finite)
    known = getattr(result, "value", None)
    if isinstance(known, np.ndarray):
        array(name, known, (None,))
    return ufl.as_vector(entries) if result is None else result


def measure(name: str, value: Any, domain: Any, *kinds: str) -> None:
    """Check a UFL measure of a mesh; one without a mesh takes that of its integrand, and passes.

    Args:
        name: what messages call it.
        value: the measure.
        domain: the mesh; None: any.
        kinds: integral types, "cell" or "exterior_facet".

    Raises:
        ValueError: it is no measure, or of another kind or mesh.
    """
    if not isinstance(value, ufl.Measure):
        raise ValueError(f"{name} = {value!r}: a UFL measure is required")
    if value.integral_type() not in kinds:
        raise ValueError(f"{name} integrates over {value.integral_type()}: {' or '.join(kinds)} is required")
    if domain is not None and value.ufl_domain() not in (None, ufl.dx(domain=domain).ufl_domain()):
        raise ValueError(f"{name} is a measure of another mesh: one of this mesh is required")


def _number(value: Any) -> float | None:
    """What a Constant or a number of UFL's is; None: another expression."""
    if isinstance(value, ufl.constantvalue.RealValue | ufl.constantvalue.Zero):
        return float(value)
    number = getattr(value, "value", None)
    return float(number) if isinstance(number, np.ndarray) and number.ndim == 0 else None


def _scalar(name: str, value: Any) -> None:
    if value.ufl_shape or value.ufl_free_indices:
        raise ValueError(f"{name} has shape {value.ufl_shape}: a scalar is required")


def whole(name: str, value: Any, low: int) -> int:
    """An integer >= low, else ValueError."""
    try:
        fits = not isinstance(value, bool) and int(value) == value and value >= low
    except (TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        raise ValueError(f"{name} = {value!r}: an integer >= {low} is required")
    return int(value)


def array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> FloatArray:
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


def freeze(data: Any) -> None:
    """Make the arrays of a frozen dataclass read-only views, so that a write is an error and not without effect."""
    for item in fields(data):
        value = getattr(data, item.name)
        if isinstance(value, np.ndarray):
            object.__setattr__(data, item.name, read_only(value))


def read_only(value: NDArray[Any]) -> NDArray[Any]:
    """View of an array that cannot be written to."""
    view = value.view()
    view.flags.writeable = False
    return view


def kind(name: str, value: Any, kinds: Any, wanted: str) -> Any:
    """A value of some class, else ValueError.

    Args:
        name: what messages call it.
        value: the value.
        kinds: class, or several.
        wanted: what messages say is required.
    """
    if not isinstance(value, kinds):
        raise ValueError(f"{name} = {value!r}: {wanted} is required")
    return value


def listed(name: str, value: Any) -> Sequence[Any]:
    """A list or tuple, else ValueError; one text or one object is none.

    Args:
        name: what messages call it.
        value: the sequence.
    """
    if not isinstance(value, list | tuple):
        raise ValueError(f"{name} = {value!r}: a list or a tuple is required, such as [{value!r}]")
    return value


class Made:
    """What is made of parts that its equations contain: once it is made, to set one in its place is refused.

    It would have no effect. What may be set are values that are read when they are needed, and names of a script's own.
    """

    _PARTS: ClassVar[tuple[str, ...]] = ()
    """Names that may not be set, besides those of Constants."""
    _ELSEWHERE: ClassVar[Mapping[str, str]] = {}
    """Names that may not be set as well, and what is to be set in their place."""
    _is_made = False

    def __setattr__(self, name: str, value: Any) -> None:
        if self._is_made and not name.startswith("_"):
            self._check_part(name, value)
        object.__setattr__(self, name, value)

    def _check_part(self, name: str, value: Any) -> None:
        present = self.__dict__.get(name)
        if isinstance(present, ufl.Constant) and value is not present:
            why = f"the equations have its Constant; {name}.value is what can be set"
        elif name in self._PARTS:
            why = f"it belongs to what is made already; another {type(self).__name__} is required"
        elif name in self._ELSEWHERE:
            why = f"{self._ELSEWHERE[name]} is what can be set"
        else:
            return  # before an array is written out
        raise AttributeError(f"{type(self).__name__}.{name} = {value!r}: {why}")


def having(name: str, value: Any, names: str, wanted: str) -> None:
    """Refuse what lacks some attributes, such as a number, or a class instead of an object of it.

    Args:
        name: what messages call it.
        value: the object.
        names: of what it is asked for, with blanks between them.
        wanted: what messages say is required.

    Raises:
        ValueError: it lacks one.
    """
    if isinstance(value, type) or not all(hasattr(value, needed) for needed in names.split()):
        raise ValueError(f"{name} = {value!r}: {wanted} is required")


def flag(name: str, value: Any) -> bool:
    """True or False, else ValueError."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} = {value!r}: True or False is required")
    return bool(value)


def indices(name: str, value: ArrayLike, count: int) -> IntArray:
    """Numbers from 0 to ``count - 1``, else ValueError; masks and numbers with a fraction are none.

    Args:
        name: what messages call them.
        value: the numbers, of any shape.
        count: how many there are to choose from.

    Returns:
        The numbers in the same shape.

    Raises:
        ValueError: they are none, or out of range.
    """
    numbers_in = np.asarray(value)
    if numbers_in.dtype == bool:
        raise ValueError(f"{name} is a mask of shape {numbers_in.shape}: numbers are required, such as flatnonzero's")
    if numbers_in.dtype.kind not in "iuf":
        raise ValueError(f"{name} = {value!r}: integers from 0 to {count - 1} are required")
    wrong = ~((numbers_in >= 0) & (numbers_in < count) & (numbers_in == np.floor(numbers_in)))
    if wrong.any():
        found = numbers_in[wrong].flat[0]
        raise ValueError(f"{name} contains {found}: integers from 0 to {count - 1} are required")
    return numbers_in.astype(np.int32)


def choice(name: str, value: Any, allowed: tuple[Any, ...]) -> Any:
    """One of the allowed values, else ValueError."""
    truth = isinstance(value, bool | np.bool_) and not any(isinstance(known, bool) for known in allowed)
    if truth or isinstance(value, np.ndarray) or value not in allowed:
        raise ValueError(f"{name} = {value!r}: one of {', '.join(map(repr, allowed)) or 'nothing'} is required")
    return value
