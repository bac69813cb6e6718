"""Which topics of a bag are which sensor: rig.toml, as `lidarpainter rig` proposes it.

licence = "my own"
clock = "header"            # or "log": when the recorder got a message
world = "map"               # the frame that stands still
ego = "base_link"           # the frame of the car
[[camera]]
name = "front"
topic = "/camera/front/image/compressed"
lens = "/camera/front/camera_info"
[[lidar]]
name = "roof"
topic = "/points"
point_time = "t"
[boxes]
topic = "/detections"
[[transform]]               # what the tree of the bag lacks
parent = "base_link"
child = "roof"
translation_m = [0.9, 0.0, 1.8]
rotation_wxyz = [1.0, 0.0, 0.0, 0.0]
"""

import json
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.scenes.schema import is_safe_name
from lidarpainter_models.scenes.validation import shown

MAX_RIG_BYTES = 1_000_000


def _safe(name: str) -> str:
    if not is_safe_name(name):
        raise ValueError("expected letters, digits, '.', '_' or '-', the first a letter or digit")
    return name


Clock = Literal["header", "log"]
"""Whose times messages have: their headers', or the recorder's when it got them."""
Number = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]


class RigPart(BaseModel):
    """A table of the file; what it does not know is refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class RigSensor(RigPart):
    """A topic of one sensor."""

    name: Annotated[str, AfterValidator(_safe)]
    """In the scene."""
    topic: str
    frame: str | None = None
    """That of its messages if absent; of a camera the optical one: x right, y down, z forward."""
    late_s: Number = 0.0
    """How much later than stamped it measures."""


class RigCamera(RigSensor):
    """A topic with images."""

    lens: str
    """Topic with its calibration."""
    is_rectified: bool = False
    """Whether images are undistorted already: then the projection holds, without distortion."""


class RigLidar(RigSensor):
    """A topic with points."""

    point_time: str | None = None
    """Field with the times of points; if absent, all are taken at the message's time."""
    is_compensated: bool = False
    """Whether points are moved to the message's time already."""


class RigBoxes(RigPart):
    """A topic with boxes of actors."""

    topic: str


class RigTransform(RigPart):
    """Where a frame stands in another, for what a bag does not say."""

    parent: str
    child: str
    translation_m: tuple[Number, Number, Number]
    rotation_wxyz: tuple[Number, Number, Number, Number] = (1.0, 0.0, 0.0, 0.0)


class BagRig(RigPart):
    """What is read of a bag, and as what."""

    licence: Annotated[str, Field(min_length=1, max_length=500)]
    """Of the recording."""
    clock: Clock = "header"
    world: str
    """Frame that stands still; that of the car where the bag says no poses."""
    ego: str
    """Frame of the car: x forward, y left, z up."""
    cameras: Annotated[tuple[RigCamera, ...], Field(alias="camera", min_length=1, max_length=100)]
    lidars: Annotated[tuple[RigLidar, ...], Field(alias="lidar", max_length=100)] = ()
    """The first is the clock of the frames."""
    boxes: RigBoxes | None = None
    transforms: Annotated[tuple[RigTransform, ...], Field(alias="transform", max_length=1000)] = ()

    @property
    def sensors(self) -> tuple[RigSensor, ...]:
        """The LiDARs, then the cameras: the first is the clock."""
        return (*self.lidars, *self.cameras)


def read_rig(file: Path) -> BagRig:
    """The rig that a TOML file says.

    Raises:
        ConfigError: the file is missing, no TOML, or lacks something; or it says what nobody knows.
    """
    try:
        if file.stat().st_size > MAX_RIG_BYTES:
            raise ConfigError(f"{file}: more than {MAX_RIG_BYTES} bytes, expected a rig.toml")
        values = tomllib.loads(file.read_text("utf-8"))
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{file}: no TOML ({error})") from None
    return rig_of(values, str(file))


def rig_of(values: Mapping[str, Any], where: str) -> BagRig:
    """The rig of the values of a TOML file.

    Raises:
        ConfigError: something is missing, unknown, of another type, or there twice.
    """
    try:
        rig = BagRig.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = " ".join(map(str, first["loc"]))
        raise ConfigError(f"{where}: {shown(place, 80)}: {first['msg']}") from None
    for what, used in (("name", "name"), ("topic", "topic")):
        given = [getattr(sensor, used) for sensor in rig.sensors]
        if twice := next((one for one in given if given.count(one) > 1), None):
            raise ConfigError(f"{where}: two sensors have the {what} {twice!r:.60}")
    return rig


def rig_text(rig: BagRig) -> str:
    """A rig as TOML; what is as by default is left out."""
    values = rig.model_dump(by_alias=True, exclude_defaults=True)
    tables = {key: value for key, value in values.items() if isinstance(value, tuple | dict)}
    lines = list(_lines({key: value for key, value in values.items() if key not in tables}))
    for key, table in tables.items():
        for row in table if isinstance(table, tuple) else [table]:
            lines += ["", f"[[{key}]]" if isinstance(table, tuple) else f"[{key}]", *_lines(row)]
    return "\n".join(lines) + "\n"


def _lines(table: Mapping[str, Any]) -> Iterator[str]:
    """Lines `name = value`; JSON writes texts, numbers, lists and truth as TOML does."""
    for name, value in table.items():
        yield f"{name} = {json.dumps(value)}"
