"""The table that says what each setting does in each scene in space, from files of results.

Results of the scenes are those of ``surface_space.py`` (a line for each number), those of the heart valve are those of
``valve_closing.py``. The table is printed, or goes into a document between two marks.
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from tigar_x.run import script

HERE = Path(__file__).resolve().parent
SETTINGS = ("plain", "converged", "jump", "sharp")
START, END = "<!-- made by benchmarks/space_table.py -->", "<!-- end -->"
Results = dict[tuple[str, str, str], dict[str, str]]
"""Numbers by name, by study, case and setting."""


def short(value: float) -> str:
    """Two digits of a number that is not negative, or all before the point."""
    return f"{value:.0f}" if 10.0 <= value < 1e4 else f"{value:.2g}"


@dataclass(frozen=True)
class Figure:
    """A number of a scene in the table.

    Attributes:
        name: in the results.
        scale: what it is multiplied by.
        known: number of which it should be; its difference relative to that is shown, in percent. None: it is shown.
    """

    name: str
    scale: float = 1.0
    known: float | None = None

    def __call__(self, found: dict[str, str]) -> str:
        """As a cell has it."""
        if self.name not in found:
            return "-"
        value = float(found[self.name]) * self.scale
        return short(abs(value)) if self.known is None else f"{100.0 * (value / self.known - 1.0):+.2g}"


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        scene: in words.
        judged: by what, in words.
        study: of ``surface_space.py``.
        cases: of the study, one after another in the cells.
        figures: of each case.
    """

    scene: str
    judged: str
    study: str
    cases: tuple[str, ...]
    figures: tuple[Figure, ...]

    def cell(self, results: Results, setting: str) -> str:
        """Figures of the cases; CPU time of a step over that of plain fields, and memory in MiB."""
        found = [results.get((self.study, case, setting), {}) for case in self.cases]
        if not any(found):
            return "-"
        if any("failed" in each for each in found):
            return "fails"
        time, memory = self.costs(results, setting)
        return f"{'; '.join(' '.join(f(each) for each in found) for f in self.figures)} ({time:.1f}, {memory:.0f})"

    def costs(self, results: Results, setting: str) -> tuple[float, float]:
        """CPU time of a step over that of plain fields, and memory in MiB; nan where there is none."""
        both = [
            (results.get((self.study, case, setting)), results.get((self.study, case, "plain"))) for case in self.cases
        ]
        known = [(one, plain) for one, plain in both if one and plain and STEP in one and STEP in plain]
        if not known:
            return math.nan, math.nan
        seconds, of_plain = (sum(float(each[k][STEP]) for each in known) for k in (0, 1))
        return seconds / of_plain, max(float(one["MiB"]) for one, _ in known)


STEP = "CPU ms/step"
SPEED = 1e5
"""Jump of the pressure of a heart valve in cm, g, s: velocities of that scene are given over it."""
DRAG = 3.664
"""Of the rigid sphere, by ``space_fitted.fitted_drag``."""
FIVE = ("gap 0.25 h", "gap 0.5 h", "gap 1 h", "gap 2 h", "gap 4 h")
THROUGH, TIP, OFF = (Figure("flow"),), (Figure("tip"),), (Figure("drag", known=DRAG),)
NORMS = tuple(map(Figure, ("L2_u", "H1_u", "L2_p", "L2_y")))
STILL = Figure("velocity")
ROWS = (
    Row("membrane, one layer, 24 cells", "L2 u; H1 u; L2 p; L2 y", "membrane, one layer", ("level 3",), NORMS),
    Row("curved membrane, 12 cells", "L2 u; H1 u; L2 p; L2 y", "membrane, curved", ("level 2",), NORMS),
    Row("the same, 24 cells", "the same", "membrane, curved", ("level 3",), NORMS),
    Row("duct with a held dome, 8 16 cells", "velocity; L2 p", "dome", ("n 8", "n 16"), (STILL, Figure("pressure"))),
    Row(
        "the same, walls without slip",
        "velocity; L2 p",
        "dome, weak walls",
        ("n 8", "n 16"),
        (STILL, Figure("pressure")),
    ),
    Row(
        "held dome, 8 cells, numbers of a valve",
        "cm/s at the end; highest",
        "valve numbers",
        ("n 8",),
        (Figure("velocity", SPEED), Figure("highest", SPEED)),
    ),
    Row(
        "closed elastic sphere, radius 2.4 h",
        "pressure inside; volume",
        "sphere",
        ("n 8",),
        (Figure("inside"), Figure("volume")),
    ),
    Row("elastic plate with free edges, 8 12 16 cells", "tip", "fence", ("n 8", "n 12", "n 16"), TIP),
    Row("slit of one layer, Re .5, gap .25 .5 1 2 4", "flow", "slit, one layer", FIVE, THROUGH),
    Row("the same, Re 10, gap 1 2 4", "flow", "slit, one layer, Re 10", FIVE[2:], THROUGH),
    Row("slit of four layers, Re .5, gap .25 .5 1 2 4", "flow", "slit, four layers", FIVE, THROUGH),
    Row("round hole, Re .5, diameter .25 .5 1 2 4", "flow", "hole", FIVE, THROUGH),
    Row("rigid sphere in a stream, 8 12 16 cells a diameter", "drag, %", "obstacle", ("n 8", "n 12", "n 16"), OFF),
    Row("the same, a tenth of the time step", "drag, %", "obstacle", ("n 8, dt / 10", "n 12, dt / 10"), OFF),
    Row("two held plates, .2 .5 apart, numbers of a valve", "cm/s", "pair", ("0.2 h, held", "0.5 h, held"), (STILL,)),
)


def read(path: Path) -> Results:
    """The numbers of a file of results."""
    results: Results = {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            results.setdefault((row["study"], row["case"], row["setting"]), {})[row["name"]] = row["value"]
    return results


def valve_row(path: Path, cells: int, dt: float) -> list[str]:
    """Row of the heart valve, of its runs with a mesh and a time step; CPU seconds are those of the steps compared."""
    found: dict[str, dict[str, str]] = {}
    if path.exists():
        with open(path, newline="") as file:
            rows = [row for row in csv.DictReader(file) if float(row["reversal"]) > 0.0]
        found = {row["preset"]: row for row in rows if int(row["cells"]) == cells and float(row["dt"]) == dt}

    def cell(setting: str) -> str:
        row, plain = found.get(setting, {}), found.get("plain", {})
        if not row.get("error_flow"):
            return "-"
        ratio = f"{float(row['cpu_s']) / float(plain['cpu_s']):.1f}" if plain.get("cpu_s") else "-"
        area = short(abs(float(row["last_opening"])))
        return f"{short(float(row['error_flow']))}; {area} ({ratio}, -)"

    judged = "flow, rms error [cm^3/s]; area that stays open [cm^2]"
    return [f"heart valve, {cells:,} cells, dt {dt:g}", judged, *map(cell, SETTINGS)]


def table(results: Results, valve: list[str]) -> str:
    """As Markdown."""
    rows: list[list[Any]] = [["scene", "judged by", *SETTINGS], ["---"] * (2 + len(SETTINGS))]
    rows += [[row.scene, row.judged, *(row.cell(results, setting) for setting in SETTINGS)] for row in ROWS]
    text = "\n".join(f"| {' | '.join(row)} |" for row in [*rows, valve])
    return f"{text}\n\n{_costs(results)}"


def _costs(results: Results) -> str:
    """What the settings cost, over all rows."""
    parts = []
    for setting in SETTINGS[1:]:
        both = [(row.costs(results, setting), row.costs(results, "plain")) for row in ROWS]
        time = [one[0] for one, _ in both if not math.isnan(one[0])]
        memory = [one[1] / plain[1] for one, plain in both if not math.isnan(one[1])]
        if time:
            ranges = [f"{median(some):.1f} ({min(some):.1f} to {max(some):.1f})" for some in (time, memory)]
            parts.append(f"{setting} {ranges[0]} and {ranges[1]}")
    return (
        f"CPU time of a step and memory over those of plain fields, median and range of the rows: {'; '.join(parts)}."
    )


def main(
    results: Path = HERE / "surface_space.csv",
    valve: Path = HERE / "valve_closing.csv",
    cells: int = 8409,
    dt: float = 1e-4,
    into: Path | None = None,
) -> None:
    """Print the table, or write it into a document.

    Args:
        results: file of ``surface_space.py``.
        valve: file of ``valve_closing.py``; there may be none.
        cells: of the valve's runs.
        dt: of the valve's runs.
        into: document with the marks between which the table stands.
    """
    text = table(read(results), valve_row(valve, cells, dt))
    if into is None:
        print(text)
        return
    before, rest = into.read_text().split(START)
    into.write_text(f"{before}{START}\n\n{text}\n\n{END}{rest.split(END, 1)[1]}")


if __name__ == "__main__":
    script.command_line(main)
