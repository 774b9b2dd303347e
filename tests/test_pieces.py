"""Triangles that a line divides, as the triangles of its two sides."""

import numpy as np
import pytest

from tigar_x.fem.pieces import SidedPieces

RNG = np.random.default_rng(3)


def signed_areas(pieces):
    return np.linalg.det(pieces.barycentric)


@pytest.mark.parametrize("signs", [(1, -1, -1), (-1, 1, 1), (1, 1, -1), (-1, 1, -1)])
def test_pieces_fill_their_cells_and_are_on_their_sides(signs):
    values = np.array(signs) * RNG.uniform(0.1, 1.0, (5, 3))
    pieces = SidedPieces.of(np.array([3, 1, 4, 11, 5]), values)
    of = dict(zip([3, 1, 4, 11, 5], values, strict=True))
    phi = np.einsum("nvk,nk->nv", pieces.barycentric, [of[cell] for cell in pieces.cells])
    assert len(phi) == 15
    assert (phi * pieces.side[:, None] > -1e-14).all()
    assert (signed_areas(pieces) > 0.0).all()
    np.testing.assert_allclose(np.bincount(pieces.cells, signed_areas(pieces))[[1, 3, 4, 5, 11]], 1.0)
    for side in (-1.0, 1.0):  # each side reaches to the line
        assert np.isclose(phi[pieces.side == side], 0.0).any()


def test_parts_without_area_are_no_pieces():
    at_vertex, along_edge = (-1.0, 0.0, 2.0), (-1.0, 0.0, 0.0)
    assert sorted(SidedPieces.of(np.array([0]), np.array([at_vertex])).side) == [-1.0, 1.0]
    assert SidedPieces.of(np.array([0]), np.array([along_edge])).side.tolist() == [-1.0]
