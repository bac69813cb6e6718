"""The unified driving scene: its stored form, readers, the synthetic street, LiDAR maps."""
