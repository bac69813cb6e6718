"""PandaSet, from its pickled tables."""
