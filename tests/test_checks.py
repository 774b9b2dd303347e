"""Checks of input: what passes comes back, what does not is named with its value and what is allowed."""

import re

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from tigar_x import checks

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("check", "good", "bad", "allowed"),
    [
        (checks.finite, [0, -1.5, 1e300, np.float32(2.0), np.int64(3)], [NAN, INF, -INF], "a finite number"),
        (checks.positive, [1e-300, 1, 1e300], [NAN, INF, 0.0, -0.0, -1e-300], "number"),
        (checks.not_negative, [0, -0.0, 1e-300, 7], [NAN, INF, -1e-300], "number"),
        (checks.poisson, [-0.999, 0, 0.3, 0.5], [NAN, -1.0, 0.5000001, 2], "number"),
    ],
)
def test_numbers(check, good, bad, allowed):
    for value in good:
        result = check("nu", value)
        assert type(result) is float
        assert result == value
    for value in bad:
        with pytest.raises(ValueError, match=f"^nu = {value!r}: .*{allowed}.* is required$"):
            check("nu", value)


@pytest.mark.parametrize(
    ("check", "value", "message"),
    [
        (checks.positive, 0.0, r"E = 0.0: a number > 0 is required"),
        (checks.not_negative, -1, r"E = -1: a number >= 0 is required"),
        (checks.poisson, 0.6, r"E = 0.6: a number in \(-1, 0.5\] is required"),
    ],
)
def test_messages_say_what_is_allowed(check, value, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        check("E", value)


def test_within_takes_its_ends():
    assert [checks.within("r", v, -1.0, 2) for v in (-1, 0.5, 2)] == [-1, 0.5, 2]
    for value in (np.nextafter(-1.0, -2.0), 2.0000001, NAN, INF):
        with pytest.raises(ValueError, match=rf"^r = {re.escape(repr(value))}: a .*number"):
            checks.within("r", value, -1.0, 2)
    with pytest.raises(ValueError, match=r"^r = 3: a number from -1 to 2 is required$"):
        checks.within("r", 3, -1.0, 2)


@pytest.mark.parametrize("value", [2, 2.0, np.int32(2), np.float64(2.0)])
def test_whole_numbers(value):
    result = checks.whole("n", value, 2)
    assert type(result) is int
    assert result == 2


@pytest.mark.parametrize("value", [1, 2.5, -3, True, NAN, INF])
def test_not_whole_numbers(value):
    with pytest.raises(ValueError, match=rf"^n = {value!r}: an integer >= 2 is required$"):
        checks.whole("n", value, 2)


@pytest.mark.parametrize("value", ["many", None, [1.0, 2.0]])
@pytest.mark.parametrize("check", [checks.finite, lambda name, value: checks.whole(name, value, 0)])
def test_what_is_no_number_at_all_is_named(check, value):
    with pytest.raises((TypeError, ValueError), match="dt"):
        check("dt", value)


def test_arrays():
    a = checks.array("X", [[1, 2], [3, 4], [5, 6]], (None, 2))
    assert a.dtype == np.float64
    np.testing.assert_array_equal(a, [[1, 2], [3, 4], [5, 6]])
    assert checks.array("X", [], (None,)).shape == (0,)
    assert checks.array("X", 3, ()) == 3.0


@pytest.mark.parametrize(
    ("value", "shape", "message"),
    [
        ([1, 2, 3], (2,), r"X has shape \(3,\): shape \(2\) is required"),
        ([1, 2, 3], (None, 3), r"X has shape \(3,\): shape \(any, 3\) is required"),
        ([[1, 2, 3]], (3, None), r"X has shape \(1, 3\): shape \(3, any\) is required"),
        (1.0, (None,), r"X has shape \(\): shape \(any\)"),
        ([0, 1, NAN], (None,), r"X\[2\] = nan: finite numbers are required"),
        ([[0, 1], [-INF, NAN]], (None, 2), r"X\[1, 0\] = -inf: finite numbers"),
    ],
)
def test_bad_arrays(value, shape, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        checks.array("X", value, shape)


@pytest.mark.parametrize("value", [["a", "b"], [[1, 2], [3]]])
def test_arrays_that_are_none_are_named(value):
    with pytest.raises(ValueError, match="X"):
        checks.array("X", value, (None,))


def test_labels():
    assert checks.label("field", 'a & "b"', without="/:") == 'a & "b"'
    assert checks.label("field", "\N{GREEK SMALL LETTER OMEGA}_0.1") == "\N{GREEK SMALL LETTER OMEGA}_0.1"
    for value in ("", " ", "..", "a\tb", "a\nb", "\udc80"):
        with pytest.raises(ValueError, match=r"^field = .*: printable characters are required$"):
            checks.label("field", value)
    with pytest.raises(ValueError, match=r"^field = 'a/b': printable characters other than / : are required$"):
        checks.label("field", "a/b", without="/:")


def test_choices():
    assert checks.choice("end", 1, (0, 1)) == 1
    assert checks.choice("rule", "lumped", ("lumped", "consistent")) == "lumped"
    with pytest.raises(ValueError, match=r"^rule = 'lump': one of 'lumped', 'consistent' is required$"):
        checks.choice("rule", "lump", ("lumped", "consistent"))
    with pytest.raises(ValueError, match=r"^end = 2: one of 0, 1 is required$"):
        checks.choice("end", 2, (0, 1))


@pytest.fixture(scope="module")
def domain():
    return mesh.create_interval(MPI.COMM_SELF, 1, [0.0, 1.0])


def test_parameters_are_checked_as_numbers_and_constants(domain):
    for value in (1, 2.5, np.float64(0.1), fem.Constant(domain, 3.0)):
        checks.parameter("rho", value, checks.positive)
    for value in (0, -2.5, NAN):
        with pytest.raises(ValueError, match=f"^rho = {value}: a"):
            checks.parameter("rho", value, checks.positive)
    for value in (0.0, NAN):
        with pytest.raises(ValueError, match=f"^rho = .*{value:.3g}.*: a .*number"):
            checks.parameter("rho", fem.Constant(domain, value), checks.positive)


def test_parameters_that_are_expressions_pass(domain):
    x = ufl.SpatialCoordinate(domain)
    checks.parameter("rho", x[0] - 5.0, checks.positive)
    checks.parameter("rho", -fem.Constant(domain, 3.0), checks.positive)
