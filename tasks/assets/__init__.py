"""Publish what a finished run yields for use elsewhere."""
