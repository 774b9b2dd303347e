"""Scripts of gmsh from elsewhere: what makes a mesh runs, what could do anything else does not."""

import pytest
from mpi4py import MPI

from tigar_x import compat
from tigar_x.run.output import on_root
from varmint.mesh.files import read_mesh
from varmint.mesh.scripts import HARMFUL, HARMLESS, plain_script

COMM = MPI.COMM_WORLD
SQUARE = """SetFactory("OpenCASCADE");
Rectangle(1) = {0, 0, 0, 1, 1};
Physical Surface("fluid") = {1};
Mesh.MeshSizeMax = 0.5;
"""
HARMLESS_SCRIPTS = {
    "variables, loops and macros": """
        // SystemCall "touch here"; is a comment
        /* Merge "a.msh";
           Include 'b.geo'; */
        DefineConstant[ n = {4, Name "Parameters/number of corners", Min 3, Max 9}, size = 0.5 ];
        r = 1.; names() = {}; corners[] = {};
        Macro Corner
          p~{i} = newp;
          Point(p~{i}) = {r * Cos(2 * Pi * i / n), r * Sin(2 * Pi * i / n), 0, size};
          corners() += p~{i};
        Return
        For i In {0 : n - 1}
          Call Corner;
        EndFor
        sides() = {};
        For i In {0 : n - 1}
          l = newl; Line(l) = {corners(i), corners[(i + 1) % n]}; sides() += l;
        EndFor
        If (n >= 3 && #corners() == n)
          Curve Loop(1) = sides(); Plane Surface(1) = {1};
        Else
          Error("too few corners: %g", n);
        EndIf
        Physical Curve(Sprintf("side %g", 1)) = {sides(0)};
        Physical Surface('inside "quoted" no', 7) = {1};
        Printf("%g corners", n);
    """.replace('"quoted" ', ""),
    "sizes": """
        SetFactory("OpenCASCADE");
        Rectangle(1) = {0, 0, 0, 2, 1};
        Disk(2) = {0.6, 0.5, 0, 0.2};
        f() = BooleanDifference{ Surface{1}; Delete; }{ Surface{2}; Delete; };
        Physical Surface("fluid", 1) = {f()};
        hole() = Curve In BoundingBox {0.3, 0.2, -1, 0.9, 0.8, 1};
        Physical Curve("hole", 2) = {hole()};
        Field[1] = Distance; Field[1].CurvesList = {hole()}; Field[1].NumPointsPerCurve = 50;
        Field[2] = Threshold; Field[2].InField = 1; Field[2].SizeMin = 0.1; Field[2].SizeMax = 0.4;
        Field[2].DistMin = 0.1; Field[2].DistMax = 0.5;
        Field[3] = MathEval; Field[3].F = "0.1 + x^2";
        Field[4] = Min; Field[4].FieldsList = {2, 3};
        Background Field = 4;
        Mesh.MeshSizeExtendFromBoundary = 0; Mesh.Algorithm = 6; Geometry.Tolerance = 1e-8; General.Terminal = 0;
        Mesh 2;
    """,
    "transfinite": """
        Point(1) = {0, 0, 0, 1.}; Point(2) = {1, 0, 0, 1.};
        Line(1) = {1, 2}; Transfinite Curve {1} = 4 Using Progression 1.1;
        out[] = Extrude {0, 1, 0} { Curve{1}; Layers{3}; Recombine; };
        Physical Surface("all") = {out[1]};
        Physical Curve("lid") = {out[0]};
        Characteristic Length {1, 2} = 0.1;
    """,
}


def shared_path(tmp_path):
    """The folder of rank 0."""
    return type(tmp_path)(COMM.bcast(str(tmp_path)))


@pytest.mark.mpi
@pytest.mark.parametrize("text", HARMLESS_SCRIPTS.values(), ids=HARMLESS_SCRIPTS)
def test_a_script_that_makes_a_mesh_runs(tmp_path, text):
    pytest.importorskip("gmsh")
    path = shared_path(tmp_path) / "scene.geo"
    on_root(COMM, lambda: path.write_text(text))
    m = read_mesh(COMM, path)
    assert COMM.allreduce(compat.owned_cells(m.domain)) > 4
    assert len(m.cell_names) == 1
    assert m.cell_names[0] in ("inside no", "fluid", "all")


ATTACKS = {
    "call": 'SystemCall "touch {here}";',
    "short name": 'System "touch {here}";',
    "in the background": 'NonBlockingSystemCall "touch {here}";',
    "client": 'OnelabRun("a", "touch {here}");',
    "string variable": 'c = "touch {here}"; SystemCall c;',
    "pieces of a string": 'SystemCall StrCat("tou", "ch {here}");',
    "no space": 'SystemCall"touch {here}";',
    "other quotes": "SystemCall 'touch {here}';",
    "over lines": 'SystemCall\n\n"touch {here}";',
    "comment between": 'SystemCall/**/"touch {here}";',
    "after a comment's end": '/* /* */ SystemCall "touch {here}";',
    "comment in a string": 'a = "/*"; SystemCall "touch {here}"; b = "*/";',
    "line comment in a string": 'a = "//"; SystemCall "touch {here}";',
    "comment in a comment": '// /*\nSystemCall "touch {here}"; // */',
    "null byte in a comment": '// \x00\nSystemCall "touch {here}";',
    "return in a comment": '// a\rSystemCall "touch {here}";',
    "null byte ends a string": 'a = "\x00 SystemCall "touch {here}"; b = "";',
    "open comment": '/* a\nSystemCall "touch {here}";',
    "open string": 'a = "b;\nSystemCall "touch {here}";',
    "long string": "a = '" + 1100 * "a" + ' ; SystemCall "touch {here}"; //' + "';",
    "end of a branch in a string": "If (0) E\"x EndIf SystemCall 'touch {here}'; \"\nEndIf",
    "macro": 'Macro m\nSystemCall "touch {here}";\nReturn\nCall m;',
    "macro by name": 'Macro "a b"\nSystemCall "touch {here}";\nReturn\nCall "a b";',
    "branch": 'If (1 == 1)\nSystemCall "touch {here}";\nEndIf',
    "loop": 'For i In {0:0}\nSystemCall "touch {here}";\nEndFor',
    "variable of that name": 'SystemCall = 1; SystemCall "touch {here}";',
    "after a member": 'Mesh.Algorithm = 6; Mesh. SystemCall "touch {here}";',
    "field": 'Field[1] = ExternalProcess; Field[1].CommandLine = "touch {here}"; Background Field = 1;',
    "include": 'Include "{other}";',
    "merge": 'Merge "{other}";',
    "merge with a box": 'MergeWithBoundingBox "{other}";',
    "open": 'Open "{other}";',
    "shape": 'ShapeFromFile("{other}");',
    "archive": 'Merge "; touch {here}; .gz";',
    "save": 'Mesh 2; Save "{here}";',
    "print": 'Print "{here}";',
    "message to a file": 'Printf("a") > "{here}";',
    "message added to a file": 'Printf("%g", 1) >> "{here}";',
    "message with other brackets": 'Printf(Str("a"]) > "{here}"; Point(9) = {{0, 0, 0});',
    "folder": 'CreateDir "{here}";',
    "plugin": "Plugin(NewView).Run;",
    "solver": 'Solver.Executable0 = "touch {here}"; OnelabRun(0);',
    "option with a file": 'General.ErrorFileName = "{here}";',
    "option that ends the run": "General.AbortOnError = 4;",
    "end": "Exit;",
    "name from a string": 'Field[1] = S2N["ExternalProcess"];',
    "environment": 'Printf(GetEnv("HOME"));',
    "question": 'a = GetString("name", "");',
    "unknown command": 'Launch "touch {here}";',
    "unknown command after a setting": 'Launch = 1; c = "touch {here}"; Launch c;',
    "unknown function": 'a() = Launch("touch {here}");',
    "backslash": 'System\\\nCall "touch {here}";',
}


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
@pytest.mark.parametrize("before", [True, False])
def test_a_script_that_does_something_else_is_refused(tmp_path, attack, before):
    """Before the geometry and after it; nothing has been made, neither by the script nor by one that it names."""
    pytest.importorskip("gmsh")
    here, other = tmp_path / "here", tmp_path / "other.geo"
    other.write_text(f'SystemCall "touch {here}";')
    line = attack.replace("{here}", str(here)).replace("{other}", str(other)).replace("{{", "{")
    path = tmp_path / "scene.geo"
    path.write_text(line + "\n" + SQUARE if before else SQUARE + line + "\n", newline="")
    with pytest.raises(ValueError, match=r"scene.geo, line \d+: .*; trust_script = True runs a script whatever"):
        read_mesh(MPI.COMM_SELF, path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["other.geo", "scene.geo"]


def test_a_trusted_script_does_what_it_says(tmp_path):
    pytest.importorskip("gmsh")
    path, here = tmp_path / "scene.geo", tmp_path / "here"
    path.write_text(SQUARE + f'Printf("a") > "{here}";\nSystemCall "touch {here}2";\n')
    with pytest.raises(ValueError, match=r"line 5: Printf\(\.\.\.\) that goes elsewhere"):
        read_mesh(MPI.COMM_SELF, path)
    assert read_mesh(MPI.COMM_SELF, path, trust_script=True).cell_names == ("fluid",)
    assert here.exists()
    assert (tmp_path / "here2").exists()


@pytest.mark.parametrize("kind", ["geo", "msh"])
def test_a_file_beside_is_not_run(tmp_path, kind):
    """gmsh runs scene.geo.opt after scene.geo, and scene.msh.opt after scene.msh."""
    gmsh = pytest.importorskip("gmsh")
    path, here = tmp_path / f"scene.{kind}", tmp_path / "here"
    if kind == "geo":
        path.write_text(SQUARE)
    else:
        gmsh.initialize([], False)
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.occ.addRectangle(0.0, 0.0, 0.0, 1.0, 1.0)
        gmsh.model.occ.synchronize()
        gmsh.model.mesh.generate(2)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(path))
        gmsh.finalize()
    path.with_name(f"{path.name}.opt").write_text(f'SystemCall "touch {here}";')
    assert COMM.size > 1 or compat.owned_cells(read_mesh(MPI.COMM_SELF, path).domain) > 2
    assert not here.exists()


@pytest.mark.parametrize("name", ["scene.msh", "scene.xdmf", "scene.MSH"])
def test_a_script_by_another_name_is_not_run(tmp_path, name):
    pytest.importorskip("gmsh")
    here = tmp_path / "here"
    for text in (
        f'SystemCall "touch {here}";',
        f'\n$MeshFormat\nSystemCall "touch {here}";',
        f'$View\nSystem "{here}";',
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match="cannot be read as"):
            read_mesh(MPI.COMM_SELF, tmp_path / name)
    assert not here.exists()


def test_gmsh_reads_what_was_looked_at_with_its_lines(tmp_path):
    path = tmp_path / "a.geo"
    path.write_bytes(b"a = 1; /* b\n c */ d = 'e';\r\n// f\nPoint(a) = {d, 0, 0};")
    lines = plain_script(path).decode().split("\n")
    assert [line.split() for line in lines] == [
        ["a", "=", "1;"],
        ["d", "=", '"e";'],
        [],
        ["Point(a)", "=", "{d,", "0,", "0};"],
        [],
    ]


def test_no_word_is_both_harmless_and_harmful():
    assert not HARMLESS & HARMFUL
