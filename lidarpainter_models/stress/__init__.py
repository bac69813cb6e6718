"""Recordings spoilt by one cause at a time, to see where methods fail."""
