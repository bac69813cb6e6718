"""A fitted scene as nodes of a viser scene: street, sky, and a node for every actor.

The nodes stand in the world frame below their root. What is drawn is sent once; a step in time
sends each actor's pose and where the sky's cube stands, nothing else.
"""

import re
from collections.abc import Sequence

import numpy as np
import viser
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.export.images import to_bytes
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import quaternion_from_rotation
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.viewing.browser_splats import BrowserSplats, recorded_rgb, splats_by_body
from lidarpainter_models.viewing.sky_panels import SKY_M, sky_panels

_STREET = 0
_UNFIT = re.compile(r"[^\w .-]+")
"""A slash in a node's name would make a child of it."""


class SceneNodes:
    """One fitted scene below one root, shown or hidden as a whole."""

    def __init__(
        self,
        api: viser.SceneApi,
        root: str,
        scene: GaussianScene,
        cameras: Sequence[tuple[Camera, int]],
        camera_name: str,
    ) -> None:
        """Send the scene, its actors where they stand at the first camera's time.

        Recorded cameras come with their times; the scene is shown in their colours, with the
        exposure of `camera_name` at the first of these times. A style stands still: it is that of
        the middle of these times, seen from where the car was.
        """
        self._scene = scene
        baked = scene.baked((cameras[0][1] + cameras[-1][1]) // 2)
        self._root = api.add_frame(root, show_axes=False)
        self._sky = api.add_frame(f"{root}/sky", show_axes=False)
        self._actors = api.add_frame(f"{root}/actors", show_axes=False)
        for panel in sky_panels(baked.sky):
            api.add_image(
                f"{root}/sky/{panel.name}",
                to_bytes(scene.exposure.apply(panel.rgb, camera_name, cameras[0][1])),
                render_width=2 * SKY_M,
                render_height=2 * SKY_M,
                format="jpeg",
                jpeg_quality=90,
                cast_shadow=False,
                receive_shadow=False,
                wxyz=quaternion_from_rotation(panel.world_from_panel).numpy(),
                position=(SKY_M * panel.world_from_panel[:, 2]).numpy(),
            )
        recorded = recorded_rgb(baked, cameras)[None]
        rgb = scene.exposure.apply(recorded, camera_name, cameras[0][1])[0]
        self._bodies: dict[int, viser.GaussianSplatHandle] = {}
        self.num_splats = 0
        for body, splats in splats_by_body(baked.gaussians, rgb).items():
            self.num_splats += len(splats.centres)
            if body == _STREET:
                add_splats(api, f"{root}/street", splats)
            else:
                name = node_name(body - 1, scene.actors.recorded_tracks[body - 1])
                self._bodies[body - 1] = add_splats(api, f"{root}/actors/{name}", splats)
        self.place(cameras[0][1], cameras[0][0].centre_world)

    @property
    def visible(self) -> bool:
        """Whether the scene is shown at all."""
        return self._root.visible

    @visible.setter
    def visible(self, shown: bool) -> None:
        self._root.visible = shown

    @property
    def with_actors(self) -> bool:
        """Whether its actors are shown."""
        return self._actors.visible

    @with_actors.setter
    def with_actors(self, shown: bool) -> None:
        if self._actors.visible != shown:
            self._actors.visible = shown

    def place(self, timestamp_ns: int, centre_world: Float[Tensor, "3"]) -> None:
        """Put the actors where they stand at a time, and the sky around a place."""
        self._sky.position = centre_world.numpy()
        poses, present = self._scene.actors.refined_poses(timestamp_ns)
        for actor, handle in self._bodies.items():
            place_node(handle, poses[actor], visible=bool(present[actor]))


def add_splats(api: viser.SceneApi, name: str, splats: BrowserSplats) -> viser.GaussianSplatHandle:
    """A node of Gaussians, in the frame that they are given in."""
    return api.add_gaussian_splats(
        name,
        centers=splats.centres.numpy(),
        covariances=splats.covariances.numpy(),
        rgbs=splats.rgb.numpy(),
        opacities=splats.opacity.numpy(),
    )


def node_name(index: int, track: ActorTrack) -> str:
    """What an actor's nodes are called: its number and its class."""
    return f"{index:03d} {_UNFIT.sub('-', track.category)}"


def place_node(
    handle: viser.SceneNodeHandle, parent_from_node: Float[Tensor, "4 4"], *, visible: bool = True
) -> None:
    """Move a node, saying only what changed."""
    if handle.visible != visible:
        handle.visible = visible
    if not visible:
        return
    position = parent_from_node[:3, 3].numpy()
    rotation_wxyz = quaternion_from_rotation(parent_from_node[:3, :3]).numpy()
    if not np.array_equal(handle.position, position):
        handle.position = position
    if not np.array_equal(handle.wxyz, rotation_wxyz):
        handle.wxyz = rotation_wxyz
