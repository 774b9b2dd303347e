"""Checkpoints: on any partition the same fields, whole or refused, and the last good one stays whatever happens."""

import errno
import json
import logging
import os
import resource
from functools import partial

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import fem, mesh
from splines import WORLD, quarter

from tigar_x import compat
from tigar_x.ranks import on_root
from tigar_x.run import checkpoint
from tigar_x.run.archives import write_archive
from tigar_x.run.checkpoint import Checkpoints
from tigar_x.run.nodal import Nodes, difference, fingerprint, matching
from tigar_x.splines.spline import ExtractedSpline

SELF = MPI.COMM_SELF


@pytest.fixture
def folder(tmp_path):
    """One folder for all ranks, which the first checkpoint has to make."""
    return WORLD.bcast(tmp_path, root=0) / "checkpoints"


def square(comm=WORLD, n=3, kind="triangle", size=1.0, **options):
    corners = [np.zeros(2), np.full(2, size)]
    return mesh.create_rectangle(comm, corners, [n, n], getattr(mesh.CellType, kind), **options)


def cube(comm=WORLD):
    return mesh.create_box(comm, [np.zeros(3), np.ones(3)], [2, 2, 2], mesh.CellType.hexahedron)


SPACES = {
    "scalar": lambda comm: compat.lagrange_space(square(comm), 1),
    "blocked": lambda comm: compat.lagrange_space(square(comm), 2, 3),
    "mixed": lambda comm: compat.mixed_lagrange_space(square(comm), (2, 2), (1, 1)),
    "solid": lambda comm: compat.lagrange_space(cube(comm), 2, 3),
    "shell": lambda comm: ExtractedSpline(quarter([(1.0, 0.0), (1.0, 0.5), (1.0, 2.0)]), comm).V,
}


def filled(space, factor=1.0):
    """Values that tell the place and the component."""
    f = fem.Function(space)
    for i in range(int(np.prod(f.ufl_shape, dtype=int))):
        scalar, dofs = compat.component_space(space, i)
        x = scalar.tabulate_dof_coordinates()
        f.x.array[dofs] = factor * (np.sin(3.0 * x[:, 0]) + np.cos(5.0 * x[:, 1]) * (2 + x[:, 2]) + 10 * i)
    f.x.scatter_forward()
    return f


@pytest.mark.mpi
@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize(("before", "after"), [(WORLD, WORLD), (SELF, WORLD), (WORLD, SELF)], ids=["all", "out", "in"])
def test_fields_come_back_on_any_partition(name, before, after, folder):
    written = SPACES[name](before)
    fields = {"u": filled(written), "rate": filled(written, -0.3)}
    path = Checkpoints(folder, fields).write(7, {"t": 0.1, "names": ["a"], "nothing": None})
    assert path == folder / "checkpoint_00000007.npz"
    space = SPACES[name](after)
    read = {"u": fem.Function(space), "rate": fem.Function(space)}
    checkpoints = Checkpoints(folder, read)
    found = checkpoints.find()
    assert (found.number, found.path) == (7, path)
    assert found.record == {"t": 0.1, "names": ["a"], "nothing": None}
    assert not any(f.x.array.any() for f in read.values())
    checkpoints.restore(found)
    for key, factor in (("u", 1.0), ("rate", -0.3)):
        np.testing.assert_allclose(read[key].x.array, filled(space, factor).x.array, rtol=0, atol=1e-13)


@pytest.mark.mpi
def test_a_field_of_all_ranks_and_one_of_each_share_a_file(folder):
    fields = {"flow": filled(SPACES["blocked"](WORLD)), "shell": filled(SPACES["shell"](SELF))}
    checkpoints = Checkpoints(folder, fields)
    checkpoints.write(0, {})
    values = {name: f.x.array.copy() for name, f in fields.items()}
    for f in fields.values():
        f.x.array[:] = np.nan
    checkpoints.restore(checkpoints.find(0))
    for name, f in fields.items():
        np.testing.assert_array_equal(f.x.array, values[name])


@pytest.mark.mpi
@pytest.mark.parametrize("discontinuous", [False, True])
def test_nodes_in_the_same_place_are_refused_before_a_run(discontinuous, folder):
    f = fem.Function(compat.lagrange_space(square(), 1, 2, discontinuous=discontinuous))
    if not discontinuous:
        Checkpoints(folder, {"stress": f})
        return
    with pytest.raises(ValueError, match="stress: nodes in the same place"):
        Checkpoints(folder, {"stress": f})


# -- another mesh -----------------------------------------------------------------------------------------------------


def moved(comm, distance):
    """The square with one inner vertex displaced."""
    domain = square(comm)
    x = domain.geometry.x
    x[np.linalg.norm(x[:, :2] - 1 / 3, axis=1) < 1e-6, 0] += distance
    return domain


DIAGONALS = {name: partial(square, diagonal=getattr(mesh.DiagonalType, name)) for name in ("left", "left_right")}
OTHERS = {
    "finer": (partial(square, n=4), "number of cells 18 was found, 32 is required"),
    "larger": (partial(square, size=1.0 + 1e-6), r"a box at \[0.0, 0.0\] of size 1.414213562 was found"),
    "quadrilaterals": (partial(square, kind="quadrilateral"), "cell triangle was found, quadrilateral is required"),
    "solid": (lambda comm: cube(comm), "cell triangle was found, hexahedron is required"),
    "left": (DIAGONALS["left"], "as many cells .* lie or are divided otherwise"),
    "left_right": (DIAGONALS["left_right"], "as many cells .* lie or are divided otherwise"),
    "moved": (partial(moved, distance=1e-6), "as many cells .* lie or are divided otherwise"),
}


@pytest.mark.mpi
@pytest.mark.parametrize("other", OTHERS)
def test_another_mesh_is_refused(other, folder):
    make, reason = OTHERS[other]
    path = Checkpoints(folder, {"u": filled(compat.lagrange_space(square(), 1))}).write(1, {})
    checkpoints = Checkpoints(folder, {"u": fem.Function(compat.lagrange_space(make(WORLD), 1))})
    for which in ("latest", 1, str(path)):
        with pytest.raises(ValueError, match=f"{path}: u is on another mesh: {reason}"):
            checkpoints.find(which)


@pytest.mark.mpi
@pytest.mark.parametrize("make", [square, cube, *DIAGONALS.values()])
def test_fingerprints_know_no_partition(make):
    assert difference(fingerprint(make(SELF)), fingerprint(make(WORLD))) is None


def test_other_diagonals_that_no_low_moment_tells_apart_have_other_fingerprints():
    """Diagonals that alternate, and the same ones the other way round, have all moments in common up to the second."""
    meshes = [square(SELF, n=4, diagonal=getattr(mesh.DiagonalType, name)) for name in ("left_right", "right_left")]
    middles = [compat.cell_vertices(domain).mean(axis=1) for domain in meshes]
    moments = [np.column_stack([m, m**2, m[:, :1] * m[:, 1:]]).sum(axis=0) for m in middles]
    np.testing.assert_allclose(moments[0], moments[1], rtol=1e-13)
    assert "divided otherwise" in difference(*map(fingerprint, meshes))


@pytest.mark.parametrize(("distance", "same"), [(1e-14, True), (1e-7, False)])
def test_rounding_is_no_other_mesh(distance, same):
    assert (difference(fingerprint(moved(SELF, distance)), fingerprint(square(SELF))) is None) == same
    nodes = Nodes(compat.lagrange_space(square(SELF), 1), "u")
    x = moved(SELF, distance).geometry.x[::-1, :2]
    here, there = nodes.find(x)
    assert len(here) == len(x) - (not same)
    np.testing.assert_allclose(x[there], nodes.x[here], rtol=0, atol=1e-13)
    if same:
        np.testing.assert_allclose(nodes.x[matching(nodes.x, x, nodes.close)], x, rtol=0, atol=1e-13)
        return
    with pytest.raises(ValueError, match="1e-07 away from those required"):
        matching(nodes.x, x, nodes.close)


@pytest.mark.mpi
@pytest.mark.parametrize(("degree", "size"), [(2, 2), (1, 3), (1, 1)])
def test_other_degrees_and_components_are_refused(degree, size, folder):
    domain = square()
    path = Checkpoints(folder, {"u": filled(compat.lagrange_space(domain, 1, 2))}).write(1, {})
    other = Checkpoints(folder, {"u": fem.Function(compat.lagrange_space(domain, degree, size))})
    with pytest.raises(ValueError, match=rf"{path}: u is of another degree or size: \(16, 2\) were found"):
        other.find()


@pytest.mark.mpi
def test_other_fields_are_refused(folder):
    f = filled(compat.lagrange_space(square(), 1))
    Checkpoints(folder, {"u": f, "rate": f}).write(1, {})
    with pytest.raises(ValueError, match=r"fields \['rate', 'u'\] were found, \['u'\] are required"):
        Checkpoints(folder, {"u": f}).find()


# -- files that are not whole -----------------------------------------------------------------------------------------


def series(folder, numbers=(1, 2), **options):
    """Checkpoints whose field is filled with their numbers."""
    f = fem.Function(compat.lagrange_space(square(), 1))
    checkpoints = Checkpoints(folder, {"u": f}, **options)
    for number in numbers:
        f.x.array[:] = number
        checkpoints.write(number, {"number": number})
    return checkpoints


def names(folder):
    """Files in the folder, looked up by the rank that writes: another one might come late; parts are as many."""

    def look():
        found = sorted(path.name for path in folder.iterdir())
        of_ranks = [name for name in found if name.endswith(".parts")]
        written = [
            name.replace(".npz", ".parts") for name in found if name[11:19].isdecimal() and name.endswith(".npz")
        ]
        assert of_ranks == (written if WORLD.size > 1 else [])
        assert all(len(list((folder / name).iterdir())) == WORLD.size for name in of_ranks)
        return [name for name in found if name not in of_ranks]

    return WORLD.bcast(on_root(WORLD, look))


@pytest.mark.mpi
@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_one_is_refused_and_the_one_before_is_used(part, folder, caplog):
    checkpoints = series(folder)
    path = folder / "checkpoint_00000002.npz"
    on_root(WORLD, lambda: os.truncate(path, int(part * path.stat().st_size)))
    with pytest.raises(ValueError, match=f"{path}: not a checkpoint, or a truncated one"):
        checkpoints.find(path)
    with caplog.at_level(logging.WARNING):
        found = checkpoints.find()
    assert found.record == {"number": 1}
    checkpoints.restore(found)
    assert (checkpoints.fields["u"].x.array == 1.0).all()
    warnings = [record.getMessage() for record in caplog.records]
    assert len(warnings) == (1 if WORLD.rank == 0 else 0)
    assert all(f"{path}: not a checkpoint" in text for text in warnings)


@pytest.mark.mpi
def test_when_none_is_whole_it_is_said(folder):
    checkpoints = series(folder, ())
    with pytest.raises(FileNotFoundError, match=f"{folder}: there is no checkpoint that is whole"):
        checkpoints.find()
    with pytest.raises(FileNotFoundError, match=r"checkpoint_00000003.npz: there is no such checkpoint"):
        checkpoints.find(3)
    checkpoints = series(folder)
    on_root(WORLD, lambda: [path.write_bytes(b"PK") for path in folder.glob("*.npz")])
    with pytest.raises(FileNotFoundError, match=f"{folder}: there is no checkpoint that is whole"):
        checkpoints.find()


def test_a_byte_that_flipped_is_found(tmp_path):
    """Wherever it is: either the file is refused, or what it holds is untouched."""
    checkpoints = series(tmp_path, (1,))
    path = tmp_path / "checkpoint_00000001.npz"
    whole = path.read_bytes()
    rng, refused = np.random.default_rng(0), []
    for place in rng.integers(len(whole), size=200):
        changed = bytearray(whole)
        changed[place] ^= int(rng.integers(1, 256))
        path.write_bytes(changed)
        try:
            found = checkpoints.find(1)
        except ValueError as error:
            refused.append(str(error))
        else:
            checkpoints.restore(found)
            assert found.record == {"number": 1}
            assert (checkpoints.fields["u"].x.array == 1.0).all()
    assert len(refused) > 100
    assert all(str(path) in text for text in refused)


@pytest.mark.mpi
def test_contents_that_do_not_agree_with_their_digest_are_refused(folder):
    checkpoints = series(folder, (1,))

    def falsify():
        path = next(path for path in (*folder.glob("*.parts/*.npz"), folder / "checkpoint_00000001.npz"))
        with np.load(path) as archive:
            arrays = {name: archive[name] for name in archive.files}
        arrays["values/u/0"][3] += 1e-12
        np.savez(path, **arrays)

    on_root(WORLD, falsify)
    with pytest.raises(ValueError, match="do not agree with their digest"):
        checkpoints.find(1)


@pytest.mark.mpi
def test_another_format_is_refused_and_not_passed_over(folder, monkeypatch):
    checkpoints = series(folder, (1,))
    monkeypatch.setattr(checkpoint, "FORMAT", 3)
    checkpoints.write(2, {})
    monkeypatch.undo()
    with pytest.raises(ValueError, match=r"checkpoint_00000002.npz: format 3 was found, 2 or less is required"):
        checkpoints.find()
    assert checkpoints.find(1).number == 1


@pytest.mark.mpi
def test_a_file_of_the_first_format_is_read_by_any_ranks(folder):
    """It has all nodes and values, and no parts or shapes."""
    one = Checkpoints(folder / "one", {"u": filled(SPACES["mixed"](SELF))})
    head = {"format": 1, "number": 4, "meshes": one._meshes, "fields": {"u": 0}, "record": {"t": 0.5}}
    arrays = {"head": np.array(json.dumps(head)), **one._arrays(shared=False)}
    on_root(WORLD, lambda: write_archive(folder / "checkpoint_00000004.npz", arrays))
    space = SPACES["mixed"](WORLD)
    checkpoints = Checkpoints(folder, {"u": fem.Function(space)})
    found = checkpoints.find()
    assert (found.number, found.record) == (4, {"t": 0.5})
    checkpoints.restore(found)
    np.testing.assert_allclose(checkpoints.fields["u"].x.array, filled(space).x.array, rtol=0, atol=1e-13)


@pytest.mark.mpi
@pytest.mark.skipif(WORLD.size == 1, reason="one rank writes no parts")
@pytest.mark.parametrize("damage", ["missing", "truncated", "of another run"])
def test_one_with_a_damaged_part_is_passed_over(damage, folder):
    checkpoints = series(folder)
    one, two = (sorted(folder.glob(f"checkpoint_0000000{n}.parts/*"))[-1] for n in (1, 2))
    WORLD.barrier()
    harm = {
        "missing": two.unlink,
        "truncated": lambda: os.truncate(two, 99),
        "of another run": lambda: two.write_bytes(one.read_bytes()),
    }
    on_root(WORLD, harm[damage])
    with pytest.raises(ValueError, match=r"a part of a checkpoint is missing|truncated one|agree with their digest"):
        checkpoints.find(2)
    found = checkpoints.find()
    assert found.number == 1
    checkpoints.restore(found)
    assert (checkpoints.fields["u"].x.array == 1.0).all()


@pytest.mark.mpi
def test_no_rank_writes_more_than_its_nodes(folder):
    checkpoints = series(folder, (1,))
    found, nodes = checkpoints.find(1), checkpoints._layouts[0].parts[0][0]
    assert len(found.parts) == (WORLD.size if WORLD.size > 1 else 0)
    for path in (found.path, *found.parts):
        with np.load(path) as archive:
            most = max([len(archive[name]) for name in archive.files if "/" in name], default=0)
            assert most <= max(WORLD.allgather(len(nodes.x)))


def test_pickled_objects_are_not_read(tmp_path):
    checkpoints = series(tmp_path, (1,))
    np.savez(tmp_path / "checkpoint_00000002.npz", digest=np.array([print], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle=False"):
        checkpoints.find(2)


# -- writing ----------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_the_newest_are_kept_and_those_of_a_run_that_is_replaced_go(folder):
    checkpoints = series(folder, (10, 20, 30))
    assert names(folder) == ["checkpoint_00000020.npz", "checkpoint_00000030.npz"]
    on_root(WORLD, lambda: (folder / "checkpoint_notes.npz").write_text("mine"))
    checkpoints.write(25, {})
    assert names(folder) == ["checkpoint_00000020.npz", "checkpoint_00000025.npz", "checkpoint_notes.npz"]
    assert checkpoints.find().number == 25
    series(folder, (26, 27), keep=1)
    assert names(folder) == ["checkpoint_00000027.npz", "checkpoint_notes.npz"]
    with pytest.raises(ValueError, match="keep = 0"):
        series(folder, (), keep=0)


@pytest.mark.mpi
def test_what_a_killed_writer_left_is_passed_over_and_removed(folder):
    checkpoints = series(folder, (1,))
    on_root(WORLD, lambda: (folder / "checkpoint_00000002.npz.part").write_bytes(b"PK half of it"))
    assert checkpoints.find().number == 1
    checkpoints.write(3, {})
    assert names(folder) == ["checkpoint_00000001.npz", "checkpoint_00000003.npz"]


@pytest.mark.mpi
@pytest.mark.parametrize("place", ["fsync", "replace"])
def test_a_full_disk_leaves_the_last_good_one_and_fails_on_all_ranks(place, folder, monkeypatch):
    checkpoints = series(folder, (1, 2))
    before = names(folder)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, place, full)
    for number in (2, 3):
        with pytest.raises(OSError, match="No space left"):
            checkpoints.write(number, {})
    monkeypatch.undo()
    assert names(folder) == before
    assert checkpoints.find().record == {"number": 2}
    checkpoints.write(3, {})
    assert names(folder) == ["checkpoint_00000002.npz", "checkpoint_00000003.npz"]


def test_a_file_that_cannot_grow_leaves_the_last_good_one(tmp_path):
    """The system itself ends the write half-way."""
    checkpoints = series(tmp_path, (1,))
    size = (tmp_path / "checkpoint_00000001.npz").stat().st_size
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size // 2, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            checkpoints.write(2, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert names(tmp_path) == ["checkpoint_00000001.npz"]
    assert checkpoints.find().number == 1


@pytest.mark.mpi
@pytest.mark.parametrize("bad", [float("nan"), object()])
def test_a_record_that_is_no_json_is_refused_on_all_ranks(bad, folder):
    checkpoints = series(folder, (1,))
    with pytest.raises(ValueError, match="JSON"):
        checkpoints.write(2, {"bad": bad})
    assert names(folder) == ["checkpoint_00000001.npz"]
