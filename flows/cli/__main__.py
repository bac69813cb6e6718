"""`python -m flows.cli` is `lidarpainter`."""

from flows.cli.main import run

run()
