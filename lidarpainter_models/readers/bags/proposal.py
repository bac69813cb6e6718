"""Propose a rig for a bag: which topic is which sensor, which frame the car's, what is missing."""

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.bags.frame_plan import tree_of
from lidarpainter_models.readers.bags.frame_tree import FrameTree
from lidarpainter_models.readers.bags.messages import lens_of, place_of
from lidarpainter_models.readers.bags.rig import (
    BagRig,
    Clock,
    RigBoxes,
    RigCamera,
    RigLidar,
    RigSensor,
)
from lidarpainter_models.readers.bags.survey import BagSurvey, BagTopic

LICENCE = "not told"
CAR_FRAMES = ("base_link", "base_footprint", "ego_vehicle", "vehicle", "ego", "body", "car")
_GENERAL = {"image", "raw", "compressed", "color", "colour", "rgb", "rect", "sensor", "sensors"}
_GENERAL |= {"camera", "cameras", "cam", "lidar", "lidars"}
_GENERAL |= {"points", "pointcloud", "pointcloud2", "cloud", "video", "h264", "h265", "data"}
_NO_CAMERA = re.compile(r"depth|disparity|thermal|segment|theora|mask", re.IGNORECASE)
_NO_LIDAR = re.compile(r"radar|map|ground|obstacle|cluster|depth|stereo", re.IGNORECASE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """What is proposed, and what a user has to add."""

    rig: BagRig | None
    """None where there is no camera."""
    missing: tuple[str, ...]
    """A line each."""

    def complete(self, where: str) -> BagRig:
        """The rig, if the bag can be read by it as it is.

        Raises:
            DataError: something is missing.
        """
        if self.rig is None or self.missing:
            raise DataError(
                f"{where}: {'; '.join(self.missing)}: `lidarpainter rig {where}` proposes a "
                "rig.toml, add what it lacks and give it as --map"
            )
        return self.rig


def proposed_rig(survey: BagSurvey) -> Proposal:
    """Look at what the first pass over a bag has found.

    Raises:
        DataError: its transforms contradict each other.
    """
    where = str(survey.files[0])
    tree = tree_of(survey, None, where)
    missing: list[str] = []
    cameras, lidars = _cameras(survey, missing), _lidars(survey)
    sensors: tuple[RigSensor, ...] = (*lidars, *cameras)
    if not lidars:
        missing.append("no topic with points of a LiDAR")
    if not survey.of_kind("image", "video"):
        missing.append("no topic with images of a camera")
    frames = [survey.topics[sensor.topic].frame for sensor in sensors]
    ego, world = _car_frame(tree, frames[0] if frames else "")
    if frames and ego == world:
        missing.append(
            f"no pose of the car: nothing moves {frames[0] or 'its sensors'} in a frame (with the "
            "rig given as --map it is read without, and `lidarpainter localise` finds them)"
        )
    for sensor, frame in zip(sensors, frames, strict=True):
        if not tree.are_tied(frame, ego):
            missing.append(
                f"frame {frame!r:.60} of {sensor.topic} is tied to nothing: [[transform]]"
            )
    clock = _clock(survey, sensors, missing)
    if not cameras:
        return Proposal(rig=None, missing=tuple(missing))
    boxes = next((RigBoxes(topic=t.name) for t in survey.of_kind("boxes") if t.count), None)
    rig = BagRig(
        licence=LICENCE,
        ego=ego,
        world=world,
        clock=clock,
        cameras=tuple(cameras),
        lidars=tuple(lidars),
        boxes=boxes if boxes and all(box.actor_id for box in survey.boxes[boxes.topic]) else None,
    )
    return Proposal(rig=rig, missing=tuple(missing))


def _cameras(survey: BagSurvey, missing: list[str]) -> list[RigCamera]:
    """One topic for each optical frame: compressed rather than raw, distorted rather than not."""
    best: dict[str, BagTopic] = {}
    for topic in survey.of_kind("image", "video"):
        if not topic.count or _NO_CAMERA.search(topic.name):
            continue
        key = topic.frame or topic.name
        if key not in best or _rank(topic) < _rank(best[key]):
            best[key] = topic
    names = _names([topic.name for topic in best.values()], "camera")
    found = []
    for topic in best.values():
        lens = _lens_of(survey, topic)
        if lens is None:
            missing.append(f"no CameraInfo or CameraCalibration for {topic.name}")
            continue
        is_rectified = "rect" in topic.name.lower()
        assert lens.first is not None, "the topic has a message"  # noqa: S101
        try:
            decoded = survey.decoders.decoded(lens.first)
            lens_of(decoded, place_of(lens.first), is_rectified=is_rectified)
        except DataError as error:
            missing.append(str(error))
        found.append(
            RigCamera(
                name=names[topic.name],
                topic=topic.name,
                lens=lens.name,
                is_rectified=is_rectified,
            )
        )
    return found


def _rank(topic: BagTopic) -> tuple[bool, bool, int, str]:
    name = topic.name.lower()
    return "rect" in name, "compressed" not in name + topic.schema.lower(), -topic.count, name


def _lens_of(survey: BagSurvey, image: BagTopic) -> BagTopic | None:
    """The calibration in an image's frame, and of those the one whose name is most alike."""
    lenses = survey.of_kind("lens")
    near = [lens for lens in lenses if lens.frame == image.frame]
    alike = [lens for lens in near or lenses if near or _alike(lens.name, image.name) > 1]
    return max(alike, key=lambda lens: _alike(lens.name, image.name), default=None)


def _alike(first: str, second: str) -> int:
    """How many parts of two topics are the same, from the front."""
    pairs = zip(first.split("/"), second.split("/"), strict=False)
    return next((n for n, (one, other) in enumerate(pairs) if one != other), 0)


def _lidars(survey: BagSurvey) -> list[RigLidar]:
    """Topics with points, those with times of points first."""
    topics = [
        topic
        for topic in survey.of_kind("cloud")
        if topic.count > 1 and not _NO_LIDAR.search(topic.name)
    ]
    topics.sort(key=lambda topic: (topic.point_time is None, -_num_bytes(topic), topic.name))
    names = _names([topic.name for topic in topics], "lidar")
    found: dict[str, RigLidar] = {}
    for topic in topics:
        lidar = RigLidar(name=names[topic.name], topic=topic.name, point_time=topic.point_time)
        found.setdefault(topic.frame or topic.name, lidar)
    return list(found.values())


def _num_bytes(topic: BagTopic) -> int:
    return len(topic.first.data) if topic.first else 0


def _names(topics: Iterable[str], otherwise: str) -> dict[str, str]:
    """A name for each topic, of those of its parts that tell it from others."""
    found: dict[str, str] = {}
    for topic in topics:
        parts = [re.findall(r"[A-Za-z0-9]+", part) for part in topic.split("/")]
        own = ["_".join(words) for words in parts if not _GENERAL.issuperset(map(str.lower, words))]
        base = name = "_".join(own)[:40] or otherwise
        number = 2
        while name in found.values():
            name, number = f"{base}_{number}", number + 1
        found[topic] = name
    return found


def _car_frame(tree: FrameTree, frame: str) -> tuple[str, str]:
    """The frame of the car that a sensor is on, and the root of its tree.

    It is called as cars are, or is the last on the way up that moves.
    """
    way = [frame]
    while (parent := tree.parent(way[-1])) is not None and len(way) < 64:
        way.append(parent)
    moving = [position for position, one in enumerate(way) if tree.is_moving(one)]
    if not moving:
        return way[-1], way[-1]
    named = [one for one in way[: moving[0] + 1] if one.split("/")[-1] in CAR_FRAMES]
    return (named[-1] if named else way[moving[0]]), way[-1]


def _clock(survey: BagSurvey, sensors: Iterable[RigSensor], missing: list[str]) -> Clock:
    """The recorder's clock where headers have no times or such that go back."""
    for sensor in sensors:
        topic = survey.topics[sensor.topic]
        if _ascends(topic, "header"):
            continue
        if _ascends(topic, "log"):
            return "log"
        missing.append(f"the times of {topic.name} ascend by no clock")
    return "header"


def _ascends(topic: BagTopic, clock: Clock) -> bool:
    return bool((np.diff(topic.times_ns(clock)) > 0).all())
