"""The part of Waymo's protobuf messages that is read, as descriptors made here.

Names and numbers follow `dataset.proto` and `label.proto` of the Waymo Open Dataset (2019 to 2023).
Fields that are not listed are skipped. What differs from those files is the same on the wire and
safer in memory:

- Messages that repeat (`images`, `lasers`, `laser_labels`, calibrations) arrive as bytes and are
  parsed one by one, so that two bytes of a hostile file never become an object of a hundred.
- Text arrives as bytes, because text that is no UTF-8 would only fail when it is looked at.
- Enumerations arrive as numbers.
- The packed floats of a matrix arrive as one run of bytes and are viewed, not copied one by one.
"""

from typing import Any

from google.protobuf import descriptor_pb2, message_factory
from google.protobuf.message import DecodeError

from lidarpainter_models.errors import DataError

_PACKAGE = "lidarpainter.waymo"
_TYPES = {
    kind: getattr(descriptor_pb2.FieldDescriptorProto, f"TYPE_{kind.upper()}")
    for kind in ("double", "float", "int32", "int64", "bytes", "message")
}
_REPEATED = descriptor_pb2.FieldDescriptorProto.LABEL_REPEATED
_OPTIONAL = descriptor_pb2.FieldDescriptorProto.LABEL_OPTIONAL

# message: {field: (number, type)}; a type with * repeats, a capital letter begins a message
_FIELDS: dict[str, dict[str, tuple[int, str]]] = {
    "MatrixShape": {"dims": (1, "int32*")},
    "MatrixFloat": {"data": (1, "bytes"), "shape": (2, "MatrixShape")},
    "Transform": {"transform": (1, "double*")},
    "Velocity": {
        "v_x": (1, "float"),
        "v_y": (2, "float"),
        "v_z": (3, "float"),
        "w_x": (4, "double"),
        "w_y": (5, "double"),
        "w_z": (6, "double"),
    },
    "CameraCalibration": {
        "name": (1, "int32"),
        "intrinsic": (2, "double*"),
        "extrinsic": (3, "Transform"),
        "width": (4, "int32"),
        "height": (5, "int32"),
        "rolling_shutter_direction": (6, "int32"),
    },
    "LaserCalibration": {
        "name": (1, "int32"),
        "beam_inclinations": (2, "double*"),
        "beam_inclination_min": (3, "double"),
        "beam_inclination_max": (4, "double"),
        "extrinsic": (5, "Transform"),
    },
    "Context": {
        "name": (1, "bytes"),
        "camera_calibrations": (2, "bytes*"),
        "laser_calibrations": (3, "bytes*"),
    },
    "RangeImage": {
        "range_image_compressed": (2, "bytes"),
        "range_image_pose_compressed": (4, "bytes"),
    },
    "Laser": {
        "name": (1, "int32"),
        "ri_return1": (2, "RangeImage"),
        "ri_return2": (3, "RangeImage"),
    },
    "CameraImage": {
        "name": (1, "int32"),
        "image": (2, "bytes"),
        "pose": (3, "Transform"),
        "velocity": (4, "Velocity"),
        "pose_timestamp": (5, "double"),
        "shutter": (6, "double"),
        "camera_trigger_time": (7, "double"),
        "camera_readout_done_time": (8, "double"),
    },
    "Box": {
        "center_x": (1, "double"),
        "center_y": (2, "double"),
        "center_z": (3, "double"),
        "width": (4, "double"),
        "length": (5, "double"),
        "height": (6, "double"),
        "heading": (7, "double"),
    },
    "Metadata": {"speed_x": (1, "double"), "speed_y": (2, "double")},
    "Label": {
        "box": (1, "Box"),
        "metadata": (2, "Metadata"),
        "type": (3, "int32"),
        "id": (4, "bytes"),
        "most_visible_camera_name": (11, "bytes"),
        "camera_synced_box": (12, "Box"),
    },
    "Frame": {
        "context": (1, "bytes"),
        "timestamp_micros": (2, "int64"),
        "pose": (3, "Transform"),
        "images": (4, "bytes*"),
        "lasers": (5, "bytes*"),
        "laser_labels": (6, "bytes*"),
    },
}


def parse_message(name: str, content: bytes, where: str) -> Any:  # noqa: ANN401
    """Decode the bytes of one of the messages above.

    Raises:
        DataError: the bytes are cut off, nest too deeply, or are no such message.
    """
    message = _CLASSES[f"{_PACKAGE}.{name}"]()
    try:
        message.ParseFromString(content)
    except DecodeError as error:
        reason = " ".join(str(error).split()) or "it cannot be decoded"
        raise DataError(f"{where}: not a {name} message ({reason})") from None
    return message


def _file_descriptor() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{_PACKAGE}.proto", package=_PACKAGE, syntax="proto2"
    )
    for message_name, fields in _FIELDS.items():
        message = file.message_type.add(name=message_name)
        for name, (number, kind) in fields.items():
            field = message.field.add(name=name, number=number)
            field.label = _REPEATED if kind.endswith("*") else _OPTIONAL
            bare = kind.rstrip("*")
            field.type = _TYPES.get(bare, _TYPES["message"])
            if bare in _FIELDS:
                field.type_name = f".{_PACKAGE}.{bare}"
    return file


_CLASSES = message_factory.GetMessages([_file_descriptor()])
