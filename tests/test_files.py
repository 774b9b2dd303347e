"""ASCII patch files: what is written comes back, what is wrong in them is found and named."""

import os
import re

import numpy as np
import pytest
from geometry import grid

from tigar_x.geometry import files, shapes, surfaces
from tigar_x.geometry.bspline import BSplineBasis
from tigar_x.geometry.patch import Patch

WRITTEN_BY_HAND = """\
3
2 1
3 2
0 0 0 2.5 2.5 2.5
-1 -1 1 1
1 0 0 1
1 1 0 0.5
0 1 0 1
1 0 3 1
1 1 3 0.5
0 1 3 1
"""
LINES = WRITTEN_BY_HAND.splitlines()


def curve():
    knots = [0.1, 0.1, 0.1, 0.7, 0.7, 1.0 / 3 + 1, 2.3, 2.3, 2.3]
    return Patch.from_points([BSplineBasis(2, knots)], np.random.default_rng(1).uniform(-1, 1, (6, 2)))


PATCHES = {
    "curve": curve,
    "curve in space": lambda: shapes.line((0, 0, 1 / 3), (1e-9, 1e9, 2), elements=3),
    "leaflet": lambda: surfaces.leaflet(1, elements=(4, 3)),
    "roof": lambda: surfaces.cylinder_panel(radius=25, length=50, angle=1.4, elements=(3, 4), degrees=(2, 3)),
    "flat": lambda: surfaces.disc(radius=1 / 3, center=(0.1, 0.2), elements=(2, 2), degrees=(2, 2)),
    "volume": lambda: shapes.extruded(
        surfaces.disc(radius=2, elements=(2, 1), degrees=(2, 2)), (0, 1 / 7, 3), degree=2
    ),
}


@pytest.fixture
def written(tmp_path):
    """Makes a file of the given text."""

    def write(text):
        path = tmp_path / "patch.txt"
        path.write_text(text)
        return path

    return write


def with_line(number, line):
    """The file written by hand with another line; None: it ends before this line."""
    before = LINES[: number - 1]
    return "".join(f"{text}\n" for text in (before if line is None else [*before, line, *LINES[number:]]))


# -- there and back ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PATCHES)
def test_there_and_back(name, tmp_path):
    patch = PATCHES[name]()
    path = tmp_path / "new folder" / "patch"
    files.write_patch(path, patch)
    back = files.read_patch(path)
    assert (back.dim, back.nsd, back.rational) == (patch.dim, patch.nsd, patch.rational)
    for old, new in zip(patch.bases, back.bases, strict=True):
        assert new.degree == old.degree
        np.testing.assert_array_equal(new.knots, old.knots)
    np.testing.assert_array_equal(back.weights, patch.weights)
    scale = np.abs(patch.points).max()
    np.testing.assert_allclose(back.points, patch.points, rtol=1e-14, atol=1e-16 * scale)
    xi = grid(patch, 5)
    np.testing.assert_allclose(back.evaluate(xi), patch.evaluate(xi), rtol=1e-14, atol=1e-14 * scale)


def test_written_by_hand(written):
    patch = files.read_patch(written(WRITTEN_BY_HAND))
    assert (patch.dim, patch.nsd, patch.basis.degrees) == (2, 3, (2, 1))
    np.testing.assert_array_equal(patch.basis.box, [[0, -1], [2.5, 1]])  # knots as they are
    np.testing.assert_array_equal(patch.points[1], [1, 1, 0])  # physical, not multiplied by the weight
    np.testing.assert_array_equal(patch.control[1], [0.5, 0.5, 0, 0.5])
    np.testing.assert_allclose(patch.evaluate([[1.25, 0.0]]), [[2 / 3, 2 / 3, 1.5]], rtol=1e-15)


def test_the_file_is_what_the_format_says(tmp_path, written):
    path = tmp_path / "again.txt"
    files.write_patch(path, files.read_patch(written(WRITTEN_BY_HAND)))
    assert path.read_text() == WRITTEN_BY_HAND
    assert sorted(os.listdir(tmp_path)) == ["again.txt", "patch.txt"]  # nothing half written


@pytest.mark.parametrize(
    "text",
    [
        WRITTEN_BY_HAND + "and then\nanything 1 2 3\n",
        WRITTEN_BY_HAND.rstrip("\n"),
        WRITTEN_BY_HAND.replace("\n", "\r\n"),
        WRITTEN_BY_HAND.replace("\n", "  \n\n"),
        WRITTEN_BY_HAND.replace(" ", "\t"),
        WRITTEN_BY_HAND.replace("2.5", "2.5e+0"),
        with_line(2, "2.0 1.0"),
    ],
)
def test_what_does_not_matter(text, written):
    patch = files.read_patch(written(text))
    np.testing.assert_array_equal(patch.points[[0, -1]], [[1, 0, 0], [0, 1, 3]])


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "patch.txt"
    path.write_text("old")

    def fail(*_):
        raise OSError("no space")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        files.write_patch(path, curve())
    assert path.read_text() == "old"


def test_periodic_patches_are_not_written(tmp_path):
    ring = surfaces.annulus(inner=1, outer=2, elements=(1, 4), degrees=(1, 2))
    with pytest.raises(ValueError, match=r"patch is periodic: one that is open"):
        files.write_patch(tmp_path / "ring", ring)
    assert not list(tmp_path.iterdir())


# -- several files ----------------------------------------------------------------------------------------------------


def test_numbered_files(tmp_path):
    valve = surfaces.trileaflet(elements=(2, 2))
    for number, patch in enumerate(valve, 1):
        files.write_patch(tmp_path / f"leaflet_{number}.dat", patch)
    files.write_patch(tmp_path / "leaflet_5.dat", curve())  # after a gap
    for count, expected in ((None, 3), (2, 2), (3, 3)):
        patches = files.read_patches(tmp_path / "leaflet_", ".dat", count)
        assert len(patches) == expected
        for patch, original in zip(patches, valve, strict=False):
            np.testing.assert_allclose(patch.points, original.points, rtol=1e-14, atol=1e-16)
    assert len(files.read_patches(str(tmp_path / "leaflet_"), ".dat")) == 3


def test_missing_files(tmp_path):
    files.write_patch(tmp_path / "p1", curve())
    with pytest.raises(FileNotFoundError, match=re.escape(str(tmp_path / "q1"))):
        files.read_patches(tmp_path / "q", "")
    with pytest.raises(FileNotFoundError, match=re.escape(str(tmp_path / "p2"))):
        files.read_patches(tmp_path / "p", "", 2)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        files.read_patch(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"count = 0: an integer >= 1"):
        files.read_patches(tmp_path / "p", "", 0)


def test_a_bad_file_among_several_is_named(tmp_path):
    files.write_patch(tmp_path / "p1", curve())
    (tmp_path / "p2").write_text("2\n")
    with pytest.raises(ValueError, match=r"p2, line 2: expected .*, found the end of the file"):
        files.read_patches(tmp_path / "p", "")


# -- what may be wrong ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "line", "message"),
    [
        (1, "three", r"line 1: expected the dimension of space, found three"),
        (1, "3 3", r"line 1: expected the dimension of space, found 2 numbers"),
        (1, "0", r"line 1: expected the dimension of space \(integers >= 1\), found 0"),
        (1, "4", r"line 1: expected the dimension of space, 1 to 3, found 4"),
        (1, "1", r"line 2: expected degrees of 1 to 1 directions, found \[2, 1\]"),
        (1, "2", r"line 6: expected control point 1 of 6: 2 coordinates and a weight > 0, found 4 numbers"),
        (2, "2 1 1 1", r"line 2: expected degrees of 1 to 3 directions, found \[2, 1, 1, 1\]"),
        (2, "2 0", r"line 2: expected a degree >= 1 .* \(integers >= 1\), found 2 0"),
        (2, "2 1.5", r"line 2: expected .*, found 2 1.5"),
        (2, "2", r"line 3: expected 1 numbers of control points, found 2 numbers"),
        (3, "3", r"line 3: expected 2 numbers of control points, found 1 numbers"),
        (3, "3 1", r"line 3: expected 2 numbers of control points \(integers >= 2\), found 3 1"),
        (3, "4 2", r"line 4: expected 7 open knots of direction 0 \(degree 2\), found 6 numbers"),
        (3, "3 3", r"line 5: expected 5 open knots of direction 1 \(degree 1\), found 4 numbers"),
        (4, "0 0 0 2.5 2.5", r"line 4: expected 6 open knots of direction 0 \(degree 2\), found 5 numbers"),
        (4, "0 0 0 2.5 x 2.5", r"line 4: expected 6 open knots .*, found 0 0 0 2.5 x 2.5"),
        (4, "0 0 0 inf inf inf", r"line 4: expected 6 open knots .*, all finite, found 0 0 0 inf"),
        (4, "0 0 1 2 2.5 2.5", r"line 4: knots repeats its ends 2 and 2 times: 3 times are required"),
        (4, "0 1 2 3 4 5", r"line 4: knots repeats its ends 1 and 1 times: 3 times are required"),
        (4, "0 0 0 2 1 1", r"line 4: knots\[3:5\] = .*: a non-decreasing sequence is required"),
        (5, "1 1 1 1", r"line 5: knots repeats its ends"),
        (6, "1 0 0", r"line 6: expected control point 1 of 6: 3 coordinates and a weight > 0, found 3 numbers"),
        (8, "1 0 nan 1", r"line 8: expected control point 3 of 6: .*, all finite, found 1 0 nan 1"),
        (9, "1 0 3 0", r"line 9: expected a weight > 0, found 0.0"),
        (11, "1 0 3 -2", r"line 11: expected a weight > 0, found -2.0"),
        (1, None, r"line 1: expected the dimension of space, found the end of the file"),
        (2, None, r"line 2: expected a degree >= 1 for each of 1 to 3 directions, found the end of the file"),
        (3, None, r"line 3: expected 2 numbers of control points, found the end"),
        (5, None, r"line 5: expected 4 open knots of direction 1 \(degree 1\), found the end"),
        (6, None, r"line 6: expected control point 1 of 6: .*, found the end"),
        (11, None, r"line 11: expected control point 6 of 6: .*, found the end"),
    ],
)
def test_malformed_files(number, line, message, written):
    path = written(with_line(number, line))
    with pytest.raises(ValueError, match=re.escape(str(path)) + ", " + message):
        files.read_patch(path)


def test_lines_are_counted_with_the_blank_ones(written):
    with pytest.raises(ValueError, match=r"patch.txt, line 8: expected 6 open knots"):
        files.read_patch(written("\n\n" + with_line(4, "0 0\n").replace("\n2 1\n", "\n\n\n2 1\n")))


def test_a_file_that_is_no_text(tmp_path):
    path = tmp_path / "picture"
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(ValueError, match=r"picture, line 1: expected the dimension of space"):
        files.read_patch(path)
