"""Settings of the synthetic street: what is driven, with which sensors, recorded how well."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from lidarpainter_models.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class RigCamera:
    """One camera of the car; the default rig has the lenses of PandaSet's."""

    name: str
    focal_per_width: float
    """Focal length over the width of the image."""
    yaw_rad: float = 0.0
    """Angle from the driving direction to the left."""
    forward_m: float = 0.4
    left_m: float = 0.0
    up_m: float = 1.6
    """Position in the ego frame, whose origin is on the ground."""
    gain: float = 1.0
    """Exposure: recorded images are multiplied by it."""
    gain_drift: float = 0.0
    """How much more it is a second later, as a share of `gain`."""
    readout_s: float = 0.0
    """Time from reading the first row to the last, downwards; an image is dated to its middle."""
    delay_s: float = 0.0
    """How much later than stored its images are really taken."""
    yaw_error_rad: float = 0.0
    """How far to the left of the stored calibration it really looks."""

    def __post_init__(self) -> None:
        if self.focal_per_width <= 0 or self.gain <= 0:
            raise ConfigError(f"camera {self.name!r}: focal length and gain must be positive")
        if not 0 <= self.readout_s < 1:
            raise ConfigError(
                f"camera {self.name!r}: a readout of {self.readout_s:g} s, expected 0 to 1"
            )


DEFAULT_CAMERAS = (
    RigCamera(name="front_camera", focal_per_width=1.026),
    RigCamera(
        name="front_left_camera",
        focal_per_width=0.484,
        yaw_rad=0.995,
        forward_m=0.2,
        left_m=0.6,
        up_m=1.5,
        gain=0.9,
    ),
    RigCamera(
        name="front_right_camera",
        focal_per_width=0.484,
        yaw_rad=-0.995,
        forward_m=0.2,
        left_m=-0.6,
        up_m=1.5,
        gain=0.9,
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RigLidar:
    """A spinning LiDAR on the roof, by default like PandaSet's 64-beam one."""

    name: str = "main_pandar64"
    beams: int = 64
    """Number of beams, evenly chosen among 64 inclinations."""
    columns: int = 1800
    """Firings per turn."""
    up_m: float = 2.0
    min_range_m: float = 1.2
    max_range_m: float = 100.0
    range_noise_m: float = 0.02
    dropout: float = 0.02
    """Share of returns lost at random, beside those lost to distance, slant and glass."""
    glass_dropout: float = 0.88
    """Share of returns lost on window panes."""

    def __post_init__(self) -> None:
        if not 1 <= self.beams <= 64 or self.columns < 8:
            raise ConfigError(
                f"a LiDAR needs 1 to 64 beams and at least 8 columns, got {self.beams} and "
                f"{self.columns}"
            )
        if not 0 <= self.min_range_m < self.max_range_m or self.range_noise_m < 0:
            raise ConfigError("a LiDAR needs 0 <= min_range_m < max_range_m and no negative noise")


@dataclass(frozen=True, slots=True, kw_only=True)
class SyntheticStreetConfig:
    """One street and one drive through it. Equal settings give equal bytes."""

    seed: int
    num_frames: int = 28
    frame_interval_s: float = 0.1
    """Time of a turn of the LiDAR; images are taken in its middle."""
    width_px: int = 960
    height_px: int = 540
    samples_per_axis: int = 2
    """Rays per pixel are the square of it."""
    cameras: tuple[RigCamera, ...] = DEFAULT_CAMERAS
    lidar: RigLidar = RigLidar()
    jpeg_quality: int = 95
    sensor_noise: float = 0.006
    """Deviation of the noise in recorded images, in image values 0..1."""
    pose_noise_m: float = 0.0
    """Deviation of the stored camera positions from the true ones, per axis."""
    pose_noise_rad: float = 0.0
    """Deviation of the stored camera angles, per axis."""
    box_noise_m: float = 0.0
    """Deviation of the stored box centres, per horizontal axis."""
    box_noise_rad: float = 0.0
    """Deviation of the stored box headings."""
    camera_delay_s: float = 0.0
    """How much later than stored the images of all cameras are really taken."""
    is_readout_told: bool = True
    """Whether the stored scene says how long cameras read."""
    speed_mps: tuple[float, float] | None = None
    """First and last speed of the recording car, 0 for one that stands; None draws it."""
    are_people_walking: bool = False
    """Whether people who move swing arms and legs, or glide in mid-stride."""
    are_lamps_switching: bool = False
    """Whether signals change and cars brake, or every lamp stays as it is."""

    def __post_init__(self) -> None:
        if self.seed < 0 or self.num_frames < 1 or self.frame_interval_s <= 0:
            raise ConfigError(
                f"a street needs seed >= 0, at least one frame and a positive interval, got "
                f"seed {self.seed}, {self.num_frames} frames, {self.frame_interval_s} s"
            )
        if min(self.width_px, self.height_px) < 8 or self.samples_per_axis < 1:
            raise ConfigError("a street needs images of 8 x 8 px or more and a ray per pixel")
        if self.speed_mps is not None and min(self.speed_mps) < 0:
            raise ConfigError(f"a car drives at 0 m/s or more, got {self.speed_mps}")
        if not self.cameras:
            raise ConfigError("a street needs at least one camera")
        if len({camera.name for camera in self.cameras}) != len(self.cameras):
            raise ConfigError("two cameras of the street have the same name")

    def to_dict(self) -> dict[str, Any]:
        """Turn the settings into values that JSON can hold."""
        values = asdict(self)
        values["cameras"] = list(values["cameras"])
        values["speed_mps"] = None if self.speed_mps is None else list(self.speed_mps)
        return values

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "SyntheticStreetConfig":
        """The inverse of `to_dict`.

        Raises:
            ConfigError: a setting is unknown or missing.
        """
        try:
            given = {
                **values,
                "cameras": tuple(RigCamera(**camera) for camera in values["cameras"]),
                "lidar": RigLidar(**values["lidar"]),
            }
            if given.get("speed_mps") is not None:
                first, last = given["speed_mps"]
                given["speed_mps"] = (first, last)
            return cls(**given)
        except (KeyError, TypeError, ValueError) as error:
            known = ", ".join(field.name for field in fields(cls))
            raise ConfigError(
                f"not a synthetic street's settings: {error} (expected {known})"
            ) from None
