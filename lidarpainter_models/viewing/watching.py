"""A running fit in a browser on this machine: the scene as it was a few seconds ago.

The viewer stands where the first recorded image was taken and looks as its camera did; actors stand
where they were at that time. What is shown is replaced as a whole, so the browser keeps the view
that somebody has turned to.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
import viser

from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.observations.views import TrainingView
from lidarpainter_models.viewing.drive_nodes import look_forward, seat_from_world
from lidarpainter_models.viewing.scene_nodes import SceneNodes, place_node
from lidarpainter_models.viewing.servers import local_server

EVERY_S = 5.0
"""How long the fit goes on at least before it is shown again."""
SHARE = 0.1
"""Part of the time that showing takes at most, however large the scene is."""
ROOT = "/fit"


class Watch:
    """What shows running fits: it stays the same for all fits of a run."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._world = server.scene.add_frame(ROOT, show_axes=False)
        self._nodes: SceneNodes | None = None
        self._shown = 0
        self._next_s = 0.0

    def is_due(self) -> bool:
        """Whether what is shown is so old that it should be replaced."""
        return time.monotonic() >= self._next_s

    @torch.no_grad()
    def show(self, scene: GaussianScene, views: Sequence[TrainingView]) -> None:
        """Show a scene, seen from the first of the views that it is fitted to."""
        began_s = time.monotonic()
        first = min(views, key=lambda view: view.timestamp_ns)
        cameras = [(view.camera, view.timestamp_ns) for view in views]
        self._shown += 1
        with self._server.atomic():
            nodes = SceneNodes(
                self._server.scene, f"{ROOT}/{self._shown}", scene, cameras, first.key[1]
            )
            nodes.place(first.timestamp_ns, first.camera.centre_world)
            if self._nodes is None:
                place_node(self._world, seat_from_world(first.camera))
                look_forward(self._server.initial_camera, first.camera)
            else:
                self._nodes.root.remove()
            self._nodes = nodes
        took_s = time.monotonic() - began_s
        self._next_s = began_s + max(EVERY_S, took_s / SHARE)


@contextmanager
def watching(*, label: str) -> Iterator[tuple[Watch, str]]:
    """Something that shows running fits, and its address, for as long as the block runs."""
    with local_server(label=label) as server:
        server.gui.configure_theme(show_share_button=False, show_logo=False)
        yield Watch(server), f"http://{server.get_host()}:{server.get_port()}"
