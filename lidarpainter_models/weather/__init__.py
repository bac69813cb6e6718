"""What weather and night physically are, for pictures and for Gaussians alike: laws and names."""
