"""Painters repair a rendered view with what was recorded around it: `selection.py` loads one."""
