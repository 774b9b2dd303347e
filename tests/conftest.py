"""What has to come before every test module, and what every test leaves as it was."""

import logging

import mpi4py.MPI  # noqa: F401  (dolfinx's wheel finds its MPI library only after this)
import pytest


def _levels():
    """Levels of all loggers by name; None: the root."""
    loggers = logging.root.manager.loggerDict.items()
    return {None: logging.root.level} | {name: log.level for name, log in loggers if isinstance(log, logging.Logger)}


@pytest.fixture(autouse=True)
def logging_as_it_was():
    """Levels and handlers that a test or a script run by it sets are gone after it, so that the order is no matter."""
    levels, handlers = _levels(), logging.root.handlers[:]
    yield
    for name in _levels():
        logging.getLogger(name).setLevel(levels.get(name, logging.NOTSET))
    logging.root.handlers[:] = [handler for handler in logging.root.handlers if handler in handlers]


@pytest.fixture
def warned(caplog):
    """The warnings of the coupling so far; on other ranks than the first there are none."""
    caplog.set_level(logging.WARNING, logger="coudalfish")
    return lambda: [record.getMessage() for record in caplog.records if record.name.startswith("coudalfish")]
