"""Compute kernels; in each, `reference` is the law and the other backends are the speed."""

from lidarpainter_models.kernels.code_cache import keep_code_by_key

keep_code_by_key()
