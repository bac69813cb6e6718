"""Where the command begins, as `lidarpainter` and as `python -m flows.cli`.

Signals are answered before anything else is imported. Names of files are UTF-8 whatever the locale
is, and what a stream cannot show is written as an escape.
"""

import io
import os
import sys
from contextlib import suppress

from flows import interruption


def run() -> None:
    """Run the command that was typed, and end with its exit code."""
    code = 0
    _read_names_as_utf8()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    with suppress(interruption.Interrupted):
        interruption.watch()
        from flows.cli.main import main

        code = main(sys.argv[1:])
    interruption.leave(code)


def _read_names_as_utf8() -> None:
    """Begin anew in Python's UTF-8 mode where a locale such as C would read names as ASCII."""
    is_asked = os.environ.get("PYTHONUTF8") == "1"  # in vain under `python -I`: not a second time
    if sys.getfilesystemencoding() != "utf-8" and not is_asked:
        os.environ["PYTHONUTF8"] = "1"
        os.execv(sys.executable, sys.orig_argv)  # noqa: S606 - this very command


if __name__ == "__main__":
    run()
