"""Many sequences: what a manifest asks for, who works on it, and how it stands."""
