"""Rays through the street: cameras, LiDARs and light, compiled with numba."""
