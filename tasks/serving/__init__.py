"""Finished runs as scenes that answer simulators."""
