"""Test problems of shells: data, exact or published solutions, and the shells themselves."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
