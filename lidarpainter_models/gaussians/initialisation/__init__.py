"""Where Gaussians start: on LiDAR surfaces, and behind what no LiDAR reached."""
