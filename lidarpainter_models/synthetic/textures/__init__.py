"""What surfaces of the street look like."""
