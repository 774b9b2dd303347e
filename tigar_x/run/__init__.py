"""Runs: command lines, progress, costs and summaries, output, checkpoints, studies of convergence."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
