"""A script with a folder of results: options that all such scripts have, and what it leaves there.

```python
@with_results
def main(results: Results, degree: int = 3) -> dict[str, Any]:
    results.claim()                                    # once the input is known to be right
    ...
    results.say("degree", degree)
    return results.summary(errors={"L2_u": error})     # summary.json, with the options


if __name__ == "__main__":
    script.command_line(main)                          # --degree, --out, --overwrite, --viz
```
"""

import functools
import inspect
import sys
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from mpi4py import MPI

from tigar_x import checks
from tigar_x.run.convergence import Solved, Study, doubled, refine
from tigar_x.run.summary import quantity_table, write_summary
from tigar_x.run.writing import claim

if TYPE_CHECKING:
    from tigar_x.run.running import Run

S = TypeVar("S", bound=Solved)

OPTIONS: dict[str, tuple[type, Any, str]] = {
    "elements": (int, 4, "per direction on the coarsest mesh; doubled from level to level."),
    "levels": (int, 4, "number of meshes, 2 or more."),
    "out": (Path, None, "folder of the results."),
    "overwrite": (bool, False, "whether to delete the results of an earlier run in this folder."),
    "viz": (bool, True, "whether to write ParaView files and pictures."),
    "checkpoint_every": (int, 0, "steps between checkpoints; 0: none, but where the run is told to end."),
    "restart": (str, "", 'checkpoint to go on from: "latest", the number of its step, or its file.'),
}
"""Type, default and help of the options that scripts share."""
LENGTHS = ("until", "steps", "frames")
"""Options in which a run may differ from the one that it goes on from."""
LEVELS, ALWAYS, RESTARTS = ("elements", "levels"), ("out", "overwrite", "viz"), ("checkpoint_every", "restart")


@dataclass(frozen=True)
class Results:
    """Where a script leaves what, and how.

    Attributes:
        name: of the script.
        inputs: its options, but for the following ones.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run.
        viz: whether to write ParaView files and pictures.
        checkpoint_every: steps between checkpoints; 0: none.
        restart: checkpoint from which the run goes on; empty: it is new.
    """

    name: str
    inputs: dict[str, Any]
    out: Path
    overwrite: bool = False
    viz: bool = True
    checkpoint_every: int = 0
    restart: str = ""

    def claim(self) -> None:
        """Refuse a folder with the results of an earlier run, or delete them, see :func:`tigar_x.run.writing.claim`."""
        claim(self.out, overwrite=self.overwrite, restart=self.restart)

    def say(self, *parts: Any) -> None:
        """Write a line to standard output, on rank 0."""
        if MPI.COMM_WORLD.rank == 0:
            sys.stdout.write(" ".join(map(str, parts)) + "\n")

    def summary(self, inputs: Mapping[str, Any] | None = None, **results: Any) -> dict[str, Any]:
        """Write ``summary.json``, see :func:`tigar_x.run.summary.write_summary`.

        Args:
            inputs: more inputs, or others in place of the options of these names.
            results: errors, quantities and costs.

        Returns:
            The summary.
        """
        return write_summary(self.out, self.name, {**self.inputs, **(inputs or {})}, **results)

    # -- runs through time --------------------------------------------------------------------------------------------

    def run(self, stepped: Any, *, series: Sequence[Any] = (), **options: Any) -> "Run":
        """A run with this folder, see :class:`tigar_x.run.running.Run`; without ``viz`` it writes no series.

        Args:
            stepped: what has a method ``run``, such as a flow or a coupled problem.
            series: of the run.
            options: of the run.
        """
        lasting = {key: value for key, value in self.inputs.items() if key not in LENGTHS}
        own = {"out": self.out, "overwrite": self.overwrite, "restart": self.restart, "inputs": lasting}
        own["checkpoint_every"] = self.checkpoint_every
        return stepped.run(series=series if self.viz else (), **(own | options))

    def of_run(self, run: "Run", *, doi: str = "", **results: Any) -> dict[str, Any]:
        """Write the summary of a run, and print what it has found.

        Args:
            run: from :meth:`run`.
            doi: of published values.
            results: see :meth:`tigar_x.run.running.Run.summary`; ``inputs`` are added to the options.

        Returns:
            The summary; nothing where the run was told to end.
        """
        if not run.finished:
            return {}
        run.inputs = {**self.inputs, **results.pop("inputs", {})}
        summary = run.summary(self.name, **results)
        self.say(f"{self.name}: {run.tally}")
        self.say(quantity_table(summary, doi))
        return summary

    def of_path(self, path: Any, *, doi: str | None = None, **results: Any) -> dict[str, Any]:
        """Write the summary of a load path, and print what it has found.

        Args:
            path: see :class:`tigar_x.run.loading.LoadPath`.
            doi: of published values.
            results: of the summary.

        Returns:
            The summary.
        """
        summary = self.summary(**{**path.results(), **results})
        self.say(f"{self.name}: {summary['steps']} load steps, {path.iterations} iterations, {path.cpu_s:.3g} CPU s")
        self.say(quantity_table(summary, doi or ""))
        return summary

    # -- studies of convergence ---------------------------------------------------------------------------------------

    def refine(
        self,
        solve: Callable[[Any], Any],
        errors: Callable[[S], Mapping[str, float]],
        expected: Mapping[str, float],
        prepare: Callable[[int], Any] | None = None,
    ) -> tuple[Study, S]:
        """Claim the folder, and solve on the meshes that the options ``elements`` and ``levels`` tell.

        Args:
            solve: see :func:`tigar_x.run.convergence.refine`.
            errors: see there.
            expected: see there.
            prepare: see there.

        Returns:
            The study, and the solution on the finest mesh.
        """
        sizes = doubled(self.inputs["elements"], self.inputs["levels"])
        self.claim()
        return refine(solve, errors, sizes, expected, prepare)

    def convergence(self, study: Study, head: str, **results: Any) -> dict[str, Any]:
        """Print a study of convergence, and write it as the summary.

        Args:
            study: errors from level to level.
            head: line above its table.
            results: more of the summary's entries.

        Returns:
            The summary.
        """
        self.say(f"{head}\n{study.table()}")
        return self.summary(**study.results(), **results)


def with_results(main: Callable[..., Any] | None = None, **shared: Any) -> Callable[..., Any]:
    """Give a script's function the options of :class:`Results`, and such an object as its first argument.

    The script is called by the name of its file, and its folder is ``results/NAME`` unless another is given. An option
    that is annotated as a ``Literal`` has to be one of its values. In place of an argument whose annotation is a
    dataclass the function has the dataclass's fields as options, and the inputs are what it makes of them.

    Args:
        main: the script's function: ``results`` first, then its options, each with a default.
        shared: defaults of more options: ``elements`` and ``levels`` of a study of convergence, ``checkpoint_every``
            (and with it ``restart``) of a long run.

    Returns:
        The function of all options by name, for :func:`tigar_x.run.script.command_line`.
    """
    if main is None:
        return functools.partial(with_results, **shared)
    name, doc = Path(inspect.getfile(main)).stem, inspect.cleandoc(main.__doc__ or "")
    hints = typing.get_type_hints(main)
    arguments = list(inspect.signature(main).parameters.values())[1:]
    kinds = {argument.name: hints[argument.name] for argument in arguments if is_dataclass(hints[argument.name])}
    options: dict[str, tuple[Any, Any]] = {}
    for argument in arguments:
        if argument.name in kinds:
            kind, types = kinds[argument.name], typing.get_type_hints(kinds[argument.name])
            options |= {item.name: (types[item.name], item.default) for item in fields(kind) if item.init}
            doc = _with_lines(doc, _section(kind.__doc__, "Attributes"))
        else:
            options[argument.name] = hints[argument.name], argument.default
    groups = (group for group in (LEVELS, ALWAYS, RESTARTS) if group is ALWAYS or set(group) & set(shared))
    added = [key for group in groups for key in group]
    defaults = {"out": Path("results") / name} | shared
    options |= {key: (OPTIONS[key][0], defaults.get(key, OPTIONS[key][1])) for key in added}
    keyword = inspect.Parameter.KEYWORD_ONLY
    signature = inspect.Signature(
        [inspect.Parameter(k, keyword, annotation=hint, default=default) for k, (hint, default) in options.items()]
    )

    @functools.wraps(main)
    def run(**chosen: Any) -> Any:
        bound = signature.bind(**chosen)
        bound.apply_defaults()
        given = dict(bound.arguments)
        ours = {key: given.pop(key) for key in added if key not in LEVELS}
        for key, value in given.items():
            _check_choice(key, value, options[key][0])
        made = {k: kind(**{f.name: given[f.name] for f in fields(kind) if f.init}) for k, kind in kinds.items()}
        given |= {f.name: getattr(made[k], f.name) for k, kind in kinds.items() for f in fields(kind) if f.init}
        own = {argument.name: made.get(argument.name, given.get(argument.name)) for argument in arguments}
        return main(Results(name, given, **(ours | {"out": Path(ours["out"])})), **own)

    run.__doc__ = _with_lines(doc, [f"    {key}: {OPTIONS[key][2]}" for key in added])
    run.__annotations__ = {key: hint for key, (hint, _) in options.items()} | {"return": hints.get("return", Any)}
    run.__signature__ = signature  # type: ignore[attr-defined]
    return run


def _check_choice(name: str, value: Any, hint: Any) -> None:
    """Refuse what is not one of the values of a ``Literal``, or None where that may be."""
    parts = (hint,) if typing.get_origin(hint) is typing.Literal else typing.get_args(hint)
    literals = [typing.get_args(part) for part in parts if typing.get_origin(part) is typing.Literal]
    if literals and not (value is None and type(None) in parts):
        checks.choice(name, value, sum(literals, ()))


def _section(doc: str | None, name: str) -> list[str]:
    """Lines of a section of a docstring."""
    _, _, section = inspect.cleandoc(doc or "").partition(f"\n\n{name}:\n")
    return section.partition("\n\n")[0].splitlines()


def _with_lines(doc: str, lines: list[str]) -> str:
    """A docstring whose section of arguments has more lines at its end."""
    head, args, tail = doc.partition("\n\nArgs:\n")
    own, gap, rest = tail.partition("\n\n")
    return head + "\n\nArgs:\n" + "\n".join([own] * bool(args) + lines) + gap + rest
