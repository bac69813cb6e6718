"""Loss terms of every pixel and their gradients in one pass."""
