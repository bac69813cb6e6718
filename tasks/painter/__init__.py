"""Stages that harvest pairs, train painters and judge them."""
