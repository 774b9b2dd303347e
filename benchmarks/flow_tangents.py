"""Exact tangents, frozen stabilisation parameters and kept tangents: Newton iterations, assembly and total CPU time.

Every row is a flow of its own in this process; the fastest of some repeats counts. The answers agree to the tolerance.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from load import load_demo

from tigar_x.run import script
from tigar_x.run.summary import table
from varmint.flow import Flow

CHOICES: dict[str, dict[str, Any]] = {
    "exact": {"keep": None},
    "frozen": {"keep": None, "frozen_tangent": True},
    "exact, kept": {},
    "frozen, kept": {"frozen_tangent": True},
}
COLUMNS = ("scene", "tangent", "Newton iterations", "tangents", "ms a tangent", "CPU s", "ratio")


def steady(**options: Any) -> Flow:
    """The cavity of degree 2."""
    return load_demo("lid_driven_cavity").build(32, 2, **options)


def fast(**options: Any) -> Flow:
    """The cavity at Re = 1000 and degree 1."""
    return load_demo("lid_driven_cavity").build(64, 1, reynolds=1000.0, **options)


def vortex(**options: Any) -> Flow:
    """The vortex of degree 1."""
    return load_demo("taylor_green").Vortex().build(64, **options)


def moving(**options: Any) -> Flow:
    """The vortex on a moving mesh."""
    return load_demo("taylor_green").Vortex(moving_mesh=True).build(32, **options)


def in_space(**options: Any) -> Flow:
    """The vortex in space."""
    return load_demo("taylor_green").Vortex(dim=3).build(32, **options)


SCENES = {
    "steady, k = 2, Re 100": steady,
    "steady, k = 1, Re 1000": fast,
    "unsteady": vortex,
    "unsteady, moving mesh": moving,
    "unsteady, 3D": in_space,
}


def measure(make: Any, repeats: int, **options: Any) -> dict[str, float]:
    """Counts and the smallest CPU times of some solves."""
    found: list[dict[str, float]] = []
    for _ in range(repeats):
        flow = make(**options)
        flow.compile()
        start, reports = time.process_time(), []
        if flow.time is None:
            reports.append(flow.solve())
        else:
            reports = [flow.take_step() for _ in range(16)]
        total = time.process_time() - start
        start = time.process_time()
        for _ in range(5):
            flow.system.assemble_tangent()
        assembly = (time.process_time() - start) / 5.0
        counts = {"iterations": sum(r.iterations for r in reports), "tangents": sum(r.tangents for r in reports)}
        found.append({**counts, "assembly": assembly, "total": total, "steps": len(reports)})
    return {name: float(np.min([f[name] for f in found])) for name in found[0]}


def main(repeats: int = 3, out: Path = Path("results/benchmarks/flow_tangents")) -> None:
    """Compare tangents of flow.

    Args:
        repeats: solves of every scene, of which the fastest counts.
        out: folder of the results.
    """
    rows: list[list[Any]] = []
    for scene, make in SCENES.items():
        first = None
        for name, options in CHOICES.items():
            if scene.startswith("steady") and "kept" in name:
                continue  # steady flow has a new tangent for every iteration
            r = measure(make, repeats, **options)
            first = r["total"] if first is None else first
            per_step = r["iterations"] / r["steps"], r["tangents"] / r["steps"]
            rows.append([scene, name, *per_step, 1e3 * r["assembly"], r["total"] / r["steps"], r["total"] / first])
    text = table(COLUMNS, rows)
    print(text)
    out.mkdir(parents=True, exist_ok=True)
    (out / "table.txt").write_text(text + "\n")


if __name__ == "__main__":
    script.command_line(main)
