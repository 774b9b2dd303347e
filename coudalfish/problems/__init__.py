"""Problems with known solutions, on which couplings are measured."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
