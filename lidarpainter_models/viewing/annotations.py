"""What stands around a scene: boxes and tracks of actors, the rig's cameras, LiDAR points.

All nodes stand in the world frame below their roots; each kind can be hidden as a whole.
"""

import colorsys
import math
import re
from collections.abc import Sequence

import cv2
import numpy as np
import viser
from jaxtyping import Float, UInt8
from torch import Tensor

from lidarpainter_models.gaussians.model.actors import ActorPoses
from lidarpainter_models.geometry.boxes import BOX_EDGES, box_corners
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.viewing.scene_nodes import node_name, place_node

FRUSTUM_M = 0.6
"""From a camera to where its image stands."""
FAR_LIDAR_M = 80.0
"""Points from here on take the last colour."""
POINT_M = 0.03
MOST_POINTS = 60_000
"""LiDAR points of a sweep that are shown."""
LINE_PX = 2.0
_GOLDEN_ANGLE = 0.618034


class TrackNodes:
    """A box for every actor, and the way that each of those that move takes."""

    def __init__(self, api: viser.SceneApi, root: str, tracks: Sequence[ActorTrack]) -> None:
        """Send boxes and ways, hidden at first."""
        self.boxes = api.add_frame(f"{root}/boxes", show_axes=False, visible=False)
        self._boxes = [
            api.add_line_segments(
                f"{root}/boxes/{node_name(index, track)}",
                points=box_corners(track.size_m)[np.array(BOX_EDGES)].numpy(),
                colors=colour_of(index),
                thickness=LINE_PX,
                thickness_units="screen",
            )
            for index, track in enumerate(tracks)
        ]
        self.tracks = api.add_frame(f"{root}/tracks", show_axes=False, visible=False)
        for index, track in enumerate(tracks):
            if track.is_moving and len(track.timestamps_ns) > 1:
                centres = track.world_from_box[:, :3, 3].numpy()
                api.add_line_segments(
                    f"{root}/tracks/{node_name(index, track)}",
                    points=np.stack([centres[:-1], centres[1:]], axis=1),
                    colors=colour_of(index),
                    thickness=LINE_PX,
                    thickness_units="screen",
                )

    def place(self, poses: ActorPoses) -> None:
        """Put the boxes where the actors stand."""
        world_from_actors, present = poses
        for actor, handle in enumerate(self._boxes):
            place_node(handle, world_from_actors[actor], visible=bool(present[actor]))


class RigNodes:
    """The rig's cameras where they stood, each with what it recorded."""

    def __init__(self, api: viser.SceneApi, root: str) -> None:
        """No camera yet: each is sent when it is first placed."""
        self.root = api.add_frame(root, show_axes=False, visible=False)
        self._api = api
        self._frusta: dict[str, viser.CameraFrustumHandle] = {}

    def place(self, name: str, camera: Camera, rgb_u8: UInt8[Tensor, "height width 3"]) -> None:
        """Put a camera where it stood, with the image that it took there."""
        if name not in self._frusta:
            self._frusta[name] = self._api.add_camera_frustum(
                f"{self.root.name}/{name}",
                fov=vertical_fov_rad(camera),
                aspect=camera.width_px / camera.height_px,
                scale=FRUSTUM_M,
            )
        self._frusta[name].image = rgb_u8.numpy()
        place_node(self._frusta[name], camera.world_from_camera)

    def show_only(self, names: Sequence[str]) -> None:
        """Hide the cameras that are not named."""
        for name, frustum in self._frusta.items():
            frustum.visible = name in names


class LidarNodes:
    """The points of one sweep, coloured by how far they lie."""

    def __init__(self, api: viser.SceneApi, root: str) -> None:
        """No points yet."""
        self.cloud = api.add_point_cloud(
            root,
            points=np.zeros((0, 3), np.float32),
            colors=np.zeros((0, 3), np.uint8),
            point_size=POINT_M,
            visible=False,
        )

    def place(self, xyz_m: Float[Tensor, "points 3"], from_world: Float[Tensor, "3"]) -> None:
        """Show points of the world, coloured by how far from a place they lie; of many some."""
        xyz_m = xyz_m[:: max(-(-len(xyz_m) // MOST_POINTS), 1)]
        range_m = (xyz_m - from_world.to(xyz_m)).norm(dim=1).numpy()
        level = (255 * np.clip(range_m / FAR_LIDAR_M, 0, 1)).astype(np.uint8)
        bgr = cv2.applyColorMap(level[:, None], cv2.COLORMAP_TURBO)
        self.cloud.points = xyz_m.numpy()
        self.cloud.colors = bgr[:, 0, ::-1]


def vertical_fov_rad(camera: Camera) -> float:
    """The angle that the image takes from its top to its bottom."""
    return 2 * math.atan(camera.height_px / 2 / camera.fy_px)


def plain(name: str) -> str:
    """A dataset's name without what Markdown and HTML would make something of."""
    return re.sub(r"[^\w .:-]+", " ", name)


def colour_of(index: int) -> tuple[float, float, float]:
    """Colours far apart for neighbouring numbers."""
    return colorsys.hsv_to_rgb(index * _GOLDEN_ANGLE % 1, 0.7, 1.0)
