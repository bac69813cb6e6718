"""The protocols by which a fitted scene is judged; each names its truth, none mixes two."""
