"""Scripts of gmsh (.geo) as data: what is run of a file from elsewhere is geometry, groups and mesh sizes alone.

gmsh's language starts programs and reads and writes files, and gmsh has no switch against that. A script is therefore
split into words, numbers and strings, all words are looked up among those that are known to be harmless, and gmsh gets
what was looked at, without comments, instead of the file. What gmsh's jumps over branches might take for code, such as
the end of a branch within a string, is refused too. A script may still take all time and memory there are, or meet an
error in gmsh.
"""

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


HARMLESS = _words(
    """
    If ElseIf Else EndIf For In EndFor Macro Function Return Call Exists Error Warning Printf Sprintf
    newreg newp newl newc newll newcl news newsl newv newf Pi MPI_Rank MPI_Size Today
    Exp Log Log10 Sqrt Sin Asin ArcSin Cos Acos ArcCos Tan Atan ArcTan Atan2 ArcTan2 Sinh Cosh Tanh Fabs Abs Floor Ceil
    Round Fmod Modulo Hypot Max Min Rand Step List Unique LinSpace LogSpace Catenary Find
    Str StrCat StrPrefix StrRelative StrReplace StrSub StrLen StrFind StrCmp StrChoice UpperCase LowerCase LowerCaseIn
    DefineConstant UndefineConstant DefineNumber DefineString GetNumber Struct Append
    Name Label Help Choices Visible ReadOnly ReadOnlyRange Highlight Closed Units Range AutoCheck
    Point Line Curve Surface Volume Loop Plane Ruled Filling Circle Ellipse Ellipsis Spline CatmullRom BSpline Bezier
    Nurbs Knots Order Sphere PolarSphere Block Box Torus Rectangle Disk Cylinder Cone Wedge Ellipsoid Quadric Wire
    ThickSolid ThruSections Fillet Chamfer Parametric Elliptic Degenerated Physical Compound Hole Using Parent Euclidian
    Coordinates BooleanUnion BooleanFuse BooleanIntersection BooleanCommon BooleanDifference BooleanCut BooleanFragments
    BooleanCoherence BooleanSection Intersect Split Delete Recursive All Coherence HealShapes Sewing Slide GeoEntity
    Rotate Translate Symmetry Dilate Affine Duplicata Extrude Layers ScaleLastLayer Recombine Boundary CombinedBoundary
    PointsOf BoundingBox Closest Mass CenterOfMass MatrixOfInertia Normal Curvature SetFactory SetTag SetMaxTag NewModel
    Mesh Geometry General Field Background MeshSize MeshAlgorithm MeshSizeFromBoundary Characteristic Length
    Transfinite Progression Bump Beta Left Right Alternate AlternateRight AlternateLeft Smoother Periodic ReverseMesh
    Reverse RefineMesh RecombineMesh OptimizeMesh ReorientMesh RelocateMesh RenumberMeshNodes RenumberMeshElements
    SetOrder ClassifySurfaces CreateGeometry CreateTopology Show Hide Color
    AttractorAnisoCurve Attractor Ball BoundaryLayer Constant Distance Extend Frustum Gradient IntersectAniso Laplacian
    LonLat MathEval MathEvalAniso MaxEigenHessian Mean MinAniso Octree Param Restrict Threshold
    True False
    """
)
"""Words of gmsh's language that make geometry, groups, mesh sizes and meshes, and those of its numbers and branches."""
HARMFUL = _words(
    """
    System SystemCall NonBlockingSystemCall OnelabRun OnelabAction SyncModel ServerAction GmshOption ExternalProcess
    CommandLine Structured PostView FileName Plugin Include Merge MergeWithBoundingBox Open ShapeFromFile ListFromFile
    Save Print Draw CreateDir CreateDirectory DirName AbsolutePath FixRelativePath FileExists GetEnv GetString GetValue
    GetStringValue GetForced GetForcedStr StringToName S2N NameToString N2S SetString SetNumber Exit Abort Sleep Solver
    PostProcessing View Alias AliasWithOptions CopyOptions Combine AutomaticMeshSizeField
    """
)
"""Words that start programs, read or write files, ask questions, end the process or make other words."""
IN_STRINGS = _words(
    """
    System SystemCall NonBlockingSystemCall OnelabRun ExternalProcess Plugin Include Merge ShapeFromFile
    If ElseIf Else EndIf For EndFor Macro Function Return Call
    """
)
"""Words that no string may have: gmsh looks for the end of a branch in strings as well, in some places."""
GENERAL = frozenset(["Terminal", "Verbosity", "ExpertMode", "NumThreads"])
"""Options of gmsh itself that may be set; those of geometry and meshes all may."""
LONGEST = 1000
"""Number of characters in a string; gmsh reads the rest of one of 1024 as code."""
TOKEN = re.compile(
    rb"""(?P<space>[ \t\f\n]+|//[^\n]*|/\*.*?\*/)
    |(?P<string>"[^"\n]*"|'[^'"\n]*')
    |(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[Ee][-+]?[0-9]+)?)
    |(?P<word>[A-Za-z_][A-Za-z_0-9]*)
    |(?P<sign>\.\.\.|>>|<<|[-+*/=!<>]=|\+\+|--|::|&&|\|\||[-+*/%^=<>!?:;,.(){}\[\]&|~\#])""",
    re.VERBOSE | re.DOTALL,
)
OPEN, CLOSE = ("(", "[", "{"), (")", "]", "}")


class Token(NamedTuple):
    """A word, string, number or sign.

    Attributes:
        kind: "word", "string", "number" or "sign".
        text: as it is in the file.
        line: from 1.
    """

    kind: str
    text: str
    line: int


def plain_script(path: Path) -> bytes:
    """A script that was found harmless, without comments.

    Args:
        path: of the script.

    Returns:
        What gmsh is to read; lines keep their numbers.

    Raises:
        ValueError: the script has a word that starts a program, reads or writes a file, or is not known, or something
            that can be read in two ways; the message has the line.
    """
    source = path.read_bytes().replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    pieces: list[bytes] = []
    tokens: list[Token] = []
    for kind, piece, line in _pieces(path, source):
        if kind == "space":
            pieces.append(b" " + b"\n" * piece.count(b"\n"))
            continue
        pieces.append(b'"' + piece[1:-1] + b'"' if kind == "string" else piece)
        tokens.append(Token(kind, piece.decode("latin-1"), line))
    for token in tokens:
        if token.kind == "string":
            _check_string(path, token)
    _check_words(path, tokens)
    return b"".join(pieces) + b"\n"


def _error(path: Path, line: int, what: str) -> ValueError:
    return ValueError(f"{path}, line {line}: {what}; trust_script = True runs a script whatever it does")


def _pieces(path: Path, source: bytes) -> Iterator[tuple[str, bytes, int]]:
    start, line = 0, 1
    while start < len(source):
        match = TOKEN.match(source, start)
        if match is None or (match.lastgroup == "sign" and source.startswith(b"/*", start)):
            raise _error(path, line, f"{source[start : start + 20]!r} is no part of the language, or has no end")
        yield str(match.lastgroup), match[0], line
        line += match[0].count(b"\n")
        start = match.end()


def _check_string(path: Path, token: Token) -> None:
    inside = token.text[1:-1]
    if len(inside) > LONGEST or re.search(r"[\x00-\x08\x0a-\x1f\x7f]", inside):
        raise _error(path, token.line, f"a string of up to {LONGEST} printable characters is required")
    for word in re.findall(r"[A-Za-z_]+", inside):
        if word in IN_STRINGS:
            raise _error(path, token.line, f"the word {word!r} in a string, where it might be read as code")


def _check_words(path: Path, tokens: list[Token]) -> None:
    known = HARMLESS | _assigned(tokens)
    for i, (token, after) in enumerate(pairwise([*tokens, Token("sign", ";", 0)])):
        if token.kind != "word":
            continue
        before = tokens[i - 1].text if i else ";"
        if token.text in HARMFUL or re.search("Command|FileName|Executable", token.text):
            raise _error(path, token.line, f"{token.text!r} can start programs or reach files, and is refused")
        if before == ".":
            _check_member(path, tokens, i)
        elif token.text not in known:
            raise _error(path, token.line, f"{token.text!r} is no word known to be harmless, nor set in the script")
        follows = after.kind == "word" and after.text != "In" and before not in ("Macro", "Function")
        if token.text not in HARMLESS and (follows or after.kind == "string"):
            raise _error(path, token.line, f"{token.text} {after.text} is no command known to be harmless")
        if token.text in ("Printf", "Error", "Warning"):
            _check_message(path, tokens, i)


def _check_member(path: Path, tokens: list[Token], i: int) -> None:
    """Refuse options other than those of geometry, meshes and fields, and some of gmsh itself."""
    owner, name = tokens[i - 2] if i > 1 else Token("sign", ";", 0), tokens[i]
    if owner.text == "General" and name.text not in GENERAL:
        raise _error(path, name.line, f"General.{name.text} can reach files or end the run, and is refused")


def _check_message(path: Path, tokens: list[Token], i: int) -> None:
    """Refuse a message that goes to a file: what follows its closing bracket is no semicolon."""
    depth, end = 0, None
    for k in range(i + 1, len(tokens)):
        depth += (tokens[k].text in OPEN) - (tokens[k].text in CLOSE)
        if depth == 0 or tokens[k].text == ";":
            end = k
            break
    if end is None or depth or end + 1 >= len(tokens) or tokens[end + 1].text != ";":
        raise _error(path, tokens[i].line, f"{tokens[i].text}(...) that goes elsewhere than to the terminal is refused")


def _assigned(tokens: list[Token]) -> set[str]:
    """Names that the script sets itself."""
    names = set()
    defining = False
    for i, token in enumerate(tokens):
        before = tokens[i - 1].text if i else ";"
        if token.text in ("DefineConstant", "UndefineConstant", "Struct"):
            defining = True
        if token.text == ";":
            defining = False
        if token.kind != "word" or before == ".":
            continue
        if before in ("For", "Macro", "Function", "Struct") or (defining and before in ("[", ",")):
            names.add(token.text)
        k = i + 1
        while k < len(tokens) and tokens[k].text in ("~", *OPEN):
            k = _closed(tokens, k)
        if k < len(tokens) and tokens[k].text in ("=", "+=", "-=", "*=", "/=", "++", "--"):
            names.add(token.text)
    return names


def _closed(tokens: list[Token], k: int) -> int:
    """Where what begins with a bracket or ~ has ended."""
    if tokens[k].text == "~":
        return k + 1
    depth = 0
    for j in range(k, len(tokens)):
        depth += (tokens[j].text in OPEN) - (tokens[j].text in CLOSE)
        if depth == 0:
            return j + 1
    return len(tokens)
