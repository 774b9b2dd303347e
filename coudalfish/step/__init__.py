"""One step: options and reports, its attempts, when it is accepted, what is wrong when it is not."""

from tigar_x.front import modules_of
from tigar_x.moved import guide

__all__ = modules_of(__name__)
__getattr__ = guide(__name__)
