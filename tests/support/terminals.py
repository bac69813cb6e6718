"""A command on a terminal of its own, as a user has it: read as it goes, and sent signals."""

import fcntl
import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CONTROL_C = b"\x03"
_COLOURS = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def _in_the_foreground():
    """Be what a terminal interrupts, also where a shell has begun the tests in the background."""
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class TerminalCommand:
    """`lidarpainter`, or other code, with these words, in the foreground of a new terminal."""

    def __init__(self, *words, code=None, **environment):
        self._master, terminal = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, *(["-c", code] if code else ["-m", "flows.cli"]), *map(str, words)],
            stdin=terminal,
            stdout=subprocess.DEVNULL,
            stderr=terminal,
            cwd=ROOT,
            env={**os.environ, "TERM": "xterm", "COLUMNS": "120", **environment},
            start_new_session=True,
            preexec_fn=_in_the_foreground,
        )
        os.close(terminal)
        self._text = ""

    @property
    def shown(self):
        """All that the terminal was sent so far, without colours and cursor moves."""
        return _COLOURS.sub("", self._text)

    def wait_for(self, pattern, timeout_s=300):
        """Read until the pattern is there."""
        deadline = time.monotonic() + timeout_s
        while not re.search(pattern, self.shown):
            assert time.monotonic() < deadline, self.shown
            assert self._read(1.0) or self.process.poll() is None, self.shown

    def interrupt(self, number):
        """Ctrl-C reaches all in the foreground, SIGTERM one process; returns seconds to the end."""
        started = time.monotonic()
        if number == signal.SIGINT:
            os.write(self._master, CONTROL_C)
        else:
            self.process.send_signal(number)
        self.finish(60)
        return time.monotonic() - started

    def finish(self, timeout_s=300):
        """Read to the end; returns the exit code."""
        deadline = time.monotonic() + timeout_s
        while self.process.poll() is None:
            assert time.monotonic() < deadline, self.shown
            self._read(0.02)
        while self._read(0):
            pass
        os.close(self._master)
        return self.process.returncode

    def _read(self, wait_s):
        if not select.select([self._master], [], [], wait_s)[0]:
            return False
        try:
            self._text += os.read(self._master, 65536).decode(errors="replace")
        except OSError:  # Linux says so once nobody has the terminal open
            return False
        return True
