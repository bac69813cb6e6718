"""What LiDAR sweeps tell: a coloured map, who is seen, sky masks, images and sparse depth."""
