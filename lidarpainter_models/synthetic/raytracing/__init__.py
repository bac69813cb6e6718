"""Rays through the street: cameras, LiDARs and light, compiled with numba."""

from lidarpainter_models.kernels.code_cache import keep_code_by_key

keep_code_by_key()
