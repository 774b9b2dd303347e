"""What documents and docstrings name is there: modules, classes, functions, arguments, files and options."""

import ast
import importlib
import inspect
import re
from contextlib import suppress

import pytest
from documents import DOCUMENTS, blocks, inline, prose
from load import load_demo
from on_disk import ROOT

PACKAGES = ("tigar_x", "shnapr", "varmint", "coudalfish")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
DOTTED = re.compile(rf"(?<![\w./-])(?:{'|'.join(PACKAGES)})(?:\.[A-Za-z_]\w*)+")
FILES = re.compile(r"(?<![\w./-])(?:tests|demos|benchmarks|tools|docs|tigar_x|shnapr|varmint|coudalfish)/[\w./-]*\w")


ELSEWHERE = {
    "SpatialCoordinate",
    "derivative",
    "div",
    "dirichletbc",
    "ds",
    "dx",
    "grad",
    "len",
    "linspace",
    "refine",
    "sym",
}
"""Names of UFL, dolfinx, NumPy and Python that porting.md offers."""


def resolved(dotted):
    """The module, or what it holds, that a dotted name stands for; an old path raises."""
    parts = dotted.split(".")
    for i in range(len(parts), 0, -1):
        with suppress(ImportError):
            found = importlib.import_module(".".join(parts[:i]))
            break
    else:
        raise ModuleNotFoundError(dotted)
    for part in parts[i:]:
        found = getattr(found, part)
    return found


def module_of(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_dotted_names_in_documents_resolve(path):
    for dotted in sorted(set(DOTTED.findall(path.read_text()))):
        resolved(dotted.removesuffix(".py"))


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_files_named_in_documents_exist(path):
    for name in sorted(set(FILES.findall(path.read_text()))):
        assert (ROOT / name).exists(), name


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_imports_in_blocks_of_code_resolve(path):
    for language, code in blocks(path):
        if language != "python":
            continue
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in PACKAGES:
                for alias in node.names:
                    resolved(f"{node.module}.{alias.name}")


@pytest.mark.parametrize("package", PACKAGES)
def test_cross_references_in_docstrings_resolve(package):
    """Those with a dot from the root, the others from their module or from a class of it."""
    found = 0
    for path in (ROOT / package).rglob("*.py"):
        for target in re.findall(r":(?:mod|class|func|meth|attr|data|exc):`~?([\w.]+)`", path.read_text()):
            found += 1
            if target.split(".")[0] in PACKAGES:
                resolved(target)
                continue
            module = importlib.import_module(module_of(path))
            first, *rest = target.split(".")
            owners = [module, *(thing for thing in vars(module).values() if isinstance(thing, type))]
            named = any(_has(owner, [first, *rest]) for owner in owners)
            assert named or f"self.{target}" in path.read_text(), f"{path.name}: {target}"
    assert found


def _has(owner, names):
    for name in names:
        if not hasattr(owner, name) and name not in getattr(owner, "__annotations__", {}):
            return False
        owner = getattr(owner, name, None)
    return True


def vocabulary():
    """Every name that the sources define: modules, functions, classes, arguments, attributes, and words of choices."""
    words = set()
    for path in [*SOURCES, *sorted((ROOT / "demos").glob("*.py")), *sorted((ROOT / "benchmarks").glob("*.py"))]:
        words.update(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                words.add(node.name)
            elif isinstance(node, ast.arg):
                words.add(node.arg)
            elif isinstance(node, ast.Attribute | ast.Name) and isinstance(node.ctx, ast.Store):
                words.add(node.attr if isinstance(node, ast.Attribute) else node.id)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and re.fullmatch(r"\w+", node.value):
                words.add(node.value)
    return words


def new_names():
    """Calls and attributes in the middle column of porting.md's tables."""
    rows = [line.split(" | ") for line in prose(ROOT / "docs/porting.md").splitlines() if line.startswith("| ")]
    for row in rows:
        for code in inline(row[1]):
            for name in re.findall(r"([A-Za-z_]\w*)\(|(?<![\w)\]])\.([A-Za-z_]\w*)|([A-Za-z_]\w*)=", code):
                yield "".join(name), code


def test_what_replaces_a_legacy_name_is_there():
    """A call, an attribute or an argument that the tables of porting.md offer is defined somewhere."""
    words = vocabulary() | ELSEWHERE
    found = list(new_names())
    assert len(found) > 300
    missing = {f"{name} in {code}" for name, code in found if name not in words}
    assert not missing


COMMAND = re.compile(r"(demos/|benchmarks/|^\| `)(\w+)\.py((?: +(?:--?)?[\w.,/=*-]+)*)", flags=re.MULTILINE)


def options(folder, name):
    """Of the command line of a demo (a row of a table starts with one) or a benchmark, which its ``main`` gives."""
    if folder != "benchmarks/":
        return set(inspect.signature(load_demo(name).main).parameters)
    tree = ast.parse((ROOT / "benchmarks" / f"{name}.py").read_text())
    (main,) = (node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "main")
    return {arg.arg for arg in (*main.args.args, *main.args.kwonlyargs)}


def test_commands_in_documents_have_their_options():
    found = [match for path in DOCUMENTS for match in COMMAND.findall(path.read_text())]
    assert len(found) > 30
    for folder, name, words in found:
        for option in re.findall(r" --([\w-]+)", words):
            names = {option.replace("-", "_"), option.removeprefix("no-").replace("-", "_")}
            assert names & options(folder, name), f"{folder}{name}.py --{option}"


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_rows_of_a_table_have_as_many_cells_as_its_head(path):
    cells = None
    for line in path.read_text().splitlines():
        if not line.startswith("|"):
            cells = None
            continue
        found = len(re.findall(r"(?<!\\)\|", re.sub(r"`[^`]*`", "", line)))
        cells = cells or found
        assert found == cells, line


def test_what_is_said_to_be_of_a_module_is_in_it():
    """ "`name(...)` of `package.module`"."""
    of = re.compile(r"`([^`\n]+)` of `(" + DOTTED.pattern + ")`")
    found = [match for path in DOCUMENTS for match in of.findall(prose(path))]
    assert len(found) > 30
    for code, module in found:
        there = resolved(module)
        assert any(hasattr(there, word) for word in re.findall(r"[A-Za-z_]\w*", code)), f"{code} of {module}"
