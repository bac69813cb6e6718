"""What leaves the system: reports and image files."""
