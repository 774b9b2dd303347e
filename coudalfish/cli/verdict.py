"""Checks and what comes of them: each says what it found, or what is wrong and what to do about it."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from coudalfish.cli.tell import say

Status = Literal["ok", "note", "WRONG", "-"]


class FaultError(Exception):
    """Something is wrong.

    Args:
        what: what is wrong.
        advice: what to do about it.
    """

    def __init__(self, what: str, advice: str) -> None:
        super().__init__(what, advice)
        self.what, self.advice = what, advice


class RemarkError(Exception):
    """Something is not there that not everybody needs.

    Args:
        what: what is missing, and what for.
    """


@dataclass(frozen=True)
class Check:
    """One thing to check.

    Attributes:
        name: what the table calls it.
        work: does it and returns what it found, or raises FaultError or RemarkError. Other exceptions are faults too.
        needs: names of checks without which it cannot be tried.
        advice: what to do where another exception comes.
    """

    name: str
    work: Callable[[], str]
    needs: tuple[str, ...] = ()
    advice: str = "this is not known to happen: the whole text of the error says more"


@dataclass(frozen=True)
class Finding:
    """What came of a check.

    Attributes:
        name: of the check.
        status: "-" where it was not tried.
        text: what was found, or what is wrong.
        advice: what to do about it; empty: nothing.
    """

    name: str
    status: Status
    text: str
    advice: str = ""


def examined(check: Check, before: Sequence[Finding] = ()) -> Finding:
    """Do a check, if what it needs is there (collective).

    On several ranks it is as good as on the worst of them.

    Args:
        check: the check.
        before: what came of those before it.

    Returns:
        What came of it, the same on all ranks.
    """
    lacking = [one.name for one in before if one.name in check.needs and one.status in ("WRONG", "-")]
    if lacking:
        return Finding(check.name, "-", f"not tried, it needs: {', '.join(lacking)}")
    try:
        found = Finding(check.name, "ok", check.work())
    except RemarkError as note:
        found = Finding(check.name, "note", str(note))
    except FaultError as trouble:
        found = Finding(check.name, "WRONG", trouble.what, trouble.advice)
    except Exception as error:
        found = Finding(check.name, "WRONG", f"{type(error).__name__}: {error}", check.advice)
    return _worst(found)


def _worst(found: Finding) -> Finding:
    from mpi4py import MPI

    all_found = MPI.COMM_WORLD.allgather(found)
    order: tuple[Status, ...] = ("WRONG", "-", "note", "ok")
    return min(all_found, key=lambda one: order.index(one.status))


def judged(checks: Sequence[Check]) -> int:
    """Do checks in their order, tell what comes of each, and the verdict (collective).

    Args:
        checks: the checks.

    Returns:
        Exit status: 0 when nothing is wrong, else 1.
    """
    start, outcomes = time.perf_counter(), list[Finding]()
    width = max(len(check.name) for check in checks)
    for check in checks:
        say(f"  {check.name + ' ':.<{width + 3}} ", end="")
        outcome = examined(check, outcomes)
        outcomes.append(outcome)
        indent = "\n" + " " * (width + 13)
        advice = f"\nwhat to do: {outcome.advice}" if outcome.advice else ""
        say(f"{outcome.status:5}  {(outcome.text + advice).replace(chr(10), indent)}")
    wrong = [one.name for one in outcomes if one.status == "WRONG"]
    left = sum(one.status == "-" for one in outcomes)
    seconds = f"{time.perf_counter() - start:.0f} s"
    if not wrong:
        say(f"\nAll is well: {len(outcomes)} checks in {seconds}.")
        return 0
    untried = f", and {left} could not be tried" if left else ""
    say(f"\nSomething is wrong: {', '.join(wrong)} ({len(wrong)} of {len(outcomes)} checks{untried}; {seconds}).")
    return 1
