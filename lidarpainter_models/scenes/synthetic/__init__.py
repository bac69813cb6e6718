"""A seeded procedural street with exact pictures, depth and LiDAR from any pose."""
