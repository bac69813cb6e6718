"""The `lidarpainter` command, a file per group."""
