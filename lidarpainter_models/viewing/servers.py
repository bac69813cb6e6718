"""A viser server that listens on this machine alone, prints nothing and is shared with nobody.

Any page that a browser has open may connect to this machine, so what other pages than the server's
own ask is refused.
"""

import io
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from http import HTTPStatus
from typing import Any

import viser
from websockets import Headers, Request, Response
from websockets.asyncio import server as websockets

from lidarpainter_models.errors import ConfigError

HOST = "127.0.0.1"
THIS_MACHINE = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]+)?")
"""What a browser on this machine calls a server on it."""
FIRST_PORT = 8080
"""Where a free port is looked for if none is asked for."""

Answer = Callable[[websockets.ServerConnection, Request], Response | None]


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
    with redirect_stdout(io.StringIO()), _own_pages_only() as served:
        server = LocalServer(HOST, asked_port, label, verbose=False)
    try:
        if not served.is_set():
            raise ConfigError(f"viser {viser.__version__} lets other pages in: expected 1.1.1")
        if port and server.get_port() != port:
            raise ConfigError(f"port {port} of {HOST} cannot be had: it is in use or not allowed")
        yield server
    finally:
        with redirect_stdout(io.StringIO()):  # where a command's JSON stands, it says goodbye
            server.stop()


@contextmanager
def _own_pages_only() -> Iterator[threading.Event]:
    """Let what is served from within the block refuse all pages but its own.

    Viser has no setting for it. The event is set once something is served by `websockets`.
    """
    module: Any = websockets
    serve = module.serve
    served = threading.Event()

    def serve_own(
        *args: Any,  # noqa: ANN401 - as `serve`
        process_request: Answer | None = None,
        **options: Any,  # noqa: ANN401
    ) -> websockets.serve:
        served.set()
        return serve(*args, process_request=partial(_answer, process_request), **options)

    module.serve = serve_own
    try:
        yield served
    finally:
        module.serve = serve


def _answer(
    usual: Answer | None, connection: websockets.ServerConnection, request: Request
) -> Response | None:
    """Refuse a request of another page; else the usual answer, None where it may connect."""
    if not _is_own_page(request.headers):
        return connection.respond(HTTPStatus.FORBIDDEN, "only the viewer's own page may ask\n")
    return usual(connection, request) if usual else None


def _is_own_page(headers: Headers) -> bool:
    """Whether a request comes from a page of the address that it asks, or from a program.

    Programs say no origin. The address is this machine's by name: another name may be made to lead
    here. Its port is any, since a port may be forwarded under another number.
    """
    origins, hosts = headers.get_all("Origin"), headers.get_all("Host")
    is_here = all(THIS_MACHINE.fullmatch(host) for host in hosts)
    return is_here and origins in ([], [f"http://{host}" for host in hosts])
