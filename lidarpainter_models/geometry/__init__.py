"""Rigid transforms, cameras, boxes and trajectories; nothing here knows of Gaussians or files."""
