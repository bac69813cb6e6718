"""Where scenes, Gaussians and painters meet."""
