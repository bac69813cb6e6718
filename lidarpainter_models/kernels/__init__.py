"""Compute kernels; in each, `reference` is the law and the other backends are the speed."""
