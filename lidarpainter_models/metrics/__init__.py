"""How good a picture, a depth map or a scene is."""
