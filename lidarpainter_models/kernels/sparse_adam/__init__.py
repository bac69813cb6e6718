"""Adam for the Gaussians that a step has seen (Kingma and Ba 2015)."""
