"""Scene folders in the canonical form, written elsewhere."""
