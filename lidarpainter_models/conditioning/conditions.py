"""Everything a painter is told about one view: render, LiDAR image and warped references.

Images are on the view's own pixel grid, rgb in [0, 1], depth camera z in metres with 0 where
there is none. Colours are those of the scene before any camera's exposure, unless a camera is
named whose exposure all of them then take.
"""

from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future
from copy import copy
from dataclasses import replace
from functools import cached_property
from operator import itemgetter
from threading import Lock

import cv2
import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.conditioning.warping import (
    SKY_ALPHA,
    SourceImage,
    WarpTarget,
    source_costs_m,
    warped_references,
)
from lidarpainter_models.gaussians.model.drawing import SceneRender
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import may_run_on_host
from lidarpainter_models.lidar.lidar_images import LidarImage, render_lidar
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.observations.views import TrainingView
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT, PaintingConditions
from lidarpainter_models.scenes.records import ViewKey

MOST_SOURCE_BYTES = 2_000_000_000
"""Of training views that are kept as sources: all of a short log, the last ones of a long one."""
SOURCE_PIXEL_BYTES = 41
"""Of a source: colour, depth and opacity, and the layers that are sampled."""
_LEAST_SHARE = 1e-3  # of LiDAR pixels around, below which there is nothing to go by
ONE_SURFACE = 0.15
"""Up to this relative difference render and LiDAR show one surface; beyond it the LiDAR may
have looked past an edge or through a window, and the render stands."""
REACH_RAD = 0.004
"""Deviation of the blur that carries corrections into gaps: 2 px at 500 px focal length."""


class ConditionBuilder:
    """Gathers painting conditions at any camera and time of one scene.

    They lie where the scene does. Depth and opacity of a training view are rendered when it first
    serves as a source and kept as long as there is room.
    """

    def __init__(
        self,
        scene: GaussianScene,
        lidar_map: LidarMap,
        training_views: Sequence[TrainingView],
        *,
        config: ConditionConfig | None = None,
    ) -> None:
        """Take the scene as it is now; build another one after the fit went on."""
        self.scene = scene
        self.lidar_map = lidar_map.to(scene.device)
        self.config = config or ConditionConfig()
        self.boxes = MovingBoxes(scene.tracks)
        self._views = {view.key: view for view in training_views}
        self._cameras = {view.key: scene.refined_camera(view) for view in training_views}
        self._sources: OrderedDict[ViewKey, Future[SourceImage]] = OrderedDict()
        self._of_sources = Lock()

    def showing(self, scene: GaussianScene, boxes: MovingBoxes) -> "ConditionBuilder":
        """The same knowledge of a scene whose actors stand elsewhere at the time of a view.

        What was recorded is still drawn with the actors where they were.
        """
        other = copy(self)
        other.scene, other.boxes = scene, boxes
        other._new_source = self._new_source  # type: ignore[method-assign]
        return other

    def forget_sources(self) -> None:
        """Free what was kept of training views; what is asked for again is rendered again."""
        self._sources.clear()

    @property
    def recorded_cameras(self) -> tuple[Camera, ...]:
        """The training views' cameras at their refined poses."""
        return tuple(self._cameras.values())

    @cached_property
    def _placed(self) -> tuple[Float[Tensor, "views 4 4"], Int[Tensor, " views"]]:
        """Poses of the training views, and when they were really taken."""
        poses = [camera.world_from_camera.double() for camera in self._cameras.values()]
        times_ns = [
            self._cameras[key].taken_ns(view.timestamp_ns) for key, view in self._views.items()
        ]
        none = torch.zeros(0, 4, 4, dtype=torch.float64)
        return torch.stack(poses) if poses else none, torch.tensor(times_ns, dtype=torch.int64)

    @property
    def training_views(self) -> tuple[TrainingView, ...]:
        """What was recorded, with cameras as recorded."""
        return tuple(self._views.values())

    @property
    def refined_views(self) -> list[TrainingView]:
        """The training views with their cameras where the fit found them to be."""
        return [replace(view, camera=self._cameras[key]) for key, view in self._views.items()]

    def source(self, key: ViewKey) -> SourceImage:
        """A training image with the surfaces it shows, colours before its exposure."""
        pixels = self._cameras[key].width_px * self._cameras[key].height_px
        most = max(MOST_SOURCE_BYTES // (SOURCE_PIXEL_BYTES * pixels), 1)
        with self._of_sources:  # views beside each other ask for the same ones
            is_new = key not in self._sources
            source = self._sources.setdefault(key, Future())
            self._sources.move_to_end(key)
            while len(self._sources) > most:
                self._sources.popitem(last=False)
        if is_new:
            try:
                source.set_result(self._new_source(key))
            except BaseException as error:  # whoever waits for it must not do so for ever
                self._sources.pop(key, None)
                source.set_exception(error)
                raise
        return source.result()

    def _new_source(self, key: ViewKey) -> SourceImage:
        view, camera = self._views[key], self._cameras[key]
        device = self.scene.device
        rgb, sky_mask = view.rgb_u8.to(device).float() / 255, view.sky_mask.to(device)
        render = self.scene.render(camera, view.timestamp_ns)
        taken_ns = camera.taken_ns(view.timestamp_ns)
        lidar = self.lidar_image(camera, taken_ns)
        # the sky mask knows better than the render where there is sky; what else is clear in
        # the render is drawn by the sky too, so it stands at infinity in both views
        source = SourceImage(
            key=key,
            camera=camera,
            timestamp_ns=taken_ns,
            rgb=self.scene.exposure.undone(rgb, key[1], taken_ns),
            depth_m=torch.where(sky_mask, 0.0, self.surface_m(render, lidar, camera)),
            alpha=torch.where(sky_mask, 0.0, render.alpha),
        )
        if view.hidden is None:
            return source
        return source.without(view.hidden.to(device), render.rgb)

    def sources_for(self, camera: Camera, timestamp_ns: int) -> tuple[SourceImage, ...]:
        """The images a view is patched from: nearest first, then spread over all others.

        Neighbours of a slow drive show the same; images further off see round corners and
        past the edge of the frame.
        """
        costs_m = source_costs_m(camera, timestamp_ns, *self._placed)
        nearest = sorted(zip(costs_m.tolist(), self._views, strict=True), key=itemgetter(0))
        keys = [key for _, key in nearest]
        near = min(self.config.num_references, len(keys))
        rest = keys[near:]
        num_rest = min(self.config.num_sources - near, len(rest))
        spread = [rest[round((i + 1) * len(rest) / num_rest) - 1] for i in range(num_rest)]
        return tuple(self.source(key) for key in (*keys[:near], *spread))

    def conditions(
        self,
        camera: Camera,
        timestamp_ns: int,
        *,
        camera_name: str | None = None,
        prompt: str = DEFAULT_PROMPT,
    ) -> PaintingConditions:
        """Gather what is known about a view.

        The camera is taken as it stands: correct it first if it was recorded. All images take the
        exposure of `camera_name`.
        """
        render = self.scene.render(camera, timestamp_ns)
        timestamp_ns = camera.taken_ns(timestamp_ns)
        lidar = self.lidar_image(camera, timestamp_ns)
        is_sky = (render.alpha < SKY_ALPHA) & (lidar.depth_m == 0)
        sources = self.sources_for(camera, timestamp_ns)
        references = warped_references(
            WarpTarget(
                camera, timestamp_ns, [self.surface_m(render, lidar, camera), lidar.depth_m], is_sky
            ),
            sources,
            self.boxes,
            count=self.config.num_references,
        )

        def expose(rgb: Tensor) -> Tensor:
            return self.scene.exposure.apply(rgb, camera_name, timestamp_ns)

        references_rgb = torch.stack([expose(rgb) for rgb in references.rgb])
        nearest = _as_taken(expose(sources[0].rgb), camera) if sources else None
        return PaintingConditions(
            render_rgb=expose(render.rgb).clamp(0, 1),
            render_depth_m=render.depth_m,
            render_alpha=render.alpha,
            lidar_rgb=_masked(expose(lidar.rgb), lidar.hit),
            lidar_depth_m=lidar.depth_m,
            lidar_hit=lidar.hit,
            warp_rgb=_masked(references_rgb, references.valid),
            warp_valid=references.valid,
            reference_rgb=nearest,
            prompt=prompt,
        )

    def lidar_image(self, camera: Camera, timestamp_ns: int) -> LidarImage:
        """What the LiDAR knows of a view."""
        return render_lidar(self.lidar_map, self.boxes, camera, timestamp_ns)

    def surface_m(
        self, render: SceneRender, lidar: LidarImage, camera: Camera
    ) -> Float[Tensor, "height width"]:
        """The best known depth of a view."""
        focal_px = (camera.fx_px + camera.fy_px) / 2
        return surface_depth(render.depth_m, lidar.depth_m, focal_px)


def _as_taken(
    rgb: Float[Tensor, "source_height source_width 3"], camera: Camera
) -> Float[Tensor, "height width 3"]:
    """A recorded image with as many pixels as a view has, whatever either shows."""
    size_px = (camera.height_px, camera.width_px)
    planes = rgb.clamp(0, 1).permute(2, 0, 1)[None]
    if planes.shape[2:] != size_px:
        planes = F.interpolate(planes, size_px, mode="bilinear", antialias=True)
    return planes[0].permute(1, 2, 0)


def _masked(
    rgb: Float[Tensor, "*batch height width 3"], valid: Tensor
) -> Float[Tensor, "*batch height width 3"]:
    """Displayable colours where they are valid, else 0."""
    return torch.where(valid[..., None], rgb.clamp(0, 1), 0)


def surface_depth(
    render_depth_m: Float[Tensor, "height width"],
    lidar_depth_m: Float[Tensor, "height width"],
    focal_px: float,
) -> Float[Tensor, "height width"]:
    """The depth of a view's surfaces: LiDAR where both see one, the corrected render elsewhere.

    A render's depth is a mean over soft Gaussians: good to a percent, which at ten metres carries
    an image taken three metres aside to the wrong place by a pixel or two. LiDAR is three times as
    good (medians on a synthetic street) but has gaps; in these the render is scaled as LiDAR found
    it wrong around them. 0 where the render is 0.
    """
    has_both = (render_depth_m > 0) & (lidar_depth_m > 0)
    ratio = torch.where(has_both, lidar_depth_m / render_depth_m.clamp_min(1e-3), 1)
    agrees = has_both & ((ratio - 1).abs() < ONE_SURFACE)
    found = torch.stack([torch.where(agrees, ratio.log(), 0), agrees.float()], dim=-1)
    change, share = _blurred(found, REACH_RAD * focal_px).unbind(-1)
    factor = torch.where(share > _LEAST_SHARE, change / share.clamp_min(_LEAST_SHARE), 0).exp()
    return torch.where(agrees, lidar_depth_m, render_depth_m * factor)


def _blurred(
    image: Float[Tensor, "height width 2"], sigma_px: float
) -> Float[Tensor, "height width 2"]:
    """A Gaussian blur that mirrors the image at its border, as OpenCV's by default."""
    if may_run_on_host(image.device):
        return torch.from_numpy(cv2.GaussianBlur(image.numpy(), (0, 0), sigma_px))
    radius_px = round(8 * sigma_px + 1) // 2
    offset = torch.arange(-radius_px, radius_px + 1, device=image.device, dtype=image.dtype)
    weights = torch.exp(-(offset**2) / (2 * sigma_px**2))
    weights = weights / weights.sum()
    planes = image.permute(2, 0, 1)[:, None]
    for shape, sides in (
        ((1, -1), (radius_px, radius_px, 0, 0)),
        ((-1, 1), (0, 0, radius_px, radius_px)),
    ):
        padded = F.pad(planes, sides, mode="reflect")
        planes = F.conv2d(padded, weights.view(1, 1, *shape))
    return planes[:, 0].permute(1, 2, 0)
