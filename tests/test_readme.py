"""The README's example runs as printed, and its links lead somewhere."""

import re

import numpy as np
from on_disk import ROOT

TEXT = (ROOT / "README.md").read_text()
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_example_runs_and_the_flap_bends_with_the_flow(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    assert len(code.strip().splitlines()) <= 45
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    flap, motion = names["flap"], names["motion"]
    tip = flap.nodal(motion.x)[np.argmax(flap.node_positions[:, 1])]
    assert 0.02 < tip[0] < 0.6
    assert tip[1] < 0.0
    assert (tmp_path / "results/flap/shell.pvd").exists()


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
