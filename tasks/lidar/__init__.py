"""What a LiDAR would measure in a finished run: learn it, judge it."""
