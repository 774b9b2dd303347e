"""The examples, found on disk: in ``demos/`` of a checkout, or where an installed wheel has put them."""

import ast
import difflib
import importlib.metadata
import runpy
import sys
from pathlib import Path

from coudalfish.cli.tell import say

INSTALLED = "coudalfish/demos"
"""Folder of the examples in an installation, below its ``share``; pyproject.toml puts them there."""


def folder() -> Path | None:
    """Folder of the examples; None: there is none."""
    checkout = Path(__file__).resolve().parents[2] / "demos"
    if (checkout.parent / "pyproject.toml").exists() and checkout.is_dir():
        return checkout
    try:
        files = importlib.metadata.files("coudalfish") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    places = {Path(str(file.locate())).resolve().parent for file in files if file.parent.as_posix().endswith(INSTALLED)}
    return min(places, default=None)


def demos() -> dict[str, Path]:
    """The examples by name."""
    place = folder()
    return {} if place is None else {path.stem: path for path in sorted(place.glob("*.py")) if path.stem[0] != "_"}


def headline(path: Path) -> str:
    """First sentence of a script's docstring, without running it."""
    doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return doc.split("\n\n")[0].replace("\n", " ").removesuffix(".")


def listing() -> str:
    """The examples, one a line."""
    known = demos()
    if not known:
        return _nothing()
    width = max(map(len, known))
    lines = [f"  {name:{width}}  {headline(path)}" for name, path in known.items()]
    return "\n".join(
        [
            "Examples:",
            *lines,
            "",
            'Run one with "coudalfish run NAME"; "coudalfish run NAME --help" shows its options.',
            f"They are scripts to read and to copy from, in {folder()}",
        ]
    )


def run_demo(name: str, arguments: list[str]) -> int:
    """Run an example as a script of its own.

    Args:
        name: of the example.
        arguments: its command line.

    Returns:
        Exit status.
    """
    known = demos()
    path = known.get(name.replace("-", "_").removesuffix(".py"))
    if path is None:
        near = difflib.get_close_matches(name, known, 3, 0.5)
        meant = f"; did you mean {' or '.join(near)}?" if near else ""
        others = f'"coudalfish list" shows those that there are ({", ".join(known)})' if known else _nothing()
        say(f"There is no example {name!r}{meant}\n{others}")
        return 2
    before = sys.argv
    sys.argv = [str(path), *arguments]
    try:
        runpy.run_path(str(path), run_name="__main__")
    finally:
        sys.argv = before
    return 0


def _nothing() -> str:
    return "No examples were found: they are in demos/ of a checkout, and come along with a wheel."
