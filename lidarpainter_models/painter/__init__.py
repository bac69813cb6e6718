"""Painters repair a degraded render, guided by LiDAR and warped pictures."""
