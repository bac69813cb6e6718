"""Stages that write a finished run as files of other programs."""
