"""The README's example runs as printed, and its links lead somewhere."""

import logging
import re

import numpy as np
import pytest
from on_disk import ROOT

TEXT = (ROOT / "README.md").read_text()
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def example(i, folder, monkeypatch):
    """Names that the i-th example leaves, run in a folder."""
    code = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)[i]
    assert len(code.strip().splitlines()) <= 50
    monkeypatch.chdir(folder)
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    return names


def test_a_coupled_run_bends_the_flap_with_the_flow(tmp_path, monkeypatch, caplog):
    """Without a warning, which would be of patterns of the multiplier that do no harm."""
    with caplog.at_level(logging.WARNING, logger="coudalfish"):
        names = example(0, tmp_path, monkeypatch)
    assert not [record.getMessage() for record in caplog.records if record.name.startswith("coudalfish")]
    flap, motion = names["flap"], names["motion"]
    tip = flap.nodal(motion.x)[np.argmax(flap.node_positions[:, 1])]
    assert 0.02 < tip[0] < 0.6
    assert tip[1] < 0.0
    assert (tmp_path / "results/flap/shell.pvd").exists()


def test_a_flow_drags_the_cylinder_along(tmp_path, monkeypatch):
    pytest.importorskip("gmsh")
    names = example(1, tmp_path, monkeypatch)
    assert 0.1 < names["report"].measured[0] < 0.2
    assert names["flow"].time.time == pytest.approx(1.0)


def test_links_exist():
    assert len(DOCUMENTS) >= 6
    for document in DOCUMENTS:
        prose = re.sub(r"```.*?```|`[^`]*`", "", document.read_text(), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", prose):
            if not target.startswith("http"):
                assert (document.parent / target).exists(), f"{document.name}: {target}"


def test_targets_named_in_the_readme_exist():
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"make ([a-z-]+)", TEXT):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target
