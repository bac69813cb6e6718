"""How good an image, a depth map or a scene is."""
