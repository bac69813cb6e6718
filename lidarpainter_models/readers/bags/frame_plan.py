"""Which messages of a bag make which frame, and where everything stands."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int64

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.bags.chunks import BagMessage
from lidarpainter_models.readers.bags.clouds import points_of
from lidarpainter_models.readers.bags.frame_tree import FrameTree
from lidarpainter_models.readers.bags.messages import BagTransform, place_of, stamp_ns
from lidarpainter_models.readers.bags.rig import BagRig, RigCamera, RigSensor
from lidarpainter_models.readers.bags.survey import BagSurvey, BagTopic
from lidarpainter_models.readers.source_logs.drive_poses import NS_PER_S, stated_pose
from lidarpainter_models.readers.source_logs.log import chosen_cameras, chosen_frames
from lidarpainter_models.readers.source_logs.sweep_frames import nearest_images
from lidarpainter_models.readers.source_logs.swept_boxes import with_motion
from lidarpainter_models.scenes.records import BoxRecord
from lidarpainter_models.scenes.validation import require_name

SLACK_NS = 50_000_000
"""Before the first pose and after the last the motion is taken to go on for so long."""
MAX_REACH_NS = 150_000_000
"""From the middle of a sweep; the doctor allows no more."""


def tree_of(survey: BagSurvey, rig: BagRig | None, where: str) -> FrameTree:
    """The frames of a bag: its transforms, those of a rig, and odometry for what these lack.

    Raises:
        DataError: they contradict each other.
    """
    transforms = list(survey.transforms)
    for one in rig.transforms if rig else ():
        pose = stated_pose(one.rotation_wxyz, one.translation_m)
        if pose is None:
            raise DataError(f"{where}: transform of {one.child!r:.60}: no unit quaternion")
        transforms.append(
            BagTransform(parent=one.parent, child=one.child, time_ns=0, parent_from_child=pose)
        )
    known = {one.child for one in transforms}
    for name in sorted(survey.odometry):
        found = survey.odometry[name]
        if found[0].child not in known:
            transforms += found
            known.add(found[0].child)
    return FrameTree(transforms, where)


class FramePlan:
    """The frames of a bag before any image or point is read."""

    def __init__(
        self,
        survey: BagSurvey,
        rig: BagRig,
        where: str,
        frames: slice | None,
        cameras: tuple[str, ...] | None,
    ) -> None:
        """Plan the frames that are asked for, see `open_log`.

        Raises:
            DataError: a topic is not there, a frame is not tied, times jump, or poses have gaps.
        """
        self._survey, self._where = survey, where
        names = chosen_cameras(cameras, (camera.name for camera in rig.cameras), where)
        kept = tuple(camera for camera in rig.cameras if camera.name in names)
        self.rig = rig.model_copy(update={"cameras": kept})
        self.tree = tree_of(survey, rig, where)
        sensors = self.rig.sensors
        self._times_ns = {sensor.topic: self._checked_times(sensor) for sensor in sensors}
        self._middles_ns = self._middles()
        for sensor in sensors:
            self.tree.poses(rig.world, self.frame_of(sensor), np.zeros(1, dtype=np.int64))
        clock = sensors[0].topic
        self.frames_ns = self._times_ns[clock] + self._middles_ns.get(clock, 0)
        possible = self._with_poses()
        self.frame_indices = [possible[i] for i in chosen_frames(len(possible), frames, where)]
        period_ns = int(np.median(np.diff(self.frames_ns))) if len(self.frames_ns) > 1 else NS_PER_S
        self._reach_ns = min(max(period_ns // 2, 1), MAX_REACH_NS)
        self._numbers = {topic: self._messages_of_frames(topic) for topic in self._times_ns}
        self.wanted: dict[str, dict[int, int]] = {
            topic: {int(numbers[i]): i for i in self.frame_indices if numbers[i] >= 0}
            for topic, numbers in self._numbers.items()
        }
        """By topic: the frame of each message that is used, by the message's number."""
        self.boxes = with_motion(self._placed_boxes())
        """By frame, in the bag's world."""

    def parts_of(self, frame_index: int) -> Iterator[tuple[str, int]]:
        """Topics and numbers of the messages of a frame."""
        for topic, numbers in self._numbers.items():
            if numbers[frame_index] >= 0:
                yield topic, int(numbers[frame_index])

    def time_of(self, topic: str, frame_index: int) -> int:
        """When the message of a frame was measured."""
        return int(self._times_ns[topic][self._numbers[topic][frame_index]])

    def frame_of(self, sensor: RigSensor) -> str:
        """The frame that a sensor's messages are in."""
        return sensor.frame or self._survey.topics[sensor.topic].frame

    def stamp_ns(self, message: BagMessage) -> int:
        """The time that a message's points count from."""
        return stamp_ns(message, self._survey.decoders)[0]

    def _topic(self, name: str, kinds: tuple[str, ...], what: str) -> BagTopic:
        topic = self._survey.topics.get(name)
        if topic is None or topic.kind not in kinds:
            known = sorted(t.name for t in self._survey.topics.values() if t.kind in kinds)
            found = f"holds {topic.schema}" if topic else "is not in the bag"
            raise DataError(
                f"{self._where}: topic {name!r:.80} {found}, expected {what}"
                + (f" such as {', '.join(known[:5])}" if known else "")
            )
        return topic

    def _checked_times(self, sensor: RigSensor) -> Int64[np.ndarray, " messages"]:
        """When a sensor's messages were measured, which must ascend."""
        if isinstance(sensor, RigCamera):
            topic = self._topic(sensor.topic, ("image", "video"), "a topic with images")
            self._topic(sensor.lens, ("lens",), f"the calibration of {sensor.name}")
        else:
            topic = self._topic(sensor.topic, ("cloud",), "a topic with points")
        times_ns = topic.times_ns(self.rig.clock) + round(sensor.late_s * NS_PER_S)
        back = np.flatnonzero(np.diff(times_ns) <= 0)
        if len(back):
            number = int(back[0]) + 1
            step_s = float(times_ns[number] - times_ns[number - 1]) / NS_PER_S
            hint = "" if self.rig.clock == "log" else ', or clock = "log" in the rig'
            raise DataError(
                f"{self._where}: message {number} of {topic.name} is stamped {step_s:+.6f} s after "
                f"the one before, expected a clock that goes on{hint}"
            )
        return times_ns

    def _middles(self) -> dict[str, int]:
        """The middle of a turn after the message's time, as a LiDAR's first message has it."""
        found = {}
        for lidar in self.rig.lidars:
            message = self._survey.topics[lidar.topic].first
            if lidar.point_time is not None and message is not None:
                points = points_of(
                    self._survey.decoders.decoded(message),
                    self.stamp_ns(message),
                    place_of(message),
                    time_field=lidar.point_time,
                )
                span = points.offset_ns
                found[lidar.topic] = int(span.min(initial=0) + span.max(initial=0)) // 2
        return found

    def _with_poses(self) -> list[int]:
        """Frames at whose time the bag says where the car is."""
        span = self.tree.span_ns(self.rig.world, self.rig.ego)
        if span is None:
            return list(range(len(self.frames_ns)))
        is_known = (self.frames_ns >= span[0] - SLACK_NS) & (self.frames_ns <= span[1] + SLACK_NS)
        if not is_known.any():
            raise DataError(
                f"{self._where}: poses from {span[0] / NS_PER_S:.3f} to {span[1] / NS_PER_S:.3f} "
                f"s, frames from {self.frames_ns[0] / NS_PER_S:.3f} to "
                f"{self.frames_ns[-1] / NS_PER_S:.3f} s, expected both at one time"
            )
        return [int(frame) for frame in np.flatnonzero(is_known)]

    def _messages_of_frames(self, topic: str) -> Int64[np.ndarray, " frames"]:
        times_ns = self._times_ns[topic] + self._middles_ns.get(topic, 0)
        return nearest_images(self.frames_ns, times_ns, reach_ns=self._reach_ns)

    def _placed_boxes(self) -> dict[int, list[BoxRecord]]:
        """Boxes by frame: each in the one whose middle it is nearest to, an actor once a frame."""
        if self.rig.boxes is None:
            return {}
        topic = self._topic(self.rig.boxes.topic, ("boxes",), "a topic with boxes")
        stated = self._survey.boxes.get(topic.name, [])
        chosen, frames_ns = set(self.frame_indices), self.frames_ns
        placed: dict[int, dict[str, tuple[int, BoxRecord]]] = {}
        for box in stated:
            if not box.actor_id:
                raise DataError(
                    f"{self._where}: a box of {topic.name} has no id, expected a track's"
                )
            after = int(np.searchsorted(frames_ns, box.time_ns).clip(1, max(len(frames_ns) - 1, 1)))
            nearby = [i for i in (after - 1, after) if i < len(frames_ns)]
            frame = min(nearby, key=lambda i: abs(int(frames_ns[i]) - box.time_ns))
            apart_ns = abs(int(frames_ns[frame]) - box.time_ns)
            others = placed.setdefault(frame, {})
            if frame not in chosen or apart_ns > self._reach_ns:
                continue
            if box.actor_id not in others or apart_ns < others[box.actor_id][0]:
                times_ns = np.array([box.time_ns])
                pose = self.tree.poses(self.rig.world, box.frame, times_ns)[0] @ box.frame_from_box
                record = BoxRecord(
                    actor_id=require_name(box.actor_id, f"{self._where}: {topic.name}: actor"),
                    category=box.category,
                    timestamp_ns=box.time_ns,
                    world_from_box=pose,
                    size_m=box.size_m,
                    is_moving=False,
                    num_points=0,
                )
                others[box.actor_id] = (apart_ns, record)
        return {frame: [record for _, record in found.values()] for frame, found in placed.items()}
