"""Stages that change a finished run."""
