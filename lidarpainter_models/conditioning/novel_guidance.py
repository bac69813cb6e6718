"""Painted images of views that nobody recorded, to guide the fit on.

The recorded cameras are moved sideways and up relative to the road, or turned, what the scene
shows there is painted, and every pixel gets a weight: painter confidence times geometric
confidence times the gate of `confidence`, where the painting departs from the render, and a little
everywhere. Views from inside a car or a wall are left out, and those that are turned towards where
another camera of the rig looks; refused paintings stay in the result, for the report, but give no
guidance. World: x forward, y left, z up; metres.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.pixel_confidence import (
    departure_weight,
    guidance_gate,
    view_support,
)
from lidarpainter_models.conditioning.sequences import SequencePainter
from lidarpainter_models.conditioning.settings import NovelGuidanceConfig
from lidarpainter_models.devices import within_memory
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectories import road_directions, shift_pose
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.lidar.map_building import views_showing_more
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.observations.views import GuidanceView, TrainingView
from lidarpainter_models.painter.protocol import Painter, Painting, PaintingConditions
from lidarpainter_models.scenes.records import ViewKey

ROOM_M = 0.6  # no surface may be nearer to a moved camera than this
MAX_POINTS_IN_ROOM = 10  # LiDAR points nearer than that which still count as noise
LEAST_WEIGHT = 0.1
"""What a painted pixel counts at the least. Where nothing vouches for a painting it is still nearer
to what is there than the holes and smears that no recorded view corrects
(docs/decisions/what-guides-a-fit.md)."""
AXIS_M = 30.0
"""How far ahead of a turned camera lies what it looks at."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NovelCamera:
    """A camera nobody had."""

    camera: Camera
    timestamp_ns: int
    shift: Shift
    key: ViewKey
    """The training view it was moved from."""

    @property
    def name(self) -> str:
        """Names the view in files and tables, such as `front_camera-004-left-2m`."""
        return f"{self.key[1]}-{self.key[0]:03d}-{self.shift.name}"


@dataclass(frozen=True, kw_only=True, eq=False)
class NovelPainting:
    """One painted view: guidance for the fit and images for a report."""

    novel: NovelCamera
    guidance: GuidanceView
    is_refused: bool
    """Whether the gate let nothing of it count."""
    images: dict[str, UInt8[Tensor, "height width 3"]]
    """Of one view of each shift, by name: render, lidar, warp, painted, confidence."""

    @property
    def mean_weight(self) -> float:
        """Mean weight of the guidance, 0 to 1."""
        return float(self.guidance.weight.mean())


def novel_cameras(
    training_views: Sequence[TrainingView],
    frame_indices: Sequence[int],
    world_from_ego: Float[Tensor, "frames 4 4"],
    *,
    config: NovelGuidanceConfig,
    start: int = 0,
) -> list[NovelCamera]:
    """The training cameras of every n-th training frame, at every shift.

    `frame_indices` are those of `world_from_ego`, in order of time. Training frames are counted
    from `start`, so that another round may paint other frames. Of a car that stands an image each
    half second counts (`views_showing_more`). A camera is turned only to where no other camera of
    its frame looks.

    Raises:
        ConfigError: a view's frame is not among `frame_indices`, or a camera named in the config
            has no training view.
    """
    directions = dict(zip(frame_indices, road_directions(world_from_ego), strict=True))
    _check_names(config.camera_names, training_views)
    unknown = sorted({view.key[0] for view in training_views} - set(directions))
    if unknown:
        raise ConfigError(f"no ego pose is given for the frames {unknown} of training views")
    training_views = views_showing_more(training_views)
    frames = sorted({view.key[0] for view in training_views})
    chosen = set(frames[start % config.every_nth :: config.every_nth])
    moved = [
        NovelCamera(
            camera=view.camera.at(
                shift_pose(view.camera.world_from_camera, directions[view.key[0]], shift)
            ),
            timestamp_ns=view.timestamp_ns,
            shift=shift,
            key=view.key,
        )
        for shift in config.shifts
        for view in training_views
        if view.key[0] in chosen
        and (config.camera_names is None or view.key[1] in config.camera_names)
    ]
    of_frame: dict[int, list[Camera]] = {}
    for view in training_views:
        of_frame.setdefault(view.key[0], []).append(view.camera)
    return [one for one in moved if not _looks_where_one_does(one, of_frame[one.key[0]])]


def _looks_where_one_does(novel: NovelCamera, cameras: Sequence[Camera]) -> bool:
    """Whether a camera that was turned in its place looks at what one of these shows."""
    if not novel.shift.yaw_rad:
        return False
    pose = novel.camera.world_from_camera
    ahead = (pose[:3, 3] + AXIS_M * pose[:3, 2])[None]
    return any(bool(camera.contains(*camera.project(ahead))) for camera in cameras)


def _check_names(names: tuple[str, ...] | None, views: Sequence[TrainingView]) -> None:
    known = sorted({view.key[1] for view in views})
    missing = sorted(set(names or ()) - set(known))
    if missing:
        raise ConfigError(
            f"no training view has the camera {', '.join(missing)} (there are {', '.join(known)})"
        )


def has_room(novel: NovelCamera, lidar_map: LidarMap, actors: MovingBoxes) -> bool:
    """Whether a camera stands in free space: not in or at a moving actor, a parked car, a wall."""
    centre = novel.camera.centre_world.float()
    for track, box in actors.placed(novel.timestamp_ns):
        if bool(is_inside_box(centre[None], box, track.size_m, margin_m=ROOM_M)):
            return False
    return lidar_map.num_street_points_near(centre, ROOM_M) <= MAX_POINTS_IN_ROOM


def paint_novel_views(
    builder: ConditionBuilder,
    painter: Painter,
    cameras: Sequence[NovelCamera],
    *,
    config: NovelGuidanceConfig,
    progress: Callable[[int, int], None] | None = None,
) -> list[NovelPainting]:
    """Paint every view that has room to stand in, several at once where nothing leans on another.

    Results do not depend on the number of threads.
    """
    standing = [one for one in cameras if has_room(one, builder.lidar_map, builder.boxes)]
    shown = _one_per_shift(standing)
    device = builder.scene.device
    paths = {
        (novel.shift, novel.key[1]): SequencePainter(builder, painter, config=config.sequence)
        for novel in standing
    }

    def painted(novel: NovelCamera) -> NovelPainting:
        path = paths[novel.shift, novel.key[1]]
        return within_memory(
            partial(_paint, builder, path, novel, novel in shown),
            device,
            "painting: a narrower observation.width_px takes less",
        )

    made: Iterator[NovelPainting]
    if any(path.goes_in_order for path in paths.values()):
        made = map(painted, standing)
    else:
        made = side_by_side(painted, standing, device)
    paintings = []
    for done, painting in enumerate(made, start=len(cameras) - len(standing) + 1):
        paintings.append(painting)
        if progress is not None:
            progress(done, len(cameras))
    return paintings


def _one_per_shift(cameras: Sequence[NovelCamera]) -> list[NovelCamera]:
    """The middle one of each shift."""
    by_shift: dict[Shift, list[NovelCamera]] = {}
    for novel in cameras:
        by_shift.setdefault(novel.shift, []).append(novel)
    return [group[len(group) // 2] for group in by_shift.values()]


def guidance_views(paintings: Sequence[NovelPainting]) -> list[GuidanceView]:
    """What the fit is given: every painting that was not refused."""
    return [painting.guidance for painting in paintings if not painting.is_refused]


def _paint(
    builder: ConditionBuilder,
    path: SequencePainter,
    novel: NovelCamera,
    is_shown: bool,
    spares: bool,
) -> NovelPainting:
    if spares:
        builder.forget_sources()
    conditions, painting = path.paint(novel.camera, novel.timestamp_ns)
    gate = guidance_gate(painting, conditions)
    geometric = view_support(conditions, novel.camera, builder.recorded_cameras)
    is_refused = bool((gate == 0).all())
    least = 0.0 if is_refused else LEAST_WEIGHT
    trust = (painting.confidence * geometric * gate).clamp(0, 1)
    guidance = GuidanceView.of(
        novel.camera,
        novel.timestamp_ns,
        rgb=painting.rgb,
        weight=least + (1 - least) * trust * departure_weight(painting, conditions),
        lidar_depth_m=conditions.lidar_depth_m,
    )
    home = torch.device("cpu")  # where paintings of a whole log have room
    images = _images(conditions, painting, trust) if is_shown else {}
    images = {name: rgb.to(home) for name, rgb in images.items()}
    return NovelPainting(
        novel=novel,
        guidance=guidance.to(home),
        is_refused=is_refused,
        images=images,
    )


def _images(
    conditions: PaintingConditions, painting: Painting, trust: Float[Tensor, "height width"]
) -> dict[str, UInt8[Tensor, "height width 3"]]:
    """What a report shows of one view."""
    floats = {
        "render": conditions.render_rgb,
        "lidar": conditions.lidar_rgb,
        "warp": conditions.warp_rgb[0],
        "painted": painting.rgb,
        "confidence": trust[..., None].expand(-1, -1, 3),
    }
    return {name: (rgb.clamp(0, 1) * 255).round().to(torch.uint8) for name, rgb in floats.items()}
