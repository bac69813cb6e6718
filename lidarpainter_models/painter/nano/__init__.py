"""The small painter that comes with the package: its network, training and weights."""
