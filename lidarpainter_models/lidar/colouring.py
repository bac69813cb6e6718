"""Give LiDAR points the colours that recorded images saw, and only those images.

Points are projected into every given image that is not too far in time; those of moving actors
stand where their box is at the exposure. A sample counts where nothing known hides the point
(`point_visibility`), most where the image was taken near in time to the point, fine enough, and
away from depth edges, where a small error of pose or calibration would take the colour of the other
side. The best few samples are brought to one exposure and combined robustly.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.colour_sampling import (
    BestSamples,
    combine_samples,
    insert_samples,
    sample_levels,
    steps_inside,
)
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.exposure_matching import match_exposure
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.lidar.point_visibility import (
    EDGE_TOLERANCE,
    Visibility,
    box_far_ends,
    surface_visibility,
    visible_points,
)
from lidarpainter_models.lidar.points_in_view import (
    MOST_AGE_NS,
    Body,
    CellGrid,
    PlacedActors,
    PointsInView,
    place_actors,
    points_in_view,
)
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.scenes.tracks import ActorTrack

BEHIND_EDGE_WEIGHT = 0.2  # weight of a sample beside a nearer surface
RIM_WEIGHT = 0.4  # weight of a sample on the rim of a surface
FOREIGN_LIKENESS = 30.0
"""A rim's colour is foreign when nearer than this (RGB distance of 255) to that beyond..."""
FOREIGN_CONTRAST = 60.0
"""... and further than this from that inside."""
INNER_REACH = 6  # how many cells away the inner part of a surface is looked for from its rim


class ImageLevels:
    """An image at three sizes, and at which of them each point is sampled."""

    def __init__(
        self, image: UInt8[Tensor, "height width 3"], footprint_px: Float[Tensor, " points"]
    ) -> None:
        height_px, width_px = image.shape[:2]
        self._images = [image.numpy()]
        for shrink in (2, 4):
            size = (max(1, width_px // shrink), max(1, height_px // shrink))
            self._images.append(cv2.resize(image.numpy(), size, interpolation=cv2.INTER_AREA))
        self._level = (footprint_px >= 1.5).int() + (footprint_px >= 3.0).int()

    def sample(
        self, pixels_uv: Float[Tensor, "rows 2"], rows: Int[Tensor, " rows"] | None = None
    ) -> UInt8[Tensor, "rows 3"]:
        """Colours at positions; `rows` says which points they belong to if not all."""
        level = self._level if rows is None else self._level[rows]
        return torch.from_numpy(
            sample_levels(pixels_uv.contiguous().numpy(), level.numpy(), *self._images)
        )


def rim_samples(
    levels: ImageLevels, points: PointsInView, visibility: Visibility, grid: CellGrid
) -> tuple[UInt8[Tensor, "points 3"], Float[Tensor, " points"]]:
    """Colours of visible points, and how far the place of each is to be trusted.

    On the rim of a surface a small error of pose takes the colour of what is beside it. Where the
    colour there is more like that beyond the rim than like that of the nearest inner cell, the
    inner one is taken. `points` are those that nothing hides; `grid` is that of the visibility.
    """
    rgb = levels.sample(points.pixels_uv)
    trust = torch.ones_like(points.depth_m)
    cells_uv = grid.cells_of(points.pixels_uv)
    column, row = cells_uv.unbind(-1)
    nearest_m, furthest_m = visibility.nearest_m[row, column], visibility.furthest_m[row, column]
    is_behind = nearest_m < points.depth_m * (1 - EDGE_TOLERANCE)
    is_before = furthest_m > points.depth_m * (1 + EDGE_TOLERANCE)
    trust[is_behind] = BEHIND_EDGE_WEIGHT
    on_rim = is_before.nonzero()[:, 0]
    trust[on_rim] *= RIM_WEIGHT
    steps, has_inner = map(
        torch.from_numpy,
        steps_inside(
            cells_uv[on_rim].numpy(),
            points.depth_m[on_rim].numpy(),
            visibility.inner_m.numpy(),
            INNER_REACH,
            EDGE_TOLERANCE,
        ),
    )
    moved, steps_px = on_rim[has_inner], steps[has_inner] / grid.cells_per_pixel
    own = rgb[moved].float()
    inner = levels.sample(points.pixels_uv[moved] + steps_px, moved)
    beyond = levels.sample(points.pixels_uv[moved] - steps_px, moved)
    to_inner, to_beyond = (own - inner.float()).norm(dim=-1), (own - beyond.float()).norm(dim=-1)
    is_foreign = (to_beyond < FOREIGN_LIKENESS) & (to_inner > FOREIGN_CONTRAST)
    rgb[moved[is_foreign]] = inner[is_foreign]
    return rgb, trust


_FINE_ENOUGH_PX = 2.0
"""An image with more pixels than this across a point's footprint is no better for it."""
FOOTPRINT_RAD = 0.002  # angle of the surface patch that a point stands for, as seen from the LiDAR
RECENCY_S = 0.2  # an image this much before or after the point weighs half
GRID_RAD = 0.002  # angle of a cell of the grid on which occlusion is judged
BEAM_SPACING_RAD = 0.004
"""Angle between neighbouring returns: the width of a disc that closes a surface."""
SURFACE_WINDOW_S = 0.5  # points measured this near in time to an image hide others in it
_SURFACE_AGE_NS = round(1.1e9 * SURFACE_WINDOW_S)  # a little more: ages are rounded
STANDING_BOX_SHARE = 0.85
"""Share of each side of a standing actor's box that hides what is behind it."""
WIDTH_PX = 960  # images are shrunk to this width before they are sampled


class PointSamples(NamedTuple):
    """Colours that one image gives points of the map."""

    view_number: int
    rows: Int[np.ndarray, " points"]
    weight: Float[np.ndarray, " points"]
    rgb: UInt8[np.ndarray, "points 3"]


class MapColouring:
    """Colours the points of a map, one image after another."""

    def __init__(
        self,
        lidar_map: LidarMap,
        tracks: Sequence[ActorTrack],
        views: Sequence[RecordedView],
        *,
        most_age_ns: int | None = MOST_AGE_NS,
    ) -> None:
        """Take the points, all actors of the scene, and the views whose images will be added.

        Images further in time from points of the street than `most_age_ns` are not asked for them.

        Raises:
            SceneError: the points of an actor that has no track.
        """
        known = {track.actor_id: track for track in tracks}
        unknown = sorted(set(lidar_map.actors) - set(known))
        if unknown:
            raise SceneError(f"points of actors without a track: {', '.join(unknown)}")
        self._actor_ids = list(lidar_map.actors)
        actors = [Body(known[name], points) for name, points in lidar_map.actors.items()]
        self._bodies = [Body(None, lidar_map.street, most_age_ns), *actors]
        self._surfaces = [Body(None, lidar_map.street, _SURFACE_AGE_NS), *actors]
        num_points = sum(len(body.points) for body in self._bodies)
        self._samples = BestSamples.none_yet(num_points, len(views))
        self._view_numbers = {view.key: number for number, view in enumerate(views)}
        self._placed = place_actors(views, tracks)

    def seen_in(
        self,
        view: RecordedView,
        image: UInt8[Tensor, "height width 3"],
        hidden: Bool[np.ndarray, "rows columns"] | None = None,
    ) -> PointSamples:
        """What the recorded image of one of the views gives; nothing of hidden pixels.

        Nothing is changed, so that images may be looked at beside each other. `hidden` is on any
        grid over the image.
        """
        actors = self._placed[view.key]
        image = _shrunk(image)
        camera = view.camera.resized(width_px=image.shape[1], height_px=image.shape[0])
        grid = CellGrid.over(camera, GRID_RAD)
        visibility = self._visibility(view, grid, camera)
        pieces = [PointsInView.none()]
        for inside in points_in_view(self._bodies, camera, view.timestamp_ns, actors):
            asked = inside.keep(self._may_gain(inside, camera))
            is_shown = _is_shown(asked, visibility, grid, hidden)
            pieces.append(asked.keep(is_shown.nonzero()[:, 0]))
        seen = PointsInView.joined(pieces)
        levels = ImageLevels(image, _footprint_px(seen, camera))
        rgb, trust = rim_samples(levels, seen, visibility, grid)
        weight = _weight(trust, seen, camera)
        number = self._view_numbers[view.key]
        return PointSamples(number, seen.rows.numpy(), weight.numpy(), rgb.numpy())

    def _visibility(self, view: RecordedView, grid: CellGrid, camera: Camera) -> Visibility:
        """What stood before and around each cell when the image was taken."""
        actors = self._placed[view.key]
        near = points_in_view(self._surfaces, camera, view.timestamp_ns, actors)
        solid = [inside.keep(_is_solid(inside).nonzero()[:, 0]) for inside in near]
        return _visibility(PointsInView.joined([PointsInView.none(), *solid]), grid, actors)

    def _may_gain(self, inside: PointsInView, camera: Camera) -> Int[Tensor, " points"]:
        """Of the points in an image, those that have no better samples from others already."""
        least = torch.from_numpy(self._samples.weight[:, -1])[inside.rows]
        return (_weight(torch.ones(len(inside)), inside, camera) > least).nonzero()[:, 0]

    def add(self, samples: PointSamples | None) -> None:
        """Keep the best of what one of the views gave."""
        if samples is None:
            return
        insert_samples(
            self._samples, samples.rows, samples.weight, samples.rgb, samples.view_number
        )

    def add_recorded(self, scene: DrivingScene, views: Sequence[RecordedView]) -> None:
        """Take samples from the images of some of the views."""

        def seen(view: RecordedView) -> PointSamples:
            return self.seen_in(view, scene.read_image(view))

        for samples in side_by_side(seen, views):
            self.add(samples)

    def gains(self) -> Float[np.ndarray, "views 3"]:
        """What brings each view, in their order, to the exposure of the first view's camera."""
        if not self._view_numbers:
            return np.ones((1, 3), np.float32)
        cameras = [camera_name for _, camera_name in self._view_numbers]
        order = list(dict.fromkeys(cameras))
        return match_exposure(self._samples, np.array([order.index(name) for name in cameras]))

    def coloured(self, gains: Float[np.ndarray, "views 3"]) -> LidarMap:
        """The map with the colours that the images added gave it, brought to one exposure.

        `gains` are those that `gains` found. Points that no image showed keep `has_colour` false.
        """
        rgb, has_colour = map(torch.from_numpy, combine_samples(self._samples, gains))
        sizes = [len(body.points) for body in self._bodies]
        street, *actors = (
            replace(body.points, rgb_u8=own_rgb.clone(), has_colour=own_has.clone())
            for body, own_rgb, own_has in zip(
                self._bodies, rgb.split(sizes), has_colour.split(sizes), strict=True
            )
        )
        return LidarMap(street=street, actors=dict(zip(self._actor_ids, actors, strict=True)))


def _footprint_px(points: PointsInView, camera: Camera) -> Float[Tensor, " points"]:
    """How many pixels the patch that each point stands for is wide."""
    return points.range_m * FOOTPRINT_RAD * camera.fx_px / points.depth_m


def _weight(
    trust: Float[Tensor, " points"], points: PointsInView, camera: Camera
) -> Float[Tensor, " points"]:
    """How much a sample counts among those of its point."""
    weight = trust / (1 + (points.age_s / RECENCY_S) ** 2)
    return weight * _footprint_px(points, camera).clamp(max=_FINE_ENOUGH_PX) ** 2


def _is_solid(points: PointsInView) -> Bool[Tensor, " points"]:
    """Which points hide others: where the street was a while ago something else may be by now."""
    return points.is_actor | (points.age_s <= SURFACE_WINDOW_S)


def _is_shown(
    points: PointsInView,
    visibility: Visibility,
    grid: CellGrid,
    hidden: Bool[np.ndarray, "rows columns"] | None,
) -> Bool[Tensor, " points"]:
    """Whether nothing known stands before each point, the recording car's own body neither."""
    cells_uv = grid.cells_of(points.pixels_uv)
    is_shown = visible_points(cells_uv, points.depth_m, visibility)
    if hidden is not None:
        size = torch.tensor([grid.camera.width_px, grid.camera.height_px])
        column, row = (cells_uv * torch.tensor(hidden.shape[::-1]) // size).unbind(-1)
        is_shown &= ~torch.from_numpy(hidden)[row, column]
    return is_shown


def _visibility(solid: PointsInView, grid: CellGrid, actors: PlacedActors) -> Visibility:
    """What these points and boxes let each cell show."""
    cells = grid.camera
    footprint_px = solid.range_m * BEAM_SPACING_RAD * cells.fx_px / solid.depth_m
    boxes = [
        (world_from_box, track.size_m * _solid_share(track))
        for track, world_from_box in actors.values()
    ]
    return surface_visibility(
        grid.cells_of(solid.pixels_uv),
        solid.depth_m,
        (footprint_px / 2).round().long().clamp(max=2),
        cells,
        box_far_ends(boxes, cells),
    )


def _solid_share(track: ActorTrack) -> float:
    """A moving actor's whole box hides, as its colours must not reach the street."""
    return 1.0 if track.is_moving else STANDING_BOX_SHARE


def _shrunk(rgb_u8: UInt8[Tensor, "height width 3"]) -> UInt8[Tensor, "rows columns 3"]:
    height_px, width_px = rgb_u8.shape[:2]
    if width_px <= WIDTH_PX:
        return rgb_u8
    size = (WIDTH_PX, round(height_px * WIDTH_PX / width_px))
    return torch.from_numpy(cv2.resize(rgb_u8.numpy(), size, interpolation=cv2.INTER_AREA))
