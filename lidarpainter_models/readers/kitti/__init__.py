"""KITTI: raw drives, and the sequences of its tracking benchmark."""
