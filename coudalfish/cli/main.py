"""``coudalfish COMMAND``, and ``python -m coudalfish COMMAND``."""

import argparse
import sys
from collections.abc import Sequence

from coudalfish.cli.tell import say

HELP = """\
Thin structures immersed in flow: heart valves, flaps, sails, membranes.
You write your problem as a Python script. These commands show whether the installation works, and run examples."""

EXAMPLES = """\
first steps:
  coudalfish check                      does everything work here? (a minute)
  coudalfish list                       which examples are there?
  coudalfish run lid_driven_cavity      run one; the results go to results/lid_driven_cavity
  coudalfish run cylinder --help        its options
  mpirun -n 4 coudalfish run cylinder   the same on four processes
  coudalfish run cylinder -fluid_ksp_rtol 1e-10
                                        options with one dash are PETSc's

"python -m coudalfish" is the same as "coudalfish". The examples are Python scripts to copy from: "list" says where."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: command line; None: that of the process.

    Returns:
        Exit status: 0 when all is well, 1 when the check found something wrong, 2 for a command that is not there.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == ["run"] and len(given) > 1 and not given[1].startswith("-"):  # what follows is the example's
        from coudalfish.cli.demos import run_demo

        return run_demo(given[1], given[2:])
    parser = _parser()
    command = parser.parse_args(given).command
    if command is None:
        say(parser.format_help().rstrip())
        return 0
    if command == "list":
        from coudalfish.cli.demos import listing

        say(listing())
        return 0
    if command == "info":
        from coudalfish.cli.about import about

        say(about())
        return 0
    from coudalfish.cli.check import check

    return check()


def _parser() -> argparse.ArgumentParser:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("coudalfish", description=HELP, epilog=EXAMPLES, formatter_class=form)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    commands.add_parser("list", help="show the examples, one a line")
    run = commands.add_parser("run", help="run an example: run NAME [its options]; run NAME --help shows them")
    run.add_argument("name", metavar="NAME", help='one of those that "coudalfish list" shows')
    commands.add_parser("info", help="show versions, solvers, caches, compiler, memory")
    commands.add_parser("check", help="test the installation and say in words what is wrong, if anything is")
    return parser
