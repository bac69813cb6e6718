"""Where the command begins, as `lidarpainter` and as `python -m flows.cli`.

Signals are answered before anything else is imported.
"""

import sys
from contextlib import suppress

from flows import interruption


def run() -> None:
    """Run the command that was typed, and end with its exit code."""
    code = 0
    with suppress(interruption.Interrupted):
        interruption.watch()
        from flows.cli.main import main

        code = main(sys.argv[1:])
    interruption.leave(code)


if __name__ == "__main__":
    run()
