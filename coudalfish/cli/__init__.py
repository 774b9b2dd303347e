"""The command line: ``coudalfish list``, ``run``, ``info`` and ``check``.

It stands on top of all four packages. What can be missing is imported where it is used, so that it can be said.
"""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
