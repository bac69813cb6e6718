"""How far from the path that was driven a fitted scene can be trusted, stretch by stretch.

Along the path, in stretches of about `STRETCH_M`, the last moment of each stretch is looked at from
farther and farther to the left, to the right, up, ahead and at more and more yaw, as long as the
frame there is promised to be good (`view_confidence`); the first moment and other cameras are
asked where that ended, and nearer until they are good too. So what is said of a stretch is the
least over its ends and cameras. A place inside something (a car, a wall) ends the walk as a
bad frame does. Ahead means that the car is so much farther along its path at the same time,
straight on past the end of the log. One step at a time: no step says anything about several.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import repeat
from typing import Any

from lidarpainter_models.conditioning.moved_cameras import MovedCameras
from lidarpainter_models.conditioning.novel_guidance import NovelCamera, has_room
from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer
from lidarpainter_models.evaluation.view_confidence import (
    GOOD_DB,
    PROMISED,
    Calibration,
    FrameConfidence,
)
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.geometry.trajectory_words import ConstantStep
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.observations.image_shrinking import fit_camera
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road
from lidarpainter_models.scenes.records import RecordedView

STRETCH_M = 20.0
UP_M = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
ASIDE_M = (*UP_M, 6.0)
AHEAD_M = (*ASIDE_M, 8.0)
LEVELS_DEG = (2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0)
"""No farther than frames were drawn to calibrate what is promised."""
Direction = tuple[tuple[float, ...], Callable[[float], ConstantStep]]
DIRECTIONS: dict[str, Direction] = {
    "left_m": (ASIDE_M, lambda level: ConstantStep(lateral_m=level)),
    "right_m": (ASIDE_M, lambda level: ConstantStep(lateral_m=-level)),
    "up_m": (UP_M, lambda level: ConstantStep(up_m=level)),
    "ahead_m": (AHEAD_M, lambda level: ConstantStep(along_m=level)),
    "yaw_left_deg": (LEVELS_DEG, lambda level: ConstantStep(yaw_rad=math.radians(level))),
    "yaw_right_deg": (LEVELS_DEG, lambda level: ConstantStep(yaw_rad=-math.radians(level))),
}
"""What is said of a stretch (`score_tables.TRUSTED`): the steps, and how one is made."""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A part of the recorded path."""

    from_m: float
    to_m: float
    first_frame: int
    last_frame: int
    """Frame indices, both included."""


def stretches_of(scene: DrivingScene) -> list[Stretch]:
    """The recorded path in parts of equal length, about `STRETCH_M` each; a standing car has one.

    Every frame is in one of them; a part that no frame falls into is none.
    """
    travelled_m = driven_road(scene).travelled_m
    length_m = float(travelled_m[-1])
    count = max(1, round(length_m / STRETCH_M))
    place = (travelled_m * (count / max(length_m, 1e-9))).long().clamp(max=count - 1)
    found = []
    for number in range(count):
        rows = (place == number).nonzero()[:, 0]
        if len(rows):
            first, last = (int(rows[end]) for end in (0, -1))
            found.append(
                Stretch(
                    from_m=length_m * number / count,
                    to_m=length_m * (number + 1) / count,
                    first_frame=scene.frame_indices[first],
                    last_frame=scene.frame_indices[last],
                )
            )
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class MovedViews:
    """Recorded views of a scene, moved by one step, and what speaks for them there."""

    scene: DrivingScene
    gatherer: EvidenceGatherer
    observation: ObservationConfig

    def camera(self, view: RecordedView, step: ConstantStep) -> Camera | None:
        """A view's camera as the fit found it, moved; None where it would stand in something."""
        fitted = self.gatherer.scene
        found = fitted.refined_camera(view, fit_camera(view, self.observation))
        if step == ConstantStep():
            return found
        # as `render --trajectory` moves it, past the end of the path as far as asked
        trajectory = Trajectory("a step", (step,), max_shift_m=None)
        (moved,) = MovedCameras(recorded=self.scene, tracks=(), trajectory=trajectory).moved(
            [view], [found]
        )
        builder = self.gatherer.builder
        novel = NovelCamera(
            camera=moved, timestamp_ns=view.timestamp_ns, shift=Shift(), key=view.key
        )
        return moved if has_room(novel, builder.lidar_map, builder.boxes) else None


def trust_envelope(
    views: MovedViews,
    camera_names: Sequence[str],
    calibration: Calibration,
    *,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> dict[str, Any]:
    """How far each stretch can be trusted, as JSON types.

    A figure is the farthest of the levels that are promised; 0 where none is, None where the
    recorded path itself is not.
    """
    looked_at = [
        (stretch, moments)
        for stretch in stretches_of(views.scene)
        if (moments := _moments(views.scene, stretch, camera_names))
    ]
    rows, num_frames, total = [], 0, len(looked_at) * (1 + len(DIRECTIONS))
    device = views.gatherer.scene.device
    for number, (stretch, moments) in enumerate(looked_at):
        walk = _Walk(views, moments, calibration)
        row: dict[str, Any] = asdict(stretch)
        row["recorded_confidence"], row["recorded_db"] = walk.recorded()
        is_trusted = row["recorded_confidence"] >= PROMISED
        done = number * (1 + len(DIRECTIONS)) + 1
        progress(done, total)
        reached: Iterator[float | None] = repeat(None, len(DIRECTIONS))
        if is_trusted:
            reached = side_by_side(walk.farthest, DIRECTIONS.values(), device)
        for place, (name, level) in enumerate(zip(DIRECTIONS, reached, strict=True), start=1):
            row[name] = level
            progress(done + place, total)
        rows.append(row)
        num_frames += len(walk.said)
    return {
        "good_db": GOOD_DB,
        "promised": PROMISED,
        "cameras": list(camera_names),
        "num_frames": num_frames,
        "calibration": asdict(calibration),
        "stretches": rows,
    }


class _Walk:
    """Steps away from the moments of one stretch."""

    def __init__(
        self, views: MovedViews, moments: Sequence[RecordedView], calibration: Calibration
    ) -> None:
        self._views, self._moments, self._calibration = views, moments, calibration
        self.said: list[FrameConfidence] = []
        """Of all frames where somebody can stand, as several directions come to them."""

    def recorded(self) -> tuple[float, float]:
        """Least confidence and least predicted PSNR on the path itself."""
        said = [self._said(view, ConstantStep()) for view in self._moments]
        found = [one for one in said if one is not None]
        return min(one.confidence for one in found), min(one.predicted_db for one in found)

    def farthest(self, way: Direction) -> float:
        """The last level of a direction before the first that is not promised.

        The first view walks outwards; every other one is asked where that came to, and nearer
        until it is promised there too.
        """
        (levels, step_of), (first, *others) = way, self._moments
        count = 0
        while count < len(levels) and self._is_promised(first, step_of(levels[count])):
            count += 1
        for view in others:
            count = self._num_free(view, [step_of(level) for level in levels[:count]])
            while count and not self._is_promised(view, step_of(levels[count - 1])):
                count -= 1
        return levels[count - 1] if count else 0.0

    def _num_free(self, view: RecordedView, steps: Sequence[ConstantStep]) -> int:
        """How many steps lead to where a camera can stand, before the first that does not."""
        free = [self._views.camera(view, step) is not None for step in steps]
        return free.index(False) if False in free else len(free)

    def _is_promised(self, view: RecordedView, step: ConstantStep) -> bool:
        said = self._said(view, step)
        return said is not None and said.is_promised

    def _said(self, view: RecordedView, step: ConstantStep) -> FrameConfidence | None:
        camera = self._views.camera(view, step)
        if camera is None:
            return None
        evidence = self._views.gatherer.of(camera, view.timestamp_ns, view.camera_name)
        self.said.append(self._calibration.of(evidence))
        return self.said[-1]


def _moments(
    scene: DrivingScene, stretch: Stretch, camera_names: Sequence[str]
) -> list[RecordedView]:
    """The first and the last view of every camera in a stretch; the last ones first."""
    found = []
    for name in camera_names:
        own = [
            view
            for view in scene.views_of(name)
            if stretch.first_frame <= view.frame_index <= stretch.last_frame
        ]
        found += [own[-1], *own[:1]] if len(own) > 1 else own
    return found
