"""What leaves the system: reports and picture files."""
