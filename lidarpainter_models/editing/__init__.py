"""Edits of a fitted scene that replay: who is where, and what is seen where somebody was."""
