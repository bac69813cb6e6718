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
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.actor_separation import poses_at
from lidarpainter_models.lidar.colour_sampling import (
    SLOTS,
    combine_samples,
    insert_samples,
    project_inside,
)
from lidarpainter_models.lidar.exposure_matching import match_exposure
from lidarpainter_models.lidar.map_points import MapPoints
from lidarpainter_models.lidar.point_visibility import (
    Neighbourhood,
    Visibility,
    box_far_ends,
    surface_visibility,
    visible_points,
)
from lidarpainter_models.lidar.rim_colours import ImageLevels, RimConfig, rim_samples
from lidarpainter_models.scenes.driving_scene import DrivingScene
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


def colour_map(
    scene: DrivingScene,
    street: MapPoints,
    actors: dict[str, MapPoints],
    views: Sequence[RecordedView],
    config: ColouringConfig,
) -> tuple[MapPoints, dict[str, MapPoints]]:
    """The same points with the colours that the views give them.

    Colours have the exposure of the first view's camera. Points that no view saw keep
    `has_colour` false.

    Raises:
        SceneError: the points of an actor that has no track.
    """
    tracks = {track.actor_id: track for track in scene.tracks}
    unknown = sorted(set(actors) - set(tracks))
    if unknown:
        raise SceneError(f"{scene.path}: no track for the actors {', '.join(unknown)}")
    bodies = [_Body(None, street), *(_Body(tracks[name], actors[name]) for name in actors)]
    samples = _Samples(sum(len(body.points) for body in bodies))
    camera_names = list(dict.fromkeys(view.camera_name for view in views))
    for number, (view, actors_then) in enumerate(
        zip(views, _actors_at(views, scene.tracks), strict=True)
    ):
        image = _shrunk(scene.read_image(view), config)
        _sample_view(image, view, number, bodies, actors_then, samples, config)
    if views:
        view_camera = np.array([camera_names.index(view.camera_name) for view in views])
        gains = match_exposure(samples.weight, samples.rgb, samples.view, view_camera)
    else:
        gains = np.ones((1, 3), np.float32)
    rgb, has_colour = combine_samples(samples.weight, samples.rgb, samples.view, gains)
    coloured, start = [], 0
    for body in bodies:
        rows = slice(start, start + len(body.points))
        coloured.append(
            replace(
                body.points,
                rgb_u8=torch.from_numpy(rgb[rows].copy()),
                has_colour=torch.from_numpy(has_colour[rows].copy()),
            )
        )
        start = rows.stop
    return coloured[0], dict(zip(actors, coloured[1:], strict=True))


_ActorsThen = dict[str, tuple[ActorTrack, Tensor]]
"""Tracks by actor id, with `world_from_box` at one time."""


@dataclass(frozen=True, eq=False)
class _Body:
    """The street (no track) or an actor."""

    track: ActorTrack | None
    points: MapPoints


class _Samples:
    """The best samples of every point, heaviest first."""

    def __init__(self, num_points: int) -> None:
        self.weight = np.zeros((num_points, SLOTS), np.float32)
        self.rgb = np.zeros((num_points, SLOTS, 3), np.uint8)
        self.view = np.zeros((num_points, SLOTS), np.int16)


@dataclass(frozen=True, kw_only=True, eq=False)
class _InView:
    """Points of all bodies that fall into an image."""

    rows: Int[Tensor, " points"]
    """Position among the points of all bodies."""
    pixels_uv: Float[Tensor, "points 2"]
    depth_m: Float[Tensor, " points"]
    range_m: Float[Tensor, " points"]
    age_s: Float[Tensor, " points"]
    """Time between the image and the point, >= 0."""
    is_actor: Bool[Tensor, " points"]


def _sample_view(
    image: UInt8[Tensor, "height width 3"],
    view: RecordedView,
    number: int,
    bodies: Sequence[_Body],
    actors_then: _ActorsThen,
    samples: _Samples,
    config: ColouringConfig,
) -> None:
    """Take one image's samples into account."""
    height_px, width_px = image.shape[:2]
    camera = view.camera.resized(width_px=width_px, height_px=height_px)
    seen = _project(bodies, camera, view.timestamp_ns, actors_then, config)
    if len(seen.rows) == 0:
        return
    cell_px = max(1.0, config.grid_rad * camera.fx_px)
    grid = camera.resized(
        width_px=max(1, round(width_px / cell_px)), height_px=max(1, round(height_px / cell_px))
    )
    scale = torch.tensor([grid.width_px / width_px, grid.height_px / height_px])
    cells_uv = (seen.pixels_uv * scale).long()
    cells_uv[:, 0].clamp_(max=grid.width_px - 1)
    cells_uv[:, 1].clamp_(max=grid.height_px - 1)
    visibility = _visibility(seen, cells_uv, grid, actors_then, config)
    visible = visible_points(cells_uv, seen.depth_m, visibility, tolerance=config.hidden_tolerance)
    kept = visible.nonzero()[:, 0]
    footprint_px = (seen.range_m * config.footprint_rad * camera.fx_px / seen.depth_m)[kept]
    levels = ImageLevels(image, footprint_px)
    rgb, trust = rim_samples(
        levels,
        seen.pixels_uv[kept],
        cells_uv[kept],
        seen.depth_m[kept],
        visibility,
        scale,
        config.rims,
    )
    weight = trust / (1 + (seen.age_s[kept] / config.recency_s) ** 2)
    weight *= footprint_px.clamp(max=_FINE_ENOUGH_PX) ** 2
    insert_samples(
        *(seen.rows[kept].numpy(), weight.numpy(), rgb.numpy(), number),
        *(samples.weight, samples.rgb, samples.view),
    )


def _actors_at(views: Sequence[RecordedView], tracks: Sequence[ActorTrack]) -> list[_ActorsThen]:
    """For each view the tracks present at its exposure, with `world_from_box` then."""
    present: list[_ActorsThen] = [{} for _ in views]
    if not views:
        return present
    times_ns = torch.tensor([view.timestamp_ns for view in views])
    for track in tracks:
        for number, pose in enumerate(poses_at(track, times_ns)):
            if track.is_present(views[number].timestamp_ns):
                present[number][track.actor_id] = (track, pose)
    return present


def _project(
    bodies: Sequence[_Body],
    camera: Camera,
    timestamp_ns: int,
    actors_then: _ActorsThen,
    config: ColouringConfig,
) -> _InView:
    """Where the points of all bodies stand in an image taken at a time."""
    lens = torch.tensor(
        [[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]],
        dtype=torch.float64,
    )
    parts, start = [], 0
    for body in bodies:
        first, start = start, start + len(body.points)
        camera_from_points = camera.camera_from_world
        if body.track is not None:
            if body.track.actor_id not in actors_then:
                continue
            _, world_from_box = actors_then[body.track.actor_id]
            camera_from_points = camera_from_points @ world_from_box
        pixels_from_points = (lens @ camera_from_points[:3]).numpy()
        rows, pixels_uv, depth_m = map(
            torch.from_numpy,
            project_inside(
                body.points.xyz_m.contiguous().numpy(),
                *(pixels_from_points, camera.width_px, camera.height_px, config.near_m),
            ),
        )
        age_ns = (body.points.timestamp_ns[rows] - timestamp_ns).abs()
        is_actor = torch.full_like(rows, body.track is not None, dtype=torch.bool)
        columns = (pixels_uv, depth_m, body.points.range_m[rows], age_ns.float() * 1e-9, is_actor)
        parts.append((rows + first, *columns))
    rows, pixels_uv, depth_m, range_m, age_s, is_actor = map(torch.cat, zip(*parts, strict=True))
    return _InView(
        rows=rows,
        pixels_uv=pixels_uv,
        depth_m=depth_m,
        range_m=range_m,
        age_s=age_s,
        is_actor=is_actor,
    )


def _visibility(
    seen: _InView,
    cells_uv: Int[Tensor, "points 2"],
    grid: Camera,
    actors_then: _ActorsThen,
    config: ColouringConfig,
) -> Visibility:
    """What stands before and around each cell when the image was taken."""
    solid = (seen.is_actor | (seen.age_s <= config.surface_window_s)).nonzero()[:, 0]
    footprint_px = seen.range_m * config.beam_spacing_rad * grid.fx_px / seen.depth_m
    boxes = [
        (world_from_box, track.size_m * _solid_share(track, config))
        for track, world_from_box in actors_then.values()
    ]
    return surface_visibility(
        cells_uv[solid],
        seen.depth_m[solid],
        (footprint_px[solid] / 2).round().long().clamp(max=2),
        grid,
        Neighbourhood(
            gap_px=max(1, round(config.gap_rad * grid.fx_px)),
            edge_px=max(1, round(config.edge_rad * grid.fx_px)),
            rim_px=max(1, round(config.rim_rad * grid.fx_px)),
            edge_tolerance=config.rims.edge_tolerance,
        ),
        box_far_ends(boxes, grid),
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
