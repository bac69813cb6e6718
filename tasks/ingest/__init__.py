"""Stages that bring logs into the store and look whether they make sense."""
