"""The HTTP server of NeuroNCAP's routes, in a thread of its own."""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.serving.http_routes import HttpScene, http_app
from lidarpainter_models.serving.render_queue import RenderQueue
from lidarpainter_models.serving.renderer import ServedScene

END_S = 1.0
"""How long the server may take to end."""


class _LazyApp:
    """The routes, whose scene is loaded when they are first asked for."""

    def __init__(self, scene: Callable[[], ServedScene], queue: RenderQueue) -> None:
        self._scene, self._queue = scene, queue
        self._lock = threading.Lock()

    @cached_property
    def _app(self) -> Any:  # noqa: ANN401  a FastAPI
        return http_app(HttpScene(served=self._scene(), queue=self._queue))

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:  # noqa: ANN401
        with self._lock:
            app = self._app
        await app(scope, receive, send)


@contextmanager
def http_server(
    scene: Callable[[], ServedScene], queue: RenderQueue, *, host: str, port: int
) -> Iterator[int]:
    """Serve as long as the block runs; gives the port, which 0 leaves to the system.

    Raises:
        ConfigError: the port cannot be had.
    """
    import uvicorn

    try:
        listening = socket.create_server((host, port))
    except OSError:
        raise ConfigError(
            f"port {port} of {host} cannot be had: it is in use or not allowed"
        ) from None
    config = uvicorn.Config(
        _LazyApp(scene, queue), log_level="critical", lifespan="off", timeout_graceful_shutdown=0
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(
        target=server.run, kwargs={"sockets": [listening]}, name="http", daemon=True
    )
    thread.start()
    try:
        yield listening.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join(END_S)
        listening.close()
