"""The README's example runs as printed, and its links lead somewhere."""

import logging
import re

import numpy as np
import pytest
from documents import DOCUMENTS, blocks, prose
from on_disk import DEMOS, ROOT

from tigar_x.compat.release import VERSION

TEXT = (ROOT / "README.md").read_text()
EXAMPLES = [code for language, code in blocks(ROOT / "README.md") if language == "python"]
TIP, FORCE = (0.4628663345, -0.2836665039), (0.7525089506, -0.1719429266)
"""Of the coupled run; dolfinx 0.5.2."""
DIGITS = 1e-7 if VERSION < (0, 6) else 1e-5  # of the linear solver, which a converged multiplier takes


def example(i, folder, monkeypatch):
    """Names that the i-th example leaves, run in a folder."""
    monkeypatch.chdir(folder)
    names = {}
    exec(compile(EXAMPLES[i], "README.md", "exec"), names)
    return names


def test_a_coupled_run_bends_the_flap_with_the_flow(tmp_path, monkeypatch, caplog):
    """As by hand, in 25 lines; without a warning, which would be of patterns of the multiplier that do no harm."""
    assert len(EXAMPLES[0].splitlines()) <= 25
    with caplog.at_level(logging.WARNING, logger="coudalfish"):
        names = example(0, tmp_path, monkeypatch)
    assert not [record.getMessage() for record in caplog.records if record.name.startswith("coudalfish")]
    np.testing.assert_allclose(names["flap"].at("u1").displacement, TIP, rtol=DIGITS)
    np.testing.assert_allclose(names["force"], FORCE, rtol=DIGITS)
    assert (tmp_path / "results/flap/shell.pvd").exists()


def test_a_flow_drags_the_cylinder_along(tmp_path, monkeypatch):
    pytest.importorskip("gmsh")
    names = example(1, tmp_path, monkeypatch)
    assert 0.1 < names["report"].measured[0] < 0.2
    assert names["flow"].time.time == pytest.approx(1.0)


def headings(document):
    """Anchors of a document, as renderers of Markdown make them of its headings."""
    lines = re.findall(r"^#+ (.*)$", prose(document), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}


def test_links_exist():
    """Files, and headings in them."""
    assert len(DOCUMENTS) >= 6
    for document in DOCUMENTS:
        text = re.sub(r"`[^`]*`", "", prose(document))
        for target, anchor in re.findall(r"\]\(([^)#]*)(?:#([^)]*))?\)", text):
            if target.startswith("http"):
                continue
            path = document.parent / target if target else document
            assert path.exists(), f"{document.name}: {target}"
            assert not anchor or anchor in headings(path), f"{document.name}: {target}#{anchor}"


def test_targets_named_in_the_readme_exist():
    makefile = (ROOT / "Makefile").read_text()
    shell = "".join(code for language, code in blocks(ROOT / "README.md") if language == "sh")
    named = {*re.findall(r"make ([a-z-]+)", shell), *re.findall(r"`make ([a-z-]+)`", TEXT)}
    assert len(named) >= 5
    for target in named:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_all_demos_are_in_the_table():
    assert set(re.findall(r"^\| `(\w+)\.py", TEXT, flags=re.MULTILINE)) == set(DEMOS)
