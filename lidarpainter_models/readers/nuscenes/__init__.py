"""nuScenes v1.0, from its JSON tables."""
