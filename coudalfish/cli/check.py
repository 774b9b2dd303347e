"""The self-test: the environment first, then what the library computes, then two ranks."""

import logging
import os
from importlib import import_module

from coudalfish.cli import environment
from coudalfish.cli.tell import say
from coudalfish.cli.verdict import Check, judged

FORMS = ("packages", "PETSc", "compiler", "cache")
"""What everything needs that compiles a form."""


def check() -> int:
    """Test the installation (collective).

    Returns:
        Exit status: 0 when nothing is wrong, else 1.
    """
    from tigar_x.front import __version__

    say(f"coudalfish {__version__} tests itself, in a minute or less:\n")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    level = logging.getLogger().level
    logging.getLogger().setLevel(logging.ERROR)  # what is compiled meanwhile is no news
    try:
        return judged(checks())
    finally:
        logging.getLogger().setLevel(level)


def checks() -> list[Check]:
    """All checks, in their order."""
    return [
        *environment.CHECKS,
        Check("splines", _late("extraction"), FORMS),
        Check("shell", _late("shell"), FORMS),
        Check("flow", _late("flow"), FORMS),
        Check("coupled step", _late("coupled"), (*FORMS, "shell", "flow")),
        Check("two ranks", _late("two_ranks"), (*FORMS, "coupled step")),
    ]


def _late(name: str) -> environment.Work:
    """A check whose module needs packages that may be missing."""
    return lambda: getattr(import_module("coudalfish.cli.problems"), name)()
