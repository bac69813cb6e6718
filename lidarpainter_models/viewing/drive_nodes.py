"""A drive as nodes of a viser scene, seen from the seat: the viewer's frame rides along.

Not the browser's camera moves along the path but the world below it, so that a person who looks
aside, or steps aside, keeps doing so while the drive goes on. Seat frame: x forward, y left, z up,
origin at the camera; it is the browser's world.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
import viser
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.conditioning.followed_paths import FollowedPath
from lidarpainter_models.export.images import jpeg_data_url
from lidarpainter_models.export.page import FirstView, PageNotes, sealed_page
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.geometry.transforms import rigid_from_rotation
from lidarpainter_models.viewing.annotations import TrackNodes, vertical_fov_rad
from lidarpainter_models.viewing.scene_nodes import SKY_M, SceneNodes, place_node
from lidarpainter_models.viewing.servers import local_server

ROOT = "/drive"
SEAT_FROM_CAMERA = rigid_from_rotation(
    torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), torch.zeros(3)
).double()
LOOK_AHEAD_M = 10.0
"""What one turns around on a drag of the mouse lies so far ahead."""
FAR_M = 4 * SKY_M


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownDrive:
    """What can be shown of a run."""

    path: FollowedPath
    """The recorded path of one camera."""
    scenes: Mapping[str, Callable[[], GaussianScene]]
    """Opened when first shown, by the names that people choose from; the first is the path's own
    and shown first."""
    sweeps: Callable[[GaussianScene, int, Float[Tensor, "3"]], Float[Tensor, "points 3"]] | None = (
        None
    )
    """Points of the world that a LiDAR would meet in a scene in a frame, from so far beside where
    it was; None where nobody learnt it."""

    @property
    def camera_name(self) -> str:
        """Whose path is followed."""
        return self.path.views[0].camera_name


class DriveNodes:
    """The nodes of a drive, one moment at a time."""

    shown: SceneNodes
    """The scene that is shown."""
    tracks: TrackNodes
    """Boxes and ways of its actors."""

    def __init__(self, server: viser.ViserServer, drive: ShownDrive) -> None:
        """Send everything but scenes; those are sent when they are first shown."""
        self._api, self._drive = server.scene, drive
        self._cameras = [
            (drive.path.camera(number), view.timestamp_ns)
            for number, view in enumerate(drive.path.views)
        ]
        self._sent: dict[str, tuple[SceneNodes, TrackNodes]] = {}
        self._api.configure_default_lights(False)
        self._api.configure_environment_map(None)
        self._world = self._api.add_frame(ROOT, show_axes=False)
        self.show_scene(next(iter(drive.scenes)))
        look_forward(server.initial_camera, self._cameras[0][0])

    def show_scene(self, name: str) -> None:
        """Show another of the drive's scenes; it is sent when it is first asked for."""
        if name not in self._sent:
            root, scene = f"{ROOT}/{name}", self._drive.scenes[name]()
            camera_name = self._drive.camera_name
            nodes = SceneNodes(self._api, root, scene, self._cameras, camera_name)
            self._sent[name] = nodes, TrackNodes(self._api, root, scene.tracks)
        self.shown, self.tracks = self._sent[name]
        for nodes, _ in self._sent.values():
            nodes.root.visible = nodes is self.shown

    def place(self, timestamp_ns: int, seat: Camera) -> None:
        """Show a moment from a seat."""
        self.shown.place(timestamp_ns, seat.centre_world)
        self.tracks.place(self.shown.scene.actors.refined_poses(timestamp_ns))
        place_node(self._world, seat_from_world(seat))


def seat_from_world(seat: Camera) -> Float[Tensor, "4 4"]:
    """The world as it lies before somebody in the place of a camera."""
    return SEAT_FROM_CAMERA @ seat.camera_from_world


def look_forward(view: viser.InitialCameraConfig | viser.CameraHandle, lens: Camera) -> None:
    """Look from the seat straight ahead, as wide as the lens."""
    view.position = (0.0, 0.0, 0.0)
    view.look_at = (LOOK_AHEAD_M, 0.0, 0.0)
    view.fov = vertical_fov_rad(lens)
    view.far = FAR_M


TITLE_M = 10.0
"""How far ahead of the seat the title of a leg stands, near the upper edge of the view."""
LAST_S = 0.1
"""How long the last moment stands."""
FIRST_VIEW_PX = (1296, 540)
"""Width and height of the picture of the first view: wider than windows are."""


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One way along the drive."""

    title: str
    """What is written over it."""
    trajectory: Trajectory


def recorded_page(
    drive: ShownDrive,
    legs: Sequence[Leg],
    notes: PageNotes,
    *,
    progress: Callable[[int, int], None],
) -> str:
    """A page that drives all legs one after another; tells how many moments are done."""
    views = drive.path.views
    times_s = [view.timestamp_ns * 1e-9 for view in views]
    pauses_s = [after - before for before, after in pairwise(times_s)]
    pauses_s.append(pauses_s[-1] if pauses_s else LAST_S)
    with local_server(port=0) as server:
        nodes = DriveNodes(server, drive)
        seat = drive.path.camera(0)
        edge_m = TITLE_M * math.tan(vertical_fov_rad(seat) / 2)
        label = server.scene.add_label(
            "/title",
            legs[-1].title,  # else the first leg would say nothing when the page begins again
            position=(TITLE_M, 0.0, 0.85 * edge_m),
            font_screen_scale=1.5,
            anchor="center-center",
        )
        nodes.place(views[0].timestamp_ns, seat)
        recording = server.get_scene_serializer()
        for number, leg in enumerate(legs):
            label.text = leg.title
            path = replace(drive.path, trajectory=leg.trajectory)
            for moment, (view, pause_s) in enumerate(zip(views, pauses_s, strict=True)):
                nodes.place(view.timestamp_ns, path.camera(moment))
                recording.insert_sleep(pause_s)
                progress(number * len(views) + moment + 1, len(legs) * len(views))
        return sealed_page(recording.as_html(), notes, _first_view(drive, nodes))


def _first_view(drive: ShownDrive, nodes: DriveNodes) -> FirstView:
    """Our own picture of what the page shows first, seen through a lens as high but wider."""
    width_px, height_px = FIRST_VIEW_PX
    seat, view = drive.path.camera(0), drive.path.views[0]
    focal_px = height_px / 2 / math.tan(vertical_fov_rad(seat) / 2)
    pose = seat.world_from_camera
    wide = Camera.centred(pose, focal_px, width_px=width_px, height_px=height_px)
    drawn = nodes.shown.scene.render(wide, view.timestamp_ns, camera_name=view.camera_name)
    return FirstView(data_url=jpeg_data_url(drawn.rgb), num_splats=nodes.shown.num_splats)
