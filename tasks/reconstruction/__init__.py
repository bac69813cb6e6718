"""Stages of one reconstruction, from a stored scene to its report."""
