"""Order only: which task follows which."""
