"""What a fit or a judge sees of a scene."""
