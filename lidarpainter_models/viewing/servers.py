"""A viser server that listens on this machine alone, prints nothing and is shared with nobody.

Any page that a browser has open may connect to this machine, so connections from other pages than
the server's own are refused.
"""

import contextlib
import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import viser
from websockets.asyncio import server as websockets

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
        ConfigError: the port is in use or not allowed, or viser is of a version that would not
            keep other pages out.
    """
    asked_port = FIRST_PORT if port is None else port
    with _silence(), _known_origins_only() as origins:
        server = LocalServer(HOST, asked_port, label, verbose=False)
    try:
        if not origins:
            raise ConfigError(f"viser {viser.__version__} lets other pages in: expected 1.1.1")
        origins.extend(f"http://{name}:{server.get_port()}" for name in (HOST, "localhost"))
        if port and server.get_port() != port:
            raise ConfigError(f"port {port} of {HOST} cannot be had: it is in use or not allowed")
        yield server
    finally:
        with _silence():  # it says goodbye on stdout, where a command's JSON stands
            server.stop()


@contextmanager
def _known_origins_only() -> Iterator[list[str | None]]:
    """Let what is served from within the block refuse all origins but those of the list.

    Viser has no setting for it. The list stays empty where nothing was served by way of
    `websockets`; then None is in it, for programs, which say no origin.
    """
    module: Any = websockets
    serve = module.serve
    origins: list[str | None] = []

    def serve_known(*args: Any, **options: Any) -> websockets.serve:  # noqa: ANN401 - as `serve`
        origins[:] = [None]
        return serve(*args, **options, origins=origins)

    module.serve = serve_known
    try:
        yield origins
    finally:
        module.serve = serve


@contextmanager
def _silence() -> Iterator[None]:
    with contextlib.redirect_stdout(io.StringIO()):
        yield
