"""Test problems of flows: data, published values and the flows themselves."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
