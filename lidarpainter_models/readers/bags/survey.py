"""The first pass over a bag: what each topic holds and when, and all that is small.

Of images and points only the times are kept, so the pass takes some bytes a message. Transforms,
calibrations and boxes are kept whole.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Int64

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.bags.chunks import BagMessage, bag_messages
from lidarpainter_models.readers.bags.clouds import time_field_of
from lidarpainter_models.readers.bags.messages import (
    BagBox,
    BagTransform,
    Decoders,
    Kind,
    boxes_of,
    kind_of,
    odometry_of,
    place_of,
    schema_name,
    stamp_ns,
    transforms_of,
)

MAX_KEPT = 5_000_000
"""Messages, transforms and boxes together: of a day's drive."""
MAX_TOPICS = 10_000
Dated = TypeVar("Dated", BagTransform, BagBox)


@dataclass
class BagTopic:
    """One topic of a bag."""

    name: str
    schema: str
    kind: Kind | None
    """None where messages of its schema are not read."""
    frame: str = ""
    """That of its first message."""
    stamps_ns: list[int] = field(default_factory=list)
    """In the order of the bag, of images and clouds."""
    logs_ns: list[int] = field(default_factory=list)
    """When the recorder got them."""
    first: BagMessage | None = None
    count: int = 0
    point_time: str | None = None
    """Of a cloud: the field with the times of points."""

    def times_ns(self, clock: str) -> Int64[np.ndarray, " messages"]:
        """The times of its messages by a clock: header or log."""
        return np.array(self.stamps_ns if clock == "header" else self.logs_ns, dtype=np.int64)


@dataclass
class BagSurvey:
    """What is in a bag."""

    files: tuple[Path, ...]
    clock: str = "header"
    """Whose times transforms and boxes have: header, or log for the recorder's."""
    decoders: Decoders = field(default_factory=Decoders)
    topics: dict[str, BagTopic] = field(default_factory=dict)
    transforms: list[BagTransform] = field(default_factory=list)
    odometry: dict[str, list[BagTransform]] = field(default_factory=dict)
    """By topic."""
    boxes: dict[str, list[BagBox]] = field(default_factory=dict)
    """By topic."""

    def of_kind(self, *kinds: Kind) -> list[BagTopic]:
        """Topics of some kinds by name."""
        found = (topic for topic in self.topics.values() if topic.kind in kinds)
        return sorted(found, key=lambda topic: topic.name)


def survey_bag(
    files: tuple[Path, ...],
    *,
    clock: str = "header",
    told: Callable[[int, int], None] | None = None,
) -> BagSurvey:
    """Read a bag once.

    Args:
        files: the pieces of the bag.
        clock: whose times transforms and boxes get: header or log.
        told: is told bytes of messages read so far, and of the files in all.

    Raises:
        DataError: a file is damaged, or a message is.
        MissingPackageError: the extra `bags` is not installed.
    """
    survey = BagSurvey(files, clock)
    total = sum(file.stat().st_size for file in survey.files)
    kept = read = 0
    for message in bag_messages(survey.files):
        read += len(message.data)
        kept += _take(survey, message)
        if kept > MAX_KEPT:
            raise DataError(f"{files[0]}: more than {MAX_KEPT} messages, cut it into pieces")
        if told is not None:
            told(min(read, total), total)
    return survey


def _take(survey: BagSurvey, message: BagMessage) -> int:
    """Note one message; gives how many things were kept."""
    topic = survey.topics.get(message.topic)
    if topic is None:
        if len(survey.topics) >= MAX_TOPICS:
            raise DataError(f"{message.file}: more than {MAX_TOPICS} topics")
        topic = BagTopic(message.topic, schema_name(message), kind_of(message))
        survey.topics[message.topic] = topic
    topic.count += 1
    if topic.kind in ("image", "video", "cloud", "lens"):
        return _take_big(survey, topic, message)
    if topic.kind is None:
        return 0
    where, decoded = place_of(message), survey.decoders.decoded(message)
    if topic.kind == "boxes":
        found = [_dated(survey, message, box) for box in boxes_of(decoded, where)]
        survey.boxes.setdefault(topic.name, []).extend(found)
        return len(found)
    stated = (
        [odometry_of(decoded, where)] if topic.kind == "odometry" else transforms_of(decoded, where)
    )
    transforms = [_dated(survey, message, one) for one in stated]
    if topic.kind == "odometry":
        topic.frame = transforms[0].child
        topic.stamps_ns.append(transforms[0].time_ns)
        survey.odometry.setdefault(topic.name, []).extend(transforms)
    else:
        survey.transforms.extend(transforms)
    return len(transforms)


def _dated(survey: BagSurvey, message: BagMessage, one: Dated) -> Dated:
    """What a message states, at the time of the chosen clock."""
    return replace(one, time_ns=message.log_ns) if survey.clock == "log" else one


def _take_big(survey: BagSurvey, topic: BagTopic, message: BagMessage) -> int:
    time_ns, frame = stamp_ns(message, survey.decoders)
    if topic.first is None:
        topic.frame = frame.lstrip("/")
        if topic.kind in ("cloud", "lens"):
            topic.first = message
        if topic.kind == "cloud":
            topic.point_time = time_field_of(survey.decoders.decoded(message), place_of(message))
    if topic.kind == "lens":
        return 0
    topic.stamps_ns.append(time_ns)
    topic.logs_ns.append(message.log_ns)
    return 1
