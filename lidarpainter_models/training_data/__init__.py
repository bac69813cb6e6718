"""Pairs that painters learn from: harvested, made from streets, corrupted, stored."""
