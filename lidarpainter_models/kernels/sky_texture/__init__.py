"""Look up and move the texels of the sky."""
