"""A flow as one object: mesh, fluid and conditions become residual, boundary values, solver and steps."""

from tigar_x.moved import guide
from varmint.flow.flow import Flow
from varmint.flow.options import FlowError, FlowOptions, FlowReport

__all__ = ["Flow", "FlowError", "FlowOptions", "FlowReport"]
__getattr__ = guide(__name__)
