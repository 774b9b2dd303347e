"""The two sides of the coupling, fluid and shell, and what belongs to them."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
