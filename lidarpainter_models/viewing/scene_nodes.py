"""A fitted scene as nodes of a viser scene: street, sky, and a node for every actor.

The nodes stand in the world frame below their root. What is drawn is sent once; a step in time
sends each actor's pose and where the sky's cube stands, nothing else. The browser knows no sky
texture: the sky is six pictures of a far cube, each in the frame of a camera (x right, y down, z
forward) through its middle.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import viser
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.export.images import to_bytes
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import (
    quaternion_from_rotation,
    rigid_from_rotation,
    rotation_from_quaternion,
)
from lidarpainter_models.kernels.gaussian_raster.blending_limits import COLOUR_OFFSET
from lidarpainter_models.kernels.gaussian_raster.reference import harmonic_basis
from lidarpainter_models.scenes.tracks import ActorTrack

MIN_OPACITY = 0.01
"""The client draws nothing fainter."""
MOST_CAMERAS = 24
"""Recorded cameras whose colours are averaged; more change nothing to be seen."""
_NEAR_M = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class BrowserSplats:
    """Rows for viser's `add_gaussian_splats`."""

    centres: Float[Tensor, "splats 3"]
    covariances: Float[Tensor, "splats 3 3"]
    rgb: Float[Tensor, "splats 3"]
    opacity: Float[Tensor, "splats 1"]


def splats_by_body(
    gaussians: GaussianSet, rgb: Float[Tensor, "gaussians 3"]
) -> dict[int, BrowserSplats]:
    """What can be seen of every body that has any, in the frame of the body."""
    rows = (gaussians.opacity.detach() >= MIN_OPACITY).nonzero()[:, 0]
    rows = rows[torch.argsort(gaussians.body_index[rows], stable=True)]
    bodies, counts = torch.unique_consecutive(gaussians.body_index[rows], return_counts=True)
    parts = rows.split(counts.tolist())
    return {
        int(body): _splats(gaussians.select(part), rgb[part])
        for body, part in zip(bodies, parts, strict=True)
    }


def _splats(gaussians: GaussianSet, rgb: Float[Tensor, "gaussians 3"]) -> BrowserSplats:
    axes = rotation_from_quaternion(gaussians.rotation_wxyz) * gaussians.scale_m[:, None]
    return BrowserSplats(
        centres=gaussians.means,
        covariances=axes @ axes.transpose(1, 2),
        rgb=rgb.clamp(0, 1),
        opacity=gaussians.opacity[:, None],
    )


def recorded_rgb(
    scene: GaussianScene, cameras: Sequence[tuple[Camera, int]]
) -> Float[Tensor, "gaussians 3"]:
    """The colour of every Gaussian, on average over the cameras that have it in their image.

    Each camera comes with its time in nanoseconds; where there are many, some of them are taken. A
    Gaussian that none of them sees keeps its constant colour.
    """
    gaussians = scene.gaussians
    total, weight = torch.zeros(len(gaussians), 3), torch.zeros(len(gaussians), 1)
    step = max(1, -(-len(cameras) // MOST_CAMERAS))
    with torch.no_grad():
        for camera, timestamp_ns in cameras[::step]:
            rows, seen_rgb = _seen(scene, camera, timestamp_ns)
            total[rows] += seen_rgb
            weight[rows] += 1
        return torch.where(weight > 0, total / weight.clamp(min=1), gaussians.base_rgb)


def _seen(
    scene: GaussianScene, camera: Camera, timestamp_ns: int
) -> tuple[Int[Tensor, " seen"], Float[Tensor, "seen 3"]]:
    """The Gaussians whose centres lie in an image, and their colours in it."""
    drawable = scene.drawable(camera, timestamp_ns)
    gaussians = drawable.gaussians
    own = drawable.posed.bodies[gaussians.body_index.long()]
    points = torch.einsum("gij,gj->gi", own[:, :3, :3], gaussians.means) + own[:, :3, 3]
    x, y, z = points.unbind(1)
    u, v = camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px
    inside = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    rows = (inside & (z > _NEAR_M)).nonzero()[:, 0]
    towards = torch.einsum("gji,gj->gi", own[rows, :3, :3], points[rows])  # in the body's frame
    basis = harmonic_basis(torch.nn.functional.normalize(towards, dim=1), gaussians.sh.shape[1])
    rgb = COLOUR_OFFSET + torch.einsum("gk,gkc->gc", basis, gaussians.sh[rows])
    return drawable.rows[rows], rgb.clamp(min=0)


_STREET = 0
SKY_M = 5000.0
"""How far the cube's sides stand: a drive of 100 m moves the sky by a degree, and it is carried
along with the car."""
MOST_PX = 1024
"""Of a picture's side; sharper skies are made coarser."""
_FORWARD_AND_DOWN = {
    "front": ((1, 0, 0), (0, 0, -1)),
    "left": ((0, 1, 0), (0, 0, -1)),
    "back": ((-1, 0, 0), (0, 0, -1)),
    "right": ((0, -1, 0), (0, 0, -1)),
    "top": ((0, 0, 1), (1, 0, 0)),
    "bottom": ((0, 0, -1), (-1, 0, 0)),
}
"""World directions of every picture's z and y axes."""
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
        self.scene = scene
        baked = scene.baked((cameras[0][1] + cameras[-1][1]) // 2)
        self.root = api.add_frame(root, show_axes=False)
        self._sky = api.add_frame(f"{root}/sky", show_axes=False)
        self.actors = api.add_frame(f"{root}/actors", show_axes=False)
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

    def place(self, timestamp_ns: int, centre_world: Float[Tensor, "3"]) -> None:
        """Put the actors where they stand at a time, and the sky around a place."""
        self._sky.position = centre_world.numpy()
        poses, present = self.scene.actors.refined_poses(timestamp_ns)
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


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyPanel:
    """One side of the cube."""

    name: str
    rgb: Float[Tensor, "side side 3"]
    world_from_panel: Float[Tensor, "3 3"]
    """A rotation."""


def sky_panels(sky: SkyTexture) -> list[SkyPanel]:
    """All six sides, as sharp in their middle as the texture is."""
    side_px = min(MOST_PX, math.ceil(2 / sky.layout.texel_rad))
    panels = []
    for name, (forward, down) in _FORWARD_AND_DOWN.items():
        z, y = torch.tensor(forward).double(), torch.tensor(down).double()
        rotation = torch.stack([torch.linalg.cross(y, z), y, z], dim=1)
        pose = rigid_from_rotation(rotation, torch.zeros(3).double())
        camera = Camera.centred(pose, side_px / 2, width_px=side_px, height_px=side_px)
        rgb = sky.sample(sky.rays(camera))
        panels.append(SkyPanel(name=name, rgb=rgb, world_from_panel=rotation))
    return panels
