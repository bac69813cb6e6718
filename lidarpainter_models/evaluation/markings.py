"""Whether painted lines stand where the road has them, on the path and beside it.

No image was taken beside the path, but LiDAR tells where the paint is: in logs whose points are
labelled, a rendered pixel on a point of a marking should be brighter than the road around it. The
figure is the area under the ROC curve of that brightness between points of markings and points of
road within `BESIDE_M` of one: 1 where every point of paint is brighter than any of road, 0.5 where
the lines are gone. Points have no place in training images, so a line that lies across the road
instead of along it costs as much as one that is missing. Labels are wider than paint and stand on
worn paint as well: `confirmed_auc` takes those points alone that return clearly more light than the
road. Where no point is labelled, ground that returns more light than what lies around it stands in
for paint, and is named so. A synthetic street
knows its paint exactly: there the pixels of lines are compared with their true colours as well.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from scipy.stats import rankdata
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.scene_evaluation import known_street
from lidarpainter_models.evaluation.score_tables import MARKINGS, Scores
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.kernels.point_splat import splat_points
from lidarpainter_models.lidar.ground_heights import GroundHeights
from lidarpainter_models.metrics.depth import OCCLUDER_RADIUS_PX, OCCLUDER_TOLERANCE
from lidarpainter_models.metrics.images import psnr_from_error, squared_error
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView

NEAR_M, FAR_M = 4.0, 30.0
"""Points so far ahead are judged: nearer ones lie below the image, farther ones in few pixels."""
BESIDE_M = 1.2
"""Road so near to a marking is held against it."""
MARKING_WORDS = ("marking", "marker")
"""What names of point classes of paint hold."""
ROAD_NAMES = ("road", "driveable_surface", "flat.driveable_surface")
"""Names of point classes of the road around it."""
NEIGHBOURS = 48
"""Points of the road around a point are looked at up to so many, the nearest within `BESIDE_M`."""
CONFIRMED = 2.0
"""Times the median intensity of the road around markings, from which on a return confirms paint."""
GROUND_M = 0.15
"""Above the ground, what is still ground, where no point is labelled."""
LEAST_BRIGHTER = 4.0
"""Mean absolute deviations by which paint returns more light than the ground around it."""
AHEAD_COS = 0.8
"""Cameras are judged whose optical axis lies within 37 degrees of where the car drives."""
LEAST_POINTS = 50
"""A figure of fewer points of paint than that is none."""
FEW_POINTS = f"fewer than {LEAST_POINTS} points of markings are in sight"
IMAGE = "image"
"""The recorded image in place of a render: what the measure can reach."""
_LUMA = torch.tensor([0.299, 0.587, 0.114])


@dataclass(frozen=True, eq=False, kw_only=True)
class RoadPoints:
    """Points of the road of one sweep, in the world: paint, and road within reach of paint."""

    xyz_m: Float[Tensor, "points 3"]
    is_paint: Bool[Tensor, " points"]
    is_confirmed: Bool[Tensor, " points"]
    """Paint that returns `CONFIRMED` times the light of the road, or more."""
    all_m: Float[Tensor, "all 3"]
    """Every point of the sweep: what may stand before the road."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Judged:
    """Brightness over the road around, of points that a view shows."""

    paint: Float[np.ndarray, " paint"]
    confirmed: Float[np.ndarray, " confirmed"]
    road: Float[np.ndarray, " road"]


def markings_scores(
    held_out: HeldOut,
    shown: ShownScene,
    shifts: tuple[Shift, ...],
    progress: Callable[[int, int], None],
) -> Scores:
    """Judge the markings that cameras looking ahead show at held-out times.

    Args:
        held_out: Views that no fit saw; their frames' sweeps tell where the paint is.
        shown: The fitted scene, as it is or painted at view time.
        shifts: How far beside the path it is looked at, beside the path itself.
        progress: Is told how many renders of how many are done.

    Returns:
        Under `markings`, by trajectory (`image`, `recorded`, then the shifts): `auc` over all
        points of markings and `confirmed_auc` over those whose returns confirm them (with a
        `_reason` where one is None), numbers of points, and `told_by`: `labels` or `intensity`.
        On a synthetic street also `paint_psnr` in dB and `paint_edge_error` in [0, 1], over the
        pixels of lines and those beside them.

    Raises:
        ConfigError: no held-out view of a frame with a sweep looks ahead.
    """
    scene, fitted = held_out.scene, shown.scene
    views = views_ahead(scene, held_out.test_views)
    moved = scene.corrected(fitted.cameras.path)
    told_by = "labels" if _paint_classes(scene) else "intensity"
    names = [IMAGE, *(shift.name for shift in (Shift(), *shifts))]
    points: dict[str, list[_Judged]] = {name: [] for name in names}
    exact: dict[str, list[tuple[float, float, int]]] = {name: [] for name in names}
    renders = {view.camera_name: shown.renderer(view.camera_name) for view in views}
    road: dict[int, RoadPoints] = {}
    for done, view in enumerate(views):
        if view.frame_index not in road:
            road = {view.frame_index: road_points(moved, view.frame_index)}
        own, render = road[view.frame_index], renders[view.camera_name]
        camera = held_out.camera_of(fitted, view, "interpolated")
        points[IMAGE].append(_brightness(held_out.image_of(view), camera, own))
        for number, shift in enumerate((Shift(), *shifts), start=1):
            camera = held_out.shifted_camera(fitted, view, shift)
            image = render(camera, view.timestamp_ns).clamp(0, 1).cpu()
            points[shift.name].append(_brightness(image, camera, own))
            exact[shift.name] += _against_truth(scene, camera, view.timestamp_ns, image)
            progress(done * (1 + len(shifts)) + number, len(views) * (1 + len(shifts)))
    found = {
        name: {**_of_points(points[name]), **_of_pixels(exact[name]), "told_by": told_by}
        for name in names
    }
    return {MARKINGS: found}


def views_ahead(scene: DrivingScene, held_out: Sequence[RecordedView]) -> list[RecordedView]:
    """The held-out views that markings are judged on: they look ahead, a sweep tells of the road.

    Raises:
        ConfigError: there is none.
    """
    views = [view for view in held_out if _looks_ahead(scene, view)]
    if not views:
        raise ConfigError(
            f"{scene.path.name}: no held-out view with a sweep looks ahead, which markings need"
        )
    return views


def road_points(scene: DrivingScene, frame_index: int) -> RoadPoints:
    """The paint, and the road around it, that the sweeps of a frame have met."""
    sweeps = scene.sweeps_of(frame_index)
    xyz_m = torch.cat([scene.read_column(sweep, "xyz_m") for sweep in sweeps])
    intensity = torch.cat([scene.read_column(sweep, "intensity").float() for sweep in sweeps])
    semantics, paint = scene.read_semantics(frame_index), _paint_classes(scene)
    if semantics is not None and paint:
        named = scene.semantic_classes.items()
        road = [number for number, name in named if name.lower() in ROAD_NAMES]
        is_paint = torch.isin(semantics.long(), torch.tensor(paint))
        is_road = torch.isin(semantics.long(), torch.tensor(road))
    else:
        is_paint, is_road = _by_intensity(xyz_m, intensity)
    rows, beside = is_paint.nonzero()[:, 0], is_road.nonzero()[:, 0]
    if len(rows) and len(beside):
        tree = cKDTree(xyz_m[rows].numpy())
        reach_m, _ = tree.query(xyz_m[beside].numpy(), distance_upper_bound=BESIDE_M)
        beside = beside[torch.from_numpy(np.isfinite(reach_m))]
    both = torch.cat([rows, beside])
    of_paint = torch.arange(len(both)) < len(rows)
    usual = intensity[beside].median() if len(beside) else torch.inf
    return RoadPoints(
        xyz_m=xyz_m[both],
        is_paint=of_paint,
        is_confirmed=of_paint & (intensity[both] >= CONFIRMED * usual),
        all_m=xyz_m,
    )


def area_under_curve(
    higher: Float[np.ndarray, " first"], lower: Float[np.ndarray, " second"]
) -> float:
    """Chance that one of the first is greater than one of the second, ties counting half."""
    ranks = rankdata(np.concatenate([higher, lower]))[: len(higher)]
    return float((ranks.mean() - (len(higher) + 1) / 2) / len(lower))


def _looks_ahead(scene: DrivingScene, view: RecordedView) -> bool:
    ego = scene.world_from_ego[scene.frame_position(view.frame_index)]
    along = float(view.camera.world_from_camera[:3, 2].double() @ ego[:3, 0].double())
    return along > AHEAD_COS and bool(scene.sweeps_of(view.frame_index))


def _paint_classes(scene: DrivingScene) -> list[int]:
    """Numbers of the point classes of paint on the road."""
    named = scene.semantic_classes.items()
    return [number for number, name in named if any(word in name.lower() for word in MARKING_WORDS)]


def _by_intensity(
    xyz_m: Float[Tensor, "points 3"], intensity: Float[Tensor, " points"]
) -> tuple[Bool[Tensor, " points"], Bool[Tensor, " points"]]:
    """Which ground returns far more light than the ground around it, and which is like it."""
    above_m = xyz_m[:, 2] - GroundHeights(xyz_m).at(xyz_m[:, :2])
    ground = (above_m.abs() < GROUND_M).nonzero()[:, 0]
    is_paint, is_road = torch.zeros(2, len(xyz_m), dtype=torch.bool)
    if len(ground):
        light, own_m = intensity[ground].numpy(), xyz_m[ground].numpy()
        over = light - _median_around(own_m, light, own_m)
        spread = np.nanmedian(np.abs(over)) + 1e-6
        is_paint[ground] = torch.from_numpy(over > LEAST_BRIGHTER * spread)
        is_road[ground] = torch.from_numpy(np.abs(over) <= spread)
    return is_paint, is_road


def _median_around(
    known_m: Float[np.ndarray, "known 3"],
    light: Float[np.ndarray, " known"],
    places_m: Float[np.ndarray, "places 3"],
) -> Float[np.ndarray, " places"]:
    """The middle brightness of the nearest points within `BESIDE_M`; NaN where there are none."""
    _, index = cKDTree(known_m).query(
        places_m, k=[*range(1, NEIGHBOURS + 1)], distance_upper_bound=BESIDE_M
    )
    around = np.append(light, np.nan)[index]
    is_known = np.isfinite(around[:, 0])
    found = np.full(len(places_m), np.nan, np.float32)
    found[is_known] = np.nanmedian(around[is_known], axis=1)
    return found


def _brightness(
    image: Float[Tensor, "height width 3"], camera: Camera, road: RoadPoints
) -> _Judged:
    """How much brighter the points in sight are than the middle of the road beside each."""
    seen = _in_sight(camera, road)
    is_paint, xyz_m = road.is_paint[seen].numpy(), road.xyz_m[seen].numpy()
    if not is_paint.any() or is_paint.all():
        return _Judged(paint=np.zeros(0), confirmed=np.zeros(0), road=np.zeros(0))
    uv = camera.project(road.xyz_m[seen].float())[0].long()
    light = (image[uv[:, 1], uv[:, 0]] @ _LUMA).numpy()
    over = light - _median_around(xyz_m[~is_paint], light[~is_paint], xyz_m)
    is_known = np.isfinite(over)
    is_confirmed = road.is_confirmed[seen].numpy()
    return _Judged(
        paint=over[is_paint & is_known],
        confirmed=over[is_confirmed & is_known],
        road=over[~is_paint & is_known],
    )


def _in_sight(camera: Camera, road: RoadPoints) -> Bool[Tensor, " points"]:
    """Which points of the road a camera sees from `NEAR_M` to `FAR_M`, hidden by no return."""
    uv, depth_m = camera.project(road.all_m.float())
    inside = camera.contains(uv, depth_m)
    before_m = depth_m[inside].contiguous()
    front = splat_points(
        uv[inside].floor().to(torch.int32),
        before_m,
        height_px=camera.height_px,
        width_px=camera.width_px,
        radius_px=OCCLUDER_RADIUS_PX,
    )
    uv, depth_m = camera.project(road.xyz_m.float())
    seen = camera.contains(uv, depth_m) & (depth_m > NEAR_M) & (depth_m < FAR_M)
    pixel = uv[seen].long()
    nearest = front[pixel[:, 1], pixel[:, 0]].long()
    is_free = depth_m[seen] <= before_m[nearest.clamp(min=0)] * (1 + OCCLUDER_TOLERANCE)
    seen[seen.clone()] = is_free | (nearest < 0)
    return seen


def _against_truth(
    scene: DrivingScene, camera: Camera, timestamp_ns: int, image: Float[Tensor, "height width 3"]
) -> list[tuple[float, float, int]]:
    """Summed squared error, summed edge error and number of pixels of lines; none in a log."""
    street = known_street(scene)
    if street is None:
        return []
    true = street.render(camera, timestamp_ns)
    paint = np.isin(true.semantics.numpy(), _paint_classes(scene)).astype(np.uint8)
    is_line = torch.from_numpy(cv2.dilate(paint, np.ones((3, 3), np.uint8)).astype(bool))
    wrong = squared_error(image, true.rgb)[is_line].double()
    edges = (_slope(image) - _slope(true.rgb))[is_line].abs().double()
    return [(float(wrong.sum()), float(edges.sum()), int(is_line.sum()))]


def _slope(image: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width"]:
    """How fast brightness changes, a pixel."""
    light = (image @ _LUMA).numpy()
    across, down = (cv2.Sobel(light, cv2.CV_32F, *way, scale=1 / 8) for way in ((1, 0), (0, 1)))
    return torch.from_numpy(np.hypot(across, down))


def _of_points(judged: list[_Judged]) -> dict[str, Any]:
    road = np.concatenate([one.road for one in judged])
    found: dict[str, Any] = {"num_road": len(road)}
    parts = {"auc": [one.paint for one in judged], "confirmed_auc": [i.confirmed for i in judged]}
    for name, values in parts.items():
        paint = np.concatenate(values)
        is_enough = len(paint) >= LEAST_POINTS and len(road) > 0
        found[name] = area_under_curve(paint, road) if is_enough else None
        found |= {} if is_enough else {f"{name}_reason": FEW_POINTS}
        found[f"num_of_{name}"] = len(paint)
    return found


def _of_pixels(exact: list[tuple[float, float, int]]) -> dict[str, float]:
    error, edges, number = (sum(part) for part in zip(*exact, strict=True)) if exact else (0, 0, 0)
    if not number:
        return {}
    return {"paint_psnr": psnr_from_error(error / number), "paint_edge_error": edges / number}
