"""NVIDIA NCore V4: component stores as folders or indexed tar archives."""
