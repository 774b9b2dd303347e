"""What a flow compiles, scene by scene, with an empty cache of forms: contents, compile times, and what is left out.

Every scene is a process of its own, whose cache is an empty folder.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from load import load_demo

from tigar_x import compat
from tigar_x.run import script
from tigar_x.run.summary import write_summary
from varmint.flow import Flow
from varmint.problems.cylinder import Channel

HERE = Path(__file__).resolve()
KINDS = ("functional", "residual", "tangent")
COLUMNS = ("scene", "form", "cell", "integrals", "functions", "Constants", "seconds")


def scenes() -> dict[str, Callable[[], Flow]]:
    """Scenes by name."""
    cavity, vortex, beam = map(load_demo, ("lid_driven_cavity", "taylor_green", "turek_hron_fsi3"))
    return {
        "2D steady": lambda: cavity.build(4),
        "2D steady, frozen tangent": lambda: cavity.build(4, frozen_tangent=True),
        "2D steady, degree 2": lambda: cavity.build(4, 2),
        "2D steady, degree 2, quadrilaterals": lambda: cavity.build(4, 2, "quadrilateral"),
        "2D unsteady": lambda: vortex.Vortex().build(4),
        "2D unsteady, outlet": lambda: Channel(20.0, degree=1, size=0.2, dt=0.1).build(),
        "2D unsteady, moving mesh": lambda: vortex.Vortex(moving_mesh=True).build(4),
        "2D solid and moving mesh, degree 2": lambda: beam.Beam(0.12, 0.02).build(),
        "3D unsteady": lambda: vortex.Vortex(dim=3).build(4),
        "3D unsteady, moving mesh": lambda: vortex.Vortex(dim=3, moving_mesh=True).build(4),
        "3D unsteady, degree 2": lambda: vortex.Vortex(dim=3, degree=2).build(4),
    }


def compiled(scene: str) -> list[dict[str, Any]]:
    """The forms of residual and tangent that a scene compiles."""
    flow = scenes()[scene]()
    before = len(compat.compiled_forms())
    flow.compile()
    return [asdict(form) for form in compat.compiled_forms()[before:]]


def run(scene: str) -> list[dict[str, Any]]:
    """The same in a process with an empty cache."""
    with tempfile.TemporaryDirectory() as cache:
        env = {**os.environ, "OMP_NUM_THREADS": "1", "XDG_CACHE_HOME": cache}
        command = [sys.executable, str(HERE), "--worker", scene]
        done = subprocess.run(command, capture_output=True, text=True, env=env)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return list(json.loads(done.stdout.splitlines()[-1]))


def main(out: Path = Path("results/benchmarks/flow_forms"), worker: str | None = None) -> None:
    """List the forms of flows and their compile times.

    Args:
        out: folder of the results.
        worker: a scene, which is compiled in this process, instead of all.
    """
    if worker:
        print(json.dumps(compiled(worker)))
        return
    rows, lines = [], [f"| {' | '.join(COLUMNS)} |", f"|{' --- |' * len(COLUMNS)}"]
    print("\n".join(lines))
    for scene in scenes():
        for form in run(scene):
            rows.append({"scene": scene, **form})
            cells = [scene, KINDS[form["arguments"]], form["cell"], ", ".join(form["integrals"])]
            cells += [", ".join(form["coefficients"]), str(form["constants"]), f"{form['seconds']:.2f}"]
            lines.append(f"| {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    write_summary(out, "flow_forms", {}, forms=rows)
    (out / "flow_forms.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    script.command_line(main)
