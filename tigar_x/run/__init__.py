"""Runs: loops over steps, histories, checkpoints, output, pictures, command lines, summaries and studies."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
