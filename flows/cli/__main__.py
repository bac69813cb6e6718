"""Where the command begins, as `lidarpainter` and as `python -m flows.cli`.

Signals are answered before anything else is imported.
"""

import sys

from flows import interruption


def run() -> None:
    """Run the command that was typed, and end with its exit code."""
    interruption.watch()
    from flows.cli.main import main

    interruption.leave(main(sys.argv[1:]))


if __name__ == "__main__":
    run()
