"""Read everything that a fit needs of a scene, each image once.

Only training views and the sweeps of training frames enter; where these tell too little of the
street, points come from the images. All sweeps tell where the car drove (`sweep_registration`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from lidarpainter_models.devices import return_freed_memory
from lidarpainter_models.errors import SceneError
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.colouring import MapColouring, PointSamples
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.lidar.map_building import MAX_RANGE_M, gather_points, views_showing_more
from lidarpainter_models.lidar.sky_masks import sky_mask
from lidarpainter_models.lidar.sparse_depth import FramePoints, sparse_lidar_depth
from lidarpainter_models.lidar.spatiotemporal_calibration import find_faults
from lidarpainter_models.lidar.sweep_registration import register_sweeps
from lidarpainter_models.lidar.whole_vehicles import with_whole_vehicles
from lidarpainter_models.observations.image_points import points_from_images
from lidarpainter_models.observations.image_shrinking import fit_camera, shrink_image
from lidarpainter_models.observations.own_body import on_grid, own_bodies
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.observations.views import SceneObservations, TrainingView
from lidarpainter_models.scenes.camera_faults import CameraFault
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.ego_corrections import EgoCorrections
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.scenes.splits import ViewSplit, sampled_views

LEAST_TOLD = 0.5
"""Below it images complete the LiDAR.

The front camera of a street has 0.90 with 16 beams, 0.73 with 8 and 0.42 with 4. It cannot be
higher: beside and behind the car, where a LiDAR on the roof never looks, PandaSet 002 has 0.63
(left) and 0.51 (back, the car's own body among it) with 64.
"""
CELL_RAD = math.radians(1.0)
"""Angle of a cell of an image, and around a measured point in which it stands for the surface."""
LEAST_ON_ACTOR = 20
"""Fewer points do not tell an actor's shape; its box does."""
_MOST_VIEWS, _MOST_POINTS = 24, 200_000


def share_told(
    street: MapPoints,
    views: Sequence[RecordedView],
    own_bodies: Mapping[str, Bool[np.ndarray, "rows columns"]],
) -> float:
    """Of the cells of the images below the horizon, the part that holds a point of the street.

    Cells of the recording car itself are left out; 1 where no image looks below the horizon. Of
    many points an even part is looked at, of many views, each camera's in order of time, some.
    """
    step = max(1, -(-len(street) // _MOST_POINTS))
    points_world = street.xyz_m[::step]
    told = of_all = 0
    for view in sampled_views(views, _MOST_VIEWS):
        asked, hit = _cells(view, points_world, own_bodies.get(view.camera_name))
        told += int((asked & hit).sum())
        of_all += int(asked.sum())
    return told / of_all if of_all else 1.0


def _cells(
    view: RecordedView,
    points_world: Float[Tensor, "points 3"],
    own_body: Bool[np.ndarray, "rows columns"] | None,
) -> tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """Cells that look below the horizon, and those that hold a point."""
    full = view.camera
    camera = full.resized(
        width_px=max(1, round(full.width_px / (full.fx_px * CELL_RAD))),
        height_px=max(1, round(full.height_px / (full.fy_px * CELL_RAD))),
    )
    down = camera.pixel_directions() @ camera.world_from_camera[2, :3].float()
    asked = down < -CELL_RAD
    if own_body is not None:
        asked &= ~on_grid(own_body, width_px=camera.width_px, height_px=camera.height_px)
    pixels_uv, depth_m = camera.project(points_world)
    column, row = pixels_uv[camera.contains(pixels_uv, depth_m)].long().unbind(-1)
    hit = torch.zeros_like(asked)
    hit[row, column] = True
    return asked, hit


def completed(measured: LidarMap, estimated: LidarMap) -> LidarMap:
    """What was measured, and of what was estimated from images that which lies not beside it.

    Beside means within `CELL_RAD` of a measured point, at the range of the estimate. An actor has
    its returns alone from `LEAST_ON_ACTOR` of them on, else its estimated points alone. The street
    that was estimated must not be empty.
    """
    street = estimated.street
    nearest_m, _ = cKDTree(measured.street.xyz_m.numpy()).query(
        street.xyz_m.numpy(), distance_upper_bound=float(street.range_m.max()) * CELL_RAD
    )
    is_new = torch.from_numpy(nearest_m) > CELL_RAD * street.range_m
    told = {name: own for name, own in measured.actors.items() if len(own) >= LEAST_ON_ACTOR}
    return LidarMap(
        street=MapPoints.concatenate([measured.street, street.keep(is_new)]),
        actors=estimated.actors | told,
    )


SAME_SWEEP_NS = 100_000_000
"""Points measured within this of one another are of one turn of the LiDAR, or of one image."""


def prepare_observations(
    scene: DrivingScene,
    split: ViewSplit,
    config: ObservationConfig,
    *,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> SceneObservations:
    """Prepare what a fit on the split's training views needs, faults of the recording corrected.

    Pixels of the recording car itself are hidden, and colour no point.
    The split's training views give images, its training frames give sweeps. `progress` counts the
    views, and the colours of the map.

    Raises:
        SceneError: the split has no training views, or nothing tells the shape of the street.
    """
    if not split.train:
        raise SceneError(f"the split of {scene.dataset}/{scene.sequence} has no training views")
    observations = _prepared(scene, split, config, progress)
    return_freed_memory()  # images, and samples of colours nine times as large as the colours
    return observations


def _prepared(
    scene: DrivingScene,
    split: ViewSplit,
    config: ObservationConfig,
    progress: Callable[[int, int], None],
) -> SceneObservations:
    """`prepare_observations` of a split that has training views."""
    path = register_sweeps(scene) if config.registers_sweeps else EgoCorrections.none()
    scene, split = scene.corrected(path), replace(split, train=path.of_views(split.train))
    bodies = own_bodies(scene, split.train)
    faults = find_faults(scene, split.train, bodies) if config.corrects_cameras else {}
    taken = [_as_taken(view, faults) for view in split.train]
    hidden = {name: _at_fit_size(body, taken, name, config) for name, body in bodies.items()}
    points, is_estimated = _points(scene, split, taken, bodies)
    colouring = MapColouring(points, scene.tracks, taken)
    colours = {view.key for view in views_showing_more(taken)}
    lidar, views = FramePoints(scene), []

    def with_lidar(recorded: RecordedView, view: RecordedView) -> _WithLidar:
        near = lidar.measured(view.frame_index)
        if is_estimated or len(near) == 0:
            near = torch.cat([near, _nearest_in_time(points.street, view.timestamp_ns)])
        return _WithLidar(recorded, view, near, lidar.at_exposure(view))

    def read(given: _WithLidar) -> tuple[TrainingView, PointSamples | None]:
        view, image = given.view, scene.read_image(given.recorded)
        made = _training_view(given, image, config, hidden=hidden.get(view.camera_name))
        if view.key not in colours:
            return made, None
        return made, colouring.seen_in(view, image, bodies.get(view.camera_name))

    given = map(with_lidar, split.train, taken)
    for done, (made, samples) in enumerate(side_by_side(read, given), start=1):
        views.append(made)
        colouring.add(samples)
        progress(done, len(split.train) + 1)
    gains = colouring.gains()
    lidar_map = colouring.coloured(gains)
    if not is_estimated:
        lidar_map = with_whole_vehicles(lidar_map, scene.tracks)
    progress(len(split.train) + 1, len(split.train) + 1)
    return SceneObservations(
        views=tuple(
            replace(view, exposure_rgb=tuple(exposure))
            for view, exposure in zip(views, (1 / gains).tolist(), strict=True)
        ),
        lidar_map=lidar_map,
        tracks=tuple(track for track in scene.tracks if track.is_moving),
        path=path,
        faults=faults,
        own_bodies=hidden,
        is_estimated=is_estimated,
    )


def _points(
    scene: DrivingScene,
    split: ViewSplit,
    taken: Sequence[RecordedView],
    bodies: Mapping[str, Bool[np.ndarray, "rows columns"]],
) -> tuple[LidarMap, bool]:
    """Points without colours, and whether images gave some of them.

    Raises:
        SceneError: neither sweeps nor images tell anything of the street.
    """
    measured = gather_points(scene, split.train_frames)
    return_freed_memory()  # the sweeps one by one, as large as the map made of them
    is_swept = len(measured.street) > 0
    if is_swept and share_told(measured.street, taken, bodies) >= LEAST_TOLD:
        return measured, False
    estimated = points_from_images(scene, taken, bodies)
    if len(estimated.street) > 0:
        return completed(measured, estimated), True
    if not is_swept:
        raise SceneError(
            f"{scene.dataset}/{scene.sequence}: no LiDAR point within {MAX_RANGE_M:g} m, and no "
            "depth in the images either: they show nothing that stands still from two places"
        )
    return measured, False


def _as_taken(view: RecordedView, faults: Mapping[str, CameraFault]) -> RecordedView:
    """The view where and when its image was really taken."""
    fault = faults.get(view.camera_name)
    if fault is None:
        return view
    camera = fault.corrected(view.camera)
    return replace(view, camera=camera, timestamp_ns=camera.taken_ns(view.timestamp_ns))


def _at_fit_size(
    body: Bool[np.ndarray, "rows columns"],
    views: Sequence[RecordedView],
    camera_name: str,
    config: ObservationConfig,
) -> Bool[Tensor, "height width"]:
    """A camera's own body on the grid of its training views."""
    camera = fit_camera(next(v for v in views if v.camera_name == camera_name), config)
    return on_grid(body, width_px=camera.width_px, height_px=camera.height_px)


def _nearest_in_time(street: MapPoints, timestamp_ns: int) -> Float[Tensor, "near 3"]:
    """The points measured at most so long before or after that time as any must be."""
    age_ns = (street.timestamp_ns - timestamp_ns).abs()
    return street.xyz_m[age_ns <= age_ns.min() + SAME_SWEEP_NS]


class _WithLidar(NamedTuple):
    """A view and what LiDAR tells of it, in the world."""

    recorded: RecordedView
    view: RecordedView
    """Where and when its image was really taken."""
    near: Float[Tensor, "points 3"]
    """Points measured or estimated about then: no sky is where they are."""
    exposed: Float[Tensor, "placed 3"]
    """Its frame's LiDAR points, moving actors where they are in the image."""


def _training_view(
    given: _WithLidar,
    image: UInt8[Tensor, "recorded_height recorded_width 3"],
    config: ObservationConfig,
    *,
    hidden: Bool[Tensor, "height width"] | None,
) -> TrainingView:
    """A recorded image at fit size, with its sky and its frame's LiDAR depth."""
    camera = fit_camera(given.view, config)
    rgb_u8 = shrink_image(image, width_px=camera.width_px, height_px=camera.height_px)
    is_sky = sky_mask(rgb_u8, given.near, camera)
    return TrainingView(
        key=given.view.key,
        camera=camera,
        timestamp_ns=given.recorded.timestamp_ns,
        rgb_u8=rgb_u8,
        sky_mask=is_sky if hidden is None else is_sky & ~hidden,
        lidar_depth_m=sparse_lidar_depth(given.exposed, camera),
        hidden=hidden,
    )
