"""Triton kernels of the Gaussian rasteriser; `gaussian_raster/triton.py` launches them.

They are written for NVIDIA GPUs from sm_80 on. With `TRITON_INTERPRET=1` in the environment when
they are first imported, they run on tensors of the CPU instead, slowly.
"""
