"""Stages that judge a fitted scene."""
