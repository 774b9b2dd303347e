"""What a run amounts to: quantities of interest, ``summary.json``, tables, versions."""

import json
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
import scipy
import ufl
from mpi4py import MPI
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.ranks import on_root, together
from tigar_x.run.progress import peak_rss_mib
from tigar_x.run.writing import replace_text


@dataclass(frozen=True)
class Quantity:
    """A quantity of interest.

    Attributes:
        value: computed.
        published: value in the literature; None: none.
        doi: where it was published; None: nowhere.
    """

    value: float
    published: float | None = None
    doi: str | None = None


def against(found: Mapping[str, float], published: Mapping[str, float], doi: str | None = None) -> dict[str, Quantity]:
    """Quantities beside what is published of them.

    Args:
        found: computed values by name.
        published: values in the literature by name; there may be fewer.
        doi: where they were published.
    """
    known = {name: (published[name], doi) if name in published else (None, None) for name in found}
    return {name: Quantity(float(value), *known[name]) for name, value in found.items()}


def deviations(found: Mapping[str, Quantity]) -> dict[str, float]:
    """How far quantities are from what is published of them, by name; those of which nothing is are left out."""
    return {name: abs(q.value - q.published) for name, q in found.items() if q.published is not None}


def versions() -> dict[str, str]:
    """Versions of the libraries underneath, for reports."""
    return {
        "dolfinx": dolfinx.__version__,
        "ufl": ufl.__version__,
        "petsc": ".".join(str(part) for part in PETSc.Sys.getVersion()),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }


def plain(value: Any) -> Any:
    """What JSON can hold, in place of dataclasses and NumPy's arrays; paths, solvers and functions are text.

    Args:
        value: anything, also in containers; None in a dataclass is left out. What is nothing of that stays as it is,
            and JSON refuses it.
    """
    if is_dataclass(value) and not isinstance(value, type):
        items = ((item.name, getattr(value, item.name)) for item in fields(value))  # a solver cannot be copied
        return plain({k: v for k, v in items if v is not None})
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return str(value) if isinstance(value, Path | PETSc.KSP) or callable(value) else value


def write_summary(out: Path, demo: str, inputs: dict[str, Any], **results: Any) -> dict[str, Any]:
    """Write ``summary.json`` of a demo; costs of the process and versions are added (collective; rank 0 writes).

    Args:
        out: folder of the results; made if missing.
        demo: name of the demo.
        inputs: its parameters.
        results: errors, quantities and costs; those that are None are left out.

    Returns:
        The summary.

    Raises:
        ValueError: on all ranks: a result is not finite.
        OSError: on all ranks: the file cannot be written.
    """
    known = {key: value for key, value in results.items() if value is not None}
    summary = plain(
        {
            "demo": demo,
            "inputs": inputs,
            **known,
            "compile_s": compat.compile_seconds(),
            "peak_rss_mib": MPI.COMM_WORLD.allreduce(peak_rss_mib(), op=MPI.MAX),
            "versions": versions(),
        }
    )
    text = together(MPI.COMM_WORLD, lambda: json.dumps(summary, indent=2, allow_nan=False) + "\n")
    on_root(MPI.COMM_WORLD, lambda: replace_text(out / "summary.json", text))
    return dict(summary)


def table(header: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Plain text table.

    Args:
        header: column names.
        rows: rows of the same length; floats are shown with four digits.

    Returns:
        Lines with aligned columns.
    """
    cells = [[f"{c:.4g}" if isinstance(c, float) else str(c) for c in row] for row in [list(header), *map(list, rows)]]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join("  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in cells)


def quantity_table(summary: Mapping[str, Any], doi: str = "") -> str:
    """Plain text table of the quantities of a summary, beside what is published and what is exact.

    Args:
        summary: of :func:`write_summary`.
        doi: of the published values.
    """
    found = summary.get("qoi", {}).items()
    known = {"published": f"published (doi:{doi})" if doi else "published", "exact": "exact"}
    beside = {key: head for key, head in known.items() if any(key in quantity for _, quantity in found)}
    rows = [(name, quantity["value"], *(quantity.get(key, "-") for key in beside)) for name, quantity in found]
    return table(("quantity", "value", *beside.values()), rows)
