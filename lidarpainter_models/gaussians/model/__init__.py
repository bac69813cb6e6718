"""What a fitted scene is: Gaussians, moving actors, sky, corrections of what was recorded."""
