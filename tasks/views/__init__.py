"""Stages that show a finished run: renders along trajectories, styles."""
