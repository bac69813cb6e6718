"""What a LiDAR would measure in a fitted scene, learnt beside it; images know nothing of it."""
