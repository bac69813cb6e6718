"""Dynamic 3D Gaussian scenes and how they are fitted."""
