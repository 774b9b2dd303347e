"""Where the time of a step of the opening heart valve goes, and what assembling the flow's Jacobian consists of.

Shares come from Python's profiler with CPU seconds, which favours compiled code a little. Of the Jacobian, packing the
coefficients and adding matrices of zeros to the global one are timed by themselves: the kernel is what is left.
"""

import cProfile
import logging
import pstats
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from breakdown import FLUID, STEP, cumulative
from dolfinx import cpp
from load import load_demo
from petsc4py import PETSc

from coudalfish import CouDALFISh
from tigar_x import checks, compat
from tigar_x.run import script
from tigar_x.run.progress import Stopwatch
from tigar_x.run.summary import table, write_summary

SHELL, SIDED, LINEARISED = (f"coudalfish/{name}.py" for name in ("sides/shell", "sides/sided_fluid", "step/linearised"))
CONDENSED, CONVERGED = "coudalfish/step/condensed.py", "coudalfish/step/converged.py"
DOUBLED, SOLVE, LINEAR = (f"tigar_x/fem/{name}.py" for name in ("doubled", "solve", "linear"))
Places = list[tuple[str, ...]]
PARTS: dict[str, dict[str, tuple[Places, Places]]] = {
    "plain": {
        "fluid: Jacobian": ([(FLUID, "assemble_tangent")], []),
        "fluid: residual": ([(FLUID, "assemble_residual")], []),
        "fluid: preconditioner and solves": ([(FLUID, "solve")], []),
        "placing": ([(STEP, "_place")], []),
        "shell: tangent": ([(SHELL, "assemble_tangent"), (SHELL, "renew_contact")], []),
        "shell: residual": ([(SHELL, "assemble_residual")], []),
        "shell: solves": ([(SHELL, "solve")], []),
        "multiplier, monitors": ([(STEP, "_finish")], []),
        "acceptance": ([(STEP, "_accepted")], []),
    },
    "jump": {
        "fluid: Jacobian of undivided cells": ([(FLUID, "assemble_tangent")], [(DOUBLED, "_add_divided")]),
        "fluid: Jacobian of divided cells": ([(DOUBLED, "_add_divided")], []),
        "fluid: residual": ([(FLUID, "assemble_residual")], []),
        "fluid: preconditioner": ([(LINEAR, "preconditioner")], []),
        "fluid: products, and solves with the preconditioner": (
            [(SOLVE, "multiply"), ("~", "<method 'apply' of 'petsc4py.PETSc.PC' objects>")],
            [],
        ),
        "solves: shell in the products": ([(LINEARISED, "moved")], []),
        "solves: the rest": (
            [(CONDENSED, "solve")],
            [(LINEARISED, "moved"), (SOLVE, "multiply"), ("~", "<method 'apply' of 'petsc4py.PETSc.PC' objects>")],
        ),
        "placing: what is divided, polygons": ([(SIDED, "place")], [(DOUBLED, "divide")]),
        "placing: rows and matrices": ([(DOUBLED, "divide")], []),
        "points, normals, functions of the multiplier": ([(STEP, "_place")], [(SIDED, "place")]),
        "shell: tangent": ([(SHELL, "assemble_tangent"), (SHELL, "renew_contact")], []),
        "shell: residual": ([(SHELL, "assemble_residual")], []),
        "shell: solves": ([(SHELL, "solve")], []),
        "monitors": ([(STEP, "_finish")], []),
        "acceptance": ([(STEP, "_accepted")], []),
    },
}
"""Functions, by file and name, whose cumulative times make a part, and those inside that are parts of their own."""
REPEATS = 8
"""Times that a measurement is repeated; the least counts."""


def seconds(stats: pstats.Stats, parts: dict[str, tuple[Places, Places]]) -> dict[str, float]:
    """CPU seconds of every part and of the rest.

    Raises:
        ValueError: nothing is found of a part: its functions have other names.
    """
    found = {}
    for part, (inside, without) in parts.items():
        found[part] = sum(cumulative(stats, *place) for place in inside)
        if found[part] <= 0.0:
            raise ValueError(f"PARTS: nothing is found of {part}")
        found[part] -= sum(cumulative(stats, *place) for place in without)
    found["the rest"] = cumulative(stats, "coudalfish/coupler.py", "takeStep") - sum(found.values())
    return found


def _least(work: Callable[[], Any]) -> float:
    """Least CPU seconds of some calls."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def jacobian(fsi: CouDALFISh) -> dict[str, float]:
    """What assembling the Jacobian of cells that nothing divides consists of, microseconds a tetrahedron."""
    system: Any = fsi.fluid.system
    divided = getattr(system, "_doubled", None)
    form = system._tangent if divided is None else system._plain[1]
    cells = compat.cell_dofs(system.x.function_space)[: compat.owned_cells(fsi.mesh_f)]
    cells = np.ascontiguousarray(cells if divided is None else cells[~divided.cells[: len(cells)]], dtype=np.int32)
    size = cells.shape[1] * system.x.function_space.dofmap.index_map_bs
    zeros, A = np.zeros((len(cells), size, size)), system.A
    whole = _least(lambda: (compat.add_matrix(A, form, system.bcs), A.assemble()))
    add = PETSc.InsertMode.ADD_VALUES
    parts = {
        "coefficients": _least(lambda: cpp.fem.pack_coefficients(getattr(form, "_cpp_object", form))),
        "adding to the matrix": _least(lambda: A.setValuesBlockedLocalRCV(cells, cells, zeros, add)),
    }
    A.assemble()
    parts["kernel and facets"] = whole - sum(parts.values())
    return {name: 1e6 * value / len(cells) for name, value in (parts | {"whole": whole}).items()}


def measure(preset: str, resolution: int, steps: int, before: int) -> dict[str, Any]:
    """Costs of one preset at one resolution."""
    demo = load_demo("heart_valve")
    flow, _, fsi = demo.Valve(resolution=resolution, preset=preset).build(demo.Data())
    for _ in range(before):
        fsi.takeStep()
    watch, profile = Stopwatch(), cProfile.Profile(time.process_time)
    with watch:
        first = [fsi.takeStep() for _ in range(steps)]
    profile.enable()
    for _ in range(steps):
        fsi.takeStep()
    profile.disable()
    parts = {name: value / steps for name, value in seconds(pstats.Stats(profile), PARTS[preset]).items()}
    known = {"preset": preset, "cells": flow.mesh.size, "cpu_s_per_step": watch.cpu_s / steps, "seconds": parts}
    known |= {"passes": np.mean([r.passes for r in first]), "iterations": np.mean([r.linear_iterations for r in first])}
    return known | {"jacobian": jacobian(fsi)}


def main(
    presets: str = "plain,jump",
    resolutions: str = "12,20",
    steps: int = 10,
    before: int = 5,
    out: Path = Path("results/benchmarks"),
) -> dict[str, Any]:
    """Profile steps of the opening heart valve on one rank.

    Args:
        presets: "plain", "jump" or both, separated by commas.
        resolutions: cells across the aorta, separated by commas.
        steps: steps that are profiled, after as many that are not.
        before: steps that are taken before both.
        out: folder of the results.

    Returns:
        The summary, with the CPU seconds of a step of every part and microseconds a tetrahedron of the Jacobian's.
    """
    logging.getLogger("coudalfish").setLevel(logging.ERROR)
    for name, value in (("steps", steps), ("before", before)):
        checks.whole(name, value, 1)
    runs = []
    for preset in presets.split(","):
        checks.choice("presets", preset, tuple(PARTS))
        some = [measure(preset, int(n), steps, before) for n in resolutions.split(",")]
        runs += some
        whole = [sum(one["seconds"].values()) for one in some]
        print(f"\n{preset}: " + ", ".join(f"{one['cells']} cells {1e3 * one['cpu_s_per_step']:.0f} ms" for one in some))
        rows = [(p, *(100 * o["seconds"][p] / w for o, w in zip(some, whole, strict=True))) for p in some[0]["seconds"]]
        print(table(("% of a step", *(one["cells"] for one in some)), rows))
        rows = [(part, *(one["jacobian"][part] for one in some)) for part in some[0]["jacobian"]]
        print(table(("Jacobian, us/cell", *(one["cells"] for one in some)), rows))
    inputs = {"presets": presets, "resolutions": resolutions, "steps": steps, "before": before}
    return write_summary(out / "valve_breakdown", "valve_breakdown", inputs, runs=runs)


if __name__ == "__main__":
    script.command_line(main)
