"""Give LiDAR points the colours that recorded images saw, and only those images.

Every point is projected into every given image; points of moving actors stand where their box is
at the exposure. A sample counts where nothing known hides the point (`point_visibility`), most
where the image was taken near in time to the point, fine enough, and away from depth edges, where
a small error of pose or calibration would take the colour of the other side. The best few samples
are brought to one exposure and combined robustly.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.colour_sampling import BestSamples, combine_samples, insert_samples
from lidarpainter_models.lidar.exposure_matching import match_exposure
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.lidar.point_visibility import (
    Neighbourhood,
    Visibility,
    box_far_ends,
    surface_visibility,
    visible_points,
)
from lidarpainter_models.lidar.points_in_view import (
    Body,
    CellGrid,
    PlacedActors,
    PointsInView,
    place_actors,
    points_in_view,
)
from lidarpainter_models.lidar.rim_colours import ImageLevels, RimConfig, rim_samples
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.scenes.tracks import ActorTrack

_FINE_ENOUGH_PX = 2.0
"""An image with more pixels than this across a point's footprint is no better for it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ColouringConfig:
    """Where a point's colour comes from. Angles make lengths follow the resolution."""

    width_px: int = 960
    """Images are shrunk to this width before they are sampled."""
    footprint_rad: float = 0.002
    """Angle of the surface patch that a point stands for, as seen from the LiDAR."""
    recency_s: float = 0.2
    """An image this much before or after the point weighs half."""
    grid_rad: float = 0.002
    """Angle of a cell of the grid on which occlusion is judged."""
    beam_spacing_rad: float = 0.004
    """Angle between neighbouring returns: the width of a disc that closes a surface."""
    surface_window_s: float = 0.5
    """Points measured this near in time to an image hide others in it."""
    gap_rad: float = 0.012
    """Gaps between scan lines up to this angle are closed to the background."""
    hidden_tolerance: float = 0.05
    """A point is behind a surface when further by this share of its depth."""
    edge_rad: float = 0.004
    """Nearer surface within this angle spoils a sample: errors of pose and calibration."""
    rim_rad: float = 0.008
    """A surface that ends within this angle may show what is beyond it."""
    rims: RimConfig = field(default_factory=RimConfig)
    standing_box_share: float = 0.85
    """Share of each side of a standing actor's box that hides what is behind it."""
    near_m: float = 0.5
    """Points nearer to the camera plane than this are not sampled."""

    def __post_init__(self) -> None:
        """Refuse settings that no image can be sampled with."""
        if self.width_px < 32:
            raise ConfigError(f"width_px must be at least 32, got {self.width_px}")
        for name in ("footprint_rad", "recency_s", "grid_rad", "beam_spacing_rad", "near_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, got {getattr(self, name)}")


class MapColouring:
    """Colours the points of a map, one image after another."""

    def __init__(
        self,
        lidar_map: LidarMap,
        tracks: Sequence[ActorTrack],
        views: Sequence[RecordedView],
        config: ColouringConfig,
    ) -> None:
        """Take the points, all actors of the scene, and the views whose images will be added.

        Raises:
            SceneError: the points of an actor that has no track.
        """
        known = {track.actor_id: track for track in tracks}
        unknown = sorted(set(lidar_map.actors) - set(known))
        if unknown:
            raise SceneError(f"points of actors without a track: {', '.join(unknown)}")
        self._config = config
        self._actor_ids = list(lidar_map.actors)
        actors = [Body(known[name], points) for name, points in lidar_map.actors.items()]
        self._bodies = [Body(None, lidar_map.street), *actors]
        self._samples = BestSamples.none_yet(sum(len(body.points) for body in self._bodies))
        self._view_numbers = {view.key: number for number, view in enumerate(views)}
        self._placed = place_actors(views, tracks)

    def add(self, view: RecordedView, image: UInt8[Tensor, "height width 3"]) -> None:
        """Take samples from the recorded image of one of the views."""
        config, actors = self._config, self._placed[view.key]
        image = _shrunk(image, config)
        camera = view.camera.resized(width_px=image.shape[1], height_px=image.shape[0])
        grid = CellGrid.over(camera, config.grid_rad)
        inside = points_in_view(
            self._bodies, camera, view.timestamp_ns, actors, grid, near_m=config.near_m
        )
        if len(inside) == 0:
            return
        visibility = _visibility(inside, grid.camera, actors, config)
        is_visible = visible_points(
            inside.cells_uv, inside.depth_m, visibility, tolerance=config.hidden_tolerance
        )
        seen = inside.keep(is_visible.nonzero()[:, 0])
        footprint_px = seen.range_m * config.footprint_rad * camera.fx_px / seen.depth_m
        levels = ImageLevels(image, footprint_px)
        rgb, trust = rim_samples(levels, seen, visibility, grid.cells_per_pixel, config.rims)
        weight = trust / (1 + (seen.age_s / config.recency_s) ** 2)
        weight *= footprint_px.clamp(max=_FINE_ENOUGH_PX) ** 2
        number = self._view_numbers[view.key]
        insert_samples(self._samples, seen.rows.numpy(), weight.numpy(), rgb.numpy(), number)

    def coloured(self) -> LidarMap:
        """The map with the colours that the images added gave it.

        Colours have the exposure of the first view's camera. Points that no image showed keep
        `has_colour` false.
        """
        cameras = [camera_name for _, camera_name in self._view_numbers]
        order = list(dict.fromkeys(cameras))
        gains = np.ones((1, 3), np.float32)
        if cameras:
            view_camera = np.array([order.index(name) for name in cameras])
            gains = match_exposure(self._samples, view_camera)
        rgb, has_colour = map(torch.from_numpy, combine_samples(self._samples, gains))
        sizes = [len(body.points) for body in self._bodies]
        street, *actors = (
            replace(body.points, rgb_u8=own_rgb.clone(), has_colour=own_has.clone())
            for body, own_rgb, own_has in zip(
                self._bodies, rgb.split(sizes), has_colour.split(sizes), strict=True
            )
        )
        return LidarMap(street=street, actors=dict(zip(self._actor_ids, actors, strict=True)))


def _visibility(
    inside: PointsInView, cells: Camera, actors: PlacedActors, config: ColouringConfig
) -> Visibility:
    """What stood before and around each cell when the image was taken."""
    is_solid = inside.is_actor | (inside.age_s <= config.surface_window_s)
    solid = inside.keep(is_solid.nonzero()[:, 0])
    footprint_px = solid.range_m * config.beam_spacing_rad * cells.fx_px / solid.depth_m
    boxes = [
        (world_from_box, track.size_m * _solid_share(track, config))
        for track, world_from_box in actors.values()
    ]
    return surface_visibility(
        solid.cells_uv,
        solid.depth_m,
        (footprint_px / 2).round().long().clamp(max=2),
        cells,
        Neighbourhood(
            gap_px=max(1, round(config.gap_rad * cells.fx_px)),
            edge_px=max(1, round(config.edge_rad * cells.fx_px)),
            rim_px=max(1, round(config.rim_rad * cells.fx_px)),
            edge_tolerance=config.rims.edge_tolerance,
        ),
        box_far_ends(boxes, cells),
    )


def _solid_share(track: ActorTrack, config: ColouringConfig) -> float:
    """A moving actor's whole box hides, as its colours must not reach the street."""
    return 1.0 if track.is_moving else config.standing_box_share


def _shrunk(
    rgb_u8: UInt8[Tensor, "height width 3"], config: ColouringConfig
) -> UInt8[Tensor, "rows columns 3"]:
    height_px, width_px = rgb_u8.shape[:2]
    if width_px <= config.width_px:
        return rgb_u8
    size = (config.width_px, round(height_px * config.width_px / width_px))
    return torch.from_numpy(cv2.resize(rgb_u8.numpy(), size, interpolation=cv2.INTER_AREA))
