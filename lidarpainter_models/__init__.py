"""LidarPainter's library: scenes, kernels, Gaussians and painters; tensors in, tensors out."""

__version__ = "0.2.0"
