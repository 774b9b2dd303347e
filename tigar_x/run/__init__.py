"""Runs: command lines, progress, costs and summaries, output, checkpoints, studies of convergence."""
