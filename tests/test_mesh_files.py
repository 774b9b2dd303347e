"""Groups of files by gmsh and dolfinx, and what is said of files that are none."""

import logging

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import io, mesh

from tigar_x import compat
from tigar_x.run.output import on_root
from varmint.mesh.files import read_mesh
from varmint.mesh.models import from_gmsh

COMM = MPI.COMM_WORLD
CORNERS = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))


def shared_path(tmp_path):
    """The folder of rank 0."""
    return type(tmp_path)(COMM.bcast(str(tmp_path)))


def lengths(m):
    """Number of facets of every group; all sides of the squares below have two of length 1/2."""
    owned = m.domain.topology.index_map(m.domain.topology.dim - 1).size_local
    return {name: COMM.allreduce(int((m.facets(name) < owned).sum())) for name in m.facet_names}


def counts(m):
    owned = compat.owned_cells(m.domain)
    return {name: COMM.allreduce(int((m.cells(name) < owned).sum())) for name in m.cell_names}


def square(path, groups, *, version=4.1, **options):
    """A file of a unit square with sides 1 to 4 and surface 1; groups: (dimension, number, name, entities)."""
    gmsh = pytest.importorskip("gmsh")

    def write():
        gmsh.initialize([], False)
        try:
            gmsh.option.setNumber("General.Terminal", 0)
            model, geo = gmsh.model, gmsh.model.geo
            points = [geo.addPoint(x, y, 0.0, 0.5) for x, y in CORNERS]
            sides = [geo.addLine(points[i], points[(i + 1) % 4]) for i in range(4)]
            geo.addPlaneSurface([geo.addCurveLoop(sides)])
            geo.synchronize()
            for dim, number, name, entities in groups:
                model.addPhysicalGroup(dim, entities, number)
                if name is not None:
                    model.setPhysicalName(dim, number, name)
            model.mesh.generate(2)
            for key, value in {"MshFileVersion": version, **options}.items():
                gmsh.option.setNumber(f"Mesh.{key}", value)
            gmsh.write(str(path))
        finally:
            gmsh.finalize()

    on_root(COMM, write)
    return path


PLAIN = [(1, 3, "inlet", [4]), (1, 4, "walls", [1, 3]), (2, 3, "fluid", [1])]
WAYS = [
    {"version": 2.2},
    {"version": 4.1},
    {"version": 4.1, "SaveAll": 1},
    {"version": 2.2, "SaveParametric": 1},
    {"version": 4.1, "SaveParametric": 1},
    {"version": 4.1, "Binary": 1, "SaveAll": 1},
    {"version": 2.2, "Binary": 1},
]


@pytest.mark.mpi
@pytest.mark.parametrize("way", WAYS, ids=str)
def test_groups_are_kept_however_gmsh_saves_them(tmp_path, way):
    m = read_mesh(COMM, square(shared_path(tmp_path) / "square.msh", PLAIN, **way))
    assert lengths(m) == {"inlet": 2, "walls": 4}
    assert counts(m) == {"fluid": COMM.allreduce(compat.owned_cells(m.domain))}


@pytest.mark.mpi
@pytest.mark.parametrize("version", [2.2, 4.1])
def test_a_name_may_be_that_of_a_group_of_cells_and_of_facets(tmp_path, version):
    groups = [(1, 1, "fluid", [1, 2]), (1, 2, "rest", [3, 4]), (2, 2, "fluid", [1])]
    m = read_mesh(COMM, square(shared_path(tmp_path) / "square.msh", groups, version=version))
    assert lengths(m) == {"fluid": 4, "rest": 4}
    assert list(counts(m)) == ["fluid"]


@pytest.mark.parametrize("version", [2.2, 4.1])
@pytest.mark.parametrize("names", [("in", None), ("in", "out"), (None, None)])
def test_an_entity_in_two_groups_is_refused_whether_these_have_names_or_not(tmp_path, version, names):
    groups = [(1, 1, names[0], [1, 2]), (1, 2, names[1], [2, 3]), (2, 1, "fluid", [1])]
    path = square(tmp_path / "square.msh", groups, version=version)
    first, second = (name or str(i) for i, name in enumerate(names, 1))
    with pytest.raises(ValueError, match=f"groups '?{first}'? and '?{second}'?: one at most is required; a condition"):
        read_mesh(MPI.COMM_SELF, path)


def test_a_surface_in_two_groups_of_version_2_is_named(tmp_path):
    path = square(tmp_path / "square.msh", [(2, 1, "fluid", [1]), (2, 2, None, [1])], version=2.2)
    with pytest.raises(ValueError, match=r"square.msh has cells in groups 'fluid' and '2': one at most is required"):
        read_mesh(MPI.COMM_SELF, path)


@pytest.mark.parametrize("version", [2.2, 4.1])
def test_two_groups_of_one_name_are_refused(tmp_path, version):
    path = square(tmp_path / "square.msh", PLAIN, version=version)
    path.write_text(path.read_text().replace('"walls"', '"inlet"'))
    with pytest.raises(
        ValueError, match=r"groups 3 and 4 of .*square.msh are both 'inlet': two names are required, in"
    ):
        read_mesh(MPI.COMM_SELF, path)
    assert list(lengths(read_mesh(MPI.COMM_SELF, path, names={"walls": 4}))) == ["inlet", "walls"]


def test_groups_that_gmsh_left_out_of_version_2_are_missed(tmp_path):
    path = square(tmp_path / "square.msh", PLAIN, version=2.2, SaveAll=1)
    with pytest.raises(
        ValueError, match=r"has the names 'inlet', 'walls', 'fluid' and no .*: with Mesh.SaveAll = 1 gmsh"
    ):
        read_mesh(MPI.COMM_SELF, path)


def test_elements_of_one_entity_may_be_of_several_groups_in_version_2(tmp_path):
    """As other programs than gmsh write them."""
    path = square(tmp_path / "square.msh", PLAIN, version=2.2)
    text = path.read_text().splitlines()
    start = text.index("$Elements") + 2
    for i in range(start, text.index("$EndElements")):
        words = text[i].split()
        text[i] = " ".join([*words[:4], "1", *words[5:]])
    path.write_text("\n".join(text) + "\n")
    assert lengths(read_mesh(MPI.COMM_SELF, path)) == {"inlet": 2, "walls": 4}


def two_squares(gmsh):
    """Two unit squares side by side; the second is in no group although its right side is."""
    geo, model = gmsh.model.geo, gmsh.model
    p = [geo.addPoint(x, y, 0.0, 0.5) for y in (0.0, 1.0) for x in (0.0, 1.0, 2.0)]
    line = [geo.addLine(p[a], p[b]) for a, b in [(0, 1), (1, 2), (3, 4), (4, 5), (0, 3), (1, 4), (2, 5)]]
    loops = [[line[0], line[5], -line[2], -line[4]], [line[1], line[6], -line[3], -line[5]]]
    planes = [geo.addPlaneSurface([geo.addCurveLoop(loop)]) for loop in loops]
    geo.synchronize()
    for dim, name, tags in ((1, "inlet", [line[4]]), (1, "outlet", [line[6]]), (2, "fluid", planes[:1])):
        model.setPhysicalName(dim, model.addPhysicalGroup(dim, tags), name)


@pytest.mark.parametrize("version", [None, 2.2, 4.1])
def test_a_facet_beside_cells_in_no_group_is_told_with_its_cause(tmp_path, version):
    pytest.importorskip("gmsh")

    def build(gmsh):
        two_squares(gmsh)
        gmsh.model.mesh.generate(2)
        if version is not None:
            gmsh.option.setNumber("Mesh.MshFileVersion", version)
            gmsh.write(str(tmp_path / "two.msh"))
            raise LookupError("written")

    cause = r"group 'outlet' with 2 of 2 facets, such as that at \(2, 0.25.*\), beside no cell of the mesh: where some"
    if version is None:
        with pytest.raises(ValueError, match="the model of build has " + cause):
            from_gmsh(MPI.COMM_SELF, build, 2)
        return
    with pytest.raises(LookupError, match="written"):
        from_gmsh(MPI.COMM_SELF, build, 2)
    with pytest.raises(ValueError, match="two.msh has " + cause):
        read_mesh(MPI.COMM_SELF, tmp_path / "two.msh")


def test_volumes_in_no_group_are_missed(tmp_path):
    pytest.importorskip("gmsh")
    path = tmp_path / "box.msh"

    def build(gmsh):
        gmsh.model.occ.addBox(0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(2, [1], 5)
        gmsh.model.mesh.generate(3)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(path))

    from_gmsh(MPI.COMM_SELF, build, 3)
    with pytest.raises(
        ValueError, match=r"box.msh has no cell in any volume: .* a physical group of the volumes is req"
    ):
        read_mesh(MPI.COMM_SELF, path)


# -- files of dolfinx --------------------------------------------------------------------------------------------------


def of_dolfinx(path, kind, *, twice=False):
    """A box with numbers on its left side and on the cells of its left half, as dolfinx writes them."""
    pytest.importorskip("meshio")
    pytest.importorskip("h5py")
    cell = getattr(mesh.CellType, kind)
    flat = kind in ("triangle", "quadrilateral")
    domain = mesh.create_unit_square(COMM, 4, 3, cell) if flat else mesh.create_unit_cube(COMM, 4, 3, 2, cell)
    dim = domain.topology.dim
    tags = []
    for d, where, number in ((dim - 1, lambda x: np.isclose(x[0], 0.0), 7), (dim, lambda x: x[0] < 0.51, 2)):
        found = np.sort(mesh.locate_entities(domain, d, where)).astype(np.int32)
        tags.append(mesh.meshtags(domain, d, found, np.full(len(found), number, dtype=np.int32)))
    names = ["sides", "parts", "again"]
    with io.XDMFFile(COMM, str(path), "w") as file:
        file.write_mesh(domain)
        domain.topology.create_connectivity(dim - 1, dim)
        for tag, name in zip([*tags, *tags[:1]] if twice else tags, names, strict=False):
            tag.name = name
            try:
                file.write_meshtags(tag, domain.geometry)
            except TypeError:  # dolfinx 0.5
                file.write_meshtags(tag)
    return path


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_a_file_of_dolfinx_is_read_with_its_tags(tmp_path, kind):
    m = read_mesh(COMM, of_dolfinx(shared_path(tmp_path) / "mesh.xdmf", kind), names={"inlet": 7})
    sides = {"triangle": 3, "quadrilateral": 3, "tetrahedron": 12, "hexahedron": 6}[kind]
    assert lengths(m) == {"inlet": sides}
    assert counts(m) == {"2": {"triangle": 12, "quadrilateral": 6, "tetrahedron": 72, "hexahedron": 12}[kind]}
    x = m.domain.geometry.x[compat.facet_nodes(m.domain)[m.facets("inlet")]]
    assert np.abs(x[..., 0]).max(initial=0.0) == 0.0
    assert compat.cell_vertices(m.domain)[m.cells("2")].max(initial=0.0, axis=(0, 1))[0] <= 0.5


@pytest.mark.mpi
def test_several_tags_of_facets_are_refused(tmp_path):
    path = of_dolfinx(shared_path(tmp_path) / "mesh.xdmf", "triangle", twice=True)
    with pytest.raises(ValueError, match=r"mesh.xdmf has several tags of facets, 'sides', 'again': one of them is"):
        read_mesh(COMM, path)


# -- numbers of other types, and files that are none -------------------------------------------------------------------


def plain_xdmf(path, name, values):
    meshio = pytest.importorskip("meshio")
    blocks = [("triangle", np.array([[0, 1, 2], [0, 2, 3]]))]
    meshio.Mesh(np.array(CORNERS), blocks, cell_data={name: [np.asarray(values)]}).write(path, data_format="XML")
    return path


def test_whole_floats_are_numbers_of_groups_under_a_known_name(tmp_path):
    m = read_mesh(MPI.COMM_SELF, plain_xdmf(tmp_path / "float.xdmf", "gmsh:physical", [1.0, 2.0]))
    assert counts(m) == {"1": 1, "2": 1}
    path = plain_xdmf(tmp_path / "part.xdmf", "gmsh:physical", [1.0, 2.5])
    with pytest.raises(
        ValueError, match=r"part.xdmf has cell data 'gmsh:physical' that are not whole: numbers of groups"
    ):
        read_mesh(MPI.COMM_SELF, path)


def test_data_that_give_no_groups_are_told(tmp_path, caplog):
    with caplog.at_level(logging.WARNING, "varmint"):
        m = read_mesh(MPI.COMM_SELF, plain_xdmf(tmp_path / "float.xdmf", "tags", [1.0, 2.0]))
    assert m.cell_names == ()
    assert "cell data 'tags' are no groups: integers, or the name 'gmsh:physical', are required" in caplog.text


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.msh", b"", r"a.msh cannot be read as .msh: it is empty, '\$MeshFormat' is required"),
        (
            "a.msh",
            b"PK\x03\x04...",
            r"a.msh cannot be read as .msh: it begins with b'PK.*', '\$MeshFormat' is required",
        ),
        ("a.msh", b"Point(1) = {0, 0, 0};", r"it begins with b'Point\(1\) = ', '\$MeshFormat' is required"),
        ("a.msh", b"$MeshFormat\n9.1 0 8\n$EndMeshFormat\n", "version '9.1', one of 2, 4 is required"),
        ("a.msh", b"$MeshFormat\n", "version '', one of 2, 4 is required"),
        (
            "a.msh",
            b"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$PhysicalNames\n1\nwalls\n",
            "has 'walls' among the names of",
        ),
        (
            "a.msh",
            b"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 4 1 4\n",
            "a.msh: gmsh makes no mesh of it|has no ce",
        ),
        ("a.msh", b"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n", "a.msh cannot be read as .msh: .*: |has no cells"),
        ("a.xdmf", b"", "a.xdmf cannot be read as .xdmf: it is empty, which is no XML"),
        ("a.xdmf", b"\x89HDF\r\n", "a.xdmf cannot be read as .xdmf: it begins with b'.x89HDF.*', which is no XML"),
        ("a.xdmf", b"<html></html>", "a.xdmf cannot be read as .xdmf: its element is <html>, <Xdmf> is required"),
        (
            "a.xdmf",
            b"<Xdmf Version='3.0'><Domain/></Xdmf>",
            "it has no grid, a uniform one, which is a mesh, is required",
        ),
        (
            "a.xdmf",
            b"<Xdmf Version='3.0'><Domain><Grid GridType='Collection'/></Domain></Xdmf>",
            "it has a grid of type 'Collection', a uniform one, which is a mesh, is required",
        ),
        (
            "a.xdmf",
            b"<Xdmf Version='3.0'><Domain><Grid><Topology/></Grid></Domain></Xdmf>",
            r"a.xdmf .*: \w+Error: \w+",
        ),
    ],
)
def test_an_empty_or_foreign_file_is_named_with_what_it_is(tmp_path, name, content, message):
    pytest.importorskip("gmsh")
    pytest.importorskip("meshio")
    path = shared_path(tmp_path) / name
    on_root(COMM, lambda: path.write_bytes(content))
    with pytest.raises(ValueError, match=message):
        read_mesh(COMM, path)
