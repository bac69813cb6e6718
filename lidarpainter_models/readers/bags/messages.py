"""What messages of ROS 2 and of Foxglove say, in one form.

ROS 2: sensor_msgs CompressedImage, Image, CameraInfo, PointCloud2; tf2_msgs TFMessage; nav_msgs
Odometry; vision_msgs Detection3DArray. Foxglove (https://docs.foxglove.dev/docs/sdk/schemas), as
protobuf or as ROS messages of `foxglove_msgs`: CompressedImage, RawImage, CompressedVideo,
CameraCalibration, PointCloud, FrameTransform, FrameTransforms, SceneUpdate. Camera frames are
optical: x right, y down, z forward (REP 103).
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError, MissingPackageError
from lidarpainter_models.readers.bags.chunks import BagMessage
from lidarpainter_models.readers.source_logs.drive_poses import NS_PER_S, stated_pose
from lidarpainter_models.scenes.records import Distortion
from lidarpainter_models.scenes.validation import require_pose, require_size, shown

if TYPE_CHECKING:
    from mcap.records import Schema

Kind = Literal["image", "video", "lens", "cloud", "transforms", "odometry", "boxes"]
_FOXGLOVE: dict[str, Kind] = {
    "CompressedImage": "image",
    "RawImage": "image",
    "CompressedVideo": "video",
    "CameraCalibration": "lens",
    "PointCloud": "cloud",
    "FrameTransform": "transforms",
    "FrameTransforms": "transforms",
    "SceneUpdate": "boxes",
}
KINDS: dict[str, Kind] = {
    "sensor_msgs/CompressedImage": "image",
    "sensor_msgs/Image": "image",
    "sensor_msgs/CameraInfo": "lens",
    "sensor_msgs/PointCloud2": "cloud",
    "tf2_msgs/TFMessage": "transforms",
    "nav_msgs/Odometry": "odometry",
    "vision_msgs/Detection3DArray": "boxes",
    **{f"foxglove/{name}": kind for name, kind in _FOXGLOVE.items()},
}
"""What a message is about, by its schema's name as `schema_name` gives it."""
_BROWN_TERMS = (4, 5, 8)
_MODELS = {"plumb_bob": "brown", "rational_polynomial": "brown"}
_MODELS |= dict.fromkeys(("equidistant", "fisheye", "kannala_brandt"), "fisheye")
_HALF_PIXEL = 0.5
"""ROS and OpenCV count pixels from the centre of the first one."""
_CATEGORY_KEYS = ("category", "class", "label", "type", "classification")


@dataclass(frozen=True, slots=True, kw_only=True)
class BagLens:
    """What a calibration message says."""

    frame: str
    intrinsics: dict[str, float]
    distortion: Distortion
    width_px: int
    height_px: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BagTransform:
    """Where one frame stands in another."""

    parent: str
    child: str
    time_ns: int
    parent_from_child: Float[Tensor, "4 4"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BagBox:
    """One detected thing."""

    actor_id: str
    category: str
    frame: str
    time_ns: int
    frame_from_box: Float[Tensor, "4 4"]
    size_m: tuple[float, float, float]


def schema_name(message: BagMessage) -> str:
    """The name of a message's schema as package/Name, the same for all ways to write it."""
    name = message.schema.name if message.schema else ""
    package, _, own = name.replace(".", "/").replace("/msg/", "/").rpartition("/")
    return f"{'foxglove' if package == 'foxglove_msgs' else package}/{own}"


def kind_of(message: BagMessage) -> Kind | None:
    """What a message is about; None for one that is not read."""
    is_ros = message.encoding == "cdr" and message.schema and message.schema.encoding == "ros2msg"
    if not is_ros and message.encoding != "protobuf":
        return None
    return KINDS.get(schema_name(message))


class Decoders:
    """Decodes messages by their schemas, each of which is taken in once."""

    def __init__(self) -> None:
        self._known: dict[bytes, Callable[[bytes], Any]] = {}

    def decoded(self, message: BagMessage) -> Any:  # noqa: ANN401 - made from a schema
        """The message as an object with the fields of its schema.

        Raises:
            DataError: it, or its schema, is damaged.
            MissingPackageError: the package that decodes it is not installed.
        """
        assert message.schema is not None, "`kind_of` has asked"  # noqa: S101
        key = message.schema.data + message.schema.name.encode()
        try:
            if key not in self._known:
                make = _ros_decoder if message.encoding == "cdr" else _protobuf_decoder
                self._known[key] = make(message.schema)
            return self._known[key](message.data)
        except (MissingPackageError, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001 - on damaged bytes decoders raise anything
            reason = shown(" ".join(str(error).split())) or type(error).__name__
            raise DataError(f"{place_of(message)}: cannot be decoded ({reason})") from None


def place_of(message: BagMessage) -> str:
    """Where a message is, to name in errors."""
    return f"{message.file}, {shown(message.topic)} at {message.log_ns / NS_PER_S:.3f} s"


def stamp_ns(message: BagMessage, decoders: Decoders) -> tuple[int, str]:
    """The time that a message with a header states, and its frame.

    Of a ROS message the header alone is read: it comes first.
    """
    if message.encoding == "cdr" and not schema_name(message).startswith("foxglove/"):
        try:
            order = "<" if message.data[1] & 1 else ">"
            seconds, rest_ns, length = struct.unpack_from(f"{order}iII", message.data, 4)
            frame = message.data[16 : 16 + max(length - 1, 0)].decode()
        except (struct.error, UnicodeDecodeError, IndexError):
            raise DataError(f"{place_of(message)}: has no header") from None
        return seconds * NS_PER_S + rest_ns, frame
    return header_of(decoders.decoded(message))


def header_of(decoded: Any) -> tuple[int, str]:  # noqa: ANN401
    """Time and frame of a decoded message."""
    header = getattr(decoded, "header", None)
    if header is not None:
        return _time_ns(header.stamp), header.frame_id
    return _time_ns(decoded.timestamp), getattr(decoded, "frame_id", "")


def lens_of(decoded: Any, where: str, *, is_rectified: bool) -> BagLens:  # noqa: ANN401
    """The lens of a CameraInfo or CameraCalibration.

    Args:
        decoded: the message.
        where: its place, to name in errors.
        is_rectified: whether images are rectified: then its projection holds, without distortion.

    Raises:
        DataError: it states no lens, or a distortion that is not known.
    """
    upper = hasattr(decoded, "K")
    k, d, p = (list(getattr(decoded, name if upper else name.lower())) for name in "KDP")
    rows = p if is_rectified and any(p) else k
    width = len(rows) // 3
    if width not in (3, 4) or not np.isfinite(rows).all() or min(rows[0], rows[width + 1]) <= 0:
        raise DataError(f"{where}: states no lens, the camera is not calibrated")
    intrinsics = {
        "fx_px": float(rows[0]),
        "fy_px": float(rows[width + 1]),
        "cx_px": float(rows[2]) + _HALF_PIXEL,
        "cy_px": float(rows[width + 2]) + _HALF_PIXEL,
    }
    model = str(decoded.distortion_model)
    has_terms = not is_rectified and any(d)
    if has_terms and model not in _MODELS:
        raise DataError(f"{where}: distortion {shown(model, 40)!r}, expected {', '.join(_MODELS)}")
    return BagLens(
        frame=header_of(decoded)[1],
        intrinsics=intrinsics,
        distortion=_distortion(_MODELS[model], d) if has_terms else Distortion(),
        width_px=int(decoded.width),
        height_px=int(decoded.height),
    )


def transforms_of(decoded: Any, where: str) -> Iterator[BagTransform]:  # noqa: ANN401
    """The transforms of a TFMessage, a FrameTransforms or a FrameTransform."""
    for one in getattr(decoded, "transforms", [decoded]):
        if hasattr(one, "parent_frame_id"):
            time_ns, parent, child = (
                _time_ns(one.timestamp),
                one.parent_frame_id,
                one.child_frame_id,
            )
            pose = pose_of(one.rotation, one.translation, where)
        else:
            (time_ns, parent), child = header_of(one), one.child_frame_id
            pose = pose_of(one.transform.rotation, one.transform.translation, where)
        yield BagTransform(
            parent=parent.lstrip("/"),
            child=child.lstrip("/"),
            time_ns=time_ns,
            parent_from_child=pose,
        )


def odometry_of(decoded: Any, where: str) -> BagTransform:  # noqa: ANN401
    """The pose of an Odometry message, of the frame that it is about in that of its header."""
    time_ns, parent = header_of(decoded)
    pose = decoded.pose.pose
    return BagTransform(
        parent=parent.lstrip("/"),
        child=decoded.child_frame_id.lstrip("/"),
        time_ns=time_ns,
        parent_from_child=pose_of(pose.orientation, pose.position, where),
    )


def boxes_of(decoded: Any, where: str) -> Iterator[BagBox]:  # noqa: ANN401
    """The boxes of a Detection3DArray, or the cubes of a SceneUpdate."""
    if hasattr(decoded, "detections"):
        time_ns, frame = header_of(decoded)
        for one in decoded.detections:
            named = [result.hypothesis.class_id for result in one.results]
            yield _box(
                (one.id, named[0] if named else "unknown", frame, time_ns),
                (one.bbox.center, one.bbox.size),
                where,
            )
        return
    for entity in decoded.entities:
        told = {pair.key.lower(): pair.value for pair in entity.metadata}
        category = next((told[key] for key in _CATEGORY_KEYS if told.get(key)), "unknown")
        for number, cube in enumerate(entity.cubes):
            name = entity.id if number == 0 else f"{entity.id}-{number}"
            stated = (name, category, entity.frame_id, _time_ns(entity.timestamp))
            yield _box(stated, (cube.pose, cube.size), where)


def _box(stated: tuple[str, str, str, int], placed: tuple[Any, Any], where: str) -> BagBox:
    (name, category, frame, time_ns), (pose, size) = stated, placed
    size_m = (float(size.x), float(size.y), float(size.z))
    require_size(size_m, where)
    return BagBox(
        actor_id=name,
        category=category,
        frame=frame.lstrip("/"),
        time_ns=time_ns,
        frame_from_box=pose_of(pose.orientation, pose.position, where),
        size_m=size_m,
    )


def _time_ns(stamp: Any) -> int:  # noqa: ANN401 - ROS says sec and nanosec, protobuf seconds, nanos
    if hasattr(stamp, "sec"):
        return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
    return int(stamp.seconds) * NS_PER_S + int(stamp.nanos)


def pose_of(rotation: Any, place: Any, where: str) -> Float[Tensor, "4 4"]:  # noqa: ANN401
    """A pose as messages state it, float64.

    Raises:
        DataError: the rotation is no unit quaternion, or a number is not finite.
    """
    quaternion = [getattr(rotation, axis) for axis in "wxyz"]
    pose = stated_pose(quaternion, [getattr(place, axis) for axis in "xyz"])
    if pose is None:
        raise DataError(f"{where}: the rotation {quaternion} is no unit quaternion")
    return require_pose(pose, where)


def _distortion(model: str, terms: list[float]) -> Distortion:
    """As many terms as the model takes; what is left out is zero."""
    count = 4 if model == "fisheye" else next((n for n in _BROWN_TERMS if n >= len(terms)), 8)
    padded = [*terms[:count], *[0.0] * (count - len(terms))]
    return Distortion(model, tuple(map(float, padded)))


def _ros_decoder(schema: "Schema") -> Callable[[bytes], Any]:
    try:
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        raise MissingPackageError(
            "messages of ROS need the package mcap-ros2-support: pip install lidarpainter[bags]"
        ) from None
    decoder = DecoderFactory().decoder_for("cdr", schema)
    if decoder is None:
        raise ValueError(f"schema of encoding {schema.encoding}, expected ros2msg")
    return decoder


def _protobuf_decoder(schema: "Schema") -> Callable[[bytes], Any]:
    """A parser of a message whose schema is a FileDescriptorSet."""
    from google.protobuf import descriptor_pb2, message_factory

    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data).file
    kinds = message_factory.GetMessages(files)
    if schema.name not in kinds:
        raise ValueError(f"its schema describes no {schema.name}")
    return kinds[schema.name].FromString
