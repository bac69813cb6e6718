"""A viser server that listens on this machine alone, prints nothing and is shared with nobody."""

import contextlib
import io
from collections.abc import Iterator
from contextlib import contextmanager

import viser

from lidarpainter_models.errors import ConfigError

HOST = "127.0.0.1"
FIRST_PORT = 8080
"""Where a free port is looked for if none is asked for."""


class LocalServer(viser.ViserServer):
    """Viser's server without its public tunnel, which any client could ask for."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Stay on this machine."""


@contextmanager
def local_server(*, label: str = "", port: int | None = None) -> Iterator[LocalServer]:
    """A server for as long as the block runs.

    Port 0 takes any, None the first free one from `FIRST_PORT` on.

    Raises:
        ConfigError: the port is in use or not allowed.
    """
    with _silence():
        server = LocalServer(HOST, FIRST_PORT if port is None else port, label, verbose=False)
    try:
        if port and server.get_port() != port:
            raise ConfigError(f"port {port} of {HOST} cannot be had: it is in use or not allowed")
        yield server
    finally:
        with _silence():  # it says goodbye on stdout, where a command's JSON stands
            server.stop()


@contextmanager
def _silence() -> Iterator[None]:
    with contextlib.redirect_stdout(io.StringIO()):
        yield
