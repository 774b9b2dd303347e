"""Stiff and extreme cases of the coupled library: what ran, what was refused, what was observed.

Every case is a function of one value of its range and gives an :class:`Outcome`; `tests/test_extremes.py` asserts on
the same outcomes that this script tabulates. The scenes are plane and small:

- a duct with slip walls and a sheet across it, loaded by a jump of traction between inflow and outflow;
- a closed box with a membrane clamped at two opposite walls, or with a free sheet in a uniform flow;
- the manufactured problem of `demos/manufactured.py`.
"""

import csv
from pathlib import Path

import stability_data
import stability_loads
from stability_runs import (
    CASES,
    HEADER,
    outcome,
)

from tigar_x.run import script

MODULES = stability_data, stability_loads
"""Those that enter the cases, in this order."""


def main(out: Path = Path("results/stability"), slow: bool = False, only: str = "") -> None:
    """Run the cases, print their table as Markdown and write it, and a CSV.

    Args:
        out: folder of the results.
        slow: whether to run the slow values as well.
        only: run the cases whose name contains this.
    """
    out.mkdir(parents=True, exist_ok=True)
    chosen = {name: entry for name, entry in CASES.items() if only in name}
    lines = [f"| {' | '.join(HEADER)} |", f"|{' --- |' * len(HEADER)}"]
    print("\n".join(lines))
    rows = []
    for name, entry in chosen.items():
        for value in entry.values + (entry.slow if slow else ()):
            rows.append(outcome(name, value))
            lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in rows[-1].cells())} |")
            print(lines[-1], flush=True)
    bounds = [
        "| case | must hold |",
        "| --- | --- |",
        *(f"| {name} | {entry.bound} |" for name, entry in chosen.items()),
    ]
    (out / "stability.md").write_text("\n".join([*lines, "", *bounds, ""]))
    with open(out / "stability.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("case", "value", "result", "passes_mean", "passes_max", "observed", "message"))
        for row in rows:
            observed = "; ".join(f"{name} = {value:.6g}" for name, value in row.observed.items())
            writer.writerow((row.case, row.value, row.result, row.passes_mean, row.passes_max, observed, row.message))
    print(f"\nwritten: {out / 'stability.md'}, {out / 'stability.csv'}")


if __name__ == "__main__":
    script.command_line(main)
