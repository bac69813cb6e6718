"""Which Gaussians a view can show, by blocks of them."""
