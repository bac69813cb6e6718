"""Recordings in MCAP files: ROS 2 bags and Foxglove's own messages."""
