"""How the cost of contact grows with the number of points: two parallel sheets, closer to each other than r_max."""

from pathlib import Path
from typing import Any

import calibrate
import numpy as np

from shnapr.contact import LinearKernel, SelfContact
from tigar_x.compat import FloatArray
from tigar_x.run import script
from tigar_x.run.progress import Stopwatch
from tigar_x.run.summary import table, write_summary
from tigar_x.splines.quadrature import NodalQuadrature

# What must hold, in CPU seconds of forces and tangent with a search, and in the exponent of their growth.
TARGET_POINTS, TARGET_SECONDS, TARGET_EXPONENT = 10_000, 0.1, 1.2
COLUMNS = ("points", "pairs", "pairs per point", "search and all", "forces and tangent", "forces", "first, scaled")


def sheets(points: int, spacing: float, gap: float, shuffled: bool) -> tuple[SelfContact, FloatArray]:
    """Two unit squares far apart, and the positions in which they lie on each other.

    Args:
        points: number of points, about.
        spacing: of the points, over r_max.
        gap: between the sheets, over r_max.
        shuffled: number the points at random.

    Returns:
        The contact, and positions of shape (points, 3).
    """
    side = round(np.sqrt(points / 2))
    h, r_max = 1.0 / side, 1.0 / (side * spacing)
    grid = np.stack(np.meshgrid(*2 * [h * np.arange(side)], [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    reference = np.concatenate([grid, grid + np.array([0.0, 0.0, 10.0 * r_max])])
    current = np.concatenate([grid, grid + np.array([0.3 * h, 0.2 * h, gap * r_max])])
    order = np.random.default_rng(0).permutation(len(grid) * 2) if shuffled else slice(None)
    n = len(reference)
    rule = NodalQuadrature(reference[order], np.full(n, h * h), np.ones(n))
    return SelfContact(rule, LinearKernel(r_max, 1.0), 1.2 * r_max), current[order]


def measure(points: int, spacing: float, gap: float, shuffled: bool, repeats: int) -> dict[str, float]:
    """Smallest CPU seconds of an evaluation: with a search, with the pairs of the last one, and of the forces alone."""
    contact, x = sheets(points, spacing, gap, shuffled)
    cases = {"search": {}, "tangent": {}, "forces": {"tangent": False}}
    seconds = dict.fromkeys(cases, np.inf)
    for repeat in range(repeats):
        moved = x + 2.0 * repeat  # far enough for a search, which the second and third case then share
        for case, options in cases.items():
            watch = Stopwatch()
            with watch:
                found = contact.evaluate(moved, **options)
            seconds[case] = min(seconds[case], watch.cpu_s)
    return {"points": len(x), "pairs": found.pairs, **seconds}


def exponent(rows: list[dict[str, float]], lowest: int = 0) -> float:
    """Fitted exponent of the time with a search over the number of points, from a number upwards."""
    used = [row for row in rows if row["points"] >= lowest]
    return float(np.polyfit(np.log([r["points"] for r in used]), np.log([r["search"] for r in used]), 1)[0])


def main(
    sizes: str = "1000,3000,10000,30000,100000",
    spacing: float = 0.55,
    gap: float = 0.3,
    shuffled: bool = False,
    repeats: int = 9,
    out: Path = Path("results/benchmarks"),
) -> dict[str, Any]:
    """Time forces and tangent of nonlocal contact over the number of points, at a fixed number of contacts per point.

    Args:
        sizes: numbers of points, separated by commas.
        spacing: spacing of the points over r_max.
        gap: distance of the sheets over r_max, below 1.
        shuffled: number the points at random instead of row by row.
        repeats: evaluations of each kind, of which the fastest counts.
        out: folder of the results.

    Returns:
        The summary: times, exponents and the speed of the machine.
    """
    inputs = {"spacing": spacing, "gap": gap, "shuffled": shuffled, "repeats": repeats}
    rows = [measure(int(points), spacing, gap, shuffled, repeats) for points in sizes.split(",")]
    here = calibrate.calibrate()
    speed = calibrate.legacy_speed(here)
    lines = [
        (r["points"], r["pairs"], r["pairs"] / r["points"], r["search"], r["tangent"], r["forces"], speed * r["search"])
        for r in rows
    ]
    largest = max(row["points"] for row in rows)
    growth = {"all": exponent(rows), "last decade": exponent(rows, int(0.08 * largest))}
    text = table(COLUMNS, lines)
    text += f"\nCPU seconds; the machine is {speed:.2f} times as fast as that of legacy.csv: {here}"
    text += "\nexponent of the time with a search: " + ", ".join(f"{k} {v:.3f}" for k, v in growth.items())
    at_target = ", ".join(f"{r['search']:.3f}" for r in rows if 0.9 < r["points"] / TARGET_POINTS < 1.1)
    text += f" (target {TARGET_EXPONENT}); at about {TARGET_POINTS} points {at_target} s (target {TARGET_SECONDS})\n"
    print(text)
    name = "contact-shuffled" if shuffled else "contact"
    summary = write_summary(out / name, name, inputs, cpu_s=rows, exponents=growth, calibration=here)
    (out / name / "table.txt").write_text(text)
    return summary


if __name__ == "__main__":
    script.command_line(main)
